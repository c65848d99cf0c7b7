//! Inputs and programs that change while a stage runs or waits: no result is recorded, and the
//! message names the file. Folders that a run refuses before a stage starts.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use common::{Finished, Project, bin, wait_until};

/// Script of a stage that copies its input after a file `go` appears next to the script.
const SCRIPT: &str = r#"#!/bin/sh
here=$(dirname "$0")
if [ "$1" = describe ]; then
  code=$(sha256sum "$0" | cut -d' ' -f1)
  echo '{"name": "copies", "version": "1", "code": "'$code'", "summary": "Copies.",
    "inputs": {"from": {"kinds": ["text"], "summary": "what is copied"}},
    "parameters": {"type": "object"}, "output": {"kind": "text"}}'
  exit
fi
while [ $# -gt 0 ]; do case $1 in --output) out=$2;; --input) from=${2#from=};; esac; shift; done
touch "$here/started"
while [ ! -e "$here/go" ]; do sleep 0.02; done
mkdir "$out" && cat "$from"/a "$from"/b > "$out/both"
"#;

const PIPELINE: &str = "default: [copies]
stages:
  copies: {run: ./copies, inputs: {from: ./data}}
";

fn create_project(pipeline: &str) -> Project {
    let project = Project::new(pipeline);
    project.program("copies", SCRIPT);
    project.write("data/a", "one\n");
    project.write("data/b", "two\n");
    project
}

/// Runs the pipeline, and calls `change` after the stage has started.
fn run_and_change(project: &Project, change: &dyn Fn(&Project)) -> Finished {
    let child = project.spawn(&["run"]);
    wait_until(|| project.path("started").exists());
    change(project);
    project.write("go", "");
    Finished::of(child.wait_with_output().unwrap())
}

/// Overwrites a file and restores its modification time.
fn rewrite(file: &Path, text: &str) {
    let time = file.metadata().unwrap().modified().unwrap();
    fs::write(file, text).unwrap();
    fs::File::options().write(true).open(file).unwrap().set_modified(time).unwrap();
}

#[test]
fn a_change_while_a_stage_runs_prevents_a_record() {
    type Change = dyn Fn(&Project);
    fn a(project: &Project) -> PathBuf {
        project.path("data/a")
    }
    fn b(project: &Project) -> PathBuf {
        project.path("data/b")
    }
    let table: [(&Change, i32, &str); 7] = [
        (&|p| rewrite(&a(p), "ONE\n"), 3, "data): a was changed"),
        (&|p| p.write("data/c", "three\n"), 3, "data): c was added"),
        (&|p| fs::rename(a(p), p.path("aside")).unwrap(), 1, "copies: failed: "),
        (
            &|p| {
                fs::rename(a(p), p.path("aside")).unwrap();
                fs::rename(b(p), a(p)).unwrap();
                fs::rename(p.path("aside"), b(p)).unwrap();
            },
            3,
            "data): a was changed",
        ),
        // The content is restored, but the stage may have read the changed content.
        (
            &|p| {
                rewrite(&a(p), "ONE\n");
                std::thread::sleep(Duration::from_millis(20));
                rewrite(&a(p), "one\n");
            },
            3,
            "data): a was changed",
        ),
        (&|p| p.program("copies", &format!("{SCRIPT}# edited\n")), 2, "copies was changed"),
        (&|p| fs::remove_file(p.path("copies")).unwrap(), 2, "copies: No such file"),
    ];
    for (number, (change, code, text)) in table.into_iter().enumerate() {
        let project = create_project(PIPELINE);
        let finished = run_and_change(&project, change);
        finished.fails(code, &[text]);
        assert!(code == 1 || finished.stderr.contains("run again") || number == 6, "{text}");
        // After everything is restored, the stage runs: the changed run has no record.
        for file in ["data/a", "data/b", "data/c"] {
            fs::remove_file(project.path(file)).ok();
        }
        project.write("data/a", "one\n");
        project.write("data/b", "two\n");
        project.program("copies", SCRIPT);
        assert!(project.ok(&["run"]).contains("1 of 1 stage ran"), "change {number}");
        let copy = project.artifact("copies", &[]).join("both");
        assert_eq!(fs::read_to_string(copy).unwrap(), "one\ntwo\n");
    }
}

/// One job runs at a time, so the second stage waits while its input changes.
#[test]
fn a_change_while_a_stage_waits_is_noticed_before_the_stage_starts() {
    let second = "  second: {extends: copies, inputs: {from: ./other}}\n";
    let project = create_project(
        &PIPELINE
            .replace("[copies]", "[copies, second]")
            .replace("./data}}\n", &format!("./data}}}}\n{second}")),
    );
    project.write("other/a", "1\n");
    project.write("other/b", "2\n");
    let child = project.spawn(&["run", "-j", "1"]);
    wait_until(|| project.path("started").exists());
    rewrite(&project.path("other/a"), "3\n");
    project.write("go", "");
    let finished = Finished::of(child.wait_with_output().unwrap());
    finished.fails(3, &["second: failed: input from", "other): a was changed", "run again"]);
    assert!(finished.stderr.contains("copies: done in"), "{}", finished.stderr);
    rewrite(&project.path("other/a"), "1\n");
    assert!(project.ok(&["run"]).contains("1 of 2 stages ran"));
    let copy = project.artifact("second", &[]).join("both");
    assert_eq!(fs::read_to_string(copy).unwrap(), "1\n2\n");
}

/// A build rewrites programs next to the runner; only a different fingerprint is a change.
#[test]
fn a_program_may_be_rebuilt_without_a_change_while_a_stage_runs() {
    let (edited, unchanged) = (format!("{SCRIPT}# edited\n"), SCRIPT.to_owned());
    for (text, code) in [(edited, 2), (unchanged, 0)] {
        let project = create_project(&PIPELINE.replace("run: ./copies, ", ""));
        fs::create_dir(project.path("bin")).unwrap();
        fs::copy(bin("nerf-sr"), project.path("bin/nerf-sr")).unwrap();
        project.program("bin/copies", SCRIPT);
        let mut command = Command::new(project.path("bin/nerf-sr"));
        command.arg("run").current_dir(project.path(".")).env_remove("NERF_SR_STORE");
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        wait_until(|| project.path("bin/started").exists());
        project.program("bin/copies", &text);
        project.write("bin/go", "");
        let finished = Finished::of(child.wait_with_output().unwrap());
        assert_eq!(finished.code, code, "{}", finished.stderr);
        let is_reported = finished.stderr.contains("bin/copies was changed or rebuilt");
        assert_eq!(is_reported, code == 2, "{}", finished.stderr);
    }
}

/// A wrapper script is identified by the description that the wrapped program prints.
#[test]
fn a_change_of_a_wrapped_program_is_noticed() {
    let project = create_project(PIPELINE);
    project.program("real/copies", SCRIPT);
    project.program("copies", "#!/bin/sh\n\"$(dirname \"$0\")/real/copies\" \"$@\"\n");
    let edit = |p: &Project| p.program("real/copies", &format!("{SCRIPT}# edited\n"));
    let child = project.spawn(&["run"]);
    wait_until(|| project.path("real/started").exists());
    edit(&project);
    project.write("real/go", "");
    let finished = Finished::of(child.wait_with_output().unwrap());
    finished.fails(2, &["copies was changed or rebuilt", "run again"]);
    assert!(project.ok(&["run"]).contains("1 of 1 stage ran"));
}

#[test]
fn unusable_folders_are_refused_before_a_stage_starts() {
    use std::os::unix::ffi::OsStrExt as _;
    let non_utf8 =
        |project: &Project| project.path(".").join(std::ffi::OsStr::from_bytes(b"f\xff"));
    let project = create_project(PIPELINE);
    let store = ["--store".into(), non_utf8(&project).into_os_string()];
    let pages = ["--executor=slurm".into(), "--out".into(), non_utf8(&project).into_os_string()];
    let pipe = ["-i", "copies.from=piped"].map(Into::into);
    fs::create_dir(project.path("piped")).unwrap();
    Command::new("mkfifo").arg(project.path("piped/a")).status().unwrap();
    let around_store = ["-i", "copies.from=."].map(Into::into);
    let around_pages = ["-i", "copies.from=data", "--out", "data/pages"].map(Into::into);
    let table: [(&[std::ffi::OsString], i32, &[&str]); 5] = [
        (&store, 3, &[r"f\xFF", "the path of the store must be UTF-8"]),
        (&pages, 3, &[r"f\xFF", "the path of the folder of pages must be UTF-8"]),
        (&pipe, 3, &["piped/a", "is a named pipe (FIFO)"]),
        (&around_store, 2, &["input from", "contains the store", ".nerf-sr"]),
        (&around_pages, 2, &["input from", "contains the folder of pages", "data/pages"]),
    ];
    for (arguments, code, texts) in table {
        let finished = Finished::of(project.command(&["run"]).args(arguments).output().unwrap());
        finished.fails(code, texts);
        assert!(!project.path("started").exists(), "{texts:?}");
    }
    // The project's folder.
    let folder = non_utf8(&project);
    fs::create_dir(&folder).unwrap();
    fs::copy(project.path("pipeline.yaml"), folder.join("pipeline.yaml")).unwrap();
    let finished = project.command(&["run"]).current_dir(&folder).output().unwrap();
    Finished::of(finished).fails(3, &[r"f\xFF", "the path of the pipeline's folder must be UTF-8"]);
    assert!(!folder.join(".nerf-sr").exists());
}

#[test]
fn checkpoints_are_not_used_after_an_input_was_written() {
    let project = Project::fast();
    project.ok(&["run", "prep"]);
    let scene = project.artifact("prep", &["prep"]).join("train");
    Command::new("cp").arg("-rL").arg(scene).arg(project.path("scene")).status().unwrap();
    let arguments = ["run", "train-ss", "-i", "train-ss.scene=scene"];
    let run_and_stop = |more: &[&str]| {
        let mut command = project.command(&[&arguments[..], more].concat());
        Finished::of(command.env("NERF_SR_STOP_AFTER", "2000").output().unwrap())
    };
    assert_eq!(run_and_stop(&[]).code, 130);
    // The content changes and is restored, so the key is equal.
    let views = project.path("scene/views.json");
    let text = fs::read_to_string(&views).unwrap();
    std::thread::sleep(Duration::from_millis(20));
    fs::write(&views, text.replace("white", "black")).unwrap();
    fs::write(&views, text).unwrap();
    let restarted = project.run(&arguments);
    assert_eq!(restarted.code, 0, "{}", restarted.stderr);
    let message = "train-ss: an input was written to after the checkpoint; starting over";
    assert!(restarted.stderr.contains(message), "{}", restarted.stderr);
    assert!(!restarted.stderr.contains("resuming from step"), "{}", restarted.stderr);
    // Without the change the training resumes.
    assert_eq!(run_and_stop(&["-p", "train-ss.seed=5"]).code, 130);
    let resumed = project.run(&[&arguments[..], &["-p", "train-ss.seed=5"]].concat());
    assert!(resumed.stderr.contains("resuming from step"), "{}", resumed.stderr);
}
