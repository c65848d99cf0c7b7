//! The command line.
//!
//! Structs that are flattened into a command, and values of options, have `//` comments. Clap
//! would take a flattened struct's doc comment as the verb's help. If an option's value had a doc
//! comment, clap would print every verb's help in the long form.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use artifact::{Failure, bail_usage};
use clap::{Args, CommandFactory as _, FromArgMatches as _, Parser, Subcommand};
use planning::{Devices, Pipeline, PlanError, Request, Selection};
use slurm::{Memory, Site};

use crate::execute::{Budget, Cluster, JOB_VERB, Local};
use crate::garbage::Policy;
use crate::session::Session;
use crate::verbs;
use crate::verbs::advise::Limits;
use crate::watch::Watch;

const DEFAULT_PIPELINE: &str = "pipeline.yaml";
const DEFAULT_DEVICE: &str = "cpu";
const DEFAULT_EXECUTOR: &str = "local";

/// Run the stages of pipeline.yaml, reuse cached results, and explain each decision
#[derive(Parser)]
#[command(name = "nerf-sr", version)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
    #[command(flatten)]
    global: GlobalArgs,
}

// Options of every verb.
#[derive(Args)]
struct GlobalArgs {
    /// Pipeline file
    #[arg(long, global = true, default_value = DEFAULT_PIPELINE, value_name = "FILE")]
    pipeline: PathBuf,
    /// Folder of the artifacts [default: .nerf-sr next to the pipeline file]
    #[arg(long, global = true, value_name = "DIR", env = "NERF_SR_STORE")]
    store: Option<PathBuf>,
    /// Compute device: cpu, cuda (the first GPU) or cuda:N
    #[arg(long, global = true, default_value = DEFAULT_DEVICE)]
    device: String,
    /// Executor of stages: this machine, or jobs of a Slurm cluster. With slurm, stages whose
    /// `resources` request GPUs compute on cuda:0
    #[arg(long, global = true, value_enum, default_value = DEFAULT_EXECUTOR,
        env = "NERF_SR_EXECUTOR")]
    executor: ExecutorKind,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum ExecutorKind {
    Local,
    Slurm,
}

// Arguments from which a plan is created.
#[derive(Args)]
struct PlanArgs {
    /// Targets: stages of the pipeline, or files in pipelines/ or experiments/ next to it [default:
    /// the pipeline's `default`]
    targets: Vec<String>,
    /// Set a parameter. Several values run all combinations; stages that don't depend on the
    /// parameter run once. A value is JSON, such as a number, true or null, or plain text; an empty
    /// value is null, and whole numbers may end in k, M or G. If a parameter is given twice, the
    /// last value wins. `quality` is `best`, `balanced` (default; a third of the time of `best`),
    /// `fast` (a ninth) or `draft` (a thirtieth). It sets those parameters of training, rendering
    /// and refinement that are not set otherwise
    #[arg(short = 'p', long = "param", value_name = "[STAGE.]NAME=VALUE[,VALUE…]")]
    parameters: Vec<String>,
    /// Read an input from this folder, not from what the pipeline names, e.g. -i
    /// dataset=scenes/lego. A stage's name stands for its artifact: -i init=train-ss trains the
    /// field of train-ss further
    #[arg(short = 'i', long = "input", value_name = "[STAGE.]NAME=DIR[,DIR…]")]
    inputs: Vec<String>,
    /// Scenes of an experiment: folders in --data, or `demo` [default: those that its file names]
    #[arg(long = "scene", value_name = "NAME[,NAME…]", value_delimiter = ',')]
    scenes: Vec<String>,
    /// Protocols of an experiment: presets of its file, or LR width and scale, such as 100x2
    /// [default: those that its file names]
    #[arg(long = "protocol", value_name = "NAME[,NAME…]", value_delimiter = ',')]
    protocols: Vec<String>,
    /// Variant of an experiment; repeat for more [default: all]
    #[arg(long = "variant", value_name = "NAME")]
    variants: Vec<String>,
    /// Use only the first N variants of an experiment
    #[arg(long, value_name = "N", value_parser = positive_count)]
    first_variants: Option<NonZeroUsize>,
    /// Show only these results on pages and in tables: stages of the pipeline, or inputs of the
    /// page or table [default: all]
    #[arg(long = "show", value_name = "NAME[,NAME…]", value_delimiter = ',')]
    show: Vec<String>,
    /// Folder of an experiment's data sets [default: the one that its file names]
    #[arg(long, value_name = "DIR", env = "NERF_SR_DATA")]
    data: Option<PathBuf>,
}

// Options of `run`.
#[derive(Args)]
struct RunOptions {
    /// Maximum number of stages that run at once [default: number of cores, at most 4]
    #[arg(short, long, value_name = "N", value_parser = positive_count)]
    jobs: Option<NonZeroUsize>,
    /// Number of processors that all stages share, and of threads that each stage starts. Results
    /// don't depend on the number [default: processors of this process]
    #[arg(long, value_name = "N", value_parser = positive_count)]
    threads: Option<NonZeroUsize>,
    /// Memory limit for all stages together, such as 8G. Nothing runs if a stage's estimated
    /// minimum is larger. A stage starts only if its expected peak fits next to those of running
    /// stages. The expected peak is that of the stage's most similar measured run, or 0 without
    /// such a run [default: all memory]
    #[arg(long, value_name = "AMOUNT")]
    memory: Option<Memory>,
    /// Continue with stages that don't depend on a failed one
    #[arg(short, long)]
    keep_going: bool,
    /// Folder of pages, tables, films, exports and watched views [default: out next to the pipeline
    /// file]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Show a test view and its scores while a field trains, in the terminal and in out/watch,
    /// using about 2 % of the processor time; needs a target that scores views, such as eval
    /// [default view: the first]
    #[arg(long, value_name = "VIEW", num_args = 0..=1, require_equals = true,
        default_missing_value = "")]
    watch: Option<String>,
    /// Site file of the cluster: partition, account, set-up lines [default:
    /// ~/.config/nerf-sr/slurm.yaml if it exists]
    #[arg(long, value_name = "FILE", env = "NERF_SR_SITE")]
    site: Option<PathBuf>,
}

#[derive(Subcommand)]
enum Verb {
    /// Run the stages that the targets need; cached ones are skipped
    Run {
        #[command(flatten)]
        plan: PlanArgs,
        #[command(flatten)]
        options: RunOptions,
    },
    /// Cancel submitted jobs of a cluster and the jobs that depend on them
    Cancel {
        /// Stage whose jobs are cancelled [default: all jobs of this store]
        stage: Option<String>,
    },
    /// Run one task of a submission; called by its jobs' script
    #[command(name = JOB_VERB, hide = true)]
    Job {
        /// Folder of the submission
        submission: PathBuf,
        /// Number of the task
        number: usize,
    },
    /// Write a commented pipeline for a folder of posed photographs
    Init {
        /// Folder of the data set, whose format is detected
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
    /// Show what `run` would do, without running anything
    Plan {
        #[command(flatten)]
        plan: PlanArgs,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Describe the scenes, estimate time and memory of each quality, and print the command of
    /// the best quality within the given limits
    Advise {
        #[command(flatten)]
        plan: PlanArgs,
        #[command(flatten)]
        limits: Limits,
    },
    /// Explain why a stage is cached, would run, or waits
    Why {
        /// Stage to explain
        stage: String,
        #[command(flatten)]
        plan: PlanArgs,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Show every stage with its artifact, age and running time
    Status {
        #[command(flatten)]
        plan: PlanArgs,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Print the path of a stage's artifact, or of a folder or file in it
    Path {
        /// Stage, e.g. eval, or a folder or file in its artifact, e.g. prep/train
        #[arg(value_name = "STAGE[/FOLDER]")]
        stage: String,
        #[command(flatten)]
        plan: PlanArgs,
    },
    /// Compare two results: parameters, defaults in use, metrics, images
    Diff {
        /// Result to compare: a stage with its arguments, quoted ("eval -p kernel=box"), the first
        /// characters of an artifact's hash, the ID of a recorded run, or the name of a pin
        before: String,
        /// Result to compare with BEFORE, given in the same way
        now: String,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Draw the stages and their inputs as a graph
    Graph {
        #[command(flatten)]
        plan: PlanArgs,
        /// Output format
        #[arg(long, value_enum, default_value = "text")]
        format: verbs::graph::Format,
    },
    /// Print the log of a stage
    Log {
        /// Stage whose log is printed
        stage: String,
        #[command(flatten)]
        plan: PlanArgs,
    },
    /// Read all artifacts and records, and compare their contents with their hashes
    Verify {
        /// Delete damaged artifacts and records, so that the next run creates them again
        #[arg(long)]
        remove: bool,
    },
    /// Protect the targets' artifacts from `gc`
    Pin {
        /// Name of the pin
        name: String,
        #[command(flatten)]
        plan: PlanArgs,
    },
    /// Remove a pin
    Unpin {
        /// Name of the pin
        name: String,
    },
    /// Delete artifacts that are not needed by a pin, a recent or running run, or a target
    Gc {
        #[command(flatten)]
        plan: PlanArgs,
        /// Only print what would be deleted
        #[arg(long)]
        dry_run: bool,
        #[command(flatten)]
        policy: Policy,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Print the help of a stage's program: its output, inputs and parameters
    Describe {
        /// Stage to describe
        stage: String,
    },
    /// Write man pages of all verbs into a folder; called by `make install`
    #[command(hide = true)]
    Man {
        /// Folder of the man pages
        folder: PathBuf,
    },
    /// Print shell completions
    Completions {
        /// Name of the shell
        shell: clap_complete::Shell,
    },
}

impl From<PlanArgs> for Request {
    fn from(args: PlanArgs) -> Self {
        let selection = Selection {
            data: args.data,
            scenes: args.scenes,
            protocols: args.protocols,
            variants: args.variants,
            max_variants: args.first_variants.map(NonZeroUsize::get),
            show: args.show,
        };
        Self { targets: args.targets, parameters: args.parameters, inputs: args.inputs, selection }
    }
}

/// Parses the arguments from which a plan is created. Fails with the problem, on one line.
pub(crate) fn plan_request(words: impl Iterator<Item = String>) -> Result<Request, String> {
    let command = PlanArgs::augment_args(clap::Command::new("").no_binary_name(true));
    let command = command.disable_help_flag(true);
    let parsed = command.try_get_matches_from(words);
    let arguments = parsed.and_then(|matches| PlanArgs::from_arg_matches(&matches));
    arguments.map(Request::from).map_err(|error| {
        let text = error.to_string();
        text.lines().next().unwrap_or_default().trim_start_matches("error: ").to_owned()
    })
}

/// Parses the command line and carries out its verb.
pub(crate) fn run_command_line() -> anyhow::Result<ExitCode> {
    let Cli { verb, global } = Cli::parse();
    let session = || global.open_session();
    match verb {
        Verb::Run { plan, options } => return run(&global, plan, options),
        Verb::Job { submission, number } => return verbs::jobs::job(&submission, number),
        Verb::Verify { remove } => return verbs::verify::verify(&session()?.store, remove),
        Verb::Describe { stage } => {
            let pipeline = Pipeline::read(&global.pipeline).map_err(PlanError::from)?;
            return verbs::standalone::describe(&pipeline, &stage, || Ok(session()?.store));
        }
        Verb::Init { folder } => verbs::standalone::init(&folder, &global.pipeline)?,
        Verb::Man { folder } => verbs::standalone::man(Cli::command(), &folder)?,
        Verb::Completions { shell } => verbs::standalone::completions(shell, &mut Cli::command()),
        Verb::Cancel { stage } => verbs::jobs::cancel(&session()?.store, stage.as_deref())?,
        Verb::Plan { plan, json } => verbs::states::plan(&session()?, &plan.into(), json)?,
        Verb::Advise { plan, limits } => {
            let arguments = global.plan_arguments(&plan);
            verbs::advise::advise(&session()?, &plan.into(), limits, &arguments)?;
        }
        Verb::Why { stage, plan, json } => {
            verbs::states::why(&session()?, &stage, &plan.into(), json)?;
        }
        Verb::Status { plan, json } => verbs::states::status(&session()?, &plan.into(), json)?,
        Verb::Path { stage, plan } => verbs::path::path(&session()?, &stage, &plan.into())?,
        Verb::Diff { before, now, json } => verbs::diff::diff(&session()?, &before, &now, json)?,
        Verb::Graph { plan, format } => verbs::graph::graph(&session()?, &plan.into(), format)?,
        Verb::Log { stage, plan } => verbs::log::log(&session()?, &stage, &plan.into())?,
        Verb::Pin { name, plan } => verbs::pin::pin(&session()?, &name, &plan.into())?,
        Verb::Unpin { name } => verbs::pin::unpin(&session()?, &name)?,
        Verb::Gc { plan, dry_run, policy, json } => {
            verbs::gc::gc(&session()?, &plan.into(), policy, dry_run, json)?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn run(global: &GlobalArgs, plan: PlanArgs, options: RunOptions) -> anyhow::Result<ExitCode> {
    let session = global.open_session()?;
    let plan_arguments = global.plan_arguments(&plan);
    let request = Request::from(plan);
    let RunOptions { jobs, threads, memory, keep_going, out, watch, site } = options;
    let out = out.unwrap_or_else(|| session.pipeline.project_folder().join("out"));
    if global.executor == ExecutorKind::Local {
        let watch = watch.map(|view| Watch { view, folder: out.join("watch") });
        let budget = Budget::new(jobs, threads, memory.map(Memory::bytes));
        let executor = Local { budget, keep_going, plan_arguments, watch };
        return verbs::run::run(&session, &request, &out, |run| executor.carry_out(run));
    }
    if jobs.is_some() || threads.is_some() || memory.is_some() || keep_going {
        bail_usage!(
            "--jobs, --threads, --memory and --keep-going need --executor local; on a cluster, set \
            `resources` in the pipeline"
        );
    }
    if watch.is_some() {
        bail_usage!(
            "--watch needs --executor local: on a cluster, the runner exits before jobs run"
        );
    }
    let site = Site::find(site.as_deref()).map_err(|e| Failure::Usage(e.to_string()))?;
    verbs::run::run(&session, &request, &out, |run| Cluster { site }.carry_out(run))
}

impl GlobalArgs {
    fn open_session(&self) -> anyhow::Result<Session> {
        let by_resources = self.executor == ExecutorKind::Slurm;
        let devices = Devices { given: self.device.clone(), by_resources };
        Session::open(&self.pipeline, self.store.as_deref(), devices)
    }

    /// Returns the arguments that repeat this plan with another verb, without `--executor`.
    fn plan_arguments(&self, plan: &PlanArgs) -> Vec<String> {
        let text = |path: &PathBuf| vec![path.to_string_lossy().into_owned()];
        let pipeline = Some(&self.pipeline).filter(|file| *file != Path::new(DEFAULT_PIPELINE));
        let device = Some(&self.device).filter(|device| *device != DEFAULT_DEVICE);
        let options = [
            ("-p", plan.parameters.clone()),
            ("-i", plan.inputs.clone()),
            ("--scene", plan.scenes.clone()),
            ("--protocol", plan.protocols.clone()),
            ("--show", plan.show.clone()),
            ("--variant", plan.variants.clone()),
            ("--first-variants", plan.first_variants.iter().map(ToString::to_string).collect()),
            ("--data", plan.data.as_ref().map(text).unwrap_or_default()),
            ("--pipeline", pipeline.map(text).unwrap_or_default()),
            ("--store", self.store.as_ref().map(text).unwrap_or_default()),
            ("--device", device.into_iter().cloned().collect()),
        ];
        let mut arguments = plan.targets.clone();
        for (option, values) in options {
            arguments.extend(values.into_iter().flat_map(|value| [option.to_owned(), value]));
        }
        arguments
    }
}

fn positive_count(text: &str) -> Result<NonZeroUsize, String> {
    text.parse().map_err(|_| "expected a whole number of at least 1".to_owned())
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_sound() {
        use clap::CommandFactory as _;
        super::Cli::command().debug_assert();
    }

    #[test]
    fn arguments_of_a_plan_are_parsed_alone() {
        let parse = |text: &str| super::plan_request(text.split_whitespace().map(str::to_owned));
        let request = parse("table -p a=1 --scene x,y --variant z").unwrap();
        assert_eq!(request.targets, ["table"]);
        assert_eq!(request.parameters, ["a=1"]);
        assert_eq!(request.selection.scenes, ["x", "y"]);
        assert_eq!(request.selection.variants, ["z"]);
        for (text, expected) in [
            ("--json", "unexpected argument '--json' found"),
            ("--help", "unexpected argument '--help' found"),
            ("-p", "a value is required for '--param"),
            ("--first-variants 0", "invalid value '0' for '--first-variants <N>'"),
        ] {
            let problem = parse(text).unwrap_err();
            assert!(problem.starts_with(expected) && !problem.contains('\n'), "{problem}");
        }
    }
}
