//! Promises of the store: a file that can't be read isn't taken for absent, and users of one store
//! don't get in each other's way.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt, symlink};
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use common::{Finished, Project, bin, signal};

/// A pipeline of one shell script; `run` is what it does, with `$out` its output and `$params` its
/// parameters. The default is another point of the same stage.
fn scripted(run: &str) -> Project {
    let project = Project::new(
        "default: [other]\nstages:\n  text: {run: ./text}\n  other: {extends: text, parameters: \
        {word: other}}\n",
    );
    let description = r#"{"name": "text", "version": "1", "code": "1", "summary": "Writes.", "inputs": {},
      "parameters": {"type": "object", "properties": {"word": {"type": "string", "default": "a"}}}, "output": {"kind": "text"}}"#;
    let script = format!(
        "#!/bin/sh\nif [ \"$1\" = describe ]; then cat <<'END'\n{description}\nEND\nexit; fi\n\
         while [ $# -gt 0 ]; do case $1 in --output) out=$2;; --params) params=$2;; esac; shift; \
         done\nmkdir $out; {run}\n"
    );
    project.program("text", &script);
    project
}

/// An artifact for each word.
const WORD: &str = "cp $params $out/word";

/// A store with a pinned artifact: of another user's, where root runs the tests.
fn pinned() -> Project {
    let project = scripted(WORD);
    project.ok(&["run", "text"]);
    project.ok(&["pin", "mine", "text"]);
    let opened = Command::new("chmod").args(["-R", "a+rwX"]).arg(project.path(".")).status();
    assert!(opened.unwrap().success());
    project
}

/// Runs the runner with no more rights than any user has; `None` if that user can't start it.
fn unprivileged(project: &Project, arguments: &[&str]) -> Option<Finished> {
    let mut command = project.command(arguments);
    if fs::metadata("/proc/self").unwrap().uid() == 0 {
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

/// The first file of a folder of the store.
fn first(project: &Project, folder: &str, ending: &str) -> PathBuf {
    let entries = fs::read_dir(project.path(".nerf-sr").join(folder)).unwrap();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.to_str().unwrap().ends_with(ending));
    paths.sort();
    paths.remove(0)
}

/// Files by which an artifact stays, and whether its stage's state follows from them.
const NEEDED: [(&str, &str, bool); 5] = [
    ("actions", ".json", true),
    ("objects", "", true),
    ("pins", ".jsonl", false),
    ("runs", ".jsonl", false),
    ("locks", "", false),
];

#[test]
fn gc_deletes_nothing_where_a_file_may_not_be_read() {
    let project = pinned();
    let before = project.store_listing();
    for (folder, ending, decides) in NEEDED {
        let path = first(&project, folder, ending);
        let permissions = fs::metadata(&path).unwrap().permissions();
        fs::set_permissions(&path, PermissionsExt::from_mode(0o0)).unwrap();
        let name = format!("{folder}/{}", path.file_name().unwrap().to_str().unwrap());
        let refused = [&name, "Permission denied", "owned by user", "umask 002", "--store"];
        for arguments in [&["gc", "--keep-days", "0"][..], &["gc", "--dry-run"]] {
            let Some(finished) = unprivileged(&project, arguments) else { return };
            finished.fails(1, &[&["nothing was deleted"][..], &refused].concat());
        }
        for verb in ["status", "plan", "run"].into_iter().filter(|_| decides) {
            unprivileged(&project, &[verb, "text"]).unwrap().fails(1, &refused);
        }
        fs::set_permissions(&path, permissions).unwrap();
        assert_eq!(project.store_listing(), before, "{name}");
    }
    project.ok(&["gc", "--keep-days", "0"]);
    assert_eq!(project.store_listing(), before, "it is pinned");
}

/// A loop of links, which not even root can read.
#[test]
fn what_can_not_be_read_is_not_absent() {
    for (folder, ending, decides) in NEEDED {
        let project = pinned();
        let path = match folder {
            "objects" => first(&project, folder, ending).join("artifact.json"),
            _ => first(&project, folder, ending),
        };
        fs::remove_file(&path).unwrap();
        symlink(path.file_name().unwrap(), &path).unwrap();
        let before = project.store_listing();
        let name = path.strip_prefix(project.path(".nerf-sr")).unwrap().to_str().unwrap();
        let words = [name, "Too many levels of symbolic links"];
        project
            .run(&["gc", "--keep-days", "0"])
            .fails(1, &[&["nothing was deleted"][..], &words].concat());
        for verb in ["status", "plan", "run"].into_iter().filter(|_| decides) {
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
    project.run(&["unpin", "yours"]).fails(2, &["no pin \"yours\"; pins: mine"]);
    project.ok(&["unpin", "mine"]);
    project.ok(&["gc", "--keep-days", "0"]);
    assert!(project.store_listing().is_empty());
}

/// A damaged record may be the one by which an artifact is pinned.
#[test]
fn a_damaged_record_stops_gc_until_it_is_removed_or_made_again() {
    let project = pinned();
    let record = first(&project, "actions", ".json");
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

/// Two users and one store without a common group: messages say what is wrong.
#[test]
fn a_colleagues_files_are_not_called_damaged() {
    let project = pinned();
    let object = first(&project, "objects", "");
    fs::set_permissions(&object, PermissionsExt::from_mode(0o0)).unwrap();
    let Some(verified) = unprivileged(&project, &["verify", "--remove"]) else { return };
    fs::set_permissions(&object, PermissionsExt::from_mode(0o777)).unwrap();
    let said = &verified.stdout;
    assert!(verified.code == 3 && said.contains("cannot read ") && object.exists(), "{said}");
    assert!(said.contains("owned by user") && !said.contains("the artifact is damaged"), "{said}");
    assert!(said.ends_with("1 artifact, 0 damaged, 1 unreadable\n"), "{said}");
    // The lock of an action that isn't done, as a colleague with umask 022 leaves it.
    fs::remove_dir_all(&object).unwrap();
    let lock = first(&project, "locks", "");
    fs::set_permissions(&lock, PermissionsExt::from_mode(0o444)).unwrap();
    let name = format!("locks/{}: Permission denied", lock.file_name().unwrap().to_str().unwrap());
    let refused = unprivileged(&project, &["run", "text"]).unwrap();
    refused.fails(1, &[&name, "owned by user", "umask 002", "--store"]);
}

/// Some file systems of clusters have no locks.
#[test]
fn a_file_system_without_locks_is_named() {
    let project = pinned();
    let refuse = "#include <errno.h>\nint flock(int f, int o) { errno = ENOSYS; return -1; }\n";
    project.write("shim.c", refuse);
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

/// Starts the runner as process 1 of its own, as a container does.
fn contained(project: &Project, arguments: &[&str]) -> Child {
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
        eprintln!("skipped: processes can't be counted anew here (it needs root)");
        return;
    }
    let project = scripted(WORD);
    for word in ["a", "b", "c"] {
        let value = format!("text.word={word}");
        let runs = [(); 3].map(|()| contained(&project, &["run", "text", "-p", &value]));
        for run in runs {
            let finished = Finished::of(run.wait_with_output().unwrap());
            assert_eq!(finished.code, 0, "{}", finished.stderr);
        }
    }
    assert_eq!(fs::read_dir(project.path(".nerf-sr/runs")).unwrap().count(), 9);
}

/// Returns whether a process has a file open whose path contains these words.
fn has_open(process: u32, words: &str) -> bool {
    let files = fs::read_dir(format!("/proc/{process}/fd")).into_iter().flatten().flatten();
    let mut targets = files.filter_map(|file| fs::read_link(file.path()).ok());
    targets.any(|target: PathBuf| target.to_string_lossy().contains(words))
}

/// Starts `verify` and stops it while it reads its first artifact.
fn stopped_verify(project: &Project, arguments: &[&str]) -> Child {
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

/// Artifacts that garbage collection takes while `verify` reads aren't damaged.
#[test]
fn verify_beside_gc_cries_no_damage() {
    // Large enough to be met while it is read; there are holes on the disk.
    let project = scripted("cp $params $out/word; truncate -s 200M $out/word");
    for arguments in [&["verify"][..], &["verify", "--remove"]] {
        project.ok(&["run", "text", "-p", "text.word=a,b,c"]);
        let verify = stopped_verify(&project, arguments);
        project.ok(&["gc", "--keep-days", "0"]);
        assert!(project.store_listing().is_empty());
        signal(&verify, "-CONT");
        let finished = Finished::of(verify.wait_with_output().unwrap());
        assert_eq!(finished.code, 0, "{}{}", finished.stdout, finished.stderr);
        assert!(finished.stdout.ends_with(", 0 damaged\n"), "{}", finished.stdout);
    }
}

/// Scripts' changes to their output, and the reason of the refusal; `${0%/*}` is the project.
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

/// An artifact that is a link would change with the user's file, and the runner would write into
/// the user's folder.
#[test]
fn links_in_a_stages_output_are_refused() {
    for (run, words) in LINKS {
        let project = scripted(run);
        project.write("own/x", "mine");
        project.run(&["run", "text"]).fails(1, &["text", "without a valid artifact", words]);
        assert!(project.store_listing().is_empty());
        assert_untouched(&project);
    }
}

#[test]
fn links_in_a_sinks_output_are_refused() {
    let description = r#"{"name": "page", "version": "1", "code": "1", "summary": "Shows.", "sink": true, "parameters": {"type": "object"},
      "inputs": {"run": {"kinds": ["run"], "summary": "a run"}}, "output": {"kind": "page"}}"#;
    for (run, words) in LINKS {
        let project = scripted(WORD);
        project.write("own/x", "mine");
        project.write(
            "pipeline.yaml",
            "default: [page]\nstages:\n  text: {run: ./text}\n  page: {run: ./page, inputs: {run: text}}\n",
        );
        let script = fs::read_to_string(project.path("text")).unwrap();
        let (_, arguments) = script.split_once("exit; fi\n").unwrap();
        let arguments = arguments.replace(WORD, run);
        project.program(
            "page",
            &format!(
                "#!/bin/sh\nif [ $1 = describe ]; then echo '{description}'; exit; fi\n{arguments}"
            ),
        );
        project.run(&["run", "page"]).fails(1, &["page", words]);
        assert!(!project.path("out/page").exists());
        assert_untouched(&project);
    }
}

/// A hard link is a second name of the user's file: the artifact has a copy.
#[test]
fn a_hard_link_in_an_output_becomes_a_copy() {
    let project = scripted("ln ${0%/*}/own/x $out/x");
    project.write("own/x", "mine");
    project.ok(&["run", "text"]);
    fs::write(project.path("own/x"), "new!").unwrap();
    assert!(project.ok(&["verify"]).ends_with("1 artifact, 0 damaged\n"));
}
