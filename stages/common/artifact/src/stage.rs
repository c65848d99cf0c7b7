use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, anyhow};
use clap::{CommandFactory, Parser};
use schemars::JsonSchema;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::canonical::hash_json;
use crate::console::{print_lines, report_text};
use crate::describe::{Description, Input, Output};
use crate::failure::{Failure, FailureExt, exit_code, one_line};
use crate::fsio::write_json;
use crate::help::help_of;
use crate::manifest::{MANIFEST_FILE, Manifest};
use crate::nearest::known_names;
use crate::panics::install_panic_hook;
use crate::parameters::Schema;
use crate::progress::{Progress, ProgressMode, StopAfter, emit_events, failed_event};
use crate::renames::{Named, renamed};
use crate::report_line;
use crate::rules::Rule;
use crate::signals::stop_on_signals;

/// A file that a stage may leave in its output: a few words on the result, which the runner prints
/// at the end.
pub const SUMMARY_FILE: &str = "summary.txt";

/// A stage of the pipeline: inputs and parameters in, one artifact out.
pub trait Stage {
    /// Parameters. Defaults, ranges and documentation come from the type; `#[serde(default,
    /// deny_unknown_fields)]` is expected. One of them may be an externally tagged `enum` of
    /// structs: it selects a variant, whose parameters are given beside it.
    type Params: Serialize + DeserializeOwned + JsonSchema + Default;
    /// Name of stage and binary.
    const NAME: &'static str;
    /// What it makes of what, in a sentence.
    const SUMMARY: &'static str;
    /// Whether it shows a run and is never cached.
    const SINK: bool = false;
    /// Whether it shows what there is of a run, some of which failed.
    const PARTIAL: bool = false;
    /// Whether the stage accepts `--from-checkpoint` ([`Context::from_checkpoint`]).
    const FROM_CHECKPOINT: bool = false;
    /// Environment variables that change the result.
    const ENVIRONMENT: &'static [&'static str] = &[];

    /// Inputs by name.
    fn inputs() -> Vec<(&'static str, Input)> {
        Vec::new()
    }

    /// What comes out.
    fn output() -> Output;

    /// What parameters and inputs must be together.
    fn rules() -> Vec<Rule> {
        Vec::new()
    }

    /// Does the work: reads inputs and writes outputs through `context`.
    fn run(context: &Context, params: &Self::Params) -> anyhow::Result<()>;

    /// What `describe` prints; `code` is the build's fingerprint.
    fn describe(version: &str, code: &str) -> Description {
        Description {
            name: Self::NAME.to_owned(),
            version: version.to_owned(),
            code: code.to_owned(),
            summary: Self::SUMMARY.to_owned(),
            parameters: schemars::schema_for!(Self::Params).to_value(),
            inputs: Self::inputs()
                .into_iter()
                .map(|(name, input)| (name.to_owned(), input))
                .collect(),
            output: Self::output(),
            environment: Self::ENVIRONMENT.iter().map(|&name| name.to_owned()).collect(),
            sink: Self::SINK,
            partial: Self::PARTIAL,
            from_checkpoint: Self::FROM_CHECKPOINT,
            rules: Self::rules(),
        }
    }
}

#[derive(Parser)]
#[command(subcommand_negates_reqs = true, args_conflicts_with_subcommands = true)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
    /// JSON file with the parameters; those it leaves out have their defaults
    #[arg(long, value_name = "FILE")]
    params: Option<PathBuf>,
    /// One input, e.g. --input scene=DIR; repeat for more
    #[arg(long = "input", value_name = "NAME=DIR")]
    inputs: Vec<String>,
    /// Folder to make; it must not exist yet and appears only when complete
    #[arg(long, value_name = "DIR", required = true)]
    output: Option<PathBuf>,
    /// Private folder that survives an interruption (checkpoints)
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Write the output from the latest checkpoint in --work, and don't train on
    #[arg(long, requires = "work")]
    from_checkpoint: bool,
    /// Where to compute: cpu or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Threads to use; the result doesn't depend on it [default: all cores]
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// How to show progress
    #[arg(long, value_enum, default_value = "plain")]
    progress: ProgressMode,
}

#[derive(clap::Subcommand)]
enum Command {
    /// Print name, code fingerprint, parameters, inputs and output as JSON
    Describe,
}

/// Environment variable in which a runner tells its stages its process id, so that they see when it
/// is gone.
pub const RUNNER_VARIABLE: &str = "NERF_SR_RUNNER";

/// What a running stage has at hand.
pub struct Context {
    /// Threads to use (rayon's global pool has this size).
    pub threads: usize,
    /// Where to compute: `cpu` or `cuda:N`.
    pub device: String,
    inputs: BTreeMap<String, GivenInput>,
    output: PathBuf,
    work: Option<PathBuf>,
    from_checkpoint: bool,
    progress: ProgressMode,
    interrupted: Arc<AtomicBool>,
    /// Hash of the parameters, of what the inputs are, of the stage's code and of where it
    /// computes; none where an input has no manifest.
    pub(crate) identity: Option<String>,
    /// Whether it was said that something is there already.
    pub(crate) goes_on: AtomicBool,
}

/// An input that was given: a folder, checked against its manifest where it has one.
#[derive(Debug, Clone)]
pub struct GivenInput {
    name: String,
    folder: PathBuf,
    /// Its manifest's, where it has one.
    identity: Option<String>,
}

impl GivenInput {
    /// A folder under an input's name. With a manifest in it or above it (a subtree), its files are
    /// checked first.
    ///
    /// # Errors
    /// [`Failure::BadInput`] where there is no such folder, or its files aren't the manifest's.
    pub fn open(name: &str, folder: &Path) -> Result<Self, Failure> {
        if !folder.exists() {
            return Err(Failure::BadInput(format!(
                "input {name}: {}: no such folder",
                folder.display()
            )));
        }
        let absolute =
            folder.canonicalize().bad_input(format!("input {name}: {}", folder.display()))?;
        let manifest = if absolute.join(MANIFEST_FILE).is_file() {
            Some(Manifest::read(&absolute))
        } else if let (Some(parent), Some(subtree)) =
            (absolute.parent(), absolute.file_name().and_then(|n| n.to_str()))
            && parent.join(MANIFEST_FILE).is_file()
        {
            Some(Manifest::read(parent).map(|manifest| manifest.subtree(subtree)))
        } else {
            None
        };
        let manifest = manifest.transpose().bad_input(format!("input {name}"))?;
        if let Some(manifest) = &manifest {
            manifest.check_contents(&absolute).bad_input(format!("input {name}"))?;
        }
        let identity = manifest.map(|manifest| manifest.identity());
        Ok(Self { name: name.to_owned(), folder: folder.to_path_buf(), identity })
    }

    /// The input's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// A file of the input.
    pub fn path(&self, file: &str) -> PathBuf {
        self.folder.join(file)
    }

    /// A JSON file of the input.
    ///
    /// # Errors
    /// [`Failure::BadInput`] with input, file and field.
    pub fn read_json<T: DeserializeOwned>(&self, file: &str) -> Result<T, Failure> {
        let path = self.path(file);
        let place = format!("input {}: {}", self.name, path.display());
        let bytes = fs::read(&path).bad_input(&place)?;
        serde_path_to_error::deserialize(&mut serde_json::Deserializer::from_slice(&bytes))
            .bad_input(&place)
    }
}

impl Context {
    /// An input that must be there.
    ///
    /// # Errors
    /// [`Failure::Usage`] where it isn't given.
    pub fn input(&self, name: &str) -> Result<&GivenInput, Failure> {
        self.optional_input(name).ok_or_else(|| {
            Failure::Usage(format!("input {name} is missing; give --input {name}=DIR"))
        })
    }

    /// An input that may be left out.
    pub fn optional_input(&self, name: &str) -> Option<&GivenInput> {
        self.inputs.get(name)
    }

    /// The path of a file in the output; folders on the way are made.
    pub fn output_path(&self, file: &str) -> anyhow::Result<PathBuf> {
        let path = self.output.join(file);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder)
                .with_context(|| format!("cannot make {}", folder.display()))?;
        }
        Ok(path)
    }

    /// Writes a JSON file of the output.
    pub fn write_json(&self, file: &str, value: &impl Serialize) -> anyhow::Result<()> {
        let path = self.output_path(file)?;
        write_json(&path, value).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Leaves a few words on the result, which the runner prints at the end.
    pub fn write_summary(&self, text: &str) -> anyhow::Result<()> {
        let path = self.output_path(SUMMARY_FILE)?;
        fs::write(&path, format!("{}\n", text.trim_end()))
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// The folder for checkpoints, where one was given.
    pub fn work(&self) -> Option<&Path> {
        self.work.as_deref()
    }

    /// Whether to write the output from the latest checkpoint in [`Context::work`], without further
    /// training. False unless the stage sets [`Stage::FROM_CHECKPOINT`].
    pub fn from_checkpoint(&self) -> bool {
        self.from_checkpoint
    }

    /// Starts a progress display.
    pub fn progress(&self, label: &str, total: u64) -> Progress {
        Progress::new(label, total, self.progress)
            .stopping(StopAfter::from_environment(&self.interrupted))
    }

    /// Says something to the person watching, on one line; it also lands in the action's log.
    pub fn say(&self, text: impl std::fmt::Display) {
        if self.progress != ProgressMode::None {
            report_text(&text.to_string());
        }
    }

    /// Whether a signal asked the stage to stop.
    pub fn interrupted(&self) -> bool {
        self.interrupted.load(Ordering::Relaxed)
    }

    /// Fails with [`Failure::Interrupted`] once a signal asked the stage to stop: for `?` in loops.
    pub fn check_interrupt(&self) -> anyhow::Result<()> {
        if self.interrupted() { Err(Failure::Interrupted.into()) } else { Ok(()) }
    }
}

/// The whole `main` of a stage: parses, checks, runs, publishes, and maps errors and panics to an
/// exit code. The reason of a failure is one line on stderr, and with `--progress json` an event on
/// stdout.
pub fn run_stage<S: Stage>(version: &'static str, code: &str) -> ExitCode {
    run_stage_with::<S>(version, code, std::env::args_os())
}

pub(crate) fn run_stage_with<S: Stage>(
    version: &'static str,
    code: &str,
    arguments: impl IntoIterator<Item = OsString>,
) -> ExitCode {
    install_panic_hook(S::NAME);
    match parse_and_run::<S>(version, code, arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let message = one_line(&error);
            report_line!("{}: {message}", S::NAME);
            if let Some(event) = failed_event(&message) {
                std::io::stdout().write_all(event.as_bytes()).ok();
            }
            ExitCode::from(exit_code(&error))
        }
    }
}

fn parse_and_run<S: Stage>(
    version: &'static str,
    code: &str,
    arguments: impl IntoIterator<Item = OsString>,
) -> anyhow::Result<()> {
    let description = S::describe(version, code);
    let mut command = Arguments::command()
        .name(S::NAME)
        .about(S::SUMMARY)
        .after_help(help_of(&description))
        .mut_arg("from_checkpoint", |argument| argument.hide(!S::FROM_CHECKPOINT));
    if !version.is_empty() {
        command = command.version(version);
    }
    let arguments = match command.clone().try_get_matches_from(arguments) {
        Ok(matches) => <Arguments as clap::FromArgMatches>::from_arg_matches(&matches)?,
        // Help and version, too, come this way; clap knows where to print and how to exit.
        Err(error) => error.exit(),
    };
    match arguments.command {
        Some(Command::Describe) => {
            print_lines(&serde_json::to_string_pretty(&description)?);
            Ok(())
        }
        None => execute::<S>(arguments, &description),
    }
}

fn execute<S: Stage>(arguments: Arguments, description: &Description) -> anyhow::Result<()> {
    let for_runner = arguments.progress == ProgressMode::Json;
    if for_runner {
        emit_events();
    }
    let (resolved, params) = read_params::<S::Params>(arguments.params.as_deref(), description)?;
    let folders = input_folders(&arguments.inputs, description)?;
    // What made an input isn't known here; rules about that are the runner's to check.
    let given = folders.iter().map(|(name, _)| ((*name).to_owned(), None)).collect();
    if let Some(problem) = description.broken_rule(&resolved, &given) {
        return Err(Failure::Usage(problem).into());
    }
    if arguments.from_checkpoint && !S::FROM_CHECKPOINT {
        let problem =
            format!("--from-checkpoint: stage {} doesn't have this option; leave it out", S::NAME);
        return Err(Failure::Usage(problem).into());
    }
    let threads = match arguments.threads {
        Some(0) => return Err(Failure::Usage("--threads 0: give at least 1".to_owned()).into()),
        Some(n) => n,
        None => std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
    };
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().ok();
    let mut inputs = BTreeMap::new();
    for (name, folder) in folders {
        inputs.insert(name.to_owned(), GivenInput::open(name, folder)?);
    }
    let interrupted = stop_on_signals()?;
    if for_runner {
        end_with_runner(&interrupted)?;
    }
    let output = arguments.output.expect("clap requires --output");
    let staging = Staging::new(&output)?;
    if let Some(work) = &arguments.work {
        fs::create_dir_all(work)
            .with_context(|| format!("--work {}: cannot be made", work.display()))?;
    }
    let made_from: Option<BTreeMap<&str, &str>> = inputs
        .iter()
        .map(|(name, input)| Some((name.as_str(), input.identity.as_deref()?)))
        .collect();
    let identity =
        made_from.map(|inputs| hash_json(&(&params, inputs, &description.code, &arguments.device)));
    let context = Context {
        threads,
        device: arguments.device,
        inputs,
        output: staging.folder.clone(),
        work: arguments.work,
        from_checkpoint: arguments.from_checkpoint,
        progress: arguments.progress,
        interrupted,
        identity,
        goes_on: AtomicBool::new(false),
    };
    S::run(&context, &params)?;
    context.check_interrupt()?;
    staging.publish(&description.output.kind, &output)
}

/// The inputs' names and folders: each one known, none missing.
fn input_folders<'a>(
    given: &'a [String],
    description: &Description,
) -> anyhow::Result<Vec<(&'a str, &'a Path)>> {
    let mut folders = Vec::new();
    for text in given {
        let (name, folder) = text
            .split_once('=')
            .ok_or_else(|| Failure::Usage(format!("--input {text}: expected NAME=DIR")))?;
        if !description.inputs.contains_key(name) {
            let problem = match renamed(Named::Input, &description.name, name) {
                Some(rename) => rename.problem(None),
                None => format!(
                    "no such input; {}",
                    known_names(name, description.inputs.keys().map(String::as_str))
                ),
            };
            return Err(Failure::Usage(format!("--input {name}: {problem}")).into());
        }
        folders.push((name, Path::new(folder)));
    }
    for (name, input) in &description.inputs {
        if !input.optional && !folders.iter().any(|(given, _)| given == name) {
            return Err(Failure::Usage(format!(
                "input {name} is missing; give --input {name}=DIR ({})",
                input.summary
            ))
            .into());
        }
    }
    Ok(folders)
}

/// Lets the stage end as if interrupted, with a checkpoint, when the runner is killed, rather than
/// work on unseen.
fn end_with_runner(interrupted: &AtomicBool) -> anyhow::Result<()> {
    rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::TERM))?;
    // It may have been killed before that, while this process was being loaded.
    let runner = std::env::var(RUNNER_VARIABLE).ok().and_then(|pid| pid.parse::<i32>().ok());
    let parent = rustix::process::getppid().map_or(0, rustix::process::Pid::as_raw_pid);
    if runner.is_some_and(|pid| pid != parent) {
        interrupted.store(true, Ordering::SeqCst);
    }
    Ok(())
}

/// The parameters from the file, checked against the schema, or the defaults: as JSON and as the
/// stage's own type.
fn read_params<P: DeserializeOwned>(
    file: Option<&Path>,
    description: &Description,
) -> anyhow::Result<(Value, P)> {
    let place = file.map(|f| f.display().to_string()).unwrap_or_default();
    let given = match file {
        None => serde_json::Map::new(),
        Some(path) => {
            let bytes = fs::read(path).usage(format!("--params {place}"))?;
            serde_json::from_slice(&bytes)
                .usage(format!("--params {place}: expected a JSON object"))?
        }
    };
    let schema = Schema::new(&description.name, &description.parameters)
        .map_err(|e| anyhow!("the stage's own parameter schema: {e}"))?;
    let resolved = schema.resolve(&given).map_err(|problems| {
        let lines: Vec<String> = problems.iter().map(ToString::to_string).collect();
        Failure::Usage(format!("--params {place}: {}", lines.join("; ")))
    })?;
    let params = serde_path_to_error::deserialize(schema.nested(&resolved))
        .usage(format!("--params {place}"))?;
    Ok((resolved, params))
}

/// The output while it is being made: beside its final place, removed unless published.
struct Staging {
    folder: PathBuf,
}

impl Staging {
    fn new(output: &Path) -> anyhow::Result<Self> {
        if output.exists() {
            return Err(Failure::Usage(format!(
                "--output {}: exists already; name a new folder",
                output.display()
            ))
            .into());
        }
        let name = output.file_name().ok_or_else(|| {
            Failure::Usage(format!("--output {}: not a folder name", output.display()))
        })?;
        let folder = output.with_file_name(format!(".{}.partial", name.to_string_lossy()));
        if folder.exists() {
            fs::remove_dir_all(&folder)
                .with_context(|| format!("cannot clear {}", folder.display()))?;
        }
        fs::create_dir_all(&folder)
            .with_context(|| format!("--output {}: cannot write there", output.display()))?;
        Ok(Self { folder })
    }

    fn publish(self, kind: &str, output: &Path) -> anyhow::Result<()> {
        let manifest = Manifest::of_folder(kind, &self.folder).context("cannot hash the output")?;
        let place = || format!("cannot write {}", output.display());
        write_json(&self.folder.join(MANIFEST_FILE), &manifest).with_context(place)?;
        fs::rename(&self.folder, output).with_context(place)
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.folder).ok();
    }
}
