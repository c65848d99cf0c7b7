//! One signal to every stage and to every long verb, at settings at which they work for long: each
//! ends within two seconds, and a later run resumes from its checkpoint.

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

/// Time from a signal to the end of the process.
const LIMIT: Duration = Duration::from_secs(2);
/// Attempts on a machine that is busy with something else.
const ATTEMPTS: usize = 3;
/// Time after which a stage or verb is at its work.
const UNDER_WAY: Duration = Duration::from_millis(500);

/// A call of a stage that takes minutes, or at least many seconds.
struct Case {
    label: &'static str,
    stage: &'static str,
    params: &'static str,
    inputs: &'static [(&'static str, &'static str)],
    /// Words of the next run, which resumes from the checkpoint or the finished views.
    goes_on: Option<&'static str>,
    /// True if the stage is over in a moment at any setting.
    is_short: bool,
}

const CASE: Case =
    Case { label: "", stage: "", params: "{}", inputs: &[], goes_on: None, is_short: false };

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
        goes_on: Some("resuming after the parts that an earlier run has finished"),
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
        goes_on: Some("resuming after the parts that an earlier run has finished"),
        ..CASE
    },
    Case { stage: "report", inputs: &[("run", "large-report")], ..CASE },
    Case { stage: "table", inputs: &[("run", "many-results")], ..CASE },
    Case { stage: "copy", inputs: &[("run", "large-film")], is_short: true, ..CASE },
    Case {
        stage: "train-refine",
        params: r#"{"steps": 1000000000, "patch_size": 16, "features": 8, "blocks": 1}"#,
        inputs: &[("views", "views"), ("truth", "scene/train")],
        goes_on: Some("resuming from step"),
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
        goes_on: Some("resuming from step"),
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

/// Makes the inputs of the cases.
fn inputs() -> Small {
    let small = Small::new();
    small.cameras("one-camera", &[48]);
    small.cameras("large-cameras", &[48, 2048, 2048, 2048]);
    small.cameras("equal-cameras", &[2048; 4]);
    let enlarged = [("views", "scene/train"), ("cameras", "equal-cameras")];
    small.make("upsample", "{}", &enlarged, "enlarged");
    small.cameras("two-cameras", &[48, 1024]);
    let rendered = [("field", "field"), ("cameras", "two-cameras")];
    small.make("render-depth", r#"{"samples_per_axis": 1}"#, &rendered, "rendered");
    // Views as photographs: without a manifest their kind isn't known.
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
    let film = |folder: &str| small.node("render-depth", "views", folder, &json!({}));
    small.record("small-film", &[film("views")]);
    small.record("large-film", &[film("enlarged")]);
    let both = json!({"views": {"node": 0}, "truth": {"folder": small.path("photographs")}});
    let result = small.node("eval", "metrics", "metrics", &both);
    small.record("large-report", &[film("enlarged"), result.clone()]);
    let mut many = vec![film("views")];
    many.resize(3000, result);
    small.record("many-results", &many);
    small.project.program("bin/ffmpeg", "#!/bin/sh\necho $$ > \"$0.pid\"\nexec sleep 60\n");
    small
}

fn goldens() -> PathBuf {
    common::root().join("stages/upsample/tests/goldens")
}

/// A process whose stderr is read while it runs.
struct Running {
    child: Child,
    said: Arc<Mutex<String>>,
    reader: std::thread::JoinHandle<()>,
}

/// End of a process that got a signal.
struct Ended {
    /// Time from the signal; none if the process ended before.
    after: Option<Duration>,
    code: Option<i32>,
    stderr: String,
}

impl Running {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let said = Arc::new(Mutex::new(String::new()));
        let (pipe, heard) = (BufReader::new(child.stderr.take().unwrap()), Arc::clone(&said));
        let reader = std::thread::spawn(move || {
            for line in pipe.lines().map_while(Result::ok) {
                *locked(&heard) += &(line + "\n");
            }
        });
        Self { child, said, reader }
    }

    /// Sends SIGINT when the process is ready for it, and waits for the end.
    #[track_caller]
    fn interrupt(mut self, mut is_ready: impl FnMut(&str) -> bool) -> Ended {
        let mut status = None;
        let ready = || {
            status = self.child.try_wait().unwrap();
            status.is_some() || is_ready(&locked(&self.said))
        };
        assert!(happens(ready), "it isn't ready: {}", locked(&self.said));
        let sent = status.is_none().then(Instant::now);
        if sent.is_some() {
            // A shell in the background has SIGINT ignored; verbs without a handler leave that so.
            signal(&self.child, if ignores_sigint(&self.child) { "-TERM" } else { "-INT" });
        }
        let too_late = Instant::now() + 10 * LIMIT;
        while status.is_none() && Instant::now() < too_late {
            std::thread::sleep(Duration::from_millis(10));
            status = self.child.try_wait().unwrap();
        }
        let after = sent.map(|sent| sent.elapsed());
        self.child.kill().ok();
        self.child.wait().unwrap();
        self.reader.join().unwrap();
        let stderr = locked(&self.said).clone();
        Ended { after, code: status.and_then(|status| status.code()), stderr }
    }
}

/// True if a process ignores SIGINT, by the kernel's mask of ignored signals.
fn ignores_sigint(child: &Child) -> bool {
    let status =
        std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).map(str::trim);
    mask.and_then(|mask| u64::from_str_radix(mask, 16).ok()).is_some_and(|mask| mask & 2 != 0)
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Repeats an attempt that takes too long while the machine has other work: the limit holds on a
/// machine of one's own.
fn in_time(label: &str, mut attempt: impl FnMut(usize) -> Ended) -> Ended {
    // Tests of this file take turns.
    static TURN: Mutex<()> = Mutex::new(());
    let _turn = locked(&TURN);
    for number in 1.. {
        let ended = attempt(number);
        let Some(after) = ended.after.filter(|after| *after > LIMIT) else { return ended };
        let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
        let busy: f64 = load.split(' ').next().and_then(|text| text.parse().ok()).unwrap_or(0.0);
        let cores = stage::processors().count;
        let words = format!("{label}: {after:?} from the signal to its end; load {busy}");
        assert!(number < ATTEMPTS && busy > cores as f64, "{words}\n{}", ended.stderr);
        eprintln!("{words}: tried again");
    }
    unreachable!("the last attempt has failed")
}

/// True if a work folder has a checkpoint or a finished part.
fn keeps_something(work: &Path) -> bool {
    let is_kept = |entry: walkdir::DirEntry| {
        let folder = entry.path().parent().and_then(Path::file_name).unwrap_or_default();
        let is_whole = !folder.to_string_lossy().starts_with('.');
        ["checkpoint.safetensors", "artifact.json"].iter().any(|name| entry.file_name() == *name)
            && is_whole
    };
    walkdir::WalkDir::new(work).into_iter().flatten().any(is_kept)
}

/// Starts a case's stage with a work folder, and interrupts it when it is ready.
#[track_caller]
fn interrupt_stage(
    small: &Small,
    case: &Case,
    folder: &Path,
    mut is_ready: impl FnMut(&str) -> bool,
) -> Ended {
    let inputs: Vec<(&str, PathBuf)> =
        case.inputs.iter().map(|(name, folder)| (*name, small.path(folder))).collect();
    let given: Vec<(&str, &Path)> =
        inputs.iter().map(|(name, folder)| (*name, folder.as_path())).collect();
    let (output, work) = (folder.join("out"), folder.join("work"));
    let more = ["--work", work.to_str().unwrap(), "--progress", "plain"];
    let mut command = stage_command(case.stage, case.params, &given, &output, &more);
    let path = std::env::var("PATH").unwrap_or_default();
    command.env("PATH", format!("{}:{path}", small.path("bin").display()));
    let partial = folder.join(".out.partial");
    let mut begun = None;
    let ended = Running::start(&mut command).interrupt(|said| {
        // From then on signals are handled.
        if begun.is_none() && partial.exists() {
            begun = Some(Instant::now());
        }
        begun.is_some_and(|begun: Instant| begun.elapsed() > UNDER_WAY) && is_ready(said)
    });
    if case.is_short && ended.code == Some(0) {
        return ended;
    }
    let label = format!("{} {}", case.stage, case.label);
    assert!(ended.after.is_some(), "{label}: it ended before the signal: {}", ended.stderr);
    let last = ended.stderr.lines().last().unwrap_or_default();
    let is_told = last.starts_with(&format!("{}: ", case.stage))
        && last.ends_with("interrupted; run again to resume");
    assert!(is_told, "{label}: {}", ended.stderr);
    assert_eq!(ended.code, Some(130), "{label}");
    assert!(!output.exists() && !partial.exists(), "{label}: something is left of its output");
    ended
}

#[test]
fn every_stage_ends_two_seconds_after_a_signal() {
    let small = inputs();
    for name in stage_names() {
        assert!(CASES.iter().any(|case| case.stage == name), "stage {name} has no case");
    }
    for case in CASES {
        let label = format!("{} {}", case.stage, case.label);
        let mut folder = PathBuf::new();
        let ended = in_time(&label, |attempt| {
            folder = small.path(&format!("{label}{attempt}"));
            std::fs::create_dir(&folder).unwrap();
            let work = folder.join("work");
            let is_ready = |_: &str| case.goes_on.is_none() || keeps_something(&work);
            interrupt_stage(&small, case, &folder, is_ready)
        });
        eprintln!("{label}: {:?}", ended.after);
        if let Some(words) = case.goes_on {
            let is_going_on = |said: &str| said.contains(words);
            in_time(&label, |_| interrupt_stage(&small, case, &folder, is_going_on));
        }
    }
    let ffmpeg = std::fs::read_to_string(small.path("bin/ffmpeg.pid")).unwrap();
    assert!(!is_running(ffmpeg.trim()), "ffmpeg still runs without its stage");
}

/// A data set, and an artifact, that take minutes to read.
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
    sparse(&data.join("notes.bin"));
    project.write(LARGE, &common::FAST.replace("dataset: demo-scene", "dataset: ./large"));
    let object = project.path(".nerf-sr/objects/new");
    std::fs::create_dir(&object).unwrap();
    std::fs::write(object.join("notes.bin"), "").unwrap();
    let mut manifest =
        serde_json::to_value(artifact::Manifest::of_folder("text", &object).unwrap()).unwrap();
    manifest["files"][0]["size"] = json!(SPARSE_BYTES);
    sparse(&object.join("notes.bin"));
    artifact::write_json(&object.join(artifact::MANIFEST_FILE), &manifest).unwrap();
    let identity = artifact::Manifest::read(&object).unwrap().identity().to_string();
    std::fs::rename(&object, object.with_file_name(identity)).unwrap();
    project
}

/// The fast pipeline on the large data set.
const LARGE: &str = "large.yaml";
const SPARSE_BYTES: u64 = 1 << 38;

fn sparse(path: &Path) {
    std::fs::File::create(path).unwrap().set_len(SPARSE_BYTES).unwrap();
}

/// Calls of a verb that read the large data set or artifact, or run a stage that works for long;
/// none of a verb that does neither.
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
fn every_verb_ends_two_seconds_after_a_signal() {
    let project = large_project();
    for call in verbs().iter().flat_map(large_calls) {
        let words = [&call.split(' ').collect::<Vec<_>>()[..], &["--pipeline", LARGE]].concat();
        let ended = in_time(&call, |_| {
            let begun = Instant::now();
            let running = Running::start(&mut project.command(&words));
            running.interrupt(|_| begun.elapsed() > UNDER_WAY)
        });
        eprintln!("{call}: {:?}", ended.after);
        assert!(ended.after.is_some(), "{call}: it ended before the signal: {}", ended.stderr);
        // Verbs that change nothing leave the signal to the system.
        assert!([None, Some(130)].contains(&ended.code), "{call}: {:?}", ended.code);
    }
    project.ok(&["run", "prep"]);
}
