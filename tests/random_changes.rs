//! Files of the data set, of programs and of the store that change at random moments of a run: the
//! run fails, or its results are those of a fresh store, and no later run takes a wrong result for
//! a cached one.
//!
//! NERF_SR_ROUNDS says how many changes (`make faults`: 100), NERF_SR_SEED which.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use common::random::{Random, number};
use common::{FAST, Finished, Project, bin, root, stage};

/// The programs of the fast pipeline but its last, which is a script.
const PROGRAMS: [&str; 4] = ["nerf-sr", "prep", "train-ss", "render-depth"];
/// Number of trainings that are run in turn.
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

/// Returns key and artifact of every complete record of a store.
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
        // A fresh store gives the same for the current files.
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
    let rounds = number("NERF_SR_ROUNDS").unwrap_or(12);
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
