//! Concurrent runners, garbage collection and foreign files, in one store and its output folder.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::io::{BufRead as _, BufReader};
use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;
use std::process::{Child, Command};

use common::{Finished, Project, call_of, last_checkpoint, signal, verbs, wait_until};

/// Arguments of a training that lasts until it is killed.
const ENDLESS: [&str; 2] = ["-p", "train-ss.rays=4000000000"];

fn is_complete(page: &Path) -> bool {
    let text = std::fs::read_to_string(page.join("index.html")).unwrap_or_default();
    text.trim_end().ends_with("</html>") && page.join("results.json").exists()
}

#[test]
fn eight_runners_run_each_stage_once() {
    let rounds = std::env::var("NERF_SR_REPEAT").map_or(2, |text| text.parse().unwrap());
    for _ in 0..rounds {
        let project = Project::fast();
        let outs = ["a", "b", "c", "d", "shared", "shared", "shared", "shared"];
        let runners: Vec<Child> =
            outs.iter().map(|out| project.spawn(&["run", "--out", out])).collect();
        let finished: Vec<Finished> =
            runners.into_iter().map(|r| Finished::of(r.wait_with_output().unwrap())).collect();
        for runner in &finished {
            assert_eq!(runner.code, 0, "{}{}", runner.stdout, runner.stderr);
        }
        let done: usize =
            finished.iter().map(|runner| runner.stderr.matches(": done in ").count()).sum();
        assert_eq!(done, 5, "each of five stages runs once");
        for out in outs {
            assert!(is_complete(&project.path(out).join("report")), "{out}");
            assert_eq!(
                std::fs::read_dir(project.path(out)).unwrap().count(),
                1,
                "{out} contains only the page"
            );
        }
        assert!(project.ok(&["verify"]).contains("5 artifacts, 0 damaged"));
    }
}

/// Reads a runner's stderr and returns the first line that contains a text.
fn wait_for_line(child: &mut Child, text: &str) -> String {
    let lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
    lines
        .into_iter()
        .find(|line| line.contains(text))
        .unwrap_or_else(|| panic!("no line with {text:?}"))
}

/// Starts an endless training and waits for the first checkpoint.
fn start_training(project: &Project) -> Child {
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
fn a_waiting_runner_names_the_running_process_and_ends_at_a_signal() {
    let project = Project::fast();
    let mut first = start_training(&project);
    for (signal_name, is_stopped) in [("-INT", false), ("-TERM", true), ("-HUP", true)] {
        if signal_name == "-HUP" && hangups_are_ignored() {
            eprintln!("skipped: nohup has SIGHUP ignored");
            continue;
        }
        if is_stopped {
            signal(&first, "-STOP");
        }
        let mut second = project.spawn(&[&["run"][..], &ENDLESS].concat());
        let line = wait_for_line(&mut second, "is being created");
        assert!(
            line.contains(&format!("train-ss: is being created by process {}", first.id())),
            "{line}"
        );
        signal(&second, signal_name);
        assert_eq!(second.wait().unwrap().code(), Some(130), "{signal_name}");
        signal(&first, "-CONT");
    }
    signal(&first, "-INT");
    assert_eq!(first.wait().unwrap().code(), Some(130));
}

#[test]
fn garbage_collection_keeps_what_a_run_in_progress_needs() {
    let project = Project::fast();
    let first = start_training(&project);
    let partial = std::fs::read_dir(project.path(".nerf-sr/partial"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    // gc keeps a running action, however old it is.
    Command::new("touch").args(["-d", "9 days ago"]).arg(&partial).status().unwrap();
    let stdout = project.ok(&["gc", "demo-scene", "--keep-days", "0", "--drop-unfinished"]);
    for (stage, reason) in [
        ("prep", "needed by the run of process"),
        ("demo-scene", "the pipeline needs it"),
        ("train-ss", "needed by the run of process"),
    ] {
        assert!(
            stdout.lines().any(|line| line.contains(stage) && line.contains(reason)),
            "{stage}: {stdout}"
        );
    }
    assert!(partial.join("work").is_dir(), "{stdout}");
    let before = last_checkpoint(&project.path(".nerf-sr/partial"));
    wait_until(|| last_checkpoint(&project.path(".nerf-sr/partial")) > before);
    signal(&first, "-INT");
    let finished = Finished::of(first.wait_with_output().unwrap());
    assert_eq!(finished.code, 130, "{}", finished.stderr);
    // The stopped training is an unfinished action with a checkpoint. gc keeps such an action and
    // its inputs, except with `--drop-unfinished`.
    let stdout = project.ok(&["gc", "demo-scene", "--keep-days", "0"]);
    assert!(partial.join("work").is_dir() && stdout.contains("has a checkpoint"), "{stdout}");
    assert!(
        stdout.lines().any(|line| line.contains("prep") && line.contains("input of train-ss")),
        "{stdout}"
    );
    let stdout = project.ok(&["gc", "demo-scene", "--keep-days", "0", "--drop-unfinished"]);
    assert!(
        !partial.exists()
            && stdout.lines().any(|line| line.contains("prep") && line.ends_with("delete")),
        "{stdout}"
    );
}

/// gc keeps the records that `plan` expects to reuse, even if their keys aren't known yet.
#[test]
fn gc_keeps_records_of_waiting_stages() {
    let project = Project::fast();
    project.ok(&["run"]);
    std::fs::remove_dir_all(project.artifact("prep", &[])).unwrap();
    assert!(project.ok(&["plan"]).contains("stays cached"));
    project.ok(&["gc", "--keep-days", "0"]);
    assert!(project.ok(&["run"]).contains("1 of 5 stages ran"));
}

#[test]
fn gc_deletes_another_point_unless_it_is_pinned() {
    let project = Project::fast();
    project.ok(&["run"]);
    let default_listing = project.store_listing();
    let point = ["-p", "kernel=box"];
    project.ok(&[&["run"][..], &point].concat());
    let full_listing = project.store_listing();
    project.ok(&[&["pin", "boxes"][..], &point].concat());
    project.ok(&["gc", "--keep-days", "0"]);
    assert_eq!(project.store_listing(), full_listing);
    project.run(&["unpin", "box"]).fails(2, &["no pin \"box\"; known: boxes"]);
    project.run(&["pin", "../x"]).fails(2, &["invalid pin name"]);
    project.run(&["pin", "new", "-p", "kernel=bicubic"]).fails(2, &["has no artifact to pin yet"]);
    project.ok(&["unpin", "boxes"]);
    // By default, gc keeps artifacts that were used recently.
    project.ok(&["gc"]);
    assert_eq!(project.store_listing(), full_listing);
    assert!(project.ok(&["gc", "--keep-days", "0", "--dry-run"]).contains("would be deleted"));
    assert_eq!(project.store_listing(), full_listing);
    project.ok(&["gc", "--keep-days", "0"]);
    assert_eq!(project.store_listing(), default_listing);
}

#[test]
fn a_missing_or_wrong_manifest_is_rewritten() {
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
    // A file at an object's path is replaced by the object.
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
    // A foreign file in a page's folder also prevents the page's replacement.
    project.ok(&["run"]);
    project.write("out/report/notes.txt", "precious");
    assert!(project.ok(&["run"]).contains("up to date"));
    project
        .run(&["run", "-p", "render-depth.samples_per_axis=2"])
        .fails(1, &["out/report/notes.txt", "was not written by nerf-sr"]);
    assert!(is_complete(&project.path("out/report")));
    std::fs::remove_file(project.path("out/report/notes.txt")).unwrap();
    project.ok(&["run", "-p", "render-depth.samples_per_axis=2"]);
}

/// A run was killed after its page had replaced another data set's page, before the older page was
/// moved aside. The next run moves the older page aside.
#[test]
fn a_page_left_by_a_kill_is_moved_aside() {
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
    for parameters in [&[][..], &["-p", "render-depth.samples_per_axis=2"]] {
        let mut copy = Command::new("cp");
        copy.arg("-r").arg(project.path("page"));
        assert!(copy.arg(out(".report.nerf-sr-new")).status().unwrap().success());
        let stdout = project.ok(&[&run[..], parameters].concat());
        assert!(
            stdout.contains("moved the earlier page to") && stdout.contains("report-a"),
            "{stdout}"
        );
        assert!(std::fs::read(out("report-a/index.html")).unwrap() == page);
        assert!(is_complete(&out("report")));
        std::fs::remove_dir_all(out("report-a")).unwrap();
        assert_eq!(std::fs::read_dir(out("")).unwrap().count(), 1, "out contains only the page");
    }
}

/// The pages are on a small tmpfs. CI may mount a tmpfs as root; without root the test is skipped.
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
    let entry_count = std::fs::read_dir(&out).unwrap().count();
    std::fs::remove_file(out.join("filler")).unwrap();
    let again = project.run(&["run", "-p", "render-depth.samples_per_axis=2"]);
    Command::new("umount").arg(&out).status().unwrap();
    finished.fails(1, &["No space left on device"]);
    assert!(after == before && entry_count == 2, "the old page is unchanged");
    assert_eq!(again.code, 0, "{}", again.stderr);
}

/// A file of any name, such as one that isn't UTF-8, is ignored if no frame refers to the file.
#[test]
fn a_data_folder_may_contain_any_file_name() {
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
    let input = ["-i", "dataset=ds"];
    project.ok(&[&["run", "prep"][..], &input].concat());
    let scene = project.output_of("prep", &input);
    for name in [&b"\xff\xfe.png"[..], b"\x1b]0;PWN\x07", b"new\nline"] {
        std::fs::copy(
            data.join("train/r_2.png"),
            data.join("train").join(std::ffi::OsStr::from_bytes(name)),
        )
        .unwrap();
        // A folder's key depends on all files in the folder.
        assert!(project.ok(&[&["plan", "prep"][..], &input].concat()).contains("will run"));
        project.ok(&[&["run", "prep"][..], &input].concat());
        assert_eq!(project.output_of("prep", &input), scene);
    }
    // The name of an output folder needn't be UTF-8 either.
    let mut command = project.command(&[&["run"][..], &input].concat());
    let out = std::ffi::OsStr::from_bytes(b"pages-\xff");
    assert!(command.arg("--out").arg(out).output().unwrap().status.success());
    assert!(is_complete(&project.path(".").join(out).join("report")));
    // For a link to a parent folder, the error names the link and the remedy.
    std::os::unix::fs::symlink(&data, data.join("loop")).unwrap();
    project.run(&[&["run", "prep"][..], &input].concat()).fails(3, &["ds/loop", "remove the link"]);
}

/// Returns the path and size of every file in the store.
fn file_sizes(project: &Project) -> Vec<(String, u64)> {
    let entries =
        walkdir::WalkDir::new(project.path(".nerf-sr")).sort_by_file_name().into_iter().flatten();
    let files = entries.filter(|entry| entry.file_type().is_file());
    files.map(|file| (file.path().display().to_string(), file.metadata().unwrap().len())).collect()
}

#[test]
fn a_store_of_a_newer_format_is_refused() {
    let project = Project::fast();
    project.ok(&["run", "prep"]);
    project.write(".nerf-sr/format", "99\n");
    let before = file_sizes(&project);
    // These verbs open no store.
    let storeless = ["init", "describe", "completions"];
    for verb in verbs().iter().filter(|verb| !storeless.contains(&verb.as_str())) {
        let finished = project.run(&call_of(verb));
        assert_eq!(
            finished.code, 1,
            "{verb}: {}\n(call_of in tests/common/mod.rs has a verb's arguments; verbs that open no \
            store are listed above)",
            finished.stderr
        );
        finished.fails(1, &[".nerf-sr", "format 99", "use the newer nerf-sr"]);
    }
    assert_eq!(file_sizes(&project), before, "no file is written");
}

/// A newer runner converts the store while an older runner trains. The older runner then fails and
/// leaves the store unchanged.
#[test]
fn a_runner_adds_nothing_to_a_store_converted_by_a_newer_runner() {
    let project = Project::fast();
    let training = ["train-ss", "-p", "train-ss.rays=1000000"];
    let run = [&["run"][..], &training].concat();
    let child = project.spawn(&run);
    wait_until(|| last_checkpoint(&project.path(".nerf-sr/partial")).is_some());
    project.write(".nerf-sr/format", "2\n");
    let before = project.store_listing();
    Finished::of(child.wait_with_output().unwrap())
        .fails(1, &["train-ss: failed", "format 2", "use the newer nerf-sr"]);
    assert_eq!(project.store_listing(), before);
    // After the format is old again, the runner resumes from its checkpoint.
    project.write(".nerf-sr/format", "1\n");
    assert!(project.ok(&[&["status"][..], &training].concat()).contains("has a checkpoint"));
    project.ok(&run);
    assert!(project.ok(&["verify"]).contains("0 damaged"));
}
