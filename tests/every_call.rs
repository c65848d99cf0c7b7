//! Kills at every call that changes a folder or makes a file durable: rename, link, unlink, rmdir
//! and fsync in all variants, of the runner and of `nerf-sr-remote`. After each kill, artifacts are
//! intact, every page is complete, and no user file has changed. The repeated command succeeds with
//! the artifacts of an uninterrupted command, and later commands remove the leftovers.
//!
//! NERF_SR_CALL_STEP is the number of calls from one kill to the next: 1 in `make faults`.
//! NERF_SR_SEED selects the first call.

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

/// Shell script of a stage whose output depends on its input and its seed.
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

/// Shell script of a sink whose page names the data set and the artifacts.
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

/// Files that no command may change. The user's folder `out/page-dsB` has the name under which the
/// page of dsB would be archived.
const USER_FILES: [&str; 7] = [
    "dsA/in.txt",
    "dsB/in.txt",
    "notes.txt",
    "out/notes.txt",
    "out/page-dsB/mine.txt",
    "shared/notes.txt",
    "exports/precious.tar",
];

/// Command that is killed. The prefix `remote` stands for `nerf-sr-remote`, `LAST` for the artifact
/// of the stage `last`.
struct Case {
    name: &'static str,
    /// Commands that prepare the project.
    before: &'static [&'static str],
    command: &'static str,
    /// Commands that remove the leftovers of killed commands.
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
/// Commands that write another page, then delete all artifacts that `gc` may delete.
const CLEAN: &[&str] =
    &["run -i first.dataset=dsA -p first.seed=7", "gc --keep-days 0 -i first.dataset=dsA"];
const CLEAN_OTHER: &[&str] = &[
    "run -i first.dataset=dsA --store other",
    "gc --keep-days 0 -i first.dataset=dsA --store other",
];

/// Entry of `Case::before` that changes a file of an artifact instead of running a command.
const DAMAGE: &str = "damage";

/// Number of cases that run in parallel.
const WORKERS: usize = 2;
/// Default of NERF_SR_CALL_STEP.
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

/// Path of the compiled `every_call.c`, which counts a program's calls and kills it at one of them.
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

/// Project of one case.
struct Fixture {
    case: &'static Case,
    project: Project,
    /// Copy of the project before the command.
    saved: tempfile::TempDir,
    /// Identity of the artifact of the stage `last`.
    last: String,
    /// Contents of the pages before the command.
    pages: BTreeSet<String>,
    /// Files after an uninterrupted command.
    done: Files,
    /// Files after the commands of `Case::after`.
    finished: Files,
}

impl Fixture {
    fn new(case: &'static Case) -> Self {
        let project = Project::new(PIPELINE);
        project.program("step", STEP);
        project.program("page", PAGE);
        for file in USER_FILES {
            project.write(file, &format!("precious {file}\n"));
        }
        let (last, saved) = (String::new(), tempfile::tempdir().unwrap());
        let (pages, done, finished) = (BTreeSet::new(), Files::new(), Files::new());
        let mut fixture = Self { case, project, saved, last, pages, done, finished };
        case.before.iter().for_each(|command| fixture.prepare(command));
        fixture.pages = fixture.complete_pages();
        copy(&fixture.project.path(""), fixture.saved.path());
        fixture.succeed(case.command);
        fixture.done = fixture.files();
        case.after.iter().for_each(|command| fixture.succeed(command));
        fixture.finished = fixture.files();
        fixture
    }

    fn prepare(&mut self, command: &str) {
        if command == DAMAGE {
            let file = self.project.object(&self.last).join("all.txt");
            return fs::write(file, "damaged").unwrap();
        }
        self.succeed(command);
        if command == RUN_A {
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

    /// Runs a command in the project. The start of its command line is `tracer`: a program with
    /// arguments, or nothing.
    fn run(&self, command: &str, tracer: &[&str]) -> Finished {
        let (program, arguments) = match command.strip_prefix("remote ") {
            Some(arguments) => (bin("nerf-sr-remote"), arguments),
            None => (bin("nerf-sr"), command),
        };
        let arguments = arguments.replace("LAST", &self.last);
        let arguments: Vec<&str> = arguments.split(' ').collect();
        let command_line = [tracer, &[program.to_str().unwrap()], &arguments].concat();
        let mut process = self.project.command_of(Path::new(command_line[0]), &command_line[1..]);
        Finished::of(process.stdin(Stdio::null()).output().unwrap())
    }

    #[track_caller]
    fn succeed(&self, command: &str) {
        let Finished { code, stdout, stderr } = self.run(command, &[]);
        assert!(is_success(command, code), "{}: {command}: {stdout}{stderr}", self.case.name);
    }

    /// Runs the command and kills it before or after call `n`, or not at all if `n` is 0. Returns
    /// the number of calls and the name of call `n`.
    fn kill(&self, n: usize, moment: &str) -> (usize, String) {
        let report = self.project.path("report");
        let tracer = [TRACER.as_str(), report.to_str().unwrap(), &n.to_string(), moment];
        let Finished { code, stdout, stderr } = self.run(self.case.command, &tracer);
        let text = fs::read_to_string(&report).unwrap_or_default();
        let Some((count, name)) = text.trim().split_once(' ') else {
            panic!("{}: {code} {stdout}{stderr}", self.case.name);
        };
        fs::remove_file(&report).unwrap();
        let is_expected = code == KILLED || is_success(self.case.command, code);
        assert!(is_expected, "{}: {code} {stdout}{stderr}", self.case.name);
        (count.parse().unwrap(), name.to_owned())
    }

    /// Kills the command, checks the project, repeats the command, and checks the project again.
    fn try_kill(&self, n: usize, moment: &str) {
        self.restore();
        let (_, call) = self.kill(n, moment);
        let context = format!("{}: killed {moment} call {n}, {call}", self.case.name);
        self.check(&context);
        let before = self.files();
        let again = self.run(self.case.command, &[]);
        // Some commands fail if they are repeated after their work is done.
        let is_done = is_success(self.case.command, again.code) || before == self.done;
        assert!(is_done, "{context}: {}{}", again.stdout, again.stderr);
        self.check(&context);
        // Pages may still differ: a replaced page may be archived by a later command.
        let [found, expected] = [self.files(), self.done.clone()].map(without_pages);
        assert_equal(&found, &expected, &context);
        make_old(&self.project.path("shared/uploads"));
        make_old(&self.project.path("exports"));
        self.case.after.iter().for_each(|command| self.succeed(command));
        assert_equal(&self.files(), &self.finished, &context);
        let left = files_below(&self.project.path("")).into_keys();
        let left: Vec<String> = left.filter(|path| is_leftover(path)).collect();
        assert!(left.is_empty(), "{context}: {left:?} are left");
    }

    /// Checks that artifacts, pages, remotes, archives and the user's files are intact.
    fn check(&self, context: &str) {
        for file in USER_FILES {
            let found = fs::read_to_string(self.project.path(file)).unwrap_or_default();
            assert_eq!(found, format!("precious {file}\n"), "{context}");
        }
        let pages = self.complete_pages();
        assert!(pages.is_superset(&self.pages), "{context}: {:?} became {pages:?}", self.pages);
        for store in [".nerf-sr", "other"] {
            let is_damaged = self.case.before.contains(&DAMAGE);
            if !is_damaged && self.project.path(store).join("objects").exists() {
                self.verify(store, context);
            }
        }
        if self.project.path("shared/format").exists() {
            self.verify_fresh("remote pull shared", context);
        }
        for archive in ["exports/last.tar", "exports/next.tar"] {
            if self.project.path(archive).exists() {
                self.verify_fresh(&format!("remote import {archive}"), context);
            }
        }
    }

    fn verify(&self, store: &str, context: &str) {
        let Finished { code, stdout, stderr } = self.run(&format!("verify --store {store}"), &[]);
        assert!(code == 0 && stdout.contains(", 0 damaged"), "{context}: {stdout}{stderr}");
    }

    /// Runs a command that adds artifacts to a new store, and verifies the store.
    fn verify_fresh(&self, command: &str, context: &str) {
        let Finished { code, stdout, stderr } = self.run(&format!("{command} --store fresh"), &[]);
        assert_eq!(code, 0, "{context}: {command}: {stdout}{stderr}");
        self.verify("fresh", context);
        fs::remove_dir_all(self.project.path("fresh")).unwrap();
    }

    /// Returns the contents of all complete pages in `out`, hidden or not. Any other visible folder
    /// must be the user's.
    fn complete_pages(&self) -> BTreeSet<String> {
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

/// Returns whether a command succeeded. `verify --remove` exits with 3 after removing damage.
fn is_success(command: &str, code: i32) -> bool {
    code == 0 || command == VERIFY && code == 3
}

fn without_pages(mut files: Files) -> Files {
    files.retain(|path, _| !path.starts_with("out/"));
    files
}

#[track_caller]
fn assert_equal(found: &Files, expected: &Files, context: &str) {
    let paths: BTreeSet<&String> = found.keys().chain(expected.keys()).collect();
    let differ: Vec<_> = paths.into_iter().filter(|p| found.get(*p) != expected.get(*p)).collect();
    assert!(differ.is_empty(), "{context}: {differ:?} differ from an uninterrupted command");
}

/// Sets the times of leftovers so far back that commands assume dead writers.
fn make_old(folder: &Path) {
    let long_ago = SystemTime::now() - Duration::from_secs(2 * 3600);
    for entry in walkdir::WalkDir::new(folder).contents_first(true).into_iter().flatten() {
        fs::File::open(entry.path()).unwrap().set_modified(long_ago).unwrap();
    }
}

/// Returns whether a process can trace another, which containers may forbid.
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
    let (next_case, all_problems) = (AtomicUsize::new(0), AtomicUsize::new(0));
    std::thread::scope(|scope| {
        for _ in 0..WORKERS {
            scope.spawn(|| {
                while let Some(case) = CASES.get(next_case.fetch_add(1, Ordering::Relaxed)) {
                    let fixture = Fixture::new(case);
                    fixture.restore();
                    let (calls, _) = fixture.kill(0, "before");
                    let (mut kills, mut problems) = (0, 0);
                    for n in (1 + seed % step.min(calls)..=calls).step_by(step) {
                        for moment in ["before", "after"] {
                            kills += 1;
                            let attempt = || fixture.try_kill(n, moment);
                            problems +=
                                usize::from(catch_unwind(AssertUnwindSafe(attempt)).is_err());
                        }
                    }
                    println!("{}: {calls} calls, {kills} kills, {problems} problems", case.name);
                    all_problems.fetch_add(problems, Ordering::Relaxed);
                }
            });
        }
    });
    assert_eq!(all_problems.into_inner(), 0, "problems");
}
