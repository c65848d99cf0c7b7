//! Signals to every stage and every long-running verb: each process ends within two seconds, and a
//! later run resumes from the checkpoint.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use common::large::Small;
use common::{Project, happens, is_running, signal, stage_command, stage_names, verbs};
use serde_json::json;

/// Maximum time from a signal to the end of the process.
const MAX_DELAY: Duration = Duration::from_secs(2);
/// Maximum number of attempts on a machine that is busy with other work.
const MAX_ATTEMPTS: usize = 3;
/// Time after which a started stage or verb is at work.
const STARTUP_TIME: Duration = Duration::from_millis(500);

/// A call of a stage that takes minutes, or at least many seconds.
struct Case {
    label: &'static str,
    stage: &'static str,
    params: &'static str,
    inputs: &'static [(&'static str, &'static str)],
    /// Message of the next run, which resumes from the checkpoint or the finished views.
    resume_message: Option<&'static str>,
    /// True if the stage ends within moments at any setting.
    is_short: bool,
}

const CASE: Case =
    Case { label: "", stage: "", params: "{}", inputs: &[], resume_message: None, is_short: false };

const CASES: &[Case] = &[
    Case {
        stage: "camera-path",
        params: r#"{"frames": 10000, "kind": "between"}"#,
        inputs: &[("cameras", "scene/train")],
        is_short: true,
        ..CASE
    },
    Case {
        stage: "demo-scene",
        params: r#"{"size": 2048, "samples_per_axis": 16, "train": 1, "test": 1}"#,
        ..CASE
    },
    Case { stage: "eval", inputs: &[("views", "photographs"), ("truth", "photographs")], ..CASE },
    Case {
        label: "its mesh",
        stage: "export",
        params: r#"{"resolution": 512}"#,
        inputs: &[("field", "field"), ("cameras", "scene/train-cameras")],
        ..CASE
    },
    Case {
        label: "a large view",
        stage: "export",
        params: r#"{"size": 4096}"#,
        inputs: &[("field", "field"), ("cameras", "one-camera")],
        ..CASE
    },
    Case { stage: "prep", inputs: &[("dataset", "large-data")], ..CASE },
    Case {
        stage: "refine",
        inputs: &[("views", "rendered"), ("refiner", "net")],
        resume_message: Some("resuming after the parts that an earlier run has finished"),
        ..CASE
    },
    Case {
        stage: "register",
        inputs: &[("field", "field"), ("photographs", "photographs")],
        ..CASE
    },
    Case {
        stage: "render-depth",
        params: r#"{"samples_per_axis": 8, "tolerance": 0}"#,
        inputs: &[("field", "field"), ("cameras", "large-cameras")],
        resume_message: Some("resuming after the parts that an earlier run has finished"),
        ..CASE
    },
    Case { stage: "report", inputs: &[("run", "large-report")], ..CASE },
    Case { stage: "table", inputs: &[("run", "many-results")], ..CASE },
    Case { stage: "copy", inputs: &[("run", "large-film")], is_short: true, ..CASE },
    Case {
        stage: "train-refine",
        params: r#"{"steps": 1000000000, "patch_size": 16, "features": 8, "blocks": 1}"#,
        inputs: &[("views", "views"), ("truth", "scene/train")],
        resume_message: Some("resuming from step"),
        ..CASE
    },
    Case {
        label: "a large batch",
        stage: "train-refine",
        params: r#"{"batch_size": 32, "patch_size": 24, "features": 128, "blocks": 32}"#,
        inputs: &[("views", "views"), ("truth", "scene/train")],
        ..CASE
    },
    Case {
        stage: "train-ss",
        params: r#"{"rays": 1000000000000, "log2_hashmap_size": 14}"#,
        inputs: &[("scene", "scene/train")],
        resume_message: Some("resuming from step"),
        ..CASE
    },
    Case {
        label: "the paper's field",
        stage: "train-ss",
        params: r#"{"field": "mlp", "rays": 1000000000000, "max_rays_per_step": 16384}"#,
        inputs: &[("scene", "scene/train")],
        ..CASE
    },
    Case {
        stage: "upsample",
        params: r#"{"method": "liif"}"#,
        inputs: &[("views", "scene/train"), ("cameras", "large-cameras"), ("weights", "goldens")],
        ..CASE
    },
    Case { label: "ffmpeg", stage: "video", inputs: &[("run", "small-film")], ..CASE },
    Case { label: "frames", stage: "video", inputs: &[("run", "large-film")], ..CASE },
    Case {
        stage: "viewer",
        params: r#"{"resolution": 256}"#,
        inputs: &[("run", "field-run")],
        ..CASE
    },
];

/// Creates the inputs of the cases.
fn create_inputs() -> Small {
    let small = Small::new();
    small.cameras("one-camera", &[48]);
    small.cameras("large-cameras", &[48, 2048, 2048, 2048]);
    small.cameras("equal-cameras", &[2048; 4]);
    let enlarged = [("views", "scene/train"), ("cameras", "equal-cameras")];
    small.make("upsample", "{}", &enlarged, "enlarged");
    small.cameras("two-cameras", &[48, 1024]);
    let rendered = [("field", "field"), ("cameras", "two-cameras")];
    small.make("render-depth", r#"{"samples_per_axis": 1}"#, &rendered, "rendered");
    // Views serve as photographs: without a manifest their kind is unknown.
    std::os::unix::fs::symlink(goldens(), small.path("goldens")).unwrap();
    std::fs::create_dir(small.path("photographs")).unwrap();
    for part in ["images", "views.json"] {
        let target = small.path("enlarged").join(part);
        std::os::unix::fs::symlink(target, small.path("photographs").join(part)).unwrap();
    }
    small.large_photographs("large-data", 4096);
    let scored = [("views", "views"), ("truth", "scene/train")];
    small.make("eval", "{}", &scored, "metrics");
    let scene = json!({"scene": {"folder": small.path("scene/train")}});
    small.record("field-run", &[small.node("train-ss", "field", "field", &scene)]);
    let views_node = |folder: &str| small.node("render-depth", "views", folder, &json!({}));
    small.record("small-film", &[views_node("views")]);
    small.record("large-film", &[views_node("enlarged")]);
    let eval_inputs = json!({"views": {"node": 0}, "truth": {"folder": small.path("photographs")}});
    let result = small.node("eval", "metrics", "metrics", &eval_inputs);
    small.record("large-report", &[views_node("enlarged"), result.clone()]);
    let mut nodes = vec![views_node("views")];
    nodes.resize(3000, result);
    small.record("many-results", &nodes);
    small.project.program("bin/ffmpeg", "#!/bin/sh\necho $$ > \"$0.pid\"\nexec sleep 60\n");
    small
}

fn goldens() -> PathBuf {
    common::root().join("stages/upsample/tests/goldens")
}

/// Process whose stderr is read while the process runs.
struct Running {
    child: Child,
    stderr: Arc<Mutex<String>>,
    reader: std::thread::JoinHandle<()>,
}

/// End of a process that got a signal.
struct Ended {
    /// Time from the signal to the end; `None` if the process ended before the signal.
    delay: Option<Duration>,
    code: Option<i32>,
    stderr: String,
}

impl Running {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let stderr = Arc::new(Mutex::new(String::new()));
        let (pipe, collected) = (BufReader::new(child.stderr.take().unwrap()), Arc::clone(&stderr));
        let reader = std::thread::spawn(move || {
            for line in pipe.lines().map_while(Result::ok) {
                *lock(&collected) += &(line + "\n");
            }
        });
        Self { child, stderr, reader }
    }

    /// Sends a signal when the process is ready, and waits for the end.
    #[track_caller]
    fn interrupt(mut self, mut is_ready: impl FnMut(&str) -> bool) -> Ended {
        let mut status = None;
        let ready = || {
            status = self.child.try_wait().unwrap();
            status.is_some() || is_ready(&lock(&self.stderr))
        };
        assert!(happens(ready), "the process isn't ready: {}", lock(&self.stderr));
        let sent = status.is_none().then(Instant::now);
        if sent.is_some() {
            // Background jobs of a shell ignore SIGINT, and so do their verbs without a handler.
            signal(&self.child, if ignores_sigint(&self.child) { "-TERM" } else { "-INT" });
        }
        let deadline = Instant::now() + 10 * MAX_DELAY;
        while status.is_none() && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(10));
            status = self.child.try_wait().unwrap();
        }
        let delay = sent.map(|sent| sent.elapsed());
        self.child.kill().ok();
        self.child.wait().unwrap();
        self.reader.join().unwrap();
        let stderr = lock(&self.stderr).clone();
        Ended { delay, code: status.and_then(|status| status.code()), stderr }
    }
}

/// True if a process ignores SIGINT, by the kernel's mask of ignored signals.
fn ignores_sigint(child: &Child) -> bool {
    let status =
        std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).map(str::trim);
    mask.and_then(|mask| u64::from_str_radix(mask, 16).ok()).is_some_and(|mask| mask & 2 != 0)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the end of an attempt, which must be within [`MAX_DELAY`]. Late attempts are repeated
/// only while other work loads the machine.
fn retry_while_busy(label: &str, mut attempt: impl FnMut(usize) -> Ended) -> Ended {
    // Tests of this file run one at a time.
    static TURN: Mutex<()> = Mutex::new(());
    let _turn = lock(&TURN);
    for number in 1.. {
        let ended = attempt(number);
        let Some(delay) = ended.delay.filter(|delay| *delay > MAX_DELAY) else { return ended };
        let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
        let busy: f64 = load.split(' ').next().and_then(|text| text.parse().ok()).unwrap_or(0.0);
        let cores = stage::processors().count;
        let message = format!("{label}: {delay:?} from the signal to the end; load {busy}");
        assert!(number < MAX_ATTEMPTS && busy > cores as f64, "{message}\n{}", ended.stderr);
        eprintln!("{message}: trying again");
    }
    unreachable!("the last attempt has failed")
}

/// True if a work folder has a checkpoint or a finished part.
fn has_saved_work(work: &Path) -> bool {
    let is_saved = |entry: walkdir::DirEntry| {
        let folder = entry.path().parent().and_then(Path::file_name).unwrap_or_default();
        let is_complete = !folder.to_string_lossy().starts_with('.');
        ["checkpoint.safetensors", "artifact.json"].iter().any(|name| entry.file_name() == *name)
            && is_complete
    };
    walkdir::WalkDir::new(work).into_iter().flatten().any(is_saved)
}

/// Starts a case's stage, and interrupts it when `is_ready` accepts the stderr.
#[track_caller]
fn interrupt_stage(
    small: &Small,
    case: &Case,
    folder: &Path,
    mut is_ready: impl FnMut(&str) -> bool,
) -> Ended {
    let inputs: Vec<(&str, PathBuf)> =
        case.inputs.iter().map(|(name, folder)| (*name, small.path(folder))).collect();
    let input_folders: Vec<(&str, &Path)> =
        inputs.iter().map(|(name, folder)| (*name, folder.as_path())).collect();
    let (output, work) = (folder.join("out"), folder.join("work"));
    let arguments = ["--work", work.to_str().unwrap(), "--progress", "plain"];
    let mut command = stage_command(case.stage, case.params, &input_folders, &output, &arguments);
    let path = std::env::var("PATH").unwrap_or_default();
    command.env("PATH", format!("{}:{path}", small.path("bin").display()));
    let partial = folder.join(".out.partial");
    let mut started = None;
    let ended = Running::start(&mut command).interrupt(|stderr| {
        // A stage with a partial output handles signals.
        if started.is_none() && partial.exists() {
            started = Some(Instant::now());
        }
        started.is_some_and(|started: Instant| started.elapsed() > STARTUP_TIME) && is_ready(stderr)
    });
    if case.is_short && ended.code == Some(0) {
        return ended;
    }
    let label = format!("{} {}", case.stage, case.label);
    assert!(ended.delay.is_some(), "{label}: ended before the signal: {}", ended.stderr);
    let last_line = ended.stderr.lines().last().unwrap_or_default();
    let is_reported = last_line.starts_with(&format!("{}: ", case.stage))
        && last_line.ends_with("interrupted; run again to resume");
    assert!(is_reported, "{label}: {}", ended.stderr);
    assert_eq!(ended.code, Some(130), "{label}");
    assert!(!output.exists() && !partial.exists(), "{label}: a part of the output is left");
    ended
}

#[test]
fn every_stage_ends_within_two_seconds_of_a_signal() {
    let small = create_inputs();
    for name in stage_names() {
        assert!(CASES.iter().any(|case| case.stage == name), "stage {name} has no case");
    }
    for case in CASES {
        let label = format!("{} {}", case.stage, case.label);
        let mut folder = PathBuf::new();
        let ended = retry_while_busy(&label, |attempt| {
            folder = small.path(&format!("{label}{attempt}"));
            std::fs::create_dir(&folder).unwrap();
            let work = folder.join("work");
            let is_ready = |_: &str| case.resume_message.is_none() || has_saved_work(&work);
            interrupt_stage(&small, case, &folder, is_ready)
        });
        eprintln!("{label}: {:?}", ended.delay);
        if let Some(message) = case.resume_message {
            let has_resumed = |stderr: &str| stderr.contains(message);
            retry_while_busy(&label, |_| interrupt_stage(&small, case, &folder, has_resumed));
        }
    }
    let ffmpeg = std::fs::read_to_string(small.path("bin/ffmpeg.pid")).unwrap();
    assert!(!is_running(ffmpeg.trim()), "ffmpeg still runs after its stage has ended");
}

/// Creates a project with a data set and an artifact that take minutes to read.
fn large_project() -> Project {
    let project = Project::fast();
    project.ok(&["run", "prep"]);
    let data = project.path("large");
    std::fs::create_dir(&data).unwrap();
    for entry in project.artifact("demo-scene", &["prep"]).read_dir().unwrap() {
        let entry = entry.unwrap();
        if entry.file_name() != artifact::MANIFEST_FILE {
            std::os::unix::fs::symlink(entry.path(), data.join(entry.file_name())).unwrap();
        }
    }
    write_sparse(&data.join("notes.bin"));
    project.write(LARGE_PIPELINE, &common::FAST.replace("dataset: demo-scene", "dataset: ./large"));
    let object = project.path(".nerf-sr/objects/new");
    std::fs::create_dir(&object).unwrap();
    std::fs::write(object.join("notes.bin"), "").unwrap();
    let mut manifest =
        serde_json::to_value(artifact::Manifest::of_folder("text", &object).unwrap()).unwrap();
    manifest["files"][0]["size"] = json!(SPARSE_BYTES);
    write_sparse(&object.join("notes.bin"));
    artifact::write_json(&object.join(artifact::MANIFEST_FILE), &manifest).unwrap();
    let identity = artifact::Manifest::read(&object).unwrap().identity().to_string();
    std::fs::rename(&object, object.with_file_name(identity)).unwrap();
    project
}

/// File of the fast pipeline with the large data set.
const LARGE_PIPELINE: &str = "large.yaml";
const SPARSE_BYTES: u64 = 1 << 38;

fn write_sparse(path: &Path) {
    std::fs::File::create(path).unwrap().set_len(SPARSE_BYTES).unwrap();
}

/// Returns a verb's calls that read the large data set or artifact, or run a slow stage; empty if
/// the verb does neither.
fn large_calls(verb: &String) -> Vec<String> {
    let large_scene = "-p demo-scene.size=2048 -p demo-scene.samples_per_axis=16";
    match verb.as_str() {
        "run" => vec!["run prep".to_owned(), format!("run demo-scene {large_scene}")],
        "plan" | "status" | "graph" | "why" | "log" | "path" => vec![format!("{verb} prep")],
        "pin" => vec!["pin mine prep".to_owned()],
        "gc" => vec!["gc --keep-days 0 prep".to_owned()],
        "diff" => vec!["diff prep prep".to_owned()],
        "verify" | "advise" => vec![verb.clone()],
        "init" | "cancel" | "unpin" | "describe" | "completions" => Vec::new(),
        other => panic!("verb {other} has no case"),
    }
}

#[test]
fn every_verb_ends_within_two_seconds_of_a_signal() {
    let project = large_project();
    for call in verbs().iter().flat_map(large_calls) {
        let arguments =
            [&call.split(' ').collect::<Vec<_>>()[..], &["--pipeline", LARGE_PIPELINE]].concat();
        let ended = retry_while_busy(&call, |_| {
            let started = Instant::now();
            let running = Running::start(&mut project.command(&arguments));
            running.interrupt(|_| started.elapsed() > STARTUP_TIME)
        });
        eprintln!("{call}: {:?}", ended.delay);
        assert!(ended.delay.is_some(), "{call}: ended before the signal: {}", ended.stderr);
        // Verbs that change nothing have no handler: the signal ends them, without an exit code.
        assert!([None, Some(130)].contains(&ended.code), "{call}: {:?}", ended.code);
    }
    project.ok(&["run", "prep"]);
}
