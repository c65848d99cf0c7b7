//! Inputs, programs and stores that change while a run uses them: the run fails, or its results are
//! those of a fresh store, and no later run takes a wrong result for a cached one.
//!
//! NERF_SR_ROUNDS says how many changes at random moments (`make faults`: 100), NERF_SR_SEED which.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use common::random::{Random, number};
use common::{FAST, Finished, Project, bin, root, stage, wait_until};

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
        (&store, 3, &[r"f\xFF", "the store must have a name in UTF-8"]),
        (&queued, 3, &[r"f\xFF", "the folder of pages must have a name in UTF-8"]),
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
    Finished::of(finished).fails(3, &[r"f\xFF", "the pipeline's folder must have a name in UTF-8"]);
    assert!(!folder.join(".nerf-sr").exists());
}

// ---- At random moments -----------------------------------------------------------------------

/// The programs of the fast pipeline but its last, which is a script.
const PROGRAMS: [&str; 4] = ["nerf-sr", "prep", "train-ss", "render-depth"];
/// So many trainings are run by turns.
const POINTS: u64 = 3;

/// The fast pipeline on a data set of its own, with its own copies of the programs.
fn copied() -> Project {
    let pipeline = FAST
        .replace("default: [report]", "default: [eval]")
        .replace("{dataset: demo-scene}", "{dataset: ./data}")
        .replace("  eval:\n", "  eval:\n    run: ./eval.py\n");
    let project = Project::new(&pipeline);
    let params = r#"{"size": 32, "train": 6, "test": 2, "samples_per_axis": 1}"#;
    assert_eq!(stage("demo-scene", params, &[], &project.path("data"), &[]).code, 0);
    // A data set as people have them; one with a manifest is checked by stages, too.
    fs::remove_file(project.path("data/artifact.json")).unwrap();
    fs::create_dir(project.path("bin")).unwrap();
    for name in PROGRAMS {
        fs::copy(bin(name), project.path("bin").join(name)).unwrap();
    }
    let script = fs::read_to_string(root().join("scripts/example-eval.py")).unwrap();
    project.program("eval.py", &script);
    project
}

fn command(project: &Project, arguments: &[&str], store: &str) -> Command {
    let mut command = Command::new(project.path("bin/nerf-sr"));
    command.args(arguments).args(["--store", store]).current_dir(project.path("."));
    let libraries = bin("nerf-sr").ancestors().nth(3).unwrap().join(".libtorch/lib");
    command.env("LD_LIBRARY_PATH", libraries);
    command
}

fn run(project: &Project, seed: u64, store: &str) -> Child {
    let seed = format!("train-ss.seed={seed}");
    command(project, &["run", "-p", &seed], store)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn finished(project: &Project, seed: u64, store: &str) -> Finished {
    Finished::of(run(project, seed, store).wait_with_output().unwrap())
}

/// What every whole record of a store says: key and artifact.
fn records(project: &Project, store: &str) -> BTreeMap<String, String> {
    let Ok(entries) = fs::read_dir(project.path(store).join("actions")) else {
        return BTreeMap::new();
    };
    let mut found = BTreeMap::new();
    for path in entries.map(|entry| entry.unwrap().path()) {
        let Ok(text) = fs::read_to_string(&path) else { continue };
        let Ok(record) = serde_json::from_str::<store::Record>(&text) else { continue };
        if path.file_stem().and_then(|stem| stem.to_str()) == Some(&record.key()) {
            found.insert(record.key(), record.output);
        }
    }
    found
}

/// Every record of a store that another knows, too, names the same artifact.
#[track_caller]
fn assert_agree(found: &BTreeMap<String, String>, expected: &BTreeMap<String, String>, what: &str) {
    for (key, output) in found {
        assert!(expected.get(key).is_none_or(|known| known == output), "{what}: wrong {key}");
    }
}

/// The files below a folder, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = walkdir::WalkDir::new(folder).sort_by_file_name().into_iter().flatten();
    let is_file = |path: &PathBuf| path.is_file();
    entries.map(walkdir::DirEntry::into_path).filter(is_file).collect()
}

/// Copies a file with its time and rights; false where a run has just removed it.
fn copy(from: &Path, to: &Path) -> bool {
    let status = Command::new("cp").arg("-p").args([from, to]).stderr(Stdio::null()).status();
    status.unwrap().success()
}

/// Something done to a file, and the file as it was.
struct Change {
    file: PathBuf,
    kept: PathBuf,
    what: &'static str,
}

impl Change {
    /// Keeps a file and does something to it; `other` is one of its kind. None where a run has just
    /// removed it.
    fn make(random: &mut Random, project: &Project, file: PathBuf, other: &Path) -> Option<Self> {
        let what = *random.choose(&["flip", "cut", "remove", "take", "folder", "loop", "touch"]);
        // A compiled program says its code itself; a flipped bit in it is the disk's fault.
        let is_compiled = file.parent() == Some(&project.path("bin"));
        let what = if is_compiled && what == "flip" { "cut" } else { what };
        let change = Self { file, kept: project.path("kept"), what };
        if !copy(&change.file, &change.kept) {
            return None;
        }
        change.carry_out(random, other);
        Some(change)
    }

    /// A run may remove the file, or its folder, meanwhile: then there is nothing to do.
    fn carry_out(&self, random: &mut Random, other: &Path) {
        let (file, mut bytes) = (&self.file, fs::read(&self.kept).unwrap());
        let at = random.below(bytes.len().max(1) as u64) as usize;
        if self.what == "touch" {
            fs::File::open(file).and_then(|f| f.set_modified(SystemTime::now())).ok();
            return;
        }
        let taken = fs::read(other).unwrap_or_default();
        // Anew: a program that runs can't be written to.
        fs::remove_file(file).ok();
        match self.what {
            "folder" => _ = fs::create_dir(file),
            "loop" => _ = symlink(file, file),
            "remove" => {}
            _ => {
                match self.what {
                    "flip" if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
                    "take" => bytes = taken,
                    _ => bytes.truncate(at),
                }
                let meta = self.kept.metadata().unwrap();
                let written = fs::write(file, bytes)
                    .and_then(|()| fs::set_permissions(file, meta.permissions()))
                    .and_then(|()| fs::File::open(file)?.set_modified(meta.modified()?));
                written.ok();
            }
        }
    }

    /// Puts the file back as it was, its time included.
    fn undo(&self) {
        if self.file.symlink_metadata().is_ok_and(|meta| meta.is_dir()) {
            fs::remove_dir_all(&self.file).unwrap();
        }
        fs::remove_file(&self.file).ok();
        copy(&self.kept, &self.file);
    }
}

/// Files of one kind, of which one may change.
fn candidates(kind: u64, project: &Project, store: &str) -> Vec<PathBuf> {
    let in_store = |folders: &[&str]| -> Vec<PathBuf> {
        folders.iter().flat_map(|folder| files(&project.path(store).join(folder))).collect()
    };
    match kind {
        0 => files(&project.path("data")),
        1 => {
            let programs = PROGRAMS[1..].iter().map(|name| project.path("bin").join(name));
            programs.chain([project.path("eval.py")]).collect()
        }
        // What a stage is just writing is its own.
        2 => in_store(&["objects", "actions"]),
        _ => in_store(&["pins", "runs", "cache", "locks"]),
    }
}

/// A change at a random moment of a run, then a run without it; whether the first one failed.
fn round(
    random: &mut Random,
    project: &Project,
    number: u64,
    whole_run: u64,
    expected: &BTreeMap<String, String>,
) -> bool {
    let (kind, point) = (random.below(4), random.below(POINTS));
    // Only a store without its scene reads the data.
    let store = if kind == 0 { format!("new-{number}") } else { format!("store-{}", number / 8) };
    let child = run(project, point, &store);
    // This is fuzzing: no moment of a run is waited for, so that any may be met.
    let longest = if kind == 0 { whole_run / 2 } else { whole_run };
    std::thread::sleep(Duration::from_millis(random.below(longest + 1)));
    let candidates = candidates(kind, project, &store);
    let change = (!candidates.is_empty()).then(|| {
        let (file, other) =
            (random.choose(&candidates).clone(), random.choose(&candidates).clone());
        Change::make(random, project, file, &other)
    });
    let Some(change) = change.flatten() else {
        return child.wait_with_output().unwrap().status.success();
    };
    let is_undone_at_once = random.below(3) == 0;
    let (what, file) = (change.what, change.file.display());
    let what = format!("round {number}, point {point}: {what} {file}, {is_undone_at_once}");
    println!("{what}");
    if is_undone_at_once {
        std::thread::sleep(Duration::from_millis(random.below(200)));
        change.undo();
    }
    let changed = Finished::of(child.wait_with_output().unwrap());
    let said = changed.stderr.lines().rev().find(|line| line.contains(": failed: "));
    println!("  {}: {}", changed.code, said.unwrap_or_default());
    assert!([0, 1, 2, 3].contains(&changed.code), "{what}: {}", changed.stderr);
    assert!(!changed.stderr.contains("internal error"), "{what}: {}", changed.stderr);
    let found = records(project, &store);
    assert_agree(&found, expected, &what);
    if kind < 2 && !is_undone_at_once && changed.code == 0 {
        // A fresh store has the same of the files as they are now.
        let fresh = format!("fresh-{number}");
        if finished(project, point, &fresh).code == 0 {
            assert_agree(&found, &records(project, &fresh), &what);
        }
    }
    // Damage to content stays, for `verify` to find.
    if kind != 2 || !change.file.is_file() {
        change.undo();
    }
    command(project, &["verify", "--remove"], &store).output().unwrap();
    let last = finished(project, point, &store);
    assert_eq!(last.code, 0, "{what}: {}", last.stderr);
    assert_agree(&records(project, &store), expected, &what);
    let verified = command(project, &["verify"], &store).output().unwrap();
    assert!(verified.status.success(), "{what}");
    command(project, &["pin", "mine"], &store).output().unwrap();
    changed.code != 0
}

#[test]
fn changes_at_random_moments_make_no_wrong_result() {
    let rounds = number("NERF_SR_ROUNDS").unwrap_or(8);
    let seed = number("NERF_SR_SEED").unwrap_or_else(|| std::process::id().into());
    println!("NERF_SR_ROUNDS={rounds} NERF_SR_SEED={seed}");
    let mut random = Random::new(seed);
    let project = copied();
    let begun = Instant::now();
    for point in 0..POINTS {
        let first = finished(&project, point, "undisturbed");
        assert_eq!(first.code, 0, "{}", first.stderr);
    }
    let whole_run = begun.elapsed().as_millis() as u64 / POINTS;
    let expected = records(&project, "undisturbed");
    let failed =
        (0..rounds).filter(|&n| round(&mut random, &project, n, whole_run, &expected)).count();
    println!("{failed} of {rounds} runs failed");
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
    let said = "train-ss: an input was written to since its checkpoint; it starts over";
    assert!(last.stderr.contains(said), "{}", last.stderr);
    assert!(!last.stderr.contains("going on from step"), "{}", last.stderr);
    // Without that it goes on.
    assert_eq!(stopped(&["-p", "train-ss.seed=5"]).code, 130);
    let last = project.run(&[&arguments[..], &["-p", "train-ss.seed=5"]].concat());
    assert!(last.stderr.contains("going on from step"), "{}", last.stderr);
}
