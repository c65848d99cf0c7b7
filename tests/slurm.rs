//! Slurm executor, on a real cluster of one node and with fake Slurm programs.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use common::{Finished, Project, commands, happens, root, wait_until};
use numerics::CounterRng;

/// Stage in plain Python that computes `steps` hashes, each from the previous one. The stage writes
/// a checkpoint when it is interrupted and, with `keeps`, after every step. While the file named by
/// `hold` exists, the stage waits at the step in this file, and appends the step to `held`. `pause`
/// prolongs each step, so that kills at random moments interrupt a working stage.
const STEP: &str = r#"#!/usr/bin/env python3
import hashlib, json, os, pathlib, signal, sys, time
here = pathlib.Path(__file__).parent
def number(default): return {"type": "number", "default": default}
def word(): return {"type": "string", "default": ""}
if sys.argv[1] == "describe":
    text = {"kinds": ["text"], "summary": "a text", "optional": True}
    print(json.dumps({"name": "step", "version": "1", "code": "1", "summary": "Steps.", "inputs": {"a": text, "b": text},
        "parameters": {"type": "object", "additionalProperties": False, "properties": {
            "steps": number(1), "pause": number(0), "keeps": number(0), "seed": number(0), "fails": number(0), "hold": word()}},
        "output": {"kind": "text"}}))
    sys.exit()
given = {"input": []}
for name, value in zip(sys.argv[1::2], sys.argv[2::2]):
    if name == "--input": given["input"].append(value.split("=", 1))
    else: given[name] = value
params = json.load(open(given["--params"]))
with open(here / "ran", "a") as ran: print(os.path.basename(os.path.dirname(given["--params"])), given["--device"], given["--threads"], file=ran)
if params["fails"]:
    sys.exit("step: asked to fail" if params["fails"] == 1 else int(params["fails"]))
asked = []
signal.signal(signal.SIGTERM, lambda *_: asked.append(1))
checkpoint = pathlib.Path(given["--work"]) / "checkpoint"
def keep():
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.with_suffix(".new").write_text(json.dumps([done, state]))
    checkpoint.with_suffix(".new").rename(checkpoint)
def is_held():
    try: return params["hold"] and done >= int((here / params["hold"]).read_text() or 0)
    except FileNotFoundError: return False
done, state = 0, hashlib.sha256(str(params["seed"]).encode()).hexdigest()
for name, folder in sorted(given["input"]):
    state = hashlib.sha256((state + pathlib.Path(folder, "text").read_text()).encode()).hexdigest()
if checkpoint.exists(): done, state = json.loads(checkpoint.read_text())
while done < params["steps"]:
    if is_held():
        with open(here / "held", "a") as held: print(done, file=held)
    while is_held() and not asked: time.sleep(0.05)
    if asked:
        keep()
        print("stopped at", done, file=sys.stderr)
        sys.exit(130)
    time.sleep(params["pause"])
    done, state = done + 1, hashlib.sha256(state.encode()).hexdigest()
    if params["keeps"]: keep()
os.makedirs(given["--output"])
pathlib.Path(given["--output"], "text").write_text(state)
"#;

/// Sink in plain Python, whose page lists the outputs of a run's nodes.
const PAGE: &str = r#"#!/usr/bin/env python3
import json, os, pathlib, sys
if sys.argv[1] == "describe":
    print(json.dumps({"name": "page", "version": "1", "code": "1", "summary": "Shows.", "sink": True, "parameters": {"type": "object"},
        "inputs": {"run": {"kinds": ["run"], "summary": "a run"}}, "output": {"kind": "page"}}))
    sys.exit()
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
record = json.load(open(given["--input"].split("=", 1)[1] + "/run.json"))
os.makedirs(given["--output"])
pathlib.Path(given["--output"], "index.html").write_text(" ".join(node["output"] for node in record["nodes"]))
"#;

const SWEEP: &str = "
default: [page]
stages:
  prep: {run: ./step, resources: {cpus: 2}}
  train: {run: ./step, inputs: {a: prep}, resources: {cpus: 1, mem: 64M, time: 1h}}
  eval: {run: ./step, inputs: {a: train, b: prep}}
  page: {run: ./page, inputs: {run: eval}}
";

fn project(pipeline: &str) -> Project {
    let project = Project::new(pipeline);
    project.program("step", STEP);
    project.program("page", PAGE);
    project
}

/// Returns the first of two consecutive free ports, below the kernel's range of client ports.
fn free_ports() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    let first = (std::process::id() % 600) as u16 * 20;
    let ports =
        std::iter::repeat_with(|| 20_000 + (first + NEXT.fetch_add(2, Ordering::Relaxed)) % 12_000);
    let is_free = |port: u16| TcpListener::bind(("127.0.0.1", port)).is_ok();
    ports.take(6_000).find(|&port| is_free(port) && is_free(port + 1)).expect("two free ports")
}

/// Slurm cluster of one node, stopped when dropped.
struct Cluster {
    dir: tempfile::TempDir,
}

fn field_value(text: &str, key: &str) -> String {
    text.split_whitespace().find_map(|word| word.strip_prefix(key)).unwrap_or_default().to_owned()
}

impl Cluster {
    /// Tries to start a cluster; fails if another process takes one of the free ports meanwhile.
    fn try_start() -> Option<Self> {
        // Paths of sockets have to be short, so the cluster isn't in a test's own folder.
        let cluster =
            Self { dir: tempfile::Builder::new().prefix("ms").tempdir_in("/tmp").unwrap() };
        let mut script = cluster.script("start");
        script.env("MINI_SLURM_PORT", free_ports().to_string()).env("MINI_SLURM_FAKE_GPUS", "2");
        // The daemons would keep a pipe open, and mix their lines with those of tests.
        script
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status()
            .unwrap()
            .success()
            .then_some(cluster)
    }

    /// Starts a cluster. Without Slurm's programs, prints that the test is skipped and returns
    /// `None`.
    fn start() -> Option<Self> {
        let path = std::env::var("PATH").unwrap_or_default() + ":/usr/sbin";
        let has = |name: &str| path.split(':').any(|folder| Path::new(folder).join(name).exists());
        if let Some(missing) = ["slurmctld", "slurmd", "munged"].into_iter().find(|name| !has(name))
        {
            eprintln!("skipped: no {missing}");
            return None;
        }
        let cluster = (0..3).find_map(|_| Self::try_start());
        assert!(cluster.is_some(), "cannot start the cluster");
        cluster
    }

    fn script(&self, verb: &str) -> Command {
        let mut command = Command::new(root().join("tests/mini-slurm.sh"));
        command.arg(verb).arg(self.dir.path());
        command
    }

    /// Returns the command with this cluster's configuration in the environment.
    fn with(&self, command: Command) -> Command {
        with_environment(command, "SLURM_CONF", &self.dir.path().join("slurm.conf"))
    }

    #[track_caller]
    fn slurm(&self, program: &str, arguments: &[&str]) -> String {
        let mut command = Command::new(program);
        command.args(arguments);
        let finished = Finished::of(self.with(command).output().unwrap());
        assert_eq!(finished.code, 0, "{program}: {}", finished.stderr);
        finished.stdout.trim().to_owned()
    }

    fn run(&self, project: &Project, arguments: &[&str]) -> Finished {
        Finished::of(self.with(command(project, arguments)).output().unwrap())
    }

    #[track_caller]
    fn ok(&self, project: &Project, arguments: &[&str]) -> String {
        let finished = self.run(project, arguments);
        assert_eq!(finished.code, 0, "{}\n{}", finished.stdout, finished.stderr);
        finished.stdout
    }

    /// Submits a run and returns its jobs' ids by their labels.
    #[track_caller]
    fn submit(&self, project: &Project, arguments: &[&str]) -> BTreeMap<String, String> {
        jobs(&self.ok(project, &[&["run"], arguments].concat()))
    }

    /// Waits until the queue is empty.
    #[track_caller]
    fn drain(&self) {
        let is_empty = happens(|| self.slurm("squeue", &["-h"]).is_empty());
        assert!(is_empty, "{}", self.slurm("scontrol", &["show", "job"]));
    }

    /// Returns a job's state and exit code as reported by Slurm: `COMPLETED 0:0`.
    fn state(&self, job: &str) -> String {
        let details = self.slurm("scontrol", &["-o", "show", "job", job]);
        format!("{} {}", field_value(&details, "JobState="), field_value(&details, "ExitCode="))
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        self.script("stop").status().ok();
    }
}

fn with_environment(mut command: Command, name: &str, value: &Path) -> Command {
    command.env(name, value);
    command
}

/// Returns the runner's command with the Slurm executor, without the user's own settings.
fn command(project: &Project, arguments: &[&str]) -> Command {
    let mut command = project.command(arguments);
    command
        .env("NERF_SR_EXECUTOR", "slurm")
        .env_remove("NERF_SR_SITE")
        .env("HOME", project.path("."));
    command
}

fn jobs(stdout: &str) -> BTreeMap<String, String> {
    stdout
        .lines()
        .filter_map(|line| line.rsplit_once(": job "))
        .map(|(label, id)| (label.to_owned(), id.to_owned()))
        .collect()
}

fn lines(project: &Project, file: &str) -> Vec<String> {
    let text = std::fs::read_to_string(project.path(file)).unwrap_or_default();
    text.lines().map(str::to_owned).collect()
}

/// Returns a line for each time that a stage ran: the key, device and number of threads.
fn stage_runs(project: &Project) -> Vec<String> {
    lines(project, "ran")
}

/// Returns the steps at which stages began to wait.
fn held_steps(project: &Project) -> Vec<String> {
    lines(project, "held")
}

/// Returns the identities of a stage's current artifacts.
fn outputs(project: &Project, stage: &str, arguments: &[&str]) -> Vec<String> {
    project.output_of(stage, arguments)
}

const SEEDS: [&str; 2] = ["-p", "train.seed=1,2,3,4,5,6"];

#[test]
fn a_sweep_submitted_twice_at_once_runs_once_and_equals_a_local_run() {
    let Some(cluster) = Cluster::start() else { return };
    let (shared, local) = (project(SWEEP), project(SWEEP));
    let runners = [0, 1].map(|_| {
        let mut command = cluster.with(command(&shared, &[&["run"][..], &SEEDS].concat()));
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    });
    let started = Instant::now();
    let finished: Vec<Finished> =
        runners.into_iter().map(|child| Finished::of(child.wait_with_output().unwrap())).collect();
    for runner in &finished {
        assert_eq!(runner.code, 0, "{}{}", runner.stdout, runner.stderr);
    }
    let submitted: usize = finished.iter().map(|runner| jobs(&runner.stdout).len()).sum();
    assert_eq!(submitted, 14, "{}{}", finished[0].stdout, finished[1].stdout);
    let status = cluster.ok(&shared, &[&["status"][..], &SEEDS].concat());
    assert!(status.contains(" pending: Dependency"), "{status}");
    cluster.drain();
    eprintln!("14 jobs, 4 hops, on four places: {:.1} s", started.elapsed().as_secs_f64());
    assert_eq!(stage_runs(&shared).len(), 13, "each stage runs once");
    local.ok(&[&["run"][..], &SEEDS].concat());
    for stage in ["prep", "train", "eval"] {
        assert_eq!(outputs(&shared, stage, &SEEDS), outputs(&local, stage, &SEEDS), "{stage}");
    }
    let page =
        |project: &Project| std::fs::read_to_string(project.path("out/page/index.html")).unwrap();
    assert_eq!(page(&shared), page(&local));
    assert!(cluster.ok(&shared, &["verify"]).contains("0 damaged"));
    assert!(
        cluster.ok(&shared, &[&["run"][..], &SEEDS].concat()).contains("nothing to run"),
        "the page exists already"
    );
    // `cpus` sets the number of threads.
    assert!(stage_runs(&shared)[0].ends_with(" cpu 2"), "{:?}", stage_runs(&shared));
}

#[test]
fn a_failing_stage_cancels_only_its_dependents() {
    let Some(cluster) = Cluster::start() else { return };
    let project = project(SWEEP);
    let arguments = ["eval", "-p", "train.fails=0,7", "-p", "eval.seed=3"];
    let jobs = cluster.submit(&project, &arguments);
    cluster.drain();
    for (label, state) in [
        ("prep", "COMPLETED 0:0"),
        ("train [fails=0]", "COMPLETED 0:0"),
        ("eval [fails=0]", "COMPLETED 0:0"),
        ("train [fails=7]", "FAILED 7:0"),
        ("eval [fails=7]", "CANCELLED 0:0"),
    ] {
        assert_eq!(cluster.state(&jobs[label]), state, "{label}");
    }
    let log = cluster.ok(&project, &[&["log", "train"][..], &arguments].concat());
    assert!(
        log.contains("failed after")
            && log.contains("slurm/")
            && log.contains("exit code 7 without a message"),
        "{log}"
    );
    // A second submission contains only the failed stage and its dependent.
    let again = cluster.submit(&project, &arguments);
    assert_eq!(again.keys().collect::<Vec<_>>(), ["eval [fails=7]", "train [fails=7]"]);
    cluster.drain();
    // `prep` has another key but an equal output, so its dependents' jobs end as cache hits.
    let hit = ["eval", "-p", "prep.pause=0.01", "-p", "train.fails=0", "-p", "eval.seed=3"];
    let jobs = cluster.submit(&project, &hit);
    assert_eq!(jobs.len(), 3);
    cluster.drain();
    assert_eq!(cluster.state(&jobs["eval"]), "COMPLETED 0:0");
    assert!(cluster.ok(&project, &[&["log", "eval"][..], &hit].concat()).contains("eval: cached"));
    assert_eq!(stage_runs(&project).len(), 6, "{:?}", stage_runs(&project));
}

/// The guide's commands succeed one after another, with a pipeline that takes seconds.
#[test]
fn commands_of_the_guide_run() {
    let Some(cluster) = Cluster::start() else { return };
    let project = Project::fast();
    let guide = commands(&root().join("docs/guide/slurm.md"));
    assert_eq!(guide.len(), 4, "{guide:?}");
    for command in &guide {
        let arguments: Vec<&str> = command.split_whitespace().skip(1).collect();
        let stdout = cluster.ok(&project, &arguments);
        assert!(!stdout.is_empty(), "{command}");
        if arguments[0] == "run" {
            // Two values of `supersample` and three seeds give six trainings.
            assert_eq!(
                jobs(&stdout).keys().filter(|label| label.starts_with("train-ss")).count(),
                6
            );
        }
    }
    cluster.drain();
}

const TWO_STAGES: &str =
    "default: [last]\nstages:\n  first: {run: ./step}\n  last: {run: ./step, inputs: {a: first}}\n";

fn is_job_running(cluster: &Cluster, project: &Project, arguments: &[&str], job: &str) -> bool {
    let status = cluster.ok(project, &[&["status"], arguments].concat());
    status.contains(&format!("job {job} running"))
}

#[test]
fn queued_jobs_are_found_kept_and_cancelled() {
    let Some(cluster) = Cluster::start() else { return };
    let project =
        project(&format!("{TWO_STAGES}  other: {{run: ./step, parameters: {{seed: 9}}}}\n"));
    cluster.ok(&project, &["run", "other", "--executor", "local"]);
    project.write("hold", "");
    let first = ["first", "-p", "first.seed=5"];
    cluster.submit(&project, &first);
    cluster.drain();
    let held = ["-p", "first.seed=5", "-p", "last.hold=hold"];
    let jobs = cluster.submit(&project, &held);
    assert_eq!(jobs.keys().collect::<Vec<_>>(), ["last"], "a cached stage isn't submitted");
    wait_until(|| is_job_running(&cluster, &project, &held, &jobs["last"]));
    let second = cluster.ok(&project, &[&["run"][..], &held].concat());
    assert!(second.contains("0 jobs submitted, 1 already queued"), "{second}");
    // gc keeps the inputs of a queued job, even if the given target doesn't need them.
    let stdout = cluster.ok(&project, &["gc", "other", "--keep-days", "0", "--drop-unfinished"]);
    assert!(
        stdout
            .lines()
            .any(|line| line.contains("first") && line.contains("a submitted job needs it")),
        "{stdout}"
    );
    // Edits of the pipeline don't change the two submitted jobs, which both wait.
    let other_jobs = cluster.submit(
        &project,
        &[&["other"][..], &["-p", "other.hold=hold", "-p", "other.seed=1"]].concat(),
    );
    std::fs::write(
        project.path("pipeline.yaml"),
        TWO_STAGES.replace("run: ./step, inputs", "parameters: {steps: 3}, run: ./step, inputs"),
    )
    .unwrap();
    std::fs::remove_file(project.path("hold")).unwrap();
    cluster.drain();
    assert_eq!(
        [&jobs["last"], &other_jobs["other"]].map(|job| cluster.state(job)),
        ["COMPLETED 0:0", "COMPLETED 0:0"]
    );
    std::fs::write(project.path("pipeline.yaml"), TWO_STAGES).unwrap();
    assert!(cluster.ok(&project, &[&["plan"][..], &held].concat()).matches("cached").count() >= 2);
    // gc removes submissions whose jobs have all ended.
    cluster.ok(&project, &["gc", "first", "--keep-days", "0"]);
    assert!(
        std::fs::read_dir(project.path(".nerf-sr/slurm"))
            .unwrap()
            .all(|e| e.unwrap().file_name() == "lock")
    );
    project.write("hold", "");
    let jobs = cluster.submit(&project, &["-p", "first.hold=hold"]);
    assert_eq!(jobs.len(), 2);
    let stdout = cluster.ok(&project, &["cancel", "first"]);
    assert!(stdout.contains("cancelled 1 job of first"), "{stdout}");
    cluster.drain();
    assert!(
        cluster.state(&jobs["last"]).starts_with("CANCELLED")
            && cluster.state(&jobs["first"]).starts_with("CANCELLED")
    );
    assert!(cluster.ok(&project, &["cancel"]).contains("cancelled 0 jobs"));
}

/// A job reaches its time limit five times: first by Slurm's clock, then by the test's signals.
/// The output equals that of an uninterrupted run.
#[test]
fn a_job_at_its_time_limit_resumes_from_its_checkpoint() {
    let Some(cluster) = Cluster::start() else { return };
    let pipeline = "default: [first]\nstages:\n  first: \
        {run: ./step, parameters: {steps: 60, hold: hold}, resources: {time: 1m}}\n";
    let (shared, local) = (project(pipeline), project(pipeline));
    shared.write("site.yaml", "notice: 56s\nsetup: ['echo set-up is done']\n");
    shared.write("hold", "10");
    let job = cluster.submit(&shared, &["--site", "site.yaml"])["first"].clone();
    let log = || cluster.ok(&shared, &["log", "first"]);
    let state = || cluster.state(&job);
    for round in 1..=5 {
        // A signal before the stage waits would stop the stage at another step, or before its
        // signal handler is installed.
        let is_held = happens(|| held_steps(&shared).len() == round);
        assert!(is_held, "{:?} {} {}", held_steps(&shared), state(), log());
        if round > 1 {
            cluster.slurm("scancel", &["--batch", "--signal=USR1", &job]);
        }
        let is_queued = happens(|| {
            log().matches("will resume from the checkpoint").count() == round
                && state().starts_with("PENDING")
        });
        assert!(is_queued, "{} {}", state(), log());
        shared.write("hold", &(10 * (round + 1)).to_string());
        // Slurm starts a requeued job after two minutes. Without any delay, Slurm would mistake
        // the job's old credential for the new one.
        cluster.slurm("scontrol", &["update", &format!("JobId={job}"), "StartTime=now+2"]);
    }
    std::fs::remove_file(shared.path("hold")).unwrap();
    cluster.drain();
    assert_eq!((stage_runs(&shared).len(), state().as_str()), (6, "COMPLETED 0:0"), "{}", log());
    assert!(
        log().contains("set-up is done")
            && [10, 20, 30, 40, 50].iter().all(|n| log().contains(&format!("stopped at {n}"))),
        "{}",
        log()
    );
    local.ok(&["run"]);
    assert_eq!(outputs(&shared, "first", &[]), outputs(&local, "first", &[]));
    assert!(cluster.ok(&shared, &["verify"]).contains("0 damaged"));
}

fn command_line_contains(entry: &std::fs::DirEntry, path: &[u8]) -> bool {
    let command_line = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
    command_line.windows(path.len()).any(|window| window == path)
}

/// Returns the ids of processes whose command line contains a project's path: runners and stages of
/// the project's jobs.
fn processes(project: &Project) -> Vec<String> {
    let folder = project.path("").into_os_string().into_encoded_bytes();
    let entries = std::fs::read_dir("/proc").unwrap().map(|entry| entry.unwrap());
    let mut found: Vec<String> = entries
        .filter(|entry| command_line_contains(entry, &folder))
        .map(|entry| entry.file_name().into_string().unwrap())
        .collect();
    found.sort();
    found
}

/// Ten times, a random process of the jobs is killed and the sweep is submitted again. Artifacts
/// equal those of a local run.
#[test]
fn kills_at_random_moments_lose_nothing() {
    let Some(cluster) = Cluster::start() else { return };
    let step = "run: ./step, parameters: {steps: 60, pause: 0.02, keeps: 1, hold: hold}";
    let pipeline = format!(
        "default: [second]\nstages:\n  first: {{{step}}}\n  second: {{{step}, inputs: \
        {{a: first}}}}\n"
    );
    let (shared, local) = (project(&pipeline), project(&pipeline));
    let sweep = ["-p", "first.seed=1,2"];
    let seed = std::env::var("NERF_SR_SEED").map_or(1, |text| text.parse().unwrap());
    let mut draws = CounterRng::new(seed, 0, 0);
    for kill in 0..10 {
        // No node finishes before the last kill. Each node may take a few steps before every kill.
        shared.write("hold", &(5 * (kill + 1)).to_string());
        // Until Slurm notices that a killed job has ended, the job counts as queued. So the job may
        // have to be submitted in a later attempt.
        let killed = happens(|| {
            cluster.submit(&shared, &sweep);
            // The kill comes at a random moment, so that every moment may be tested.
            std::thread::sleep(Duration::from_millis(draws.below(500)));
            let running = processes(&shared);
            let chosen = running.get(draws.below(running.len().max(1) as u64) as usize);
            // The process may end by itself before the signal arrives.
            chosen.is_some_and(|process| {
                Command::new("kill").args(["-KILL", process]).status().unwrap().success()
            })
        });
        assert!(killed, "seed {seed}, kill {kill}");
    }
    std::fs::remove_file(shared.path("hold")).unwrap();
    cluster.drain();
    cluster.submit(&shared, &sweep);
    cluster.drain();
    local.ok(&[&["run"][..], &sweep].concat());
    for stage in ["first", "second"] {
        assert_eq!(
            outputs(&shared, stage, &sweep),
            outputs(&local, stage, &sweep),
            "{stage}, seed {seed}"
        );
    }
    assert!(cluster.ok(&shared, &["verify"]).contains("0 damaged"));
}

#[test]
fn a_dependency_that_slurm_has_forgotten_is_caught() {
    let Some(cluster) = Cluster::start() else { return };
    let project = project(TWO_STAGES);
    cluster.submit(&project, &[]);
    cluster.drain();
    // Both artifacts are removed, because a cached `last` wouldn't need `first`.
    let objects = ["first", "last"].map(|stage| project.artifact(stage, &[]));
    objects.iter().for_each(|object| std::fs::remove_dir_all(object).unwrap());
    let submissions =
        std::fs::read_dir(project.path(".nerf-sr/slurm")).unwrap().map(|e| e.unwrap().path());
    let script: PathBuf =
        submissions.filter(|path| path.is_dir()).map(|path| path.join("job.sh")).next().unwrap();
    let log = project.path("log");
    let output = format!("--output={}", log.display());
    // Slurm treats an unknown job as one that succeeded.
    let arguments = [
        "--parsable",
        "--dependency=afterok:99999",
        "--kill-on-invalid-dep=yes",
        &output,
        script.to_str().unwrap(),
        "1",
    ];
    let job = cluster.slurm("sbatch", &arguments);
    cluster.drain();
    assert_eq!(cluster.state(&job), "FAILED 3:0");
    let log_text = std::fs::read_to_string(log).unwrap();
    assert!(log_text.contains("last needs first, which has no artifact"), "{log_text}");
}

/// A stage that requests a GPU computes on the job's first GPU. The key differs from the key of a
/// run on the CPU.
#[test]
fn a_stage_with_a_gpu_computes_on_it() {
    let Some(cluster) = Cluster::start() else { return };
    let project = project(&TWO_STAGES.replace("last: {", "last: {resources: {gpus: 1}, "));
    let jobs = cluster.submit(&project, &[]);
    cluster.drain();
    assert_eq!(cluster.state(&jobs["last"]), "COMPLETED 0:0");
    let devices: Vec<String> = stage_runs(&project)
        .iter()
        .map(|line| line.split(' ').nth(1).unwrap().to_owned())
        .collect();
    assert_eq!(devices, ["cpu", "cuda:0"]);
    assert!(cluster.ok(&project, &["run"]).contains("nothing to run"));
    let why = project.ok(&["why", "last"]);
    assert!(why.contains("device: \"cuda\" → \"cpu\""), "{why}");
}

/// Writes a fake Slurm program, which appends its arguments to `NAME.called` and then runs `body`.
fn write_fake(project: &Project, name: &str, body: &str) {
    let folder = project.path(".").display().to_string();
    project.program(
        &format!("bin/{name}"),
        &format!("#!/bin/sh\ncd '{folder}'\necho \"$@\" >> {name}.called\n{body}\n"),
    );
}

fn run_on_path(project: &Project, path: &str, arguments: &[&str]) -> Finished {
    let command = with_environment(command(project, arguments), "PATH", Path::new(path));
    let mut command = with_environment(command, "NERF_SR_SITE", Path::new("site.yaml"));
    Finished::of(command.output().unwrap())
}

#[test]
fn resources_and_dependencies_are_passed_to_slurm() {
    let project = project(
        "default: [page]\nstages:\n  first: \
        {run: ./step, resources: {cpus: 4, mem: 8G, gpus: 1, time: 2h}}\n  \
         last: {extends: first, inputs: {a: first}, resources: {gpus: 0}}\n  page: \
         {run: ./page, inputs: {run: last}}\n",
    );
    write_fake(&project, "sbatch", "echo $((40 + $(wc -l < sbatch.called)))");
    write_fake(&project, "squeue", "cat queue 2>/dev/null || true");
    write_fake(&project, "scancel", "");
    let path = format!("{}:{}", project.path("bin").display(), std::env::var("PATH").unwrap());
    project.write("site.yaml", "partition: gpu\nmax_submit: 2\nsetup: [module load cuda]\n");
    let finished = run_on_path(&project, &path, &["run"]);
    assert_eq!(
        (finished.code, finished.stdout.as_str()),
        (0, "first: job 41\nlast: job 42\n2 jobs submitted, 0 already queued\n"),
        "{}",
        finished.stderr
    );
    assert!(
        finished
            .stderr
            .contains("1 job not submitted: at most 2 jobs may be queued at once (max_submit)"),
        "{}",
        finished.stderr
    );
    let calls = std::fs::read_to_string(project.path("sbatch.called")).unwrap();
    let lines: Vec<&str> = calls.lines().collect();
    for (line, options) in [
        (lines[0], " --cpus-per-task=4 --mem=8192M --gres=gpu:1 --time=120 --partition=gpu /"),
        (
            lines[1],
            " --cpus-per-task=4 --mem=8192M --time=120 --partition=gpu --dependency=afterok:41 \
            --kill-on-invalid-dep=yes /",
        ),
    ] {
        assert!(
            line.contains(options)
                && line.contains("--requeue")
                && line.contains("--signal=B:USR1@90"),
            "{line}"
        );
    }
    // Queued jobs aren't submitted again, and `page` is submitted after `max_submit` is raised.
    let script = lines[0].split_whitespace().find(|word| word.ends_with("job.sh")).unwrap();
    project
        .write("queue", &format!("41|RUNNING|None|{script} 0\n42|PENDING|Dependency|{script} 1\n"));
    assert!(
        run_on_path(&project, &path, &["run"])
            .stdout
            .contains("0 jobs submitted, 2 already queued")
    );
    project.write("site.yaml", "max_submit: 3\n");
    let finished = run_on_path(&project, &path, &["run"]);
    assert_eq!(finished.stdout, "page: job 43\n1 job submitted, 2 already queued\n");
    assert!(
        std::fs::read_to_string(project.path("sbatch.called"))
            .unwrap()
            .contains("--dependency=afterok:42 ")
    );
    let status = run_on_path(&project, &path, &["status"]).stdout;
    assert!(
        status.contains("job 41 running") && status.contains("job 42 pending: Dependency"),
        "{status}"
    );
    let json: serde_json::Value =
        serde_json::from_str(&run_on_path(&project, &path, &["status", "--json"]).stdout).unwrap();
    assert_eq!(json["nodes"][0]["job"]["state"], "RUNNING", "{json}");
    assert!(
        run_on_path(&project, &path, &["cancel", "last"])
            .stdout
            .contains("cancelled 1 job of last")
    );
    assert_eq!(std::fs::read_to_string(project.path("scancel.called")).unwrap(), "42\n");
    // A refusal is one line, and the jobs can be submitted later.
    write_fake(&project, "sbatch", "echo 'sbatch: error: invalid partition' >&2; exit 1");
    project.write("queue", "");
    run_on_path(&project, &path, &["run"])
        .fails(1, &["3 jobs not submitted: sbatch: error: invalid partition; run this again"]);
    run_on_path(&project, &path, &["run", "-j", "2"])
        .fails(2, &["--jobs, --threads, --memory and --keep-going need --executor local"]);
    project.write("site.yaml", "partitions: gpu\n");
    run_on_path(&project, &path, &["run"]).fails(2, &["site.yaml", "unknown field `partitions`"]);
    std::fs::remove_file(project.path("bin/squeue")).unwrap();
    let mut without_slurm = with_environment(
        command(&project, &["gc", "--keep-days", "0"]),
        "PATH",
        Path::new("/nowhere"),
    );
    let finished = Finished::of(without_slurm.output().unwrap());
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    assert!(
        project.path(".nerf-sr/slurm").read_dir().unwrap().count() > 1,
        "gc keeps submissions if Slurm can't be queried"
    );
}

#[test]
fn resources_are_validated_and_not_part_of_keys() {
    for (block, message) in [
        (
            "{mem: 8}",
            "pipeline.yaml:3: stages.first.resources.mem: invalid amount of memory \"8\"; write a \
            number with M, G or T",
        ),
        (
            "{time: 2 hours}",
            "pipeline.yaml:3: stages.first.resources.time: invalid duration \"2 hours\"",
        ),
        ("{cores: 2}", "unknown field `cores`, expected one of `cpus`, `mem`, `gpus`, `time`"),
    ] {
        let project = project(&format!(
            "default: [first]\nstages:\n  first: {{run: ./step, resources: {block}}}\n"
        ));
        project.run(&["plan"]).fails(2, &[message]);
    }
    // No resource is part of a key.
    let project = project("default: [first]\nstages:\n  first: {run: ./step}\n");
    project.ok(&["run"]);
    project.replace("run: ./step", "run: ./step, resources: {cpus: 2, mem: 1G, gpus: 0, time: 1h}");
    assert!(project.ok(&["run"]).contains("nothing to run"));
}
