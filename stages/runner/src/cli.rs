use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, anyhow};
use artifact::{Failure, Record, SUMMARY_FILE, Store, hash_json};
use clap::{Args, CommandFactory as _, Parser, Subcommand};

use crate::execute::{self, Options, seconds};
use crate::graph::{ascii, dot, state_word, svg};
use crate::key;
use crate::pipeline::Pipeline;
use crate::plan::{Plan, PlanError, Request, State};
use crate::sink::{Shown, show};

/// Runs pipeline.yaml: makes what isn't there, skips what is, and says why.
#[derive(Parser)]
#[command(name = "nerf-sr", version)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
    /// The pipeline
    #[arg(long, global = true, default_value = "pipeline.yaml", value_name = "FILE")]
    pipeline: PathBuf,
    /// Where artifacts are kept [default: .nerf-sr beside the pipeline]
    #[arg(long, global = true, value_name = "DIR", env = "NERF_SR_STORE")]
    store: Option<PathBuf>,
    /// Where to compute: cpu or cuda:N
    #[arg(long, global = true, default_value = "cpu")]
    device: String,
}

#[derive(Args, Default)]
struct What {
    /// Stages to make [default: the pipeline's `default`]
    targets: Vec<String>,
    /// Sets a parameter; several values run all combinations, sharing what they share
    #[arg(short = 'p', long = "param", value_name = "[STAGE.]NAME=VALUE[,VALUE…]")]
    parameters: Vec<String>,
    /// Takes an input from a folder instead, e.g. -i dataset=scenes/lego
    #[arg(short = 'i', long = "input", value_name = "[STAGE.]NAME=DIR[,DIR…]")]
    inputs: Vec<String>,
}

#[derive(Subcommand)]
enum Verb {
    /// Make the targets; what is cached isn't run again
    Run {
        #[command(flatten)]
        what: What,
        /// Stages at once [default: the number of cores, at most 4]
        #[arg(short, long, value_name = "N")]
        jobs: Option<usize>,
        /// Threads of all stages together; results don't depend on it [default: all cores]
        #[arg(long, value_name = "N")]
        threads: Option<usize>,
        /// Go on with what doesn't need a failed stage
        #[arg(short, long)]
        keep_going: bool,
        /// Where pages are written [default: out beside the pipeline]
        #[arg(long, value_name = "DIR")]
        out: Option<PathBuf>,
    },
    /// Show what `run` would do, and run nothing
    Plan {
        #[command(flatten)]
        what: What,
    },
    /// Say why a stage is cached, would run, or waits
    Why {
        /// The stage
        stage: String,
        #[command(flatten)]
        what: What,
    },
    /// Show every stage with its artifact, age and time
    Status {
        #[command(flatten)]
        what: What,
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
    /// Read every artifact again and compare its hashes
    Verify {
        /// Remove damaged artifacts, so that the next run makes them again
        #[arg(long)]
        remove: bool,
    },
    /// Remove artifacts that the pipeline doesn't come to any more
    Gc {
        #[command(flatten)]
        what: What,
        /// Only say what would go
        #[arg(long)]
        dry_run: bool,
        /// Keep what was made within so many days
        #[arg(long, default_value_t = 7, value_name = "N")]
        keep_days: u64,
    },
    /// Print shell completions
    Completions {
        /// For which shell
        shell: clap_complete::Shell,
    },
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum GraphFormat {
    Ascii,
    Dot,
    Svg,
}

/// The program: exit code 0 when all is there, a failed stage's own code, 2 for a wrong file or command line.
pub fn main() -> ExitCode {
    match run(Cli::parse()) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("nerf-sr: {}", artifact::one_line(&error));
            let plan_code = error.chain().find_map(|e| e.downcast_ref::<PlanError>()).map(|e| match e {
                PlanError::Pipeline(_) | PlanError::Usage(_) => 2,
                PlanError::Source(_) => 3,
            });
            ExitCode::from(plan_code.unwrap_or_else(|| artifact::exit_code(&error)))
        }
    }
}

/// What every verb works with.
struct Session {
    pipeline: Pipeline,
    store: Store,
    device: String,
}

impl Session {
    fn open(cli: &Cli) -> anyhow::Result<Self> {
        let pipeline = Pipeline::read(&cli.pipeline).map_err(PlanError::from)?;
        let root = cli.store.clone().unwrap_or_else(|| pipeline.folder().join(".nerf-sr"));
        std::fs::create_dir_all(&root)
            .with_context(|| format!("cannot open the store {}; name another with --store", root.display()))?;
        // Stages get absolute paths, whatever folder they run in.
        let root = root.canonicalize().with_context(|| root.display().to_string())?;
        let store = Store::open(&root).context("cannot open the store; name another with --store")?;
        Ok(Self { pipeline, store, device: cli.device.clone() })
    }

    fn plan(&self, what: &What) -> anyhow::Result<Plan> {
        let request = Request { targets: what.targets.clone(), parameters: what.parameters.clone(), inputs: what.inputs.clone() };
        Ok(Plan::new(&self.pipeline, &self.store, &request)?)
    }

    fn states(&self, plan: &Plan) -> anyhow::Result<Vec<State>> {
        Ok(plan.states(&self.store, &self.device)?)
    }
}

fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    if let Verb::Completions { shell } = cli.verb {
        clap_complete::generate(shell, &mut Cli::command(), "nerf-sr", &mut std::io::stdout());
        return Ok(ExitCode::SUCCESS);
    }
    let session = Session::open(&cli)?;
    match cli.verb {
        Verb::Run { what, jobs, threads, keep_going, out } => {
            let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
            if jobs == Some(0) || threads == Some(0) {
                return Err(PlanError::Usage("--jobs and --threads must be at least 1".to_owned()).into());
            }
            let threads = threads.unwrap_or(cores);
            let options = Options { jobs: jobs.unwrap_or(cores.min(4)), threads, device: session.device.clone(), keep_going };
            let out = out.unwrap_or_else(|| session.pipeline.folder().join("out"));
            run_plan(&session, &what, &options, &out)
        }
        Verb::Plan { what } => {
            let plan = session.plan(&what)?;
            let states = session.states(&plan)?;
            for (i, state) in states.iter().enumerate() {
                println!("{:<40} {}", plan.nodes[i].label(), words(&session, &plan, i, state, &[]));
            }
            Ok(ExitCode::SUCCESS)
        }
        Verb::Why { stage, what } => {
            let plan = session.plan(&what)?;
            let states = session.states(&plan)?;
            let records = session.store.records()?;
            for i in of_stage(&plan, &stage)? {
                println!("{}: {}", plan.nodes[i].label(), words(&session, &plan, i, &states[i], &records));
                for cause in causes(&states, i) {
                    println!("  {}: {}", plan.nodes[cause].label(), words(&session, &plan, cause, &states[cause], &records));
                }
            }
            Ok(ExitCode::SUCCESS)
        }
        Verb::Status { what } => {
            let plan = session.plan(&what)?;
            for (node, state) in plan.nodes.iter().zip(session.states(&plan)?) {
                let detail = match &state {
                    State::Cached(record) => {
                        let size = session.store.manifest(&record.output).map_or(0, |m| m.size());
                        format!(
                            "{}  {:>9.1} MB  {:>9}  {}",
                            &record.output[..10],
                            size as f64 / 1e6,
                            seconds(record.seconds),
                            age(record)
                        )
                    }
                    State::WillRun { key_parts } if session.store.partial(&hash_json(key_parts)).join("work").exists() => {
                        "has a checkpoint to go on from".to_owned()
                    }
                    _ => String::new(),
                };
                println!("{:<40} {:<9} {detail}", node.label(), state_word(&state));
            }
            Ok(ExitCode::SUCCESS)
        }
        Verb::Graph { what, format } => {
            let plan = session.plan(&what)?;
            let states = session.states(&plan)?;
            print!(
                "{}",
                match format {
                    GraphFormat::Ascii => ascii(&plan, &states),
                    GraphFormat::Dot => dot(&plan),
                    GraphFormat::Svg => svg(&plan, &states),
                }
            );
            Ok(ExitCode::SUCCESS)
        }
        Verb::Log { stage, what } => {
            let plan = session.plan(&what)?;
            let states = session.states(&plan)?;
            for i in of_stage(&plan, &stage)? {
                let path = match &states[i] {
                    State::Cached(record) => session.store.action(&record.key(), "log"),
                    State::WillRun { key_parts } => session.store.partial(&hash_json(key_parts)).join("log"),
                    State::Waits { .. } => continue,
                };
                println!("{}:", plan.nodes[i].label());
                print!("{}", std::fs::read_to_string(&path).unwrap_or_else(|_| "  it has said nothing yet\n".to_owned()));
            }
            Ok(ExitCode::SUCCESS)
        }
        Verb::Verify { remove } => verify(&session.store, remove),
        Verb::Gc { what, dry_run, keep_days } => {
            let plan = session.plan(&what)?;
            let states = session.states(&plan)?;
            let keys: BTreeSet<String> = states
                .iter()
                .filter_map(|state| match state {
                    State::Cached(record) => Some(record.key()),
                    State::WillRun { key_parts } => Some(hash_json(key_parts)),
                    State::Waits { .. } => None,
                })
                .collect();
            let garbage = crate::gc::find(&session.store, &keys, keep_days)?;
            garbage.lines.iter().for_each(|line| println!("{line}"));
            if !dry_run {
                garbage.remove(&session.store)?;
            }
            println!("{:.1} MB {}", garbage.bytes as f64 / 1e6, if dry_run { "would go" } else { "freed" });
            Ok(ExitCode::SUCCESS)
        }
        Verb::Completions { .. } => unreachable!("handled before the session"),
    }
}

fn run_plan(session: &Session, what: &What, options: &Options, out: &Path) -> anyhow::Result<ExitCode> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    let plan = session.plan(what)?;
    let outcome = execute::run(&plan, &session.store, options, &stop);
    if stop.load(Ordering::Relaxed) {
        return Err(Failure::Interrupted.into());
    }
    if let Some((index, failure)) = outcome.failures.first() {
        let skipped = outcome.skipped.len();
        eprintln!(
            "nerf-sr: {} failed; {skipped} stages were not run; `nerf-sr log {}` has all it said",
            plan.nodes[*index].label(),
            plan.nodes[*index].stage
        );
        return Ok(ExitCode::from(failure.code));
    }
    let ends: BTreeSet<usize> =
        (0..plan.nodes.len()).filter(|&i| !plan.nodes.iter().any(|n| n.parents().any(|p| p == i))).collect();
    for index in ends {
        let record = outcome.records[index].as_ref().context("every node is done")?;
        let summary = std::fs::read_to_string(session.store.object(&record.output).join(SUMMARY_FILE)).unwrap_or_default();
        if !summary.is_empty() {
            println!("{}: {}", plan.nodes[index].label(), summary.trim_end());
        }
    }
    let mut wrote = false;
    for sink in &plan.sinks {
        match show(&plan, sink, &outcome, &session.store, out, options, &stop).map_err(|e| anyhow!("{}: {e}", sink.stage))? {
            Shown::Written(folder) => {
                wrote = true;
                println!("{}: {}", sink.stage, page(&folder).display());
            }
            Shown::UpToDate(folder) => println!("{}: {} (up to date)", sink.stage, page(&folder).display()),
            Shown::Missing => println!("{}: nothing to show", sink.stage),
        }
    }
    if outcome.ran.is_empty() && !wrote {
        println!("nothing to run: all {} stages are cached", plan.nodes.len());
    } else {
        println!(
            "{} of {} stages ran, {} were cached",
            outcome.ran.len(),
            plan.nodes.len(),
            plan.nodes.len() - outcome.ran.len()
        );
    }
    Ok(ExitCode::SUCCESS)
}

/// The page in a sink's folder, or the folder.
fn page(folder: &Path) -> PathBuf {
    let page = folder.join("index.html");
    if page.exists() { page } else { folder.to_path_buf() }
}

fn verify(store: &Store, remove: bool) -> anyhow::Result<ExitCode> {
    let objects = store.objects()?;
    let mut damaged = 0;
    for object in &objects {
        if let Err(damage) = store.verify(object) {
            damaged += 1;
            println!("{damage}");
            if remove {
                store.remove_object(object)?;
                println!("  removed; the next run makes it again");
            }
        }
    }
    println!("{} artifacts, {damaged} damaged", objects.len());
    Ok(if damaged == 0 { ExitCode::SUCCESS } else { ExitCode::from(3) })
}

fn of_stage(plan: &Plan, stage: &str) -> Result<Vec<usize>, PlanError> {
    let found: Vec<usize> = (0..plan.nodes.len()).filter(|&i| plan.nodes[i].stage == stage).collect();
    if found.is_empty() {
        let known: BTreeSet<&str> = plan.nodes.iter().map(|n| n.stage.as_str()).collect();
        return Err(PlanError::Usage(format!(
            "no stage {stage:?} in this plan; there are: {}",
            known.into_iter().collect::<Vec<_>>().join(", ")
        )));
    }
    Ok(found)
}

/// The nodes that will run for sure and on which a waiting node depends, directly or not.
fn causes(states: &[State], index: usize) -> Vec<usize> {
    let mut found = BTreeSet::new();
    let mut waiting = vec![index];
    while let Some(i) = waiting.pop() {
        if let State::Waits { on } = &states[i] {
            waiting.extend(on);
            found.extend(on.iter().copied().filter(|&p| matches!(states[p], State::WillRun { .. })));
        }
    }
    found.into_iter().collect()
}

/// A node's state in words; with records, why it will run.
fn words(session: &Session, plan: &Plan, index: usize, state: &State, records: &[Record]) -> String {
    match state {
        State::Cached(record) => format!("cached ({}, made in {})", age(record), seconds(record.seconds)),
        State::Waits { on } => {
            let names: Vec<String> = on.iter().map(|&p| plan.nodes[p].label()).collect();
            format!("waits for {}; if that comes out as before, it stays cached", names.join(", "))
        }
        State::WillRun { .. } if records.is_empty() => "will run".to_owned(),
        State::WillRun { key_parts } => match key::explain(key_parts, &plan.nodes[index].stage, records) {
            None => "will run: it never ran before".to_owned(),
            Some(changes) if changes.is_empty() => match session.store.record(&hash_json(key_parts)) {
                Some(record) => format!("will run: its artifact {} is gone or incomplete", &record.output[..10]),
                None => "will run".to_owned(),
            },
            Some(changes) => format!("will run: {}", changes.join("; ")),
        },
    }
}

fn age(record: &Record) -> String {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_secs());
    match now.saturating_sub(record.started_unix) {
        s if s < 120 => format!("{s} s ago"),
        s if s < 7200 => format!("{} min ago", s / 60),
        s if s < 172_800 => format!("{} h ago", s / 3600),
        s => format!("{} days ago", s / 86_400),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_sound() {
        use clap::CommandFactory as _;
        super::Cli::command().debug_assert();
    }
}
