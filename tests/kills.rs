//! Kills at random moments, with garbage collection at random moments beside: what was finished is
//! whole, what a run needs stays, and the artifacts come out equal.
//!
//! NERF_SR_KILLS says how many kills (`make faults`: 200), NERF_SR_SEED which moments.

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
/// Number of pipelines that are run in turn; each trains with another seed.
const POINTS: u64 = 3;

fn point(number: u64) -> [String; 2] {
    ["-p".to_owned(), format!("train-ss.seed={number}")]
}

fn arguments<'a>(verb: &'a str, point: &'a [String; 2]) -> Vec<&'a str> {
    vec![verb, &point[0], &point[1]]
}

/// The finished stages of a point with their artifacts.
fn finished(project: &Project, point: &[String; 2]) -> BTreeMap<String, String> {
    let word = |node: &Value, key: &str| node[key].as_str().map(str::to_owned);
    let nodes = project.nodes(&point.each_ref().map(String::as_str));
    nodes.iter().filter_map(|node| Some((word(node, "stage")?, word(node, "output")?))).collect()
}

/// The processes that a process has started.
fn children(pid: u32) -> Vec<String> {
    let text =
        std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap_or_default();
    // Threads start stages, too.
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let of_threads =
        tasks.filter_map(|task| std::fs::read_to_string(task.path().join("children")).ok());
    let all = of_threads.collect::<String>() + " " + &text;
    all.split_whitespace().map(str::to_owned).collect()
}

fn send(signal: &str, process: &str) {
    // It may have ended by itself.
    Command::new("kill").args([signal, "--", process]).stderr(Stdio::null()).status().unwrap();
}

/// Sends a signal to the runner, its stages, both, or the process group; says to whom.
fn strike(random: &mut Random, runner: &Child, stages: &[String]) -> String {
    let signal = SIGNALS[random.below(4) as usize];
    let pid = runner.id();
    let whom = ["runner", "stage", "both", "group"][random.below(4) as usize];
    if whom == "stage" || whom == "both" {
        stages.iter().for_each(|stage| send(signal, stage));
    }
    match whom {
        "runner" | "both" => send(signal, &pid.to_string()),
        "group" => send(signal, &format!("-{pid}")),
        _ => {}
    }
    format!("{signal} to {whom}")
}

/// The command's result; one that hangs fails the test.
fn ended(child: Child, what: &str) -> Finished {
    let (sender, receiver) = std::sync::mpsc::channel();
    let pid = child.id();
    std::thread::spawn(move || sender.send(child.wait_with_output()));
    match receiver.recv_timeout(Duration::from_secs(120)) {
        Ok(output) => Finished::of(output.unwrap()),
        Err(_) => panic!("{what}: process {pid} hangs"),
    }
}

#[test]
fn kills_at_random_moments_lose_nothing() {
    let kills = number("NERF_SR_KILLS").unwrap_or(20);
    let seed = number("NERF_SR_SEED").unwrap_or_else(|| std::process::id().into());
    println!("NERF_SR_KILLS={kills} NERF_SR_SEED={seed}");
    let mut random = Random::new(seed);
    let undisturbed = Project::fast();
    let begun = Instant::now();
    undisturbed.ok(&["run", "-p", "train-ss.seed=0"]);
    let whole_run = begun.elapsed().as_millis() as u64;
    let expected: Vec<BTreeMap<String, String>> = (0..POINTS)
        .map(|seed| {
            undisturbed.ok(&arguments("run", &point(seed)));
            finished(&undisturbed, &point(seed))
        })
        .collect();
    assert!(expected.iter().all(|stages| stages.len() == STAGES.len()));

    let mut project = Project::fast();
    let mut cut_short = 0;
    for round in 0..kills {
        let seed = random.below(POINTS);
        let before = finished(&project, &point(seed));
        if before.len() == STAGES.len() {
            // All is made: begin anew, so that kills find something to do.
            project = Project::fast();
        }
        let mut command = project.command(&arguments("run", &point(seed)));
        let runner =
            command.process_group(0).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let moment = Duration::from_millis(random.below(whole_run + 1));
        let collect_first = random.below(2) == 0;
        let collect = |project: &Project| project.spawn(&["gc", "--keep-days", "0"]);
        let mut collector = collect_first.then(|| collect(&project));
        // This is fuzzing: no moment of a run is waited for, so that any may be met.
        std::thread::sleep(moment);
        collector = collector.or_else(|| Some(collect(&project)));
        // Asked before, since a runner that is killed has no children any more.
        let mut stages = children(runner.id());
        let what = strike(&mut random, &runner, &stages);
        // One may have been started in between.
        stages.extend(children(runner.id()));
        let place = format!("round {round}: seed {seed}, {what} after {moment:?}");
        println!("{place}");
        let run = ended(runner, &place);
        cut_short += u64::from(run.code != 0);
        let gc = ended(collector.unwrap(), &place);
        assert_eq!(gc.code, 0, "{place}: {}{}", gc.stdout, gc.stderr);
        assert!(
            !run.stderr.contains("panicked") && !run.stderr.contains("damaged"),
            "{place}: {}",
            run.stderr
        );
        // Stages may live on for a moment, to write their checkpoints.
        wait_until(|| !stages.iter().any(|stage| is_running(stage)));
        assert!(project.ok(&["verify"]).contains(", 0 damaged"), "{place}");
        for (stage, hash) in finished(&project, &point(seed)) {
            assert_eq!(hash, expected[seed as usize][&stage], "{place}: {stage}");
        }
        // What everything is made of is needed by the pipeline as it stands, whatever the point.
        for stage in ["demo-scene", "prep"] {
            let now = finished(&project, &point(seed));
            assert!(
                !before.contains_key(stage)
                    || before.len() == STAGES.len()
                    || now.contains_key(stage),
                "{place}: {stage} is gone"
            );
        }
    }
    // Of a few kills each may have come too late.
    println!("{cut_short} of {kills} runs were cut short");
    assert!(cut_short > 0 || kills < 20, "no kill met a run");
    for seed in 0..POINTS {
        // With garbage collection beside, and no kill, a run ends well.
        let runner = project.spawn(&arguments("run", &point(seed)));
        let collector = project.spawn(&["gc", "--keep-days", "0"]);
        let run = ended(runner, "the last run");
        assert_eq!(run.code, 0, "{}", run.stderr);
        assert_eq!(ended(collector, "the last collection").code, 0);
        assert_eq!(finished(&project, &point(seed)), expected[seed as usize]);
    }
}
