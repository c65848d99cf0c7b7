//! Inputs and programs that change while a stage uses them or waits for its place: no result is
//! recorded, and the message names the file. Folders that a run refuses before it starts.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use common::{Finished, Project, bin, wait_until};

/// A stage that copies its input once a file `go` lies beside it, or says what it lacks.
const COPIES: &str = r#"#!/bin/sh
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

const COPYING: &str = "default: [copies]
stages:
  copies: {run: ./copies, inputs: {from: ./data}}
";

fn copying(pipeline: &str) -> Project {
    let project = Project::new(pipeline);
    project.program("copies", COPIES);
    project.write("data/a", "one\n");
    project.write("data/b", "two\n");
    project
}

/// Runs, and changes something once the stage has started.
fn changed_while_it_runs(project: &Project, change: &dyn Fn(&Project)) -> Finished {
    let child = project.spawn(&["run"]);
    wait_until(|| project.path("started").exists());
    change(project);
    project.write("go", "");
    Finished::of(child.wait_with_output().unwrap())
}

/// Overwrites a file and gives it back its time.
fn rewrite(file: &Path, text: &str) {
    let time = file.metadata().unwrap().modified().unwrap();
    fs::write(file, text).unwrap();
    fs::File::options().write(true).open(file).unwrap().set_modified(time).unwrap();
}

#[test]
fn a_change_while_a_stage_runs_makes_no_record() {
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
        // What a stage read of a file that has its content back isn't known.
        (
            &|p| {
                rewrite(&a(p), "ONE\n");
                std::thread::sleep(Duration::from_millis(20));
                rewrite(&a(p), "one\n");
            },
            3,
            "data): a was changed",
        ),
        (&|p| p.program("copies", &format!("{COPIES}# edited\n")), 2, "copies was changed"),
        (&|p| fs::remove_file(p.path("copies")).unwrap(), 2, "copies: No such file"),
    ];
    for (number, (change, code, words)) in table.into_iter().enumerate() {
        let project = copying(COPYING);
        let finished = changed_while_it_runs(&project, change);
        finished.fails(code, &[words]);
        assert!(code == 1 || finished.stderr.contains("run again") || number == 6, "{words}");
        // With all as it was, nothing is taken for done.
        for file in ["data/a", "data/b", "data/c"] {
            fs::remove_file(project.path(file)).ok();
        }
        project.write("data/a", "one\n");
        project.write("data/b", "two\n");
        project.program("copies", COPIES);
        assert!(project.ok(&["run"]).contains("1 of 1 stage ran"), "change {number}");
        let made = project.artifact("copies", &[]).join("both");
        assert_eq!(fs::read_to_string(made).unwrap(), "one\ntwo\n");
    }
}

/// A stage that is ready waits for its place; what its data were then doesn't count.
#[test]
fn a_change_while_a_stage_waits_for_its_place_is_seen_before_it_starts() {
    let second = "  second: {extends: copies, inputs: {from: ./other}}\n";
    let project = copying(
        &COPYING
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
    let made = project.artifact("second", &[]).join("both");
    assert_eq!(fs::read_to_string(made).unwrap(), "1\n2\n");
}

/// Builds write programs beside the runner anew; only another code is a change.
#[test]
fn a_program_of_the_runner_may_be_built_anew_while_it_runs() {
    let (edited, again) = (format!("{COPIES}# edited\n"), COPIES.to_owned());
    for (text, code) in [(edited, 2), (again, 0)] {
        let project = copying(&COPYING.replace("run: ./copies, ", ""));
        fs::create_dir(project.path("bin")).unwrap();
        fs::copy(bin("nerf-sr"), project.path("bin/nerf-sr")).unwrap();
        project.program("bin/copies", COPIES);
        let mut command = Command::new(project.path("bin/nerf-sr"));
        command.arg("run").current_dir(project.path(".")).env_remove("NERF_SR_STORE");
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        wait_until(|| project.path("bin/started").exists());
        project.program("bin/copies", &text);
        project.write("bin/go", "");
        let finished = Finished::of(child.wait_with_output().unwrap());
        assert_eq!(finished.code, code, "{}", finished.stderr);
        let is_said = finished.stderr.contains("bin/copies was changed or rebuilt");
        assert_eq!(is_said, code == 2, "{}", finished.stderr);
    }
}

/// A script that only calls another program is known by what that program says.
#[test]
fn a_program_behind_a_wrapper_that_changes_is_seen() {
    let project = copying(COPYING);
    project.program("real/copies", COPIES);
    project.program("copies", "#!/bin/sh\n\"$(dirname \"$0\")/real/copies\" \"$@\"\n");
    let edit = |p: &Project| p.program("real/copies", &format!("{COPIES}# edited\n"));
    let child = project.spawn(&["run"]);
    wait_until(|| project.path("real/started").exists());
    edit(&project);
    project.write("real/go", "");
    let finished = Finished::of(child.wait_with_output().unwrap());
    finished.fails(2, &["copies was changed or rebuilt", "run again"]);
    assert!(project.ok(&["run"]).contains("1 of 1 stage ran"));
}

/// Folders of inputs, of results and of records that a run refuses before it starts anything.
#[test]
fn folders_that_a_run_can_not_use_are_refused_first() {
    use std::os::unix::ffi::OsStrExt as _;
    let odd = |project: &Project| project.path(".").join(std::ffi::OsStr::from_bytes(b"f\xff"));
    let project = copying(COPYING);
    let store = ["--store".into(), odd(&project).into_os_string()];
    let queued = ["--executor=slurm".into(), "--out".into(), odd(&project).into_os_string()];
    let pipe = ["-i", "copies.from=piped"].map(Into::into);
    fs::create_dir(project.path("piped")).unwrap();
    Command::new("mkfifo").arg(project.path("piped/a")).status().unwrap();
    let around = ["-i", "copies.from=."].map(Into::into);
    let elsewhere = ["-i", "copies.from=data", "--out", "data/pages"].map(Into::into);
    let table: [(&[std::ffi::OsString], i32, &[&str]); 5] = [
        (&store, 3, &[r"f\xFF", "the path of the store must be UTF-8"]),
        (&queued, 3, &[r"f\xFF", "the path of the folder of pages must be UTF-8"]),
        (&pipe, 3, &["piped/a", "is a FIFO, socket or device"]),
        (&around, 2, &["input from", "contains the store", ".nerf-sr"]),
        (&elsewhere, 2, &["input from", "contains the folder of pages", "data/pages"]),
    ];
    for (words, code, said) in table {
        let finished = Finished::of(project.command(&["run"]).args(words).output().unwrap());
        finished.fails(code, said);
        assert!(!project.path("started").exists(), "{said:?}");
    }
    // The project itself.
    let folder = odd(&project);
    fs::create_dir(&folder).unwrap();
    fs::copy(project.path("pipeline.yaml"), folder.join("pipeline.yaml")).unwrap();
    let finished = project.command(&["run"]).current_dir(&folder).output().unwrap();
    Finished::of(finished).fails(3, &[r"f\xFF", "the path of the pipeline's folder must be UTF-8"]);
    assert!(!folder.join(".nerf-sr").exists());
}

#[test]
fn checkpoints_of_inputs_that_were_written_to_are_not_trusted() {
    let project = Project::fast();
    project.ok(&["run", "prep"]);
    let scene = project.artifact("prep", &["prep"]).join("train");
    Command::new("cp").arg("-rL").arg(scene).arg(project.path("scene")).status().unwrap();
    let arguments = ["run", "train-ss", "-i", "train-ss.scene=scene"];
    let stopped = |more: &[&str]| {
        let mut command = project.command(&[&arguments[..], more].concat());
        Finished::of(command.env("NERF_SR_STOP_AFTER", "2000").output().unwrap())
    };
    assert_eq!(stopped(&[]).code, 130);
    // Another content, and back: the key is the same again.
    let views = project.path("scene/views.json");
    let text = fs::read_to_string(&views).unwrap();
    std::thread::sleep(Duration::from_millis(20));
    fs::write(&views, text.replace("white", "black")).unwrap();
    fs::write(&views, text).unwrap();
    let last = project.run(&arguments);
    assert_eq!(last.code, 0, "{}", last.stderr);
    let said = "train-ss: an input was written to after the checkpoint; starting over";
    assert!(last.stderr.contains(said), "{}", last.stderr);
    assert!(!last.stderr.contains("resuming from step"), "{}", last.stderr);
    // Without the change it resumes.
    assert_eq!(stopped(&["-p", "train-ss.seed=5"]).code, 130);
    let last = project.run(&[&arguments[..], &["-p", "train-ss.seed=5"]].concat());
    assert!(last.stderr.contains("resuming from step"), "{}", last.stderr);
}
