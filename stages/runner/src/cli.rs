use std::path::{Path, PathBuf};
use std::process::ExitCode;

use artifact::report_line;
use clap::{Args, CommandFactory as _, Parser, Subcommand};
use garbage::Policy;
use planning::{Devices, Pipeline, PlanError, Request, Selection};
use slurm::{Memory, Site};
use stage::machine_memory;

use crate::execute::{Budget, Cluster, Executor, JOB_VERB, Local};
use crate::limits::capped;
use crate::remedy::Remedy;
use crate::session::Session;
use crate::verbs::{self, GraphFormat, Style};
use crate::watch::Watch;

/// Where the pipeline is looked for.
const PIPELINE: &str = "pipeline.yaml";
/// Where stages compute.
const DEVICE: &str = "cpu";
/// Who runs them.
const EXECUTOR: &str = "local";

/// Runs pipeline.yaml: makes what isn't there, skips what is, and says why.
#[derive(Parser)]
#[command(name = "nerf-sr", version)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
    /// The pipeline
    #[arg(long, global = true, default_value = PIPELINE, value_name = "FILE")]
    pipeline: PathBuf,
    /// Where artifacts are kept [default: .nerf-sr beside the pipeline]
    #[arg(long, global = true, value_name = "DIR", env = "NERF_SR_STORE")]
    store: Option<PathBuf>,
    /// Where to compute: cpu or cuda:N
    #[arg(long, global = true, default_value = DEVICE)]
    device: String,
    /// Who runs the stages: this machine, or a cluster's jobs; there a stage that needs GPUs
    /// (`resources`) computes on cuda:0
    #[arg(long, global = true, value_enum, default_value = EXECUTOR, env = "NERF_SR_EXECUTOR")]
    executor: Choose,
}

/// An executor's name.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Choose {
    // Without texts of their own: clap would give every verb's help its long form.
    Local,
    Slurm,
}

#[derive(Args, Default)]
struct What {
    /// Targets: stages of the pipeline, or files of pipelines/ beside it [default: the pipeline's
    /// `default`]
    targets: Vec<String>,
    /// Sets a parameter; several values run all combinations, sharing what they share. A value is a
    /// JSON number, true, false or null, else a word; nothing at all is null. The last of several
    /// for the same parameter counts
    #[arg(short = 'p', long = "param", value_name = "[STAGE.]NAME=VALUE[,VALUE…]")]
    parameters: Vec<String>,
    /// Takes an input from a folder instead, e.g. -i dataset=scenes/lego
    #[arg(short = 'i', long = "input", value_name = "[STAGE.]NAME=DIR[,DIR…]")]
    inputs: Vec<String>,
    #[command(flatten)]
    experiment: OfExperiment,
}

/// What of an experiment is wanted
#[derive(Args, Default)]
struct OfExperiment {
    /// Scenes of an experiment: folders of --data, or `demo` [default: those that its file names]
    #[arg(long = "scene", value_name = "NAME[,NAME…]", value_delimiter = ',')]
    scenes: Vec<String>,
    /// Protocols of an experiment: its presets, or WIDTHxSCALE [default: those that its file names]
    #[arg(long = "protocol", value_name = "NAME[,NAME…]", value_delimiter = ',')]
    protocols: Vec<String>,
    /// A variant of an experiment; repeat for more [default: all]
    #[arg(long = "variant", value_name = "NAME")]
    variants: Vec<String>,
    /// Only so many variants of an experiment, the first
    #[arg(long, value_name = "N")]
    first_variants: Option<usize>,
    /// Of what a sink shows only these: names of its inputs, or blocks [default: all]
    #[arg(long = "show", value_name = "NAME[,NAME…]", value_delimiter = ',')]
    show: Vec<String>,
    /// Folder of an experiment's data sets [default: the file's]
    #[arg(long, value_name = "DIR", env = "NERF_SR_DATA")]
    data: Option<PathBuf>,
}

// Without a text of its own: clap would give it to the verb.
#[derive(Args)]
struct RunOptions {
    /// Stages at once [default: the number of cores, at most 4]
    #[arg(short, long, value_name = "N")]
    jobs: Option<usize>,
    /// Threads of each stage, and cores of all together; results don't depend on it [default:
    /// all cores]
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Memory of all stages together, such as 8G, by what each took when it last ran [default:
    /// all there is]
    #[arg(long, value_name = "AMOUNT")]
    memory: Option<Memory>,
    /// Go on with what doesn't need a failed stage
    #[arg(short, long)]
    keep_going: bool,
    /// Where pages and watched views are written [default: out beside the pipeline]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Show a test view and its scores while a field trains, for about 2 % of the processor
    /// time; needs a target that scores views, such as eval [default view: the first]
    #[arg(long, value_name = "VIEW", num_args = 0..=1, require_equals = true,
        default_missing_value = "")]
    watch: Option<String>,
    /// What a cluster wants besides: partition, account, set-up lines [default:
    /// ~/.config/nerf-sr/slurm.yaml if it is there]
    #[arg(long, value_name = "FILE", env = "NERF_SR_SITE")]
    site: Option<PathBuf>,
}

#[derive(Subcommand)]
enum Verb {
    /// Make the targets; what is cached isn't run again
    Run {
        #[command(flatten)]
        what: What,
        #[command(flatten)]
        how: RunOptions,
    },
    /// Cancel jobs that were submitted to a cluster, and those that need them
    Cancel {
        /// The stage [default: all jobs of this store]
        stage: Option<String>,
    },
    /// Do one task of a submission; the script of its jobs calls this
    #[command(name = JOB_VERB, hide = true)]
    Job {
        /// The submission's folder
        submission: PathBuf,
        /// The task's number
        number: usize,
    },
    /// Write a commented pipeline for a folder of posed photographs
    Init {
        /// The folder; its form is found by looking
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
    /// Show what `run` would do, and run nothing
    Plan {
        #[command(flatten)]
        what: What,
        /// Print JSON, for programs
        #[arg(long)]
        json: bool,
    },
    /// Say why a stage is cached, would run, or waits
    Why {
        /// The stage
        stage: String,
        #[command(flatten)]
        what: What,
        /// Print JSON, for programs
        #[arg(long)]
        json: bool,
    },
    /// Show every stage with its artifact, age and time
    Status {
        #[command(flatten)]
        what: What,
        /// Print JSON, for programs
        #[arg(long)]
        json: bool,
    },
    /// Print the folder of a stage's artifact, or a folder or file inside it
    Path {
        /// The stage, e.g. eval, or with a folder or file, e.g. prep/train
        #[arg(value_name = "STAGE[/FOLDER]")]
        stage: String,
        #[command(flatten)]
        what: What,
    },
    /// Tell what differs between two results: parameters, defaults in use, metrics, images
    Diff {
        /// A stage with its arguments as one word ("eval -p kernel=box"), the beginning of an
        /// artifact's hash, or a recorded run or pin
        before: String,
        /// Likewise
        now: String,
        /// Print JSON, for programs
        #[arg(long)]
        json: bool,
    },
    /// Draw the graph
    Graph {
        #[command(flatten)]
        what: What,
        /// As what
        #[arg(long, value_enum, default_value = "ascii")]
        format: GraphFormat,
    },
    /// Print what a stage said when it ran
    Log {
        /// The stage
        stage: String,
        #[command(flatten)]
        what: What,
    },
    /// Read every artifact and record again, and compare hashes
    Verify {
        /// Remove damaged artifacts and records, so that the next run makes them again
        #[arg(long)]
        remove: bool,
    },
    /// Keep what targets have, whatever `gc` is told
    Pin {
        /// What to call it
        name: String,
        #[command(flatten)]
        what: What,
    },
    /// Take a pin away
    Unpin {
        /// What it is called
        name: String,
    },
    /// Delete artifacts that nothing needs: no pin, no run in progress or of late, no target
    Gc {
        #[command(flatten)]
        what: What,
        /// Only say what would go
        #[arg(long)]
        dry_run: bool,
        /// Keep what was made or used within so many days
        #[arg(long, default_value_t = 7, value_name = "N")]
        keep_days: u64,
        /// Delete checkpoints, too, of stages that were stopped
        #[arg(long)]
        drop_unfinished: bool,
        /// Delete what older versions of nerf-sr made, too: its keys can't be met any more
        #[arg(long)]
        drop_old: bool,
        /// Print JSON, for programs
        #[arg(long)]
        json: bool,
    },
    /// Print the help of a stage's program: what it makes, its inputs and its parameters
    Describe {
        /// The stage
        stage: String,
    },
    /// Write man pages of all verbs into a folder; `make install` calls this
    #[command(hide = true)]
    Man {
        /// The folder
        folder: PathBuf,
    },
    /// Print shell completions
    Completions {
        /// For which shell
        shell: clap_complete::Shell,
    },
}

/// The program: exit code 0 when all is there, a failed stage's own code, 2 for a wrong file or
/// command line, 70 for a panic. None of them changes where stdout is closed.
pub fn main() -> ExitCode {
    stage::install_panic_hook("nerf-sr");
    match run(Cli::parse()) {
        Ok(code) => code,
        Err(error) => {
            report_line!("nerf-sr: {}", artifact::one_line(&error));
            let plan_code =
                error.chain().find_map(|e| e.downcast_ref::<PlanError>()).map(|e| match e {
                    PlanError::Pipeline(_) | PlanError::Usage(_) => 2,
                    PlanError::Store(_) => 1,
                    PlanError::Source { .. } | PlanError::Artifact(_) => 3,
                    PlanError::Interrupted => 130,
                });
            ExitCode::from(plan_code.unwrap_or_else(|| artifact::exit_code(&error)))
        }
    }
}

impl From<What> for Request {
    fn from(what: What) -> Self {
        let OfExperiment { scenes, protocols, variants, first_variants, show, data } =
            what.experiment;
        let selection =
            Selection { data, scenes, protocols, variants, max_variants: first_variants, show };
        Self { targets: what.targets, parameters: what.parameters, inputs: what.inputs, selection }
    }
}

fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    match &cli.verb {
        Verb::Completions { shell } => {
            return Ok(verbs::completions(*shell, &mut Cli::command()));
        }
        Verb::Describe { stage } => {
            return verbs::describe(
                &Pipeline::read(&cli.pipeline).map_err(PlanError::from)?,
                stage,
            );
        }
        Verb::Init { folder } => return verbs::init(folder, &cli.pipeline),
        Verb::Man { folder } => return verbs::man(Cli::command(), folder),
        Verb::Job { submission, number } => return verbs::job(submission, *number),
        _ => {}
    }
    let devices =
        Devices { given: cli.device.clone(), by_resources: cli.executor == Choose::Slurm };
    let session = Session::open(&cli.pipeline, cli.store.as_deref(), devices)?;
    match cli.verb {
        Verb::Run { what, how } => {
            let home = session.pipeline.project_folder();
            let out = how.out.clone().unwrap_or_else(|| home.join("out"));
            let words = given(&what, &cli.pipeline, cli.store.as_deref(), &cli.device);
            let executor = executor(cli.executor, &how, Remedy::new(words), &out)?;
            verbs::run(&session, &what.into(), &out, executor.as_ref())
        }
        Verb::Cancel { stage } => verbs::cancel(&session.store, stage.as_deref()),
        Verb::Plan { what, json } => verbs::plan(&session, &what.into(), json),
        Verb::Why { stage, what, json } => verbs::why(&session, &stage, &what.into(), json),
        Verb::Status { what, json } => verbs::status(&session, &what.into(), json),
        Verb::Path { stage, what } => verbs::path(&session, &stage, &what.into()),
        Verb::Diff { before, now, json } => verbs::diff(&session, &before, &now, json),
        Verb::Graph { what, format } => verbs::graph(&session, &what.into(), format),
        Verb::Log { stage, what } => verbs::log(&session, &stage, &what.into()),
        Verb::Verify { remove } => verbs::verify(&session.store, remove),
        Verb::Pin { name, what } => verbs::pin(&session, &name, &what.into()),
        Verb::Unpin { name } => verbs::unpin(&session, &name),
        Verb::Gc { what, dry_run, keep_days, drop_unfinished, drop_old, json } => {
            let policy = Policy { keep_days, drop_unfinished, drop_old };
            verbs::gc(&session, &what.into(), policy, Style { dry_run, json })
        }
        Verb::Completions { .. }
        | Verb::Describe { .. }
        | Verb::Init { .. }
        | Verb::Job { .. }
        | Verb::Man { .. } => {
            unreachable!("handled before the session")
        }
    }
}

/// Who carries out a run. `remedy` is what to say after a failure, `out` where pages go.
fn executor(
    choice: Choose,
    how: &RunOptions,
    remedy: Remedy,
    out: &Path,
) -> Result<Box<dyn Executor>, PlanError> {
    let RunOptions { jobs, threads, memory, keep_going, site, watch, .. } = how;
    if choice == Choose::Local {
        let watch = watch.clone().map(|view| Watch { view, folder: out.join("watch") });
        let budget = budget(*jobs, *threads, *memory)?;
        return Ok(Box::new(Local { budget, keep_going: *keep_going, remedy, watch }));
    }
    if jobs.is_some() || threads.is_some() || memory.is_some() || *keep_going {
        let problem = "--jobs, --threads, --memory and --keep-going are for --executor local; say \
            `resources` in the pipeline";
        return Err(PlanError::Usage(problem.to_owned()));
    }
    if watch.is_some() {
        let problem = "--watch is for --executor local: no runner stays while jobs run";
        return Err(PlanError::Usage(problem.to_owned()));
    }
    let site = Site::find(site.as_deref()).map_err(|e| PlanError::Usage(e.to_string()))?;
    Ok(Box::new(Cluster { site }))
}

/// What a run may take, as far as the machine can use it.
fn budget(
    jobs: Option<usize>,
    threads: Option<usize>,
    memory: Option<Memory>,
) -> Result<Budget, PlanError> {
    if jobs == Some(0) || threads == Some(0) {
        return Err(PlanError::Usage("--jobs and --threads must be at least 1".to_owned()));
    }
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let (stages, less_jobs) = capped("--jobs", jobs.unwrap_or(cores.min(4)), cores);
    let (threads, less_threads) = capped("--threads", threads.unwrap_or(cores), cores);
    less_jobs.into_iter().chain(less_threads).for_each(|said| report_line!("{said}"));
    Ok(Budget {
        stages,
        threads,
        memory: memory.map(Memory::bytes).or_else(machine_memory).unwrap_or(u64::MAX),
    })
}

/// The words with which another verb is asked for the same.
fn given(what: &What, pipeline: &Path, store: Option<&Path>, device: &str) -> Vec<String> {
    let mut words = what.targets.clone();
    words.extend(what.parameters.iter().flat_map(|value| ["-p".to_owned(), value.clone()]));
    words.extend(what.inputs.iter().flat_map(|value| ["-i".to_owned(), value.clone()]));
    let file = |path: &Path| path.to_string_lossy().into_owned();
    let OfExperiment { scenes, protocols, variants, first_variants, show, data } = &what.experiment;
    let lists = [("--scene", scenes), ("--protocol", protocols), ("--show", show)];
    let lists = lists.into_iter().filter(|(_, names)| !names.is_empty());
    words.extend(lists.flat_map(|(option, names)| [option.to_owned(), names.join(",")]));
    words.extend(variants.iter().flat_map(|name| ["--variant".to_owned(), name.clone()]));
    let options = [
        ("--first-variants", first_variants.map(|count| count.to_string())),
        ("--data", data.as_deref().map(file)),
        ("--pipeline", (pipeline != Path::new(PIPELINE)).then(|| file(pipeline))),
        ("--store", store.map(file)),
        ("--device", (device != DEVICE).then(|| device.to_owned())),
    ];
    words.extend(
        options
            .into_iter()
            .flat_map(|(name, value)| value.into_iter().flat_map(|v| [name.to_owned(), v])),
    );
    words
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_sound() {
        use clap::CommandFactory as _;
        super::Cli::command().debug_assert();
    }
}
