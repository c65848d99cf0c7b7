//! A run with nothing to do starts no process and reads no artifact's bytes.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs::{File, FileTimes};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use common::{FAST, Project, bin};

const STAGES: [&str; 6] = ["demo-scene", "prep", "train-ss", "render-depth", "eval", "report"];

/// Creates a fast project whose stages and `git` are scripts that log each start.
fn project_with_start_log() -> Project {
    let mut pipeline = FAST.to_owned();
    for stage in STAGES {
        pipeline = pipeline.replace(
            &format!("\n  {stage}:\n"),
            &format!("\n  {stage}:\n    run: ./watched/{stage}\n"),
        );
    }
    let project = Project::new(&pipeline);
    let log = project.path("started");
    for stage in STAGES {
        let script = format!(
            "#!/bin/sh\necho {stage} >> '{}'\nexec '{}' \"$@\"\n",
            log.display(),
            bin(stage).display()
        );
        project.program(&format!("watched/{stage}"), &script);
    }
    project.program("path/git", &format!("#!/bin/sh\necho git >> '{}'\n", log.display()));
    project
}

fn run(project: &Project) -> String {
    let path =
        format!("{}:{}", project.path("path").display(), std::env::var("PATH").unwrap_or_default());
    let output = project.command(&["run"]).env("PATH", path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn count_starts(project: &Project) -> usize {
    std::fs::read_to_string(project.path("started")).unwrap_or_default().lines().count()
}

/// Sets a file's access time to long ago, so that the next read changes the access time on any file
/// system that records access times.
fn reset_access_time(path: &Path) {
    let long_ago = SystemTime::now() - Duration::from_secs(1_000_000);
    File::open(path).unwrap().set_times(FileTimes::new().set_accessed(long_ago)).unwrap();
}

fn access_time(path: &Path) -> SystemTime {
    path.metadata().unwrap().accessed().unwrap()
}

/// Returns the files of all artifacts, except manifests.
fn content_files(project: &Project) -> Vec<PathBuf> {
    let files = walkdir::WalkDir::new(project.path(".nerf-sr/objects"))
        .sort_by_file_name()
        .into_iter()
        .flatten();
    let is_content = |path: &PathBuf| path.is_file() && !path.ends_with("artifact.json");
    files.map(walkdir::DirEntry::into_path).filter(is_content).collect()
}

#[test]
fn a_run_with_nothing_to_do_starts_nothing_and_reads_nothing() {
    let project = project_with_start_log();
    let first = run(&project);
    let starts = count_starts(&project);
    assert!(starts > STAGES.len(), "not all stages were started");
    let files = content_files(&project);
    assert!(files.len() >= 5, "expected a file of each artifact: {files:?}");
    files.iter().for_each(|file| reset_access_time(file));
    let probe = project.path("pipeline.yaml");
    reset_access_time(&probe);
    let times: Vec<SystemTime> = files.iter().map(|file| access_time(file)).collect();
    let probe_time = access_time(&probe);

    let second = run(&project);
    assert!(second.contains("nothing to run: all 5 stages are cached"), "{second}");
    let summary =
        |output: &str| output.lines().find(|line| line.starts_with("eval: ")).unwrap().to_owned();
    assert_eq!(summary(&first), summary(&second));
    assert_eq!(count_starts(&project), starts, "the second run started a process");
    if access_time(&probe) == probe_time {
        eprintln!("skipped: this file system keeps no access times");
        return;
    }
    for (file, time) in files.iter().zip(times) {
        assert_eq!(access_time(file), time, "{} was read", file.display());
    }
}
