//! A run with nothing to do starts no process and reads no artifact's bytes.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs::{File, FileTimes};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use common::{FAST, Project, bin};

const STAGES: [&str; 6] = ["demo-scene", "prep", "train-ss", "render-depth", "eval", "report"];

/// The fast pipeline, its programs and git behind scripts that leave a mark when they are started.
fn watched() -> Project {
    let mut pipeline = FAST.to_owned();
    for stage in STAGES {
        pipeline = pipeline.replace(
            &format!("\n  {stage}:\n"),
            &format!("\n  {stage}:\n    run: ./watched/{stage}\n"),
        );
    }
    let project = Project::new(&pipeline);
    let here = project.path("started");
    for stage in STAGES {
        let script = format!(
            "#!/bin/sh\necho {stage} >> '{}'\nexec '{}' \"$@\"\n",
            here.display(),
            bin(stage).display()
        );
        project.program(&format!("watched/{stage}"), &script);
    }
    project.program("path/git", &format!("#!/bin/sh\necho git >> '{}'\n", here.display()));
    project
}

fn run(project: &Project) -> String {
    let path =
        format!("{}:{}", project.path("path").display(), std::env::var("PATH").unwrap_or_default());
    let output = project.command(&["run"]).env("PATH", path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn started(project: &Project) -> usize {
    std::fs::read_to_string(project.path("started")).unwrap_or_default().lines().count()
}

/// Sets when a file was last read to long ago, so that the next read changes it on any file system
/// that keeps such times.
fn set_unread(path: &Path) {
    let long_ago = SystemTime::now() - Duration::from_secs(1_000_000);
    File::open(path).unwrap().set_times(FileTimes::new().set_accessed(long_ago)).unwrap();
}

fn last_read(path: &Path) -> SystemTime {
    path.metadata().unwrap().accessed().unwrap()
}

/// Files of all artifacts but their manifests.
fn contents(project: &Project) -> Vec<PathBuf> {
    let files = walkdir::WalkDir::new(project.path(".nerf-sr/objects"))
        .sort_by_file_name()
        .into_iter()
        .flatten();
    let is_content = |path: &PathBuf| path.is_file() && !path.ends_with("artifact.json");
    files.map(walkdir::DirEntry::into_path).filter(is_content).collect()
}

#[test]
fn a_run_with_nothing_to_do_starts_nothing_and_reads_nothing() {
    let project = watched();
    let first = run(&project);
    let before = started(&project);
    assert!(before > STAGES.len(), "all were started");
    let files = contents(&project);
    assert!(files.len() >= 5, "each artifact has a file: {files:?}");
    files.iter().for_each(|file| set_unread(file));
    let probe = project.path("pipeline.yaml");
    set_unread(&probe);
    let times: Vec<SystemTime> = files.iter().map(|file| last_read(file)).collect();
    let untouched = last_read(&probe);

    let second = run(&project);
    assert!(second.contains("nothing to run: all 5 stages are cached"), "{second}");
    let summary =
        |said: &str| said.lines().find(|line| line.starts_with("eval: ")).unwrap().to_owned();
    assert_eq!(summary(&first), summary(&second));
    assert_eq!(started(&project), before, "nothing was started");
    if last_read(&probe) == untouched {
        eprintln!("skipped: this file system keeps no access times");
        return;
    }
    for (file, time) in files.iter().zip(times) {
        assert_eq!(last_read(file), time, "{} was read", file.display());
    }
}
