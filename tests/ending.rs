//! Early ends of runs: signals during long work, second signals and killed runners, also with a
//! stage behind a wrapper script.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::process::Child;
use std::time::{Duration, Instant};

use common::{Finished, Project, bin, is_running, last_checkpoint, signal, wait_until};

/// Maximum time from a signal to the end of a run.
const MAX_DELAY: Duration = Duration::from_secs(2);
/// Arguments of a run whose training lasts until a signal.
const ENDLESS_RUN: [&str; 3] = ["run", "-p", "train-ss.rays=4000000000"];

/// Sends a signal to a run, which must end promptly. Returns the run's exit code and output.
#[track_caller]
fn end_promptly(child: Child, name: &str) -> Finished {
    signal(&child, name);
    let sent = Instant::now();
    let finished = Finished::of(child.wait_with_output().unwrap());
    assert!(sent.elapsed() < MAX_DELAY, "{name}: {:?}: {}", sent.elapsed(), finished.stderr);
    finished
}

/// Creates a project with one stage, which runs shell commands; `$out` is the stage's output.
fn project_with_script(commands: &str) -> Project {
    let project = Project::new("default: [talk]\nstages:\n  talk: {run: ./talk}\n");
    let description = r#"{"name": "talk", "version": "1", "code": "1", "summary": "Talks.",
        "inputs": {}, "parameters": {"type": "object"}, "output": {"kind": "text"}}"#;
    let script = format!(
        "#!/bin/sh\nif [ \"$1\" = describe ]; then echo '{description}'; exit; fi\n\
         while [ $# -gt 0 ]; do case $1 in --output) out=$2;; esac; shift; done\n{commands}\n"
    );
    project.program("talk", &script);
    project
}

#[test]
fn hashing_a_large_data_set_is_reported_and_ends_after_a_signal() {
    let project = Project::fast();
    fs::create_dir(project.path("data")).unwrap();
    File::create(project.path("data/stray.bin")).unwrap().set_len(1 << 38).unwrap();
    // A background process of a shell ignores SIGINT; unlike `run`, `plan` doesn't change this.
    for (verb, name, code) in [("run", "-INT", 130), ("plan", "-TERM", -1)] {
        let mut child = project.spawn(&[verb, "prep", "-i", "dataset=data"]);
        let lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let line = lines.into_iter().find(|line| line.starts_with("hashing ")).unwrap();
        assert!(line.ends_with(" of 274.9 GB"), "{line}");
        assert_eq!(end_promptly(child, name).code, code, "{verb}");
    }
}

/// Shell commands that ignore signals and start a process that ignores SIGTERM. Process IDs are
/// written to the files `self` and `left`.
const IGNORE_SIGNALS: &str =
    "trap '' TERM INT HUP; (trap '' TERM; sleep 1000) & echo $! > left; echo $$ > self; wait; wait";

#[test]
fn the_second_signal_kills_a_stage_that_ignores_the_first() {
    let project = project_with_script(IGNORE_SIGNALS);
    let child = project.spawn(&["run"]);
    wait_until(|| fs::read_to_string(project.path("self")).is_ok_and(|text| text.ends_with('\n')));
    let processes = ["self", "left"].map(|file| fs::read_to_string(project.path(file)).unwrap());
    signal(&child, "-INT");
    std::thread::sleep(Duration::from_millis(300));
    assert!(is_running(&child.id().to_string()), "the first signal waits for the stage");
    let finished = end_promptly(child, "-INT");
    assert_eq!(finished.code, 130, "{}", finished.stderr);
    wait_until(|| processes.iter().all(|process| !is_running(process.trim())));
    // The killed stage's lock is free.
    project.program(
        "talk",
        &fs::read_to_string(project.path("talk"))
            .unwrap()
            .replace(IGNORE_SIGNALS, "mkdir $out; echo text > $out/text"),
    );
    let again = project.run(&["run"]);
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert!(!again.stderr.contains("is being created"), "{}", again.stderr);
}

/// Creates a fast project whose training runs behind a wrapper script, as its child process.
fn wrapped_project() -> Project {
    let project = Project::fast();
    project.replace("  train-ss:\n", "  train-ss:\n    run: ./wrap\n");
    let train = bin("train-ss").display().to_string();
    let script = format!("#!/bin/sh\necho $$ >> wrappers\n'{train}' \"$@\"\ncode=$?\nexit $code\n");
    project
        .program("wrap", &script.replace("wrappers", project.path("wrappers").to_str().unwrap()));
    project
}

#[test]
fn a_stage_runs_behind_a_wrapper_script() {
    let (project, plain) = (wrapped_project(), Project::fast());
    project.ok(&["run", "eval"]);
    plain.ok(&["run", "eval"]);
    assert_eq!(project.output_of("eval", &["eval"]), plain.output_of("eval", &["eval"]));
}

/// Returns the IDs of running processes whose command lines contain a program and a folder.
fn processes(program: &str, folder: &str) -> Vec<String> {
    let entries = fs::read_dir("/proc").unwrap().flatten();
    let is_match = |process: &String| {
        let command_line =
            fs::read_to_string(format!("/proc/{process}/cmdline")).unwrap_or_default();
        command_line.contains(program) && command_line.contains(folder) && is_running(process)
    };
    entries.filter_map(|entry| entry.file_name().into_string().ok()).filter(is_match).collect()
}

#[test]
fn a_stage_ends_with_its_runner_and_leaves_a_checkpoint() {
    for (project, variant) in [(Project::fast(), "plain"), (wrapped_project(), "wrapped")] {
        let partial = project.path(".nerf-sr/partial");
        let folder = partial.to_str().unwrap();
        let mut child = project.spawn(&ENDLESS_RUN);
        wait_until(|| last_checkpoint(&partial).is_some());
        assert!(!processes("train-ss", folder).is_empty());
        child.kill().unwrap();
        child.wait().unwrap();
        let killed = Instant::now();
        wait_until(|| processes("train-ss", folder).is_empty());
        assert!(killed.elapsed() < Duration::from_secs(10), "{variant}: {:?}", killed.elapsed());
        // The next run resumes from the checkpoint and, after a signal, leaves a newer one.
        let before = last_checkpoint(&partial);
        let child = project.spawn(&ENDLESS_RUN);
        wait_until(|| !processes("train-ss", folder).is_empty());
        wait_until(|| last_checkpoint(&partial) > before);
        let before = last_checkpoint(&partial);
        signal(&child, "-INT");
        let finished = Finished::of(child.wait_with_output().unwrap());
        assert_eq!(finished.code, 130, "{variant}: {}", finished.stderr);
        assert!(finished.stderr.contains("resuming from step"), "{variant}: {}", finished.stderr);
        assert!(finished.stderr.contains("interrupted"), "{variant}: {}", finished.stderr);
        assert!(last_checkpoint(&partial) > before, "{variant}: no newer checkpoint at the end");
    }
}

/// A stage that resumes from a checkpoint has the time of its earlier, failed calls in its record.
#[test]
fn a_resumed_stage_counts_its_earlier_time() {
    let project = project_with_script(
        "work=$(dirname \"$out\")/work
if [ -e \"$work/x\" ]; then mkdir \"$out\"; echo 1 > \"$out/x\"; exit; fi
mkdir -p \"$work\"; echo 1 > \"$work/x\"; sleep 1; exit 1",
    );
    project.run(&["run"]).fails(1, &["talk"]);
    project.ok(&["run"]);
    let records = fs::read_dir(project.path(".nerf-sr/actions")).unwrap().flatten();
    let mut records = records.map(|entry| entry.path());
    let record = records.find(|path| path.extension().is_some_and(|end| end == "json")).unwrap();
    let record: serde_json::Value = serde_json::from_slice(&fs::read(record).unwrap()).unwrap();
    assert!(record["seconds"].as_f64().unwrap() > 1.0, "{record}");
}
