//! Early ends of runs: signals during long work, second signals, killed runners, and all of this
//! behind wrapper scripts.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::process::Child;
use std::time::{Duration, Instant};

use common::{Finished, Project, bin, is_running, last_checkpoint, signal, wait_until};

/// Time in which a run ends after a signal.
const PROMPT: Duration = Duration::from_secs(2);
/// A training that lasts until it is ended.
const ENDLESS: [&str; 3] = ["run", "-p", "train-ss.rays=4000000000"];

/// Sends a signal, and returns what the run left; it must end promptly.
#[track_caller]
fn ends_promptly(child: Child, name: &str) -> Finished {
    signal(&child, name);
    let sent = Instant::now();
    let finished = Finished::of(child.wait_with_output().unwrap());
    assert!(sent.elapsed() < PROMPT, "{name}: {:?}: {}", sent.elapsed(), finished.stderr);
    finished
}

/// A stage that is a shell script; `$out` is its output.
fn scripted(run: &str) -> Project {
    let project = Project::new("default: [talk]\nstages:\n  talk: {run: ./talk}\n");
    let description = r#"{"name": "talk", "version": "1", "code": "1", "summary": "Talks.",
        "inputs": {}, "parameters": {"type": "object"}, "output": {"kind": "text"}}"#;
    let script = format!(
        "#!/bin/sh\nif [ \"$1\" = describe ]; then echo '{description}'; exit; fi\n\
         while [ $# -gt 0 ]; do case $1 in --output) out=$2;; esac; shift; done\n{run}\n"
    );
    project.program("talk", &script);
    project
}

#[test]
fn hashing_a_large_data_set_is_told_and_ends_with_the_signal() {
    let project = Project::fast();
    fs::create_dir(project.path("data")).unwrap();
    File::create(project.path("data/stray.bin")).unwrap().set_len(1 << 38).unwrap();
    // A shell in the background has SIGINT ignored; `plan` leaves that so.
    for (verb, name, code) in [("run", "-INT", 130), ("plan", "-TERM", -1)] {
        let mut child = project.spawn(&[verb, "prep", "-i", "dataset=data"]);
        let lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let said = lines.into_iter().find(|line| line.starts_with("hashing ")).unwrap();
        assert!(said.ends_with(" of 274.9 GB"), "{said}");
        assert_eq!(ends_promptly(child, name).code, code, "{verb}");
    }
}

/// Ignores the request to end, as does what it starts beside itself.
const STUBBORN: &str =
    "trap '' TERM INT HUP; (trap '' TERM; sleep 1000) & echo $! > left; echo $$ > self; wait; wait";

#[test]
fn the_second_signal_kills_a_stage_that_ignores_the_first() {
    let project = scripted(STUBBORN);
    let child = project.spawn(&["run"]);
    wait_until(|| fs::read_to_string(project.path("self")).is_ok_and(|text| text.ends_with('\n')));
    let processes = ["self", "left"].map(|file| fs::read_to_string(project.path(file)).unwrap());
    signal(&child, "-INT");
    std::thread::sleep(Duration::from_millis(300));
    assert!(is_running(&child.id().to_string()), "the first signal waits for the stage");
    let finished = ends_promptly(child, "-INT");
    assert_eq!(finished.code, 130, "{}", finished.stderr);
    wait_until(|| processes.iter().all(|process| !is_running(process.trim())));
    // Nobody holds its lock.
    project.program(
        "talk",
        &fs::read_to_string(project.path("talk"))
            .unwrap()
            .replace(STUBBORN, "mkdir $out; echo text > $out/text"),
    );
    let again = project.run(&["run"]);
    assert_eq!(again.code, 0, "{}", again.stderr);
    assert!(!again.stderr.contains("is being created"), "{}", again.stderr);
}

/// The fast pipeline, its training behind a script that doesn't replace itself.
fn wrapped() -> Project {
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
    let (project, plain) = (wrapped(), Project::fast());
    project.ok(&["run", "eval"]);
    plain.ok(&["run", "eval"]);
    assert_eq!(project.output_of("eval", &["eval"]), plain.output_of("eval", &["eval"]));
}

/// The processes that run this program with this folder among their arguments.
fn processes(program: &str, folder: &str) -> Vec<String> {
    let entries = fs::read_dir("/proc").unwrap().flatten();
    let has_it = |process: &String| {
        let words = fs::read_to_string(format!("/proc/{process}/cmdline")).unwrap_or_default();
        words.contains(program) && words.contains(folder) && is_running(process)
    };
    entries.filter_map(|entry| entry.file_name().into_string().ok()).filter(has_it).collect()
}

#[test]
fn a_stage_ends_with_its_runner_and_leaves_a_checkpoint() {
    for (project, what) in [(Project::fast(), "plain"), (wrapped(), "wrapped")] {
        let partial = project.path(".nerf-sr/partial");
        let folder = partial.to_str().unwrap();
        let mut child = project.spawn(&ENDLESS);
        wait_until(|| last_checkpoint(&partial).is_some());
        assert!(!processes("train-ss", folder).is_empty());
        child.kill().unwrap();
        child.wait().unwrap();
        let killed = Instant::now();
        wait_until(|| processes("train-ss", folder).is_empty());
        assert!(killed.elapsed() < Duration::from_secs(10), "{what}: {:?}", killed.elapsed());
        // After a signal, the next run resumes from the checkpoint and leaves another one.
        let before = last_checkpoint(&partial);
        let child = project.spawn(&ENDLESS);
        wait_until(|| !processes("train-ss", folder).is_empty());
        wait_until(|| last_checkpoint(&partial) > before);
        let before = last_checkpoint(&partial);
        signal(&child, "-INT");
        let finished = Finished::of(child.wait_with_output().unwrap());
        assert_eq!(finished.code, 130, "{what}: {}", finished.stderr);
        assert!(finished.stderr.contains("resuming from step"), "{what}: {}", finished.stderr);
        assert!(finished.stderr.contains("interrupted"), "{what}: {}", finished.stderr);
        assert!(last_checkpoint(&partial) > before, "{what}: no checkpoint at the end");
    }
}
