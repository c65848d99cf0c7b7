//! Guarantees of the store: an unreadable file isn't treated as absent, and users of one store
//! don't disturb each other.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt, symlink};
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use common::{Finished, Project, bin, signal};

/// Creates a project with a stage `text`, a shell script that executes `command`: `$out` is the
/// output folder, `$params` the parameter file. The default target extends `text`.
fn scripted(command: &str) -> Project {
    let project = Project::new(
        "default: [other]\nstages:\n  text: {run: ./text}\n  other: {extends: text, parameters: \
        {word: other}}\n",
    );
    let description = r#"{"name": "text", "version": "1", "code": "1", "summary": "Writes.", "inputs": {},
      "parameters": {"type": "object", "properties": {"word": {"type": "string", "default": "a"}}}, "output": {"kind": "text"}}"#;
    let script = format!(
        "#!/bin/sh\nif [ \"$1\" = describe ]; then cat <<'END'\n{description}\nEND\nexit; fi\n\
         while [ $# -gt 0 ]; do case $1 in --output) out=$2;; --params) params=$2;; esac; shift; \
         done\nmkdir $out; {command}\n"
    );
    project.program("text", &script);
    project
}

/// Command that creates an artifact for each value of `word`.
const COPY_PARAMETERS: &str = "cp $params $out/word";

/// Creates a project with a pinned artifact, whose files all users may read and write.
fn pinned() -> Project {
    let project = scripted(COPY_PARAMETERS);
    project.ok(&["run", "text"]);
    project.ok(&["pin", "mine", "text"]);
    let status = Command::new("chmod").args(["-R", "a+rwX"]).arg(project.path(".")).status();
    assert!(status.unwrap().success());
    project
}

fn is_root() -> bool {
    fs::metadata("/proc/self").unwrap().uid() == 0
}

/// Returns words of the advice to the user of [`run_unprivileged`], who owns the files unless root
/// runs the tests.
fn advice() -> &'static [&'static str] {
    if is_root() { &["owned by user", "umask 002", "--store"] } else { &["you own it", "chmod"] }
}

/// Runs the runner, as user 65534 if root runs the tests; returns `None` if that user can't start
/// the runner.
fn run_unprivileged(project: &Project, arguments: &[&str]) -> Option<Finished> {
    let mut command = project.command(arguments);
    if is_root() {
        command.uid(65534).gid(65534);
    }
    match command.output() {
        Err(error) if error.kind() == ErrorKind::PermissionDenied => {
            eprintln!("skipped: another user can't start {}", bin("nerf-sr").display());
            None
        }
        output => Some(Finished::of(output.unwrap())),
    }
}

/// Returns a store folder's first entry, by name, with the given ending.
fn first_entry(project: &Project, folder: &str, ending: &str) -> PathBuf {
    let entries = fs::read_dir(project.path(".nerf-sr").join(folder)).unwrap();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.to_str().unwrap().ends_with(ending));
    paths.sort();
    paths.remove(0)
}

/// Files that `gc` reads: folder, ending, and whether a stage's state depends on the file.
const READ_BY_GC: [(&str, &str, bool); 5] = [
    ("actions", ".json", true),
    ("objects", "", true),
    ("pins", ".jsonl", false),
    ("runs", ".jsonl", false),
    ("locks", "", false),
];

#[test]
fn gc_deletes_nothing_if_a_file_is_unreadable() {
    let project = pinned();
    let before = project.store_listing();
    for (folder, ending, decides_state) in READ_BY_GC {
        let path = first_entry(&project, folder, ending);
        let permissions = fs::metadata(&path).unwrap().permissions();
        fs::set_permissions(&path, PermissionsExt::from_mode(0o0)).unwrap();
        let name = format!("{folder}/{}", path.file_name().unwrap().to_str().unwrap());
        let refused = [&[&name, "Permission denied"], advice()].concat();
        for arguments in [&["gc", "--keep-days", "0"][..], &["gc", "--dry-run"]] {
            let Some(finished) = run_unprivileged(&project, arguments) else { return };
            finished.fails(1, &[&["nothing was deleted"][..], &refused].concat());
        }
        for verb in ["status", "plan", "run"].into_iter().filter(|_| decides_state) {
            run_unprivileged(&project, &[verb, "text"]).unwrap().fails(1, &refused);
        }
        fs::set_permissions(&path, permissions).unwrap();
        assert_eq!(project.store_listing(), before, "{name}");
    }
    project.ok(&["gc", "--keep-days", "0"]);
    assert_eq!(project.store_listing(), before, "the artifact is pinned");
}

/// A symbolic link to itself, which not even root can read, must be reported.
#[test]
fn unreadable_files_are_not_treated_as_absent() {
    for (folder, ending, decides_state) in READ_BY_GC {
        let project = pinned();
        let path = match folder {
            "objects" => first_entry(&project, folder, ending).join("artifact.json"),
            _ => first_entry(&project, folder, ending),
        };
        fs::remove_file(&path).unwrap();
        symlink(path.file_name().unwrap(), &path).unwrap();
        let before = project.store_listing();
        let name = path.strip_prefix(project.path(".nerf-sr")).unwrap().to_str().unwrap();
        let words = [name, "Too many levels of symbolic links"];
        project
            .run(&["gc", "--keep-days", "0"])
            .fails(1, &[&["nothing was deleted"][..], &words].concat());
        for verb in ["status", "plan", "run"].into_iter().filter(|_| decides_state) {
            project.run(&[verb, "text"]).fails(1, &words);
        }
        assert_eq!(project.store_listing(), before, "{name}");
    }
}

#[test]
fn a_damaged_pin_stops_gc_until_it_is_removed() {
    let project = pinned();
    let before = project.store_listing();
    let pin = fs::read_to_string(project.path(".nerf-sr/pins/mine.jsonl")).unwrap();
    for text in ["", "my notes\n", &pin[..pin.len() / 2], &pin[..pin.len() - 10]] {
        project.write(".nerf-sr/pins/mine.jsonl", text);
        project
            .run(&["gc", "--keep-days", "0"])
            .fails(1, &["nothing was deleted", "pins/mine.jsonl", "`nerf-sr unpin mine`"]);
        assert_eq!(project.store_listing(), before, "{text:?}");
    }
    project.run(&["unpin", "yours"]).fails(2, &["no pin \"yours\"; known: mine"]);
    project.ok(&["unpin", "mine"]);
    project.ok(&["gc", "--keep-days", "0"]);
    assert!(project.store_listing().is_empty());
}

/// A damaged record may be the record of a pinned artifact.
#[test]
fn a_damaged_record_stops_gc_until_it_is_removed_or_rewritten() {
    let project = pinned();
    let record = first_entry(&project, "actions", ".json");
    let damage = || fs::write(&record, "{\"stage\":").unwrap();
    let name = record.file_name().unwrap().to_str().unwrap();
    damage();
    let before = project.store_listing();
    let gc = ["gc", "--keep-days", "0"];
    project.run(&gc).fails(1, &["nothing was deleted", name, "`nerf-sr verify --remove`"]);
    assert_eq!(project.store_listing(), before);
    assert!(project.ok(&["run", "text"]).contains("1 of 1 stage ran"));
    project.ok(&gc);
    damage();
    for arguments in [&["verify"][..], &["verify", "--remove"]] {
        let verified = project.run(arguments);
        assert!(verified.code == 3 && verified.stdout.contains(name), "{}", verified.stdout);
        assert!(verified.stdout.ends_with("1 artifact, 0 damaged, 1 record damaged\n"));
    }
    assert!(project.ok(&["verify"]).ends_with("1 artifact, 0 damaged\n"));
    project.ok(&gc);
}

/// If two users without a common group share a store, messages must report missing permissions.
#[test]
fn a_colleagues_files_are_not_called_damaged() {
    let project = pinned();
    let object = first_entry(&project, "objects", "");
    fs::set_permissions(&object, PermissionsExt::from_mode(0o0)).unwrap();
    let Some(verified) = run_unprivileged(&project, &["verify", "--remove"]) else { return };
    fs::set_permissions(&object, PermissionsExt::from_mode(0o777)).unwrap();
    let report = &verified.stdout;
    assert!(verified.code == 3 && report.contains("cannot read ") && object.exists(), "{report}");
    assert!(
        report.contains(advice()[0]) && !report.contains("the artifact is damaged"),
        "{report}"
    );
    assert!(report.ends_with("1 artifact, 0 damaged, 1 unreadable\n"), "{report}");
    // A lock of an unfinished action, as a colleague with umask 022 leaves the file.
    fs::remove_dir_all(&object).unwrap();
    let lock = first_entry(&project, "locks", "");
    fs::set_permissions(&lock, PermissionsExt::from_mode(0o444)).unwrap();
    let name = format!("locks/{}: Permission denied", lock.file_name().unwrap().to_str().unwrap());
    let refused = run_unprivileged(&project, &["run", "text"]).unwrap();
    refused.fails(1, &[&[&name[..]], advice()].concat());
}

/// Some clusters' file systems have no file locks.
#[test]
fn a_file_system_without_locks_is_reported() {
    let project = pinned();
    let source = "#include <errno.h>\nint flock(int f, int o) { errno = ENOSYS; return -1; }\n";
    project.write("shim.c", source);
    let shim = project.path("shim.so");
    let compiled = Command::new("cc")
        .args(["-shared", "-fPIC", "-o"])
        .args([&shim, &project.path("shim.c")])
        .status();
    if !compiled.is_ok_and(|status| status.success()) {
        eprintln!("skipped: no C compiler");
        return;
    }
    let words = ["file locks don't work on the file system of", "local disk", "--store"];
    for arguments in [&["run", "text"][..], &["gc"], &["run", "text", "--store", "fresh"]] {
        let output = project.command(arguments).env("LD_PRELOAD", &shim).output().unwrap();
        Finished::of(output).fails(1, &words);
    }
}

/// Starts the runner as process 1 of a new PID namespace, as a container does.
fn spawn_contained(project: &Project, arguments: &[&str]) -> Child {
    let mut command = Command::new("unshare");
    command.args(["--pid", "--fork"]).arg(bin("nerf-sr")).args(arguments);
    command.current_dir(project.path(".")).env_remove("NERF_SR_STORE");
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

#[test]
fn containers_share_a_store() {
    if !Command::new("unshare")
        .args(["--pid", "--fork", "true"])
        .status()
        .is_ok_and(|s| s.success())
    {
        eprintln!("skipped: a new PID namespace needs root");
        return;
    }
    let project = scripted(COPY_PARAMETERS);
    for word in ["a", "b", "c"] {
        let value = format!("text.word={word}");
        let runs = [(); 3].map(|()| spawn_contained(&project, &["run", "text", "-p", &value]));
        for run in runs {
            let finished = Finished::of(run.wait_with_output().unwrap());
            assert_eq!(finished.code, 0, "{}", finished.stderr);
        }
    }
    assert_eq!(fs::read_dir(project.path(".nerf-sr/runs")).unwrap().count(), 9);
}

/// Returns whether a process has an open file whose path contains `part`.
fn has_open(process: u32, part: &str) -> bool {
    let files = fs::read_dir(format!("/proc/{process}/fd")).into_iter().flatten().flatten();
    let mut targets = files.filter_map(|file| fs::read_link(file.path()).ok());
    targets.any(|target: PathBuf| target.to_string_lossy().contains(part))
}

/// Starts `verify`, and suspends the process while an artifact is being read.
fn suspended_verify(project: &Project, arguments: &[&str]) -> Child {
    loop {
        let mut child = project.spawn(arguments);
        while child.try_wait().unwrap().is_none() {
            if has_open(child.id(), "/word") {
                signal(&child, "-STOP");
                return child;
            }
        }
    }
}

/// Artifacts that `gc` deletes while `verify` reads aren't damaged.
#[test]
fn verify_reports_no_damage_during_gc() {
    // Large enough that `verify` is suspended while reading, and sparse on the disk.
    let project = scripted("cp $params $out/word; truncate -s 200M $out/word");
    for arguments in [&["verify"][..], &["verify", "--remove"]] {
        project.ok(&["run", "text", "-p", "text.word=a,b,c"]);
        let verify = suspended_verify(&project, arguments);
        project.ok(&["gc", "--keep-days", "0"]);
        assert!(project.store_listing().is_empty());
        signal(&verify, "-CONT");
        let finished = Finished::of(verify.wait_with_output().unwrap());
        assert_eq!(finished.code, 0, "{}{}", finished.stdout, finished.stderr);
        assert!(finished.stdout.ends_with(", 0 damaged\n"), "{}", finished.stdout);
    }
}

/// Commands that write links or pipes, and the reason why the output is refused. `${0%/*}` is the
/// project's folder.
const LINKS: [(&str, &str); 4] = [
    ("rmdir $out; ln -s ${0%/*}/own $out", "/output is a symbolic link"),
    ("cp ${0%/*}/own/x $out; ln -s x $out/link", "/output/link is a symbolic link"),
    ("mkdir $out/in; ln -s .. $out/in/loop", "/output/in/loop is a symbolic link"),
    ("mkfifo $out/summary.txt", "/output/summary.txt is a named pipe (FIFO)"),
];

fn assert_untouched(project: &Project) {
    assert_eq!(fs::read_dir(project.path("own")).unwrap().count(), 1);
    assert_eq!(fs::read_to_string(project.path("own/x")).unwrap(), "mine");
}

/// A linked artifact would change with the user's file, and the runner would write into the user's
/// folder.
#[test]
fn links_in_a_stages_output_are_refused() {
    for (command, reason) in LINKS {
        let project = scripted(command);
        project.write("own/x", "mine");
        project.run(&["run", "text"]).fails(1, &["text", "without a valid artifact", reason]);
        assert!(project.store_listing().is_empty());
        assert_untouched(&project);
    }
}

/// Description of a sink.
const SINK: &str = r#"{"name": "page", "version": "1", "code": "1", "summary": "Shows.", "sink": true, "parameters": {"type": "object"},
  "inputs": {"run": {"kinds": ["run"], "summary": "a run"}}, "output": {"kind": "page"}}"#;

/// A failed sink doesn't stop the others, and the first one gives the exit code.
#[test]
fn every_sink_runs() {
    let project = scripted(COPY_PARAMETERS);
    project.write(
        "pipeline.yaml",
        "default: [a, b, c]\nstages:\n  text: {run: ./text}\n  a: {run: ./page, inputs: {run: text}}\n  \
        b: {run: ./page, inputs: {run: text}}\n  c: {run: ./page, inputs: {run: text}}\n",
    );
    let script = fs::read_to_string(project.path("text")).unwrap();
    let (_, body) = script.split_once("exit; fi\n").unwrap();
    let command = "case $out in */a/output) echo bad >&2; exit 3;; */b/output) exit;; esac; \
        mkdir $out; cp $params $out/x";
    let body = body.replace(&format!("mkdir $out; {COPY_PARAMETERS}"), command);
    let script = format!("#!/bin/sh\nif [ $1 = describe ]; then echo '{SINK}'; exit; fi\n{body}");
    project.program("page", &script);
    let finished = project.run(&["run"]);
    finished.fails(3, &["a: bad"]);
    finished.fails(3, &["b: ", "without a valid artifact", "not created the folder --output"]);
    assert!(project.path("out/c/x").exists() && !project.path("out/b").exists());
}

#[test]
fn links_in_a_sinks_output_are_refused() {
    for (command, reason) in LINKS {
        let project = scripted(COPY_PARAMETERS);
        project.write("own/x", "mine");
        project.write(
            "pipeline.yaml",
            "default: [page]\nstages:\n  text: {run: ./text}\n  page: {run: ./page, inputs: {run: text}}\n",
        );
        let script = fs::read_to_string(project.path("text")).unwrap();
        let (_, body) = script.split_once("exit; fi\n").unwrap();
        let body = body.replace(COPY_PARAMETERS, command);
        project.program(
            "page",
            &format!("#!/bin/sh\nif [ $1 = describe ]; then echo '{SINK}'; exit; fi\n{body}"),
        );
        project.run(&["run", "page"]).fails(1, &["page", reason]);
        assert!(!project.path("out/page").exists());
        assert_untouched(&project);
    }
}

/// A hard link is a second name of the user's file, so the artifact contains a copy.
#[test]
fn a_hard_link_in_an_output_becomes_a_copy() {
    let project = scripted("ln ${0%/*}/own/x $out/x");
    project.write("own/x", "mine");
    project.ok(&["run", "text"]);
    fs::write(project.path("own/x"), "new!").unwrap();
    assert!(project.ok(&["verify"]).ends_with("1 artifact, 0 damaged\n"));
}
