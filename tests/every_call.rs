//! Kills at every call that changes a folder or makes a file durable: rename, link, unlink, rmdir
//! and fsync in all variants, of the runner and of `nerf-sr-remote`. After each kill the store is
//! clean, every page is whole, and no user's file has changed. The command succeeds when it is
//! repeated, with the artifacts of an undisturbed one, and later commands remove what is left.
//!
//! NERF_SR_CALL_STEP says at which calls: every one with 1 (`make faults`). NERF_SR_SEED says at
//! which it begins.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeSet;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, SystemTime};

use artifact::{Manifest, list_files};
use common::leftovers::{Files, files_below, is_leftover, lasting_files};
use common::random::number;
use common::{Finished, Project, bin, root};

/// A stage in shell: its output follows from the data set and from the seed.
const STEP: &str = r#"#!/bin/sh
if [ "$1" = describe ]; then
    echo '{"name": "step", "version": "1", "code": "1", "summary": "Copies.",
      "inputs": {"dataset": {"kinds": ["dataset"], "summary": "files", "optional": true}, "scene": {"kinds": ["scene"], "summary": "files", "optional": true}},
      "parameters": {"type": "object", "properties": {"seed": {"type": "number", "default": 0}}}, "output": {"kind": "scene"}}'
    exit
fi
while [ $# -gt 0 ]; do
    case $1 in
        --output) out=$2 ;;
        --params) params=$2 ;;
        --input) in=${2#*=} ;;
    esac
    shift
done
mkdir -p "$out/part"
cat "$params" "$in"/*.txt > "$out/all.txt"
echo done > "$out/part/summary.txt"
"#;

/// A sink in shell: its page names the data set and the artifacts.
const PAGE: &str = r#"#!/bin/sh
if [ "$1" = describe ]; then
    echo '{"name": "page", "version": "1", "code": "1", "summary": "Shows.", "sink": true, "parameters": {"type": "object"},
      "inputs": {"run": {"kinds": ["run"], "summary": "a run"}}, "output": {"kind": "page"}}'
    exit
fi
while [ $# -gt 0 ]; do
    case $1 in
        --output) out=$2 ;;
        --input) in=${2#*=} ;;
    esac
    shift
done
mkdir -p "$out/views"
grep -oE '"output": "[0-9a-f]*"|/ds[AB]"' "$in/run.json" | sort -u > "$out/index.html"
echo view > "$out/views/a.txt"
"#;

const PIPELINE: &str = "
default: [page]
stages:
  first: {run: ./step, inputs: {dataset: ./dsA}}
  last: {run: ./step, inputs: {scene: first}}
  page: {run: ./page, inputs: {run: last}}
";

/// Files that no command may change. A folder of the user's has the name that the page of dsB would
/// be archived under.
const USER_FILES: [&str; 7] = [
    "dsA/in.txt",
    "dsB/in.txt",
    "notes.txt",
    "out/notes.txt",
    "out/page-dsB/mine.txt",
    "shared/notes.txt",
    "exports/precious.tar",
];

/// A command that is killed. The word `remote` stands for `nerf-sr-remote`, `LAST` for the artifact
/// of the stage `last`.
struct Case {
    name: &'static str,
    /// Commands that lead to the state before the command.
    before: &'static [&'static str],
    command: &'static str,
    /// Commands that remove what killed ones left.
    after: &'static [&'static str],
}

const fn case(
    name: &'static str,
    before: &'static [&'static str],
    command: &'static str,
    after: &'static [&'static str],
) -> Case {
    Case { name, before, command, after }
}

const RUN_A: &str = "run -i first.dataset=dsA";
const RUN_B: &str = "run -i first.dataset=dsB";
const RUN_B1: &str = "run -i first.dataset=dsB -p first.seed=1";
const PIN: &str = "pin mine -i first.dataset=dsA";
const VERIFY: &str = "verify --remove";
const PUSH: &str = "remote push shared";
const EXPORT: &str = "remote export LAST exports/last.tar";
/// Another page, then all that may go goes.
const CLEAN: &[&str] =
    &["run -i first.dataset=dsA -p first.seed=7", "gc --keep-days 0 -i first.dataset=dsA"];
const CLEAN_OTHER: &[&str] = &[
    "run -i first.dataset=dsA --store other",
    "gc --keep-days 0 -i first.dataset=dsA --store other",
];

/// Not a command: changes a file of an artifact.
const DAMAGE: &str = "damage";

/// Number of cases that are tried in parallel.
const WORKERS: usize = 2;
/// Without NERF_SR_CALL_STEP.
const DEFAULT_STEP: usize = 12;

const CASES: [Case; 14] = [
    case("first page", &[], RUN_A, CLEAN),
    case("page of another data set", &[RUN_A], RUN_B, CLEAN),
    case("page of the first data set again", &[RUN_A, RUN_B], RUN_A, CLEAN),
    case("archived page replaced", &[RUN_A, RUN_B, RUN_A], RUN_B1, CLEAN),
    case("gc", &[RUN_A, RUN_B], "gc --keep-days 0 -i first.dataset=dsA", CLEAN),
    case("verify", &[RUN_A, DAMAGE], VERIFY, CLEAN),
    case("pin", &[RUN_A], PIN, CLEAN),
    case("unpin", &[RUN_A, PIN], "unpin mine", CLEAN),
    case("push", &[RUN_A], PUSH, &[PUSH]),
    case("push of more", &[RUN_A, PUSH, RUN_B], PUSH, &[PUSH]),
    case("pull", &[RUN_A, PUSH], "remote pull shared --store other", CLEAN_OTHER),
    case("export", &[RUN_A], EXPORT, &["remote export LAST exports/next.tar"]),
    case(
        "export --force",
        &[RUN_A, EXPORT],
        "remote export LAST exports/last.tar --force",
        &["remote export LAST exports/next.tar"],
    ),
    case("import", &[RUN_A, EXPORT], "remote import exports/last.tar --store other", CLEAN_OTHER),
];

/// The program that counts and kills.
static TRACER: LazyLock<String> = LazyLock::new(|| {
    let program = format!("{}/every_call", env!("CARGO_TARGET_TMPDIR"));
    let mut compiler = Command::new("cc");
    compiler.args(["-O1", "-Wall", "-Wextra", "-o", &program]);
    assert!(compiler.arg(root().join("tests/every_call.c")).status().unwrap().success());
    program
});

fn copy(from: &Path, to: &Path) {
    let from = from.join(".");
    assert!(Command::new("cp").arg("-a").args([&from, to]).status().unwrap().success());
}

/// A project for one case.
struct Bench {
    case: &'static Case,
    project: Project,
    /// The project before the command.
    saved: tempfile::TempDir,
    /// Artifact of the stage `last`.
    last: String,
    /// Pages before the command.
    pages: BTreeSet<String>,
    /// Files after an undisturbed command.
    done: Files,
    /// Files after the commands that follow.
    finished: Files,
}

impl Bench {
    fn new(case: &'static Case) -> Self {
        let project = Project::new(PIPELINE);
        project.program("step", STEP);
        project.program("page", PAGE);
        for file in USER_FILES {
            project.write(file, &format!("precious {file}\n"));
        }
        let (last, saved) = (String::new(), tempfile::tempdir().unwrap());
        let (pages, done, finished) = (BTreeSet::new(), Files::new(), Files::new());
        let mut bench = Self { case, project, saved, last, pages, done, finished };
        case.before.iter().for_each(|words| bench.prepare(words));
        bench.pages = bench.whole_pages();
        copy(&bench.project.path(""), bench.saved.path());
        bench.succeed(case.command);
        bench.done = bench.files();
        case.after.iter().for_each(|words| bench.succeed(words));
        bench.finished = bench.files();
        bench
    }

    fn prepare(&mut self, words: &str) {
        if words == DAMAGE {
            let file = self.project.object(&self.last).join("all.txt");
            return fs::write(file, "damaged").unwrap();
        }
        self.succeed(words);
        if words == RUN_A {
            self.last.clone_from(&self.project.output_of("last", &["-i", "first.dataset=dsA"])[0]);
        }
    }

    fn files(&self) -> Files {
        lasting_files(&self.project.path(""))
    }

    fn restore(&self) {
        let project = self.project.path("");
        for entry in fs::read_dir(&project).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) }.unwrap();
        }
        copy(self.saved.path(), &project);
    }

    /// Runs a command in the project, by another program if `by` has its words.
    fn run(&self, words: &str, by: &[&str]) -> Finished {
        let (program, words) = match words.strip_prefix("remote ") {
            Some(words) => (bin("nerf-sr-remote"), words),
            None => (bin("nerf-sr"), words),
        };
        let words = words.replace("LAST", &self.last);
        let words: Vec<&str> = words.split(' ').collect();
        let all = [by, &[program.to_str().unwrap()], &words].concat();
        let mut command = self.project.command_of(Path::new(all[0]), &all[1..]);
        Finished::of(command.stdin(Stdio::null()).output().unwrap())
    }

    #[track_caller]
    fn succeed(&self, words: &str) {
        let Finished { code, stdout, stderr } = self.run(words, &[]);
        assert!(is_success(words, code), "{}: {words}: {stdout}{stderr}", self.case.name);
    }

    /// Runs the command and kills it before or after call `n`, or not at all with 0. Returns the
    /// number of calls that were made, and the name of call `n`.
    fn kill(&self, n: usize, moment: &str) -> (usize, String) {
        let report = self.project.path("report");
        let by = [TRACER.as_str(), report.to_str().unwrap(), &n.to_string(), moment];
        let Finished { code, stdout, stderr } = self.run(self.case.command, &by);
        let text = fs::read_to_string(&report).unwrap_or_default();
        let Some((count, name)) = text.trim().split_once(' ') else {
            panic!("{}: {code} {stdout}{stderr}", self.case.name);
        };
        fs::remove_file(&report).unwrap();
        let is_expected = code == KILLED || is_success(self.case.command, code);
        assert!(is_expected, "{}: {code} {stdout}{stderr}", self.case.name);
        (count.parse().unwrap(), name.to_owned())
    }

    /// Kills the command, looks at what is left, repeats the command, and looks again.
    fn try_kill(&self, n: usize, moment: &str) {
        self.restore();
        let (_, call) = self.kill(n, moment);
        let place = format!("{}: killed {moment} call {n}, {call}", self.case.name);
        self.check(&place);
        let before = self.files();
        let again = self.run(self.case.command, &[]);
        // Some commands can't be repeated once they have done their work.
        let is_done = is_success(self.case.command, again.code) || before == self.done;
        assert!(is_done, "{place}: {}{}", again.stdout, again.stderr);
        self.check(&place);
        // A page that nobody asks for may be archived later.
        let [found, expected] = [self.files(), self.done.clone()].map(without_pages);
        assert_equal(&found, &expected, &place);
        make_old(&self.project.path("shared/uploads"));
        make_old(&self.project.path("exports"));
        self.case.after.iter().for_each(|words| self.succeed(words));
        assert_equal(&self.files(), &self.finished, &place);
        let left = files_below(&self.project.path("")).into_keys();
        let left: Vec<String> = left.filter(|path| is_leftover(path)).collect();
        assert!(left.is_empty(), "{place}: {left:?} are left");
    }

    /// Whatever was killed: artifacts, pages, remotes, archives and the user's files are whole.
    fn check(&self, place: &str) {
        for file in USER_FILES {
            let found = fs::read_to_string(self.project.path(file)).unwrap_or_default();
            assert_eq!(found, format!("precious {file}\n"), "{place}");
        }
        let pages = self.whole_pages();
        assert!(pages.is_superset(&self.pages), "{place}: {:?} became {pages:?}", self.pages);
        for store in [".nerf-sr", "other"] {
            let is_damaged = self.case.before.contains(&DAMAGE);
            if !is_damaged && self.project.path(store).join("objects").exists() {
                self.verify(store, place);
            }
        }
        if self.project.path("shared/format").exists() {
            self.verify_fresh("remote pull shared", place);
        }
        for archive in ["exports/last.tar", "exports/next.tar"] {
            if self.project.path(archive).exists() {
                self.verify_fresh(&format!("remote import {archive}"), place);
            }
        }
    }

    fn verify(&self, store: &str, place: &str) {
        let Finished { code, stdout, stderr } = self.run(&format!("verify --store {store}"), &[]);
        assert!(code == 0 && stdout.contains(", 0 damaged"), "{place}: {stdout}{stderr}");
    }

    /// Checks that the artifacts that a command brings into a new store are whole.
    fn verify_fresh(&self, words: &str, place: &str) {
        let Finished { code, stdout, stderr } = self.run(&format!("{words} --store fresh"), &[]);
        assert_eq!(code, 0, "{place}: {words}: {stdout}{stderr}");
        self.verify("fresh", place);
        fs::remove_dir_all(self.project.path("fresh")).unwrap();
    }

    /// The pages that are whole, wherever they are. Any other folder that is shown is the user's.
    fn whole_pages(&self) -> BTreeSet<String> {
        let mut pages = BTreeSet::new();
        for entry in fs::read_dir(self.project.path("out")).unwrap() {
            let folder = entry.unwrap().path();
            let name = folder.file_name().unwrap().to_str().unwrap();
            let manifest = Manifest::read(&folder).ok();
            if manifest.is_some_and(|manifest| manifest.check_contents(&folder).is_ok()) {
                pages.insert(fs::read_to_string(folder.join("index.html")).unwrap());
            } else if folder.is_dir() && !name.starts_with('.') {
                let files = list_files(&folder).unwrap();
                assert!(files.len() == 1 && name == "page-dsB", "{name}: {files:?}");
            }
        }
        pages
    }
}

/// Exit code of the tracer for a killed program.
const KILLED: i32 = 128 + 9;

/// Returns whether a command has done its work: `verify` reports by its code the damage that it
/// removed.
fn is_success(words: &str, code: i32) -> bool {
    code == 0 || words == VERIFY && code == 3
}

fn without_pages(mut files: Files) -> Files {
    files.retain(|path, _| !path.starts_with("out/"));
    files
}

#[track_caller]
fn assert_equal(found: &Files, expected: &Files, place: &str) {
    let paths: BTreeSet<&String> = found.keys().chain(expected.keys()).collect();
    let differ: Vec<_> = paths.into_iter().filter(|p| found.get(*p) != expected.get(*p)).collect();
    assert!(differ.is_empty(), "{place}: {differ:?} differ from an undisturbed run");
}

/// Makes leftovers so old that their writers count as dead.
fn make_old(folder: &Path) {
    let long_ago = SystemTime::now() - Duration::from_secs(2 * 3600);
    for entry in walkdir::WalkDir::new(folder).contents_first(true).into_iter().flatten() {
        fs::File::open(entry.path()).unwrap().set_modified(long_ago).unwrap();
    }
}

/// Containers may forbid that one process watches another.
fn can_trace() -> bool {
    let report = Path::new(&*TRACER).with_extension("report");
    let mut command = Command::new(&*TRACER);
    command.arg(&report).args(["0", "before", "/bin/true"]);
    command.output().unwrap().status.success()
}

#[test]
fn kills_at_every_call_lose_nothing() {
    if !can_trace() {
        println!("skipped: this machine does not allow ptrace");
        return;
    }
    let step = number("NERF_SR_CALL_STEP").map_or(DEFAULT_STEP, |step| step as usize);
    let seed = number("NERF_SR_SEED").unwrap_or_else(|| std::process::id().into()) as usize;
    println!("NERF_SR_CALL_STEP={step} NERF_SR_SEED={seed}");
    let (next, all) = (AtomicUsize::new(0), AtomicUsize::new(0));
    std::thread::scope(|scope| {
        for _ in 0..WORKERS {
            scope.spawn(|| {
                while let Some(case) = CASES.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let bench = Bench::new(case);
                    bench.restore();
                    let (calls, _) = bench.kill(0, "before");
                    let (mut kills, mut problems) = (0, 0);
                    for n in (1 + seed % step.min(calls)..=calls).step_by(step) {
                        for moment in ["before", "after"] {
                            kills += 1;
                            let tried = || bench.try_kill(n, moment);
                            problems += usize::from(catch_unwind(AssertUnwindSafe(tried)).is_err());
                        }
                    }
                    println!("{}: {calls} calls, {kills} kills, {problems} problems", case.name);
                    all.fetch_add(problems, Ordering::Relaxed);
                }
            });
        }
    });
    assert_eq!(all.into_inner(), 0, "problems");
}
