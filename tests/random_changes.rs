//! Changes of the data set, of programs and of the store at random moments of a run: the run must
//! fail or give a fresh store's results, and no later run may take a wrong result for a cached one.
//!
//! `NERF_SR_ROUNDS` is the number of changes (`make faults`: 100), `NERF_SR_SEED` their seed.

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

/// Compiled programs of the fast pipeline; `eval` is a script.
const PROGRAMS: [&str; 4] = ["nerf-sr", "prep", "train-ss", "render-depth"];
/// Number of seeds of the training; each run has one of them.
const TRAINING_SEEDS: u64 = 3;

/// Creates a project with the fast pipeline, a data set, and copies of the programs.
fn project_with_copies() -> Project {
    let pipeline = FAST
        .replace("default: [report]", "default: [eval]")
        .replace("{dataset: demo-scene}", "{dataset: ./data}")
        .replace("  eval:\n", "  eval:\n    run: ./eval.py\n");
    let project = Project::new(&pipeline);
    let params = r#"{"size": 32, "train": 6, "test": 2, "samples_per_axis": 1}"#;
    assert_eq!(stage("demo-scene", params, &[], &project.path("data"), &[]).code, 0);
    // Users' data sets have no manifest; with one, stages would check the files.
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

fn start_run(project: &Project, seed: u64, store: &str) -> Child {
    let seed = format!("train-ss.seed={seed}");
    command(project, &["run", "-p", &seed], store)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn run(project: &Project, seed: u64, store: &str) -> Finished {
    Finished::of(start_run(project, seed, store).wait_with_output().unwrap())
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

/// Asserts that records of equal keys have equal artifacts in both stores.
#[track_caller]
fn assert_agree(found: &BTreeMap<String, String>, expected: &BTreeMap<String, String>, case: &str) {
    for (key, output) in found {
        assert!(expected.get(key).is_none_or(|known| known == output), "{case}: wrong {key}");
    }
}

/// Returns the files below a folder, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = walkdir::WalkDir::new(folder).sort_by_file_name().into_iter().flatten();
    let is_file = |path: &PathBuf| path.is_file();
    entries.map(walkdir::DirEntry::into_path).filter(is_file).collect()
}

/// Copies a file with its time and permissions; false if a run has just removed the file.
fn copy(from: &Path, to: &Path) -> bool {
    let status = Command::new("cp").arg("-p").args([from, to]).stderr(Stdio::null()).status();
    status.unwrap().success()
}

/// Edit of a file, with a copy of the original.
struct Change {
    file: PathBuf,
    original: PathBuf,
    edit: &'static str,
}

impl Change {
    /// Copies and edits a file; `other` is a file of its kind. Returns `None` if a run has just
    /// removed the file.
    fn apply(random: &mut Random, project: &Project, file: PathBuf, other: &Path) -> Option<Self> {
        let edit = *random.choose(&["flip", "cut", "remove", "take", "folder", "loop", "touch"]);
        // A compiled program reports its own fingerprint, which a flipped bit doesn't change.
        let is_compiled = file.parent() == Some(&project.path("bin"));
        let edit = if is_compiled && edit == "flip" { "cut" } else { edit };
        let change = Self { file, original: project.path("kept"), edit };
        if !copy(&change.file, &change.original) {
            return None;
        }
        change.edit_file(random, other);
        Some(change)
    }

    /// Edits the file; does nothing if a run has meanwhile removed the file or its folder.
    fn edit_file(&self, random: &mut Random, other: &Path) {
        let (file, mut bytes) = (&self.file, fs::read(&self.original).unwrap());
        let position = random.below(bytes.len().max(1) as u64) as usize;
        if self.edit == "touch" {
            fs::File::open(file).and_then(|f| f.set_modified(SystemTime::now())).ok();
            return;
        }
        let other_bytes = fs::read(other).unwrap_or_default();
        // A running program can't be written to, only replaced.
        fs::remove_file(file).ok();
        match self.edit {
            "folder" => _ = fs::create_dir(file),
            "loop" => _ = symlink(file, file),
            "remove" => {}
            _ => {
                match self.edit {
                    "flip" if position < bytes.len() => bytes[position] ^= 1 << random.below(8),
                    "take" => bytes = other_bytes,
                    _ => bytes.truncate(position),
                }
                let meta = self.original.metadata().unwrap();
                let written = fs::write(file, bytes)
                    .and_then(|()| fs::set_permissions(file, meta.permissions()))
                    .and_then(|()| fs::File::open(file)?.set_modified(meta.modified()?));
                written.ok();
            }
        }
    }

    /// Restores the original file with its time.
    fn undo(&self) {
        if self.file.symlink_metadata().is_ok_and(|meta| meta.is_dir()) {
            fs::remove_dir_all(&self.file).unwrap();
        }
        fs::remove_file(&self.file).ok();
        copy(&self.original, &self.file);
    }
}

/// Returns the files of a kind: 0 data set, 1 programs, 2 artifacts and records, 3 rest of a store.
fn candidates(kind: u64, project: &Project, store: &str) -> Vec<PathBuf> {
    let store_files = |folders: &[&str]| -> Vec<PathBuf> {
        folders.iter().flat_map(|folder| files(&project.path(store).join(folder))).collect()
    };
    match kind {
        0 => files(&project.path("data")),
        1 => {
            let programs = PROGRAMS[1..].iter().map(|name| project.path("bin").join(name));
            programs.chain([project.path("eval.py")]).collect()
        }
        // Files that a stage is still writing aren't changed.
        2 => store_files(&["objects", "actions"]),
        _ => store_files(&["pins", "runs", "cache", "locks"]),
    }
}

/// Changes a file at a random moment of a run, and checks this run and another after the repair.
/// Returns whether the first run failed.
fn fails_in_round(
    random: &mut Random,
    project: &Project,
    round: u64,
    run_milliseconds: u64,
    expected: &BTreeMap<String, String>,
) -> bool {
    let (kind, seed) = (random.below(4), random.below(TRAINING_SEEDS));
    // Only a run without a cached scene reads the data set.
    let store = if kind == 0 { format!("new-{round}") } else { format!("store-{}", round / 8) };
    let child = start_run(project, seed, &store);
    // The delay is random, so that changes may hit any moment of the run.
    let max_delay = if kind == 0 { run_milliseconds / 2 } else { run_milliseconds };
    std::thread::sleep(Duration::from_millis(random.below(max_delay + 1)));
    let candidates = candidates(kind, project, &store);
    let change = (!candidates.is_empty()).then(|| {
        let (file, other) =
            (random.choose(&candidates).clone(), random.choose(&candidates).clone());
        Change::apply(random, project, file, &other)
    });
    let Some(change) = change.flatten() else {
        return !child.wait_with_output().unwrap().status.success();
    };
    let is_undone_at_once = random.below(3) == 0;
    let (edit, file) = (change.edit, change.file.display());
    let case = format!("round {round}, seed {seed}: {edit} {file}, undone: {is_undone_at_once}");
    println!("{case}");
    if is_undone_at_once {
        std::thread::sleep(Duration::from_millis(random.below(200)));
        change.undo();
    }
    let changed = Finished::of(child.wait_with_output().unwrap());
    let failure = changed.stderr.lines().rev().find(|line| line.contains(": failed: "));
    println!("  {}: {}", changed.code, failure.unwrap_or_default());
    assert!([0, 1, 2, 3].contains(&changed.code), "{case}: {}", changed.stderr);
    assert!(!changed.stderr.contains("internal error"), "{case}: {}", changed.stderr);
    let found = records(project, &store);
    assert_agree(&found, expected, &case);
    if kind < 2 && !is_undone_at_once && changed.code == 0 {
        // A fresh store must have equal results for the changed files.
        let fresh = format!("fresh-{round}");
        if run(project, seed, &fresh).code == 0 {
            assert_agree(&found, &records(project, &fresh), &case);
        }
    }
    // Damaged content stays, because `verify` must find the damage.
    if kind != 2 || !change.file.is_file() {
        change.undo();
    }
    command(project, &["verify", "--remove"], &store).output().unwrap();
    let repaired = run(project, seed, &store);
    assert_eq!(repaired.code, 0, "{case}: {}", repaired.stderr);
    assert_agree(&records(project, &store), expected, &case);
    let verified = command(project, &["verify"], &store).output().unwrap();
    assert!(verified.status.success(), "{case}");
    command(project, &["pin", "mine"], &store).output().unwrap();
    changed.code != 0
}

#[test]
fn changes_at_random_moments_make_no_wrong_result() {
    let rounds = number("NERF_SR_ROUNDS").unwrap_or(12);
    let seed = number("NERF_SR_SEED").unwrap_or_else(|| std::process::id().into());
    println!("NERF_SR_ROUNDS={rounds} NERF_SR_SEED={seed}");
    let mut random = Random::new(seed);
    let project = project_with_copies();
    let start = Instant::now();
    for seed in 0..TRAINING_SEEDS {
        let undisturbed = run(&project, seed, "undisturbed");
        assert_eq!(undisturbed.code, 0, "{}", undisturbed.stderr);
    }
    let run_milliseconds = start.elapsed().as_millis() as u64 / TRAINING_SEEDS;
    let expected = records(&project, "undisturbed");
    let failed = (0..rounds)
        .filter(|&round| fails_in_round(&mut random, &project, round, run_milliseconds, &expected))
        .count();
    println!("{failed} of {rounds} runs failed");
}
