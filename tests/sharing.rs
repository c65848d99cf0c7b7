//! Several runners, garbage collection and other people's files around one store.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::io::{BufRead as _, BufReader};
use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;
use std::process::{Child, Command};

use common::{Finished, Project, call_of, last_checkpoint, signal, verbs, wait_until};

/// A training that lasts until it is killed.
const ENDLESS: [&str; 2] = ["-p", "train-ss.rays=4000000000"];

fn is_whole(page: &Path) -> bool {
    let text = std::fs::read_to_string(page.join("index.html")).unwrap_or_default();
    text.trim_end().ends_with("</html>") && page.join("results.json").exists()
}

#[test]
fn eight_runners_make_each_stage_once() {
    let rounds = std::env::var("NERF_SR_REPEAT").map_or(2, |text| text.parse().unwrap());
    for _ in 0..rounds {
        let project = Project::fast();
        let outs = ["a", "b", "c", "d", "shared", "shared", "shared", "shared"];
        let runners: Vec<Child> =
            outs.iter().map(|out| project.spawn(&["run", "--out", out])).collect();
        let finished: Vec<Finished> =
            runners.into_iter().map(|r| Finished::of(r.wait_with_output().unwrap())).collect();
        for one in &finished {
            assert_eq!(one.code, 0, "{}{}", one.stdout, one.stderr);
        }
        let done: usize = finished.iter().map(|one| one.stderr.matches(": done in ").count()).sum();
        assert_eq!(done, 5, "five stages in all");
        for out in outs {
            assert!(is_whole(&project.path(out).join("report")), "{out}");
            assert_eq!(
                std::fs::read_dir(project.path(out)).unwrap().count(),
                1,
                "nothing is left beside {out}'s page"
            );
        }
        assert!(project.ok(&["verify"]).contains("5 artifacts, 0 damaged"));
    }
}

/// Lines of a runner's stderr until one has these words.
fn said(child: &mut Child, words: &str) -> String {
    let lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
    lines
        .into_iter()
        .find(|line| line.contains(words))
        .unwrap_or_else(|| panic!("never said {words:?}"))
}

/// A training that is at work on its checkpoints.
fn training(project: &Project) -> Child {
    let child = project.spawn(&[&["run"][..], &ENDLESS].concat());
    wait_until(|| last_checkpoint(&project.path(".nerf-sr/partial")).is_some());
    child
}

/// Returns whether this process and its children ignore hangups, as under nohup.
fn hangups_are_ignored() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).unwrap();
    u64::from_str_radix(ignored.trim(), 16).unwrap() & 1 == 1
}

#[test]
fn a_runner_that_waits_says_for_whom_and_ends_at_a_signal() {
    let project = Project::fast();
    let mut first = training(&project);
    for (name, is_stopped) in [("-INT", false), ("-TERM", true), ("-HUP", true)] {
        if name == "-HUP" && hangups_are_ignored() {
            eprintln!("skipped: nohup has SIGHUP ignored");
            continue;
        }
        if is_stopped {
            signal(&first, "-STOP");
        }
        let mut second = project.spawn(&[&["run"][..], &ENDLESS].concat());
        let line = said(&mut second, "is being created");
        assert!(
            line.contains(&format!("train-ss: is being created by process {}", first.id())),
            "{line}"
        );
        signal(&second, name);
        assert_eq!(second.wait().unwrap().code(), Some(130), "{name}");
        signal(&first, "-CONT");
    }
    signal(&first, "-INT");
    assert_eq!(first.wait().unwrap().code(), Some(130));
}

#[test]
fn garbage_collection_keeps_what_a_run_in_progress_needs() {
    let project = Project::fast();
    let first = training(&project);
    let partial = std::fs::read_dir(project.path(".nerf-sr/partial"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    // However long ago it began.
    Command::new("touch").args(["-d", "9 days ago"]).arg(&partial).status().unwrap();
    let said = project.ok(&["gc", "demo-scene", "--keep-days", "0", "--drop-unfinished"]);
    for (stage, reason) in [
        ("prep", "needed by the run of process"),
        ("demo-scene", "the pipeline needs it"),
        ("train-ss", "needed by the run of process"),
    ] {
        assert!(
            said.lines().any(|line| line.contains(stage) && line.contains(reason)),
            "{stage}: {said}"
        );
    }
    assert!(partial.join("work").is_dir(), "{said}");
    let before = last_checkpoint(&project.path(".nerf-sr/partial"));
    wait_until(|| last_checkpoint(&project.path(".nerf-sr/partial")) > before);
    signal(&first, "-INT");
    let finished = Finished::of(first.wait_with_output().unwrap());
    assert_eq!(finished.code, 130, "{}", finished.stderr);
    // Stopped, it is an unfinished action with a checkpoint: it and what it is made of stay until
    // one says otherwise.
    let said = project.ok(&["gc", "demo-scene", "--keep-days", "0"]);
    assert!(partial.join("work").is_dir() && said.contains("has a checkpoint"), "{said}");
    assert!(
        said.lines().any(|line| line.contains("prep") && line.contains("input of train-ss")),
        "{said}"
    );
    let said = project.ok(&["gc", "demo-scene", "--keep-days", "0", "--drop-unfinished"]);
    assert!(
        !partial.exists()
            && said.lines().any(|line| line.contains("prep") && line.ends_with("delete")),
        "{said}"
    );
}

/// Records that `plan` expects to reuse aren't collected, even if their keys aren't known yet.
#[test]
fn what_waits_keeps_its_records() {
    let project = Project::fast();
    project.ok(&["run"]);
    std::fs::remove_dir_all(project.artifact("prep", &[])).unwrap();
    assert!(project.ok(&["plan"]).contains("stays cached"));
    project.ok(&["gc", "--keep-days", "0"]);
    assert!(project.ok(&["run"]).contains("1 of 5 stages ran"));
}

#[test]
fn another_point_goes_unless_it_is_pinned() {
    let project = Project::fast();
    project.ok(&["run"]);
    let own = project.store_listing();
    let point = ["-p", "kernel=box"];
    project.ok(&[&["run"][..], &point].concat());
    let both = project.store_listing();
    project.ok(&[&["pin", "boxes"][..], &point].concat());
    project.ok(&["gc", "--keep-days", "0"]);
    assert_eq!(project.store_listing(), both);
    project.run(&["unpin", "box"]).fails(2, &["no pin \"box\"; pins: boxes"]);
    project.run(&["pin", "../x"]).fails(2, &["invalid pin name"]);
    project.run(&["pin", "new", "-p", "kernel=bicubic"]).fails(2, &["has no artifact to pin yet"]);
    project.ok(&["unpin", "boxes"]);
    // Used within the days to keep: it stays.
    project.ok(&["gc"]);
    assert_eq!(project.store_listing(), both);
    assert!(project.ok(&["gc", "--keep-days", "0", "--dry-run"]).contains("would be deleted"));
    assert_eq!(project.store_listing(), both);
    project.ok(&["gc", "--keep-days", "0"]);
    assert_eq!(project.store_listing(), own);
}

#[test]
fn a_manifest_that_is_gone_is_written_again() {
    let project = Project::fast();
    project.ok(&["run"]);
    let manifest = project.artifact("train-ss", &[]).join("artifact.json");
    let foreign = std::fs::read(project.artifact("prep", &[]).join("artifact.json")).unwrap();
    for damage in [None, Some(&b""[..]), Some(&foreign[..])] {
        std::fs::remove_file(&manifest).unwrap();
        if let Some(bytes) = damage {
            std::fs::write(&manifest, bytes).unwrap();
        }
        assert!(project.ok(&["run"]).contains("nothing to run"));
        assert!(project.ok(&["verify"]).contains("5 artifacts, 0 damaged"));
    }
    // A file in an object's place gives way, once.
    let object = project.artifact("eval", &[]);
    std::fs::remove_dir_all(&object).unwrap();
    std::fs::write(&object, "").unwrap();
    assert!(project.ok(&["run"]).contains("1 of 5 stages ran"));
    assert!(project.ok(&["run"]).contains("nothing to run"));
}

#[test]
fn somebody_elses_folder_is_not_replaced() {
    let project = Project::fast();
    for (file, text) in [("mine/report/notes.txt", "precious"), ("mine/report/index.html", "hi")] {
        project.write(file, text);
    }
    project
        .run(&["run", "--out", "mine"])
        .fails(1, &["mine/report/", "was not written by nerf-sr", "--out"]);
    assert_eq!(std::fs::read_to_string(project.path("mine/report/notes.txt")).unwrap(), "precious");
    assert_eq!(std::fs::read_dir(project.path("mine")).unwrap().count(), 1);
    // Notes laid beside a page stay, too, when the page would change.
    project.ok(&["run"]);
    project.write("out/report/notes.txt", "precious");
    assert!(project.ok(&["run"]).contains("up to date"));
    project
        .run(&["run", "-p", "render-depth.samples_per_axis=2"])
        .fails(1, &["out/report/notes.txt", "was not written by nerf-sr"]);
    assert!(is_whole(&project.path("out/report")));
    std::fs::remove_file(project.path("out/report/notes.txt")).unwrap();
    project.ok(&["run", "-p", "render-depth.samples_per_axis=2"]);
}

/// A run was killed when its page had taken the place of another data set's, which wasn't put aside
/// yet: it is put aside by the next run, and the data set's page isn't lost.
#[test]
fn a_page_that_a_kill_left_is_put_aside() {
    let project = Project::fast();
    project.demo_data("demo");
    for name in ["a", "b"] {
        let mut copy = Command::new("cp");
        copy.arg("-rL").args([project.path("data/demo"), project.path(name)]);
        assert!(copy.status().unwrap().success());
    }
    let out = |name: &str| project.path("out").join(name);
    let run = ["run", "-i", "dataset=a"];
    project.ok(&run);
    let page = std::fs::read(out("report/index.html")).unwrap();
    std::fs::rename(out("report"), project.path("page")).unwrap();
    let run = ["run", "-i", "dataset=b"];
    project.ok(&run);
    for more in [&[][..], &["-p", "render-depth.samples_per_axis=2"]] {
        let mut copy = Command::new("cp");
        copy.arg("-r").arg(project.path("page"));
        assert!(copy.arg(out(".report.nerf-sr-new")).status().unwrap().success());
        let said = project.ok(&[&run[..], more].concat());
        assert!(said.contains("moved the earlier page to") && said.contains("report-a"), "{said}");
        assert!(std::fs::read(out("report-a/index.html")).unwrap() == page);
        assert!(is_whole(&out("report")));
        std::fs::remove_dir_all(out("report-a")).unwrap();
        assert_eq!(std::fs::read_dir(out("")).unwrap().count(), 1, "nothing is left beside");
    }
}

/// A small tmpfs for the pages: needs root, as CI has; says so where it can't be mounted.
#[test]
fn a_full_disk_leaves_the_old_page() {
    let project = Project::fast();
    let out = project.path("out");
    std::fs::create_dir(&out).unwrap();
    let mounted =
        Command::new("mount").args(["-t", "tmpfs", "-o", "size=600k", "tmpfs"]).arg(&out).output();
    if !mounted.is_ok_and(|m| m.status.success()) {
        eprintln!("skipped: a tmpfs can't be mounted here (it needs root)");
        return;
    }
    project.ok(&["run"]);
    let before = std::fs::read(out.join("report/index.html")).unwrap();
    std::fs::write(out.join("filler"), vec![0; 1 << 20]).unwrap_err();
    let finished = project.run(&["run", "-p", "render-depth.samples_per_axis=2"]);
    let after = std::fs::read(out.join("report/index.html")).unwrap();
    let names = std::fs::read_dir(&out).unwrap().count();
    std::fs::remove_file(out.join("filler")).unwrap();
    let again = project.run(&["run", "-p", "render-depth.samples_per_axis=2"]);
    Command::new("umount").arg(&out).status().unwrap();
    finished.fails(1, &["No space left on device"]);
    assert!(after == before && names == 2, "the old page is whole");
    assert_eq!(again.code, 0, "{}", again.stderr);
}

/// A file whose name isn't UTF-8 in a data folder is ignored if no frame names it.
#[test]
fn any_file_name_may_lie_in_a_data_folder() {
    let project = Project::fast();
    project.demo_data("demo");
    let data = project.path("ds");
    assert!(
        Command::new("cp")
            .arg("-rL")
            .args([project.path("data/demo"), data.clone()])
            .status()
            .unwrap()
            .success()
    );
    std::fs::remove_file(data.join("artifact.json")).unwrap();
    let from = ["-i", "dataset=ds"];
    project.ok(&[&["run", "prep"][..], &from].concat());
    let scene = project.output_of("prep", &from);
    for name in [&b"\xff\xfe.png"[..], b"\x1b]0;PWN\x07", b"new\nline"] {
        std::fs::copy(
            data.join("train/r_2.png"),
            data.join("train").join(std::ffi::OsStr::from_bytes(name)),
        )
        .unwrap();
        // A folder's key is of all its files.
        assert!(project.ok(&[&["plan", "prep"][..], &from].concat()).contains("will run"));
        project.ok(&[&["run", "prep"][..], &from].concat());
        assert_eq!(project.output_of("prep", &from), scene);
    }
    // The same holds for a folder that the command line names.
    let mut command = project.command(&[&["run"][..], &from].concat());
    let out = std::ffi::OsStr::from_bytes(b"pages-\xff");
    assert!(command.arg("--out").arg(out).output().unwrap().status.success());
    assert!(is_whole(&project.path(".").join(out).join("report")));
    // A link that leads back up is named, with what to do.
    std::os::unix::fs::symlink(&data, data.join("loop")).unwrap();
    project.run(&[&["run", "prep"][..], &from].concat()).fails(3, &["ds/loop", "remove the link"]);
}

/// All files of the store, by path and size.
fn files(project: &Project) -> Vec<(String, u64)> {
    let entries =
        walkdir::WalkDir::new(project.path(".nerf-sr")).sort_by_file_name().into_iter().flatten();
    let files = entries.filter(|entry| entry.file_type().is_file());
    files.map(|file| (file.path().display().to_string(), file.metadata().unwrap().len())).collect()
}

#[test]
fn a_store_of_a_newer_form_is_refused() {
    let project = Project::fast();
    project.ok(&["run", "prep"]);
    project.write(".nerf-sr/format", "99\n");
    let before = files(&project);
    // These open no store.
    let others = ["init", "describe", "completions"];
    for verb in verbs().iter().filter(|verb| !others.contains(&verb.as_str())) {
        let finished = project.run(&call_of(verb));
        assert_eq!(
            finished.code, 1,
            "{verb}: {}\n(call_of in tests/common/mod.rs has a verb's arguments; one that opens no \
            store is excepted above)",
            finished.stderr
        );
        finished.fails(1, &[".nerf-sr", "format 99", "use the newer nerf-sr"]);
    }
    assert_eq!(files(&project), before, "nothing is written");
}

/// A newer runner takes the store over while this one trains: what this one made is not taken in,
/// and nothing of the store changes.
#[test]
fn a_runner_takes_nothing_into_a_store_that_has_become_newer() {
    let project = Project::fast();
    let what = ["train-ss", "-p", "train-ss.rays=1000000"];
    let run = [&["run"][..], &what].concat();
    let child = project.spawn(&run);
    wait_until(|| last_checkpoint(&project.path(".nerf-sr/partial")).is_some());
    project.write(".nerf-sr/format", "2\n");
    let before = project.store_listing();
    Finished::of(child.wait_with_output().unwrap())
        .fails(1, &["train-ss: failed", "format 2", "use the newer nerf-sr"]);
    assert_eq!(project.store_listing(), before);
    // The older one again, now alone: it resumes from its checkpoint.
    project.write(".nerf-sr/format", "1\n");
    assert!(project.ok(&[&["status"][..], &what].concat()).contains("has a checkpoint"));
    project.ok(&run);
    assert!(project.ok(&["verify"]).contains("0 damaged"));
}
