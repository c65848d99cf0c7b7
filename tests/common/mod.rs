//! Fixture of the end-to-end tests: a project folder with its own pipeline, on which the built
//! runner and stages are run.

#![allow(dead_code, reason = "every test file uses a part of it")]
#![allow(unreachable_pub, reason = "shared by several test binaries")]

pub mod browser;
pub mod large;
pub mod leftovers;
pub mod random;
pub mod splats;
pub mod surfaces;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::LazyLock;
use std::time::{Duration, Instant, SystemTime};

/// Returns the root folder of the repository.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_path_buf()
}

/// Returns the path of a program built by `make build`.
pub fn bin(name: &str) -> PathBuf {
    // Test binaries are one folder deeper than programs.
    let test = std::env::current_exe().unwrap();
    let path = test.ancestors().nth(2).unwrap().join(name);
    assert!(path.exists(), "{} is not built; run `make build` first", path.display());
    path
}

/// Returns all stage names, sorted: names of crate folders, and names of files in `src/bin/` for
/// crates with a second program.
pub fn stage_names() -> Vec<String> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(root().join("stages")).unwrap() {
        let folder = entry.unwrap().path();
        if folder.join("src/main.rs").exists() {
            names.push(stem(&folder));
        }
        if let Ok(programs) = std::fs::read_dir(folder.join("src/bin")) {
            names.extend(programs.map(|program| stem(&program.unwrap().path())));
        }
    }
    names.sort();
    names
}

/// Returns a path's last component, without its extension.
fn stem(path: &Path) -> String {
    path.file_stem().unwrap().to_str().unwrap().to_owned()
}

/// Returns the runner's verbs.
pub fn verbs() -> Vec<String> {
    let help = Finished::of(Command::new(bin("nerf-sr")).arg("--help").output().unwrap()).stdout;
    verbs_of(&help).into_iter().map(str::to_owned).collect()
}

/// Returns the verbs listed in a help text of the runner.
pub fn verbs_of(help: &str) -> Vec<&str> {
    let lines = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    lines
        .take_while(|line| !line.is_empty())
        .filter_map(|line| line.split_whitespace().next())
        .filter(|verb| *verb != "help")
        .collect()
}

/// Returns a verb with its required arguments, for a project that has `prep`'s artifact. Add a new
/// verb with required arguments here.
pub fn call_of(verb: &str) -> Vec<&str> {
    let arguments: &[&str] = match verb {
        "init" => &["data"],
        "why" | "path" | "log" | "describe" => &["prep"],
        "diff" => &["prep", "prep"],
        "pin" | "unpin" => &["mine"],
        "gc" => &["--keep-days", "0"],
        "completions" => &["bash"],
        _ => &[],
    };
    [&[verb][..], arguments].concat()
}

/// Pipeline that runs in seconds: 12 training views 24 pixels wide, a small field.
pub const TINY: &str = "
default: [eval]
stages:
  demo-scene:
    parameters: {size: 48, train: 12, test: 3, samples_per_axis: 2}
  prep:
    inputs: {dataset: demo-scene}
    parameters: {lr_width: 24, scale: 2}
  train-ss:
    inputs: {scene: prep/train}
    parameters: {rays: 60000, n_levels: 4, log2_hashmap_size: 12, hidden_dim: 16, march_steps: 128, max_rays_per_step: 2048, samples_per_step: 16384}
  render-depth:
    inputs: {field: train-ss, cameras: prep/cameras}
  eval:
    inputs: {views: render-depth, truth: prep/truth}
";

/// Pipeline with a report page; each stage takes a tenth of a second.
pub const FAST: &str = "
default: [report]
stages:
  demo-scene:
    parameters: {size: 32, train: 6, test: 2, samples_per_axis: 1}
  prep:
    inputs: {dataset: demo-scene}
    parameters: {lr_width: 16, scale: 2}
  train-ss:
    inputs: {scene: prep/train}
    parameters: {rays: 4000, n_levels: 2, cells_per_pixel: 0.64, log2_hashmap_size: 10, hidden_dim: 16, march_steps: 64, max_rays_per_step: 512, samples_per_step: 4096}
  render-depth:
    inputs: {field: train-ss, cameras: prep/cameras}
    parameters: {samples_per_axis: 1}
  eval:
    inputs: {views: render-depth, truth: prep/truth}
  report:
    inputs: {run: eval}
";

/// Path of the cache of stage descriptions, relative to the project.
const DESCRIPTION_CACHE: &str = ".nerf-sr/cache/describe.json";

/// Cached descriptions of all stages. Without a cache, each project's runner starts every stage's
/// program, and programs with libtorch take half a second to start.
static STAGE_DESCRIPTIONS: LazyLock<String> = LazyLock::new(|| {
    let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join("describe.json");
    let modified = |path: &Path| path.metadata().and_then(|metadata| metadata.modified());
    let built = stage_names().iter().map(|stage| modified(&bin(stage)).unwrap()).max().unwrap();
    if modified(&file).is_ok_and(|written| written > built) {
        return std::fs::read_to_string(file).unwrap();
    }
    let project = Project { dir: tempfile::tempdir().unwrap() };
    let blocks = stage_names().iter().map(|stage| format!("  {stage}: {{}}\n")).collect::<String>();
    project.write("pipeline.yaml", &format!("default: [prep]\nstages:\n{blocks}"));
    // The blocks lack inputs, which `plan` reports only after the runner has cached descriptions.
    assert_ne!(project.run(&["plan"]).code, 0);
    let cached = project.path(DESCRIPTION_CACHE);
    artifact::write_atomically(&file, &std::fs::read(&cached).unwrap()).unwrap();
    std::fs::read_to_string(cached).unwrap()
});

/// Temporary project folder with a pipeline.
pub struct Project {
    dir: tempfile::TempDir,
}

impl Project {
    pub fn new(pipeline: &str) -> Self {
        let project = Self { dir: tempfile::tempdir().unwrap() };
        project.write("pipeline.yaml", pipeline);
        project.write(DESCRIPTION_CACHE, &STAGE_DESCRIPTIONS);
        project
    }

    pub fn tiny() -> Self {
        Self::new(TINY)
    }

    pub fn fast() -> Self {
        Self::new(FAST)
    }

    /// Creates a project with the tiny pipeline and shipped targets; `blocks` are additional or
    /// overriding stage blocks.
    pub fn shipped(targets: &[&str], blocks: &str) -> Self {
        let project = Self::tiny();
        project.write("base/pipeline.yaml", TINY);
        project.copy_folder("pipelines", "base");
        let files: Vec<String> =
            targets.iter().map(|target| format!("base/pipelines/{target}.yaml")).collect();
        let stages = if blocks.is_empty() { String::new() } else { format!("stages:\n{blocks}") };
        project.write(
            "pipeline.yaml",
            &format!("extends: [{}]\ndefault: [eval]\n{stages}", files.join(", ")),
        );
        project
    }

    /// Creates a project with the tiny pipeline and the shipped `pipelines/` and `experiments/`.
    pub fn experiments() -> Self {
        let project = Self::tiny();
        ["pipelines", "experiments"]
            .into_iter()
            .for_each(|folder| project.copy_folder(folder, "."));
        project
    }

    /// Copies a shipped folder of pipeline files into a folder of the project.
    pub fn copy_folder(&self, shipped: &str, folder: &str) {
        for entry in std::fs::read_dir(root().join(shipped)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap().to_owned();
            self.write(
                &format!("{folder}/{shipped}/{name}"),
                &std::fs::read_to_string(&path).unwrap(),
            );
        }
    }

    pub fn path(&self, file: &str) -> PathBuf {
        self.dir.path().join(file)
    }

    pub fn write(&self, file: &str, text: &str) {
        let path = self.path(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    /// Writes an executable file with `install`: a child forked by a concurrent test would inherit
    /// this process's open file, and a file open for writing can't be executed.
    pub fn program(&self, file: &str, text: &str) {
        self.write(".source", text);
        let path = self.path(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        assert!(
            Command::new("install")
                .args(["-m", "755"])
                .arg(self.path(".source"))
                .arg(path)
                .status()
                .unwrap()
                .success()
        );
    }

    /// Replaces text in the pipeline and the base pipeline; at least one must contain the text.
    #[track_caller]
    pub fn replace(&self, from: &str, to: &str) {
        let files = ["pipeline.yaml", "base/pipeline.yaml"];
        let texts =
            files.map(|file| (file, std::fs::read_to_string(self.path(file)).unwrap_or_default()));
        assert!(texts.iter().any(|(_, text)| text.contains(from)), "the pipeline has no {from:?}");
        for (file, text) in texts.iter().filter(|(_, text)| text.contains(from)) {
            self.write(file, &text.replace(from, to));
        }
    }

    pub fn command(&self, arguments: &[&str]) -> Command {
        self.command_of(&bin("nerf-sr"), arguments)
    }

    /// Returns a command that runs a program in the project's folder.
    pub fn command_of(&self, program: &Path, arguments: &[&str]) -> Command {
        let mut command = Command::new(program);
        command.args(arguments).current_dir(self.dir.path());
        // The environment of the user who runs the tests must not change the runner's defaults.
        for name in ["STORE", "EXECUTOR", "SITE", "DATA"] {
            command.env_remove(format!("NERF_SR_{name}"));
        }
        command
    }

    /// Starts the runner with captured output.
    pub fn spawn(&self, arguments: &[&str]) -> Child {
        self.command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    }

    pub fn run(&self, arguments: &[&str]) -> Finished {
        Finished::of(self.command(arguments).output().unwrap())
    }

    /// Runs the runner, asserts success and returns stdout.
    #[track_caller]
    pub fn ok(&self, arguments: &[&str]) -> String {
        let finished = self.run(arguments);
        assert_eq!(finished.code, 0, "{}\n{}", finished.stdout, finished.stderr);
        finished.stdout
    }

    /// Returns the nodes that `status --json` reports.
    #[track_caller]
    pub fn nodes(&self, arguments: &[&str]) -> Vec<serde_json::Value> {
        let status = self.ok(&[&["status", "--json"], arguments].concat());
        let report: serde_json::Value = serde_json::from_str(&status).unwrap();
        report["nodes"].as_array().unwrap().clone()
    }

    /// Returns the identities of a stage's current artifacts, in the order of the sweep's points.
    #[track_caller]
    pub fn output_of(&self, stage: &str, arguments: &[&str]) -> Vec<String> {
        let nodes = self.nodes(arguments);
        let outputs = nodes.iter().filter(|node| node["stage"] == stage).map(|node| {
            node["output"].as_str().unwrap_or_else(|| panic!("not cached: {node}")).to_owned()
        });
        outputs.collect()
    }

    /// Returns the folder of a stage's current artifact; in a sweep, of the first point's artifact.
    #[track_caller]
    pub fn artifact(&self, stage: &str, arguments: &[&str]) -> PathBuf {
        self.object(&self.output_of(stage, arguments)[0])
    }

    /// Reads a JSON file of a stage's current artifact.
    #[track_caller]
    pub fn json(&self, stage: &str, file: &str, arguments: &[&str]) -> serde_json::Value {
        let path = self.artifact(stage, arguments).join(file);
        serde_json::from_slice(&std::fs::read(&path).unwrap())
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()))
    }

    /// Returns the folder of the artifact whose identity begins with `prefix`.
    #[track_caller]
    pub fn object(&self, prefix: &str) -> PathBuf {
        let objects = std::fs::read_dir(self.path(".nerf-sr/objects")).unwrap();
        let found = objects
            .map(|e| e.unwrap().path())
            .find(|p| p.file_name().unwrap().to_str().unwrap().starts_with(prefix));
        found.unwrap_or_else(|| panic!("no object {prefix}"))
    }

    /// Links the pipeline's demo scene as `data/NAME`, so that `data` can be used as a data
    /// folder.
    pub fn demo_data(&self, name: &str) {
        self.ok(&["run", "demo-scene"]);
        let dataset = self.object(&self.output_of("demo-scene", &[])[0]);
        std::fs::create_dir_all(self.path("data")).unwrap();
        std::os::unix::fs::symlink(&dataset, self.path("data").join(name)).unwrap();
    }

    /// Returns the paths of all objects and records of the store, sorted.
    pub fn store_listing(&self) -> Vec<String> {
        let mut names: Vec<String> = ["objects", "actions"]
            .into_iter()
            .flat_map(|f| {
                std::fs::read_dir(self.path(&format!(".nerf-sr/{f}"))).into_iter().flatten()
            })
            .map(|e| e.unwrap().path().display().to_string())
            .collect();
        names.sort();
        names
    }
}

/// Returns the commands of `nerf-sr` and `nerf-sr-remote` in a document's shell blocks.
pub fn commands(document: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(document).unwrap();
    let blocks = text.split("```sh\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    let lines = blocks.flat_map(|block| {
        let joined = block.replace("\\\n", " ");
        joined
            .lines()
            .map(|line| line.split('#').next().unwrap().trim().to_owned())
            .collect::<Vec<_>>()
    });
    let is_command =
        |line: &String| line.starts_with("nerf-sr ") || line.starts_with("nerf-sr-remote ");
    lines.filter(is_command).collect()
}

/// Exit code and output of a finished command.
pub struct Finished {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

impl Finished {
    pub fn of(output: Output) -> Self {
        Self {
            code: output.status.code().unwrap_or(-1),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }

    /// Asserts the exit code, that one line of stderr contains all `texts`, and that no panic is
    /// printed.
    #[track_caller]
    pub fn fails(&self, code: i32, texts: &[&str]) {
        assert_eq!(self.code, code, "{}\n{}", self.stdout, self.stderr);
        let line = self.stderr.lines().rfind(|l| texts.iter().all(|text| l.contains(text)));
        assert!(line.is_some(), "no line with {texts:?} in:\n{}", self.stderr);
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
    }
}

/// Runs a stage's program with the arguments of the stage contract.
pub fn stage(
    name: &str,
    params: &str,
    inputs: &[(&str, &Path)],
    output: &Path,
    options: &[&str],
) -> Finished {
    Finished::of(stage_command(name, params, inputs, output, options).output().unwrap())
}

/// Writes a stage's parameters next to the output and returns the stage's command. The stage prints
/// no progress unless `options` has `--progress`.
pub fn stage_command(
    name: &str,
    params: &str,
    inputs: &[(&str, &Path)],
    output: &Path,
    options: &[&str],
) -> Command {
    let file = output.with_extension("params.json");
    if let Some(folder) = file.parent().filter(|f| f.is_dir()) {
        std::fs::write(folder.join(file.file_name().unwrap()), params).ok();
    }
    let silent: &[&str] =
        if options.contains(&"--progress") { &[] } else { &["--progress", "none"] };
    let mut command = Command::new(bin(name));
    command.arg("--params").arg(&file).arg("--output").arg(output).args(silent).args(options);
    for (name, folder) in inputs {
        command.arg("--input").arg(format!("{name}={}", folder.display()));
    }
    command
}

/// Renders a small demo scene, prepares it at half the width and returns the folder of LR images.
pub fn demo_train(project: &Project, views: u32) -> PathBuf {
    let (data, scene) = (project.path("data"), project.path("scene"));
    let params = format!(r#"{{"size": 48, "train": {views}, "test": 1, "samples_per_axis": 1}}"#);
    assert_eq!(stage("demo-scene", &params, &[], &data, &[]).code, 0);
    assert_eq!(stage("prep", r#"{"lr_width": 24}"#, &[("dataset", &data)], &scene, &[]).code, 0);
    scene.join("train")
}

/// Returns the text of an artifact's manifest, which identifies the artifact's content.
pub fn manifest(folder: &Path) -> String {
    std::fs::read_to_string(folder.join("artifact.json")).unwrap()
}

/// Sends a signal, such as "-TERM" or "-KILL", to a child process.
pub fn signal(child: &Child, name: &str) {
    Command::new("kill").args([name, &child.id().to_string()]).status().unwrap();
}

/// Returns the modification time of a work folder's latest checkpoint.
pub fn last_checkpoint(work: &Path) -> Option<SystemTime> {
    checkpoints(work).iter().filter_map(|file| file.metadata().ok()?.modified().ok()).max()
}

/// Returns the paths of a work folder's checkpoints.
pub fn checkpoints(work: &Path) -> Vec<PathBuf> {
    let files = walkdir::WalkDir::new(work).sort_by_file_name().into_iter().flatten();
    files
        .filter(|file| file.file_name() == "checkpoint.safetensors")
        .map(walkdir::DirEntry::into_path)
        .collect()
}

/// Timeout of [`wait_until`], long enough for a busy machine. Slurm takes a minute to end a job
/// whose time limit has passed.
const TIMEOUT: Duration = Duration::from_secs(300);

/// Waits until a condition is true; panics after [`TIMEOUT`].
#[track_caller]
pub fn wait_until(condition: impl FnMut() -> bool) {
    assert!(happens(condition), "condition not met within {TIMEOUT:?}");
}

/// Waits until a condition is true; returns `false` after [`TIMEOUT`], for callers that report the
/// failure in more detail.
pub fn happens(mut condition: impl FnMut() -> bool) -> bool {
    let start = Instant::now();
    while !condition() {
        if start.elapsed() > TIMEOUT {
            return false;
        }
        std::thread::sleep(Duration::from_millis(25));
    }
    true
}

/// Returns whether a process is running; a zombie, which `/proc` still lists, isn't running.
pub fn is_running(pid: &str) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    // The state follows the parenthesised process name, which may contain any characters.
    stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with(['Z', 'X']))
}

/// Runs and kills a stage once per entry of `milliseconds`, a delay after the start in the first
/// round and after the next checkpoint in later rounds. Asserts that a checkpoint remains and no
/// output exists.
///
/// Kills happen at arbitrary moments. From the progress count `slow_from`, the stage is slowed, so
/// that no machine finishes the stage before the last kill. Tests that need a certain step set
/// `NERF_SR_STOP_AFTER`.
pub fn kill_again_and_again(
    name: &str,
    params: &str,
    inputs: &[(&str, &Path)],
    output: &Path,
    work: &Path,
    slow_from: u64,
    milliseconds: &[u64],
) {
    let missing_file = work.with_extension("never");
    for (round, pause) in milliseconds.iter().enumerate() {
        let previous = last_checkpoint(work);
        let options = ["--work", work.to_str().unwrap()];
        let mut child = stage_command(name, params, inputs, output, &options)
            .env("NERF_SR_SLOW_UNTIL", format!("{slow_from} {}", missing_file.display()))
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        if round > 0 {
            wait_until(|| last_checkpoint(work) != previous || child.try_wait().unwrap().is_some());
        }
        std::thread::sleep(Duration::from_millis(*pause));
        child.kill().unwrap();
        let killed = Finished::of(child.wait_with_output().unwrap());
        assert_eq!(killed.code, -1, "{name} ended before kill {round}: {}", killed.stderr);
    }
    assert!(last_checkpoint(work).is_some() && !output.exists());
}

/// Returns the data folder with real scenes and weights; without one, prints that the test is
/// skipped and returns `None`.
pub fn data() -> Option<PathBuf> {
    let path =
        std::env::var("NERF_SR_DATA").map_or_else(|_| root().join("../shared/data"), PathBuf::from);
    if path.is_dir() {
        return Some(path);
    }
    eprintln!("skipped: no data ({} is not there; set NERF_SR_DATA)", path.display());
    None
}
