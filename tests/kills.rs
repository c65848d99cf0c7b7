//! Kills and garbage collection at random moments of a run: finished artifacts stay complete,
//! required artifacts stay stored, and results equal those of undisturbed runs.
//!
//! `NERF_SR_KILLS` is the number of kills (`make faults`: 200); `NERF_SR_SEED` selects the moments.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeMap;
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::random::{Random, number};
use common::{Finished, Project, is_running, wait_until};
use serde_json::Value;

const SIGNALS: [&str; 4] = ["-KILL", "-INT", "-TERM", "-HUP"];
const STAGES: [&str; 5] = ["demo-scene", "prep", "train-ss", "render-depth", "eval"];
/// Number of points; each trains with another seed.
const POINTS: u64 = 3;

fn point(seed: u64) -> [String; 2] {
    ["-p".to_owned(), format!("train-ss.seed={seed}")]
}

fn arguments<'a>(verb: &'a str, point: &'a [String; 2]) -> Vec<&'a str> {
    vec![verb, &point[0], &point[1]]
}

/// Returns the identity of each finished stage's artifact at a point.
fn finished_artifacts(project: &Project, point: &[String; 2]) -> BTreeMap<String, String> {
    let text_of = |node: &Value, key: &str| node[key].as_str().map(str::to_owned);
    let nodes = project.nodes(&point.each_ref().map(String::as_str));
    nodes
        .iter()
        .filter_map(|node| Some((text_of(node, "stage")?, text_of(node, "output")?)))
        .collect()
}

/// Returns the ids of a process's children.
fn children(pid: u32) -> Vec<String> {
    let text =
        std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap_or_default();
    // A thread's `children` contains only the processes that this thread has started.
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let thread_children =
        tasks.filter_map(|task| std::fs::read_to_string(task.path().join("children")).ok());
    let all = thread_children.collect::<String>() + " " + &text;
    all.split_whitespace().map(str::to_owned).collect()
}

fn send_signal(signal: &str, process: &str) {
    // The process may have ended already, so that `kill` fails.
    Command::new("kill").args([signal, "--", process]).stderr(Stdio::null()).status().unwrap();
}

/// Sends a random signal to the runner, its stages, both, or the process group. Returns the signal
/// and its target as text.
fn send_random_signal(random: &mut Random, runner: &Child, stages: &[String]) -> String {
    let signal = SIGNALS[random.below(4) as usize];
    let pid = runner.id();
    let target = ["runner", "stage", "both", "group"][random.below(4) as usize];
    if target == "stage" || target == "both" {
        stages.iter().for_each(|stage| send_signal(signal, stage));
    }
    match target {
        "runner" | "both" => send_signal(signal, &pid.to_string()),
        "group" => send_signal(signal, &format!("-{pid}")),
        _ => {}
    }
    format!("{signal} to {target}")
}

/// Waits for a command and returns its result; panics after two minutes.
fn wait_for(child: Child, context: &str) -> Finished {
    let (sender, receiver) = std::sync::mpsc::channel();
    let pid = child.id();
    std::thread::spawn(move || sender.send(child.wait_with_output()));
    match receiver.recv_timeout(Duration::from_secs(120)) {
        Ok(output) => Finished::of(output.unwrap()),
        Err(_) => panic!("{context}: process {pid} hangs"),
    }
}

#[test]
fn kills_at_random_moments_lose_nothing() {
    let kills = number("NERF_SR_KILLS").unwrap_or(20);
    let seed = number("NERF_SR_SEED").unwrap_or_else(|| std::process::id().into());
    println!("NERF_SR_KILLS={kills} NERF_SR_SEED={seed}");
    let mut random = Random::new(seed);
    let undisturbed = Project::fast();
    let start = Instant::now();
    undisturbed.ok(&["run", "-p", "train-ss.seed=0"]);
    let run_milliseconds = start.elapsed().as_millis() as u64;
    let expected: Vec<BTreeMap<String, String>> = (0..POINTS)
        .map(|seed| {
            undisturbed.ok(&arguments("run", &point(seed)));
            finished_artifacts(&undisturbed, &point(seed))
        })
        .collect();
    assert!(expected.iter().all(|stages| stages.len() == STAGES.len()));

    let mut project = Project::fast();
    let mut cut_short = 0;
    for round in 0..kills {
        let seed = random.below(POINTS);
        let before = finished_artifacts(&project, &point(seed));
        if before.len() == STAGES.len() {
            // Every stage has finished: a new project gives kills a run to interrupt.
            project = Project::fast();
        }
        let mut command = project.command(&arguments("run", &point(seed)));
        let runner =
            command.process_group(0).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let moment = Duration::from_millis(random.below(run_milliseconds + 1));
        let collect_first = random.below(2) == 0;
        let collect = |project: &Project| project.spawn(&["gc", "--keep-days", "0"]);
        let mut collector = collect_first.then(|| collect(&project));
        // Fuzzing: a random pause, not an event of the run, so that kills happen at any moment.
        std::thread::sleep(moment);
        collector = collector.or_else(|| Some(collect(&project)));
        // Children are listed before the kill, because a killed runner has none.
        let mut stages = children(runner.id());
        let signal = send_random_signal(&mut random, &runner, &stages);
        // The runner may have started another stage in between.
        stages.extend(children(runner.id()));
        let context = format!("round {round}: seed {seed}, {signal} after {moment:?}");
        println!("{context}");
        let run = wait_for(runner, &context);
        cut_short += u64::from(run.code != 0);
        let gc = wait_for(collector.unwrap(), &context);
        assert_eq!(gc.code, 0, "{context}: {}{}", gc.stdout, gc.stderr);
        assert!(
            !run.stderr.contains("panicked") && !run.stderr.contains("damaged"),
            "{context}: {}",
            run.stderr
        );
        // Stages may still be writing checkpoints.
        wait_until(|| !stages.iter().any(|stage| is_running(stage)));
        assert!(project.ok(&["verify"]).contains(", 0 damaged"), "{context}");
        for (stage, hash) in finished_artifacts(&project, &point(seed)) {
            assert_eq!(hash, expected[seed as usize][&stage], "{context}: {stage}");
        }
        // `gc` must keep these artifacts, because every point of the pipeline needs them.
        for stage in ["demo-scene", "prep"] {
            let now = finished_artifacts(&project, &point(seed));
            assert!(
                !before.contains_key(stage)
                    || before.len() == STAGES.len()
                    || now.contains_key(stage),
                "{context}: {stage} was removed"
            );
        }
    }
    // If there are few kills, all may have come after the ends of their runs.
    println!("{cut_short} of {kills} runs were cut short");
    assert!(cut_short > 0 || kills < 20, "no kill interrupted a run");
    for seed in 0..POINTS {
        // Without a kill, a run succeeds during garbage collection.
        let runner = project.spawn(&arguments("run", &point(seed)));
        let collector = project.spawn(&["gc", "--keep-days", "0"]);
        let run = wait_for(runner, "the last run");
        assert_eq!(run.code, 0, "{}", run.stderr);
        assert_eq!(wait_for(collector, "the last collection").code, 0);
        assert_eq!(finished_artifacts(&project, &point(seed)), expected[seed as usize]);
    }
}
