//! Default number of threads: the processors that a process may use.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Finished, Project, bin, stage_command};
use stage::{ALL_PROCESSORS, processors};

/// Slurm's environment variables that limit the number of processors.
const VARIABLES: [&str; 2] = ["SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"];

/// Runs a stage with a launcher such as `taskset` and an optional Slurm variable, and returns the
/// line that reports the number of threads.
fn reported_threads(
    project: &Project,
    launcher: &[&str],
    variable: Option<(&str, &str)>,
) -> String {
    let output = project.path("data");
    fs::remove_dir_all(&output).ok();
    let params = r#"{"size": 16, "train": 1, "test": 1, "samples_per_axis": 1}"#;
    let call = stage_command("demo-scene", params, &[], &output, &["--progress", "plain"]);
    let mut command = match launcher {
        [] => Command::new(call.get_program()),
        [first, others @ ..] => {
            let mut command = Command::new(first);
            command.args(others).arg(call.get_program());
            command
        }
    };
    command.args(call.get_args());
    for name in VARIABLES {
        command.env_remove(name);
    }
    let finished = Finished::of(command.envs(variable).output().unwrap());
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    finished.stderr.lines().next().unwrap_or_default().to_owned()
}

fn can_start(program: &str) -> bool {
    Command::new(program).arg("--help").output().is_ok()
}

#[test]
fn affinity_limits_threads_of_stages_and_runs() {
    if !can_start("taskset") {
        eprintln!("skipped: no taskset");
        return;
    }
    let project = Project::fast();
    let Some(processor) = any_processor() else {
        eprintln!("skipped: no list of processors in /proc/self/status");
        return;
    };
    let launcher = ["taskset", "-c", processor.as_str()];
    let line = reported_threads(&project, &launcher, None);
    if processors().limit == ALL_PROCESSORS && processors().count == 1 {
        assert_eq!(line, "1 thread: all processors of this machine");
        return;
    }
    assert_eq!(line, "1 thread: the CPU affinity of this process");
    let help =
        Command::new(launcher[0]).args(&launcher[1..]).arg(bin("eval")).arg("--help").output();
    let help = Finished::of(help.unwrap()).stdout;
    assert!(help.contains("[default: the CPU affinity of this process, here 1]"), "{help}");
    let nerf_sr = project.command(&["run", "prep"]);
    let mut run = Command::new(launcher[0]);
    run.args(&launcher[1..]).arg(nerf_sr.get_program()).args(nerf_sr.get_args());
    for name in VARIABLES {
        run.env_remove(name);
    }
    let run = Finished::of(run.current_dir(project.path(".")).output().unwrap());
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stderr.contains("nerf-sr: 1 thread: the CPU affinity"), "{}", run.stderr);
    let log = project.ok(&["log", "prep"]);
    assert!(log.lines().any(|line| line.ends_with(", 1 thread")), "{log}");
}

/// Returns the number of a processor that this process may use.
fn any_processor() -> Option<String> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let list = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?;
    list.trim().split(['-', ',']).next().map(str::to_owned)
}

#[test]
fn slurm_variables_limit_threads() {
    let project = Project::new("");
    for name in VARIABLES {
        let line = reported_threads(&project, &[], Some((name, "1")));
        let expected = if processors().count == 1 { "1 thread: " } else { "1 thread: SLURM_CPUS_" };
        assert!(line.starts_with(expected), "{line}");
    }
    let without_variable = reported_threads(&project, &[], None);
    for value in ["0", "x", "", "1000000"] {
        assert_eq!(
            reported_threads(&project, &[], Some(("SLURM_CPUS_ON_NODE", value))),
            without_variable,
            "{value}"
        );
    }
}

/// Cgroup with a quota of one processor, removed when dropped.
struct Quota(PathBuf);

impl Quota {
    /// Creates a cgroup of version 1 or 2; `None` if this process may not create one.
    fn create() -> Option<Self> {
        let name = format!("nerf-sr-test-{}", std::process::id());
        let versions: [(&str, &[(&str, &str)]); 3] = [
            ("/sys/fs/cgroup", &[("cpu.max", "100000 100000")]),
            (
                "/sys/fs/cgroup/cpu",
                &[("cpu.cfs_period_us", "100000"), ("cpu.cfs_quota_us", "100000")],
            ),
            (
                "/sys/fs/cgroup/cpu,cpuacct",
                &[("cpu.cfs_period_us", "100000"), ("cpu.cfs_quota_us", "100000")],
            ),
        ];
        versions.iter().find_map(|(root, settings)| {
            // A folder without this file isn't a cgroup hierarchy.
            Path::new(root).join("cgroup.procs").is_file().then_some(())?;
            let group = Self(Path::new(root).join(&name));
            fs::create_dir(&group.0).ok()?;
            settings
                .iter()
                .try_for_each(|(file, text)| fs::write(group.0.join(file), text))
                .ok()?;
            Some(group)
        })
    }
}

impl Drop for Quota {
    fn drop(&mut self) {
        fs::remove_dir(&self.0).ok();
    }
}

#[test]
fn a_quota_limits_threads() {
    let Some(group) = Quota::create() else {
        eprintln!("skipped: this process may not create a cgroup with a CPU quota");
        return;
    };
    let project = Project::new("");
    let enter = format!("echo $$ > {}/cgroup.procs && exec \"$0\" \"$@\"", group.0.display());
    let line = reported_threads(&project, &["sh", "-c", &enter], None);
    let expected = if processors().count == 1 { "1 thread: " } else { "1 thread: the CPU quota" };
    assert!(line.starts_with(expected), "{line}");
}

/// Trains a field from an input that is checked in parallel. Returns the largest number of threads
/// and the field's bytes.
fn train_with_threads(project: &Project, threads: &str) -> (usize, Vec<u8>) {
    let data = project.path("data");
    if !data.exists() {
        let params = r#"{"size": 32, "train": 2, "test": 1, "samples_per_axis": 1}"#;
        let demo = stage_command("demo-scene", params, &[], &data, &[]).output().unwrap();
        assert!(demo.status.success());
    }
    let params = r#"{"lr_width": 16, "scale": 2}"#;
    let scene = project.path(&format!("scene-{threads}"));
    let prepared =
        stage_command("prep", params, &[("dataset", &data)], &scene, &[]).output().unwrap();
    assert!(prepared.status.success());
    let params = r#"{"field": "grid", "rays": 100000}"#;
    let (input, output) = (scene.join("train"), project.path(&format!("field-{threads}")));
    let inputs = [("scene", input.as_path())];
    let mut command = stage_command("train-ss", params, &inputs, &output, &["--threads", threads]);
    let mut training = command.spawn().unwrap();
    let tasks = PathBuf::from(format!("/proc/{}/task", training.id()));
    let mut max_threads = 0;
    while training.try_wait().unwrap().is_none() {
        max_threads = max_threads.max(fs::read_dir(&tasks).map_or(0, Iterator::count));
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    assert!(training.wait().unwrap().success());
    (max_threads, fs::read(output.join("field-0.safetensors")).unwrap())
}

/// A stage has the given number of threads, which doesn't change the field's bytes.
#[test]
fn fields_are_equal_at_any_number_of_threads() {
    let project = Project::fast();
    let (base_threads, field) = train_with_threads(&project, "1");
    for threads in [2, 3, 8, 16] {
        let (max_threads, other_field) = train_with_threads(&project, &threads.to_string());
        assert_eq!(
            max_threads - base_threads,
            threads - 1,
            "{base_threads} and {max_threads} threads"
        );
        assert!(other_field == field, "{threads} threads");
    }
}
