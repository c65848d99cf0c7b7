use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Write as _};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::contract::{Description, render_help};
use anyhow::Context as _;
use artifact::{
    Failure, FailureExt as _, GivenInput, bail_usage, exit_code, format_count, hash_json, one_line,
    print_lines, report_line,
};
use clap::CommandFactory as _;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use serde_json::Value;

use crate::arguments::{Arguments, Command, Parameters, input_folders, read_params};
use crate::context::Context;
use crate::ending::{EndClaim, install_panic_hook, stop_on_signals};
use crate::processors::{Processors, processors, start_threads};
use crate::progress::{ProgressMode, enable_failure_event, failed_event};
use crate::stage::Stage;
use crate::staging::Staging;

/// Environment variable that is set if a runner reads the stage's stdout.
pub const RUNNER_VARIABLE: &str = "NERF_SR_RUNNER";

/// Runs a stage as a program: parses the arguments, checks and runs the stage, publishes the
/// output, and maps errors and panics to an exit code. A failure is reported in one line on stderr,
/// and with `--progress json` also as an event on stdout.
pub fn run_stage<S: Stage>(version: &'static str, code: &str) -> ExitCode {
    run_stage_with::<S>(version, code, std::env::args_os())
}

/// Defines `main` of a stage's program; the crate's build script calls `fingerprint::emit`.
#[macro_export]
macro_rules! main {
    ($stage:ty) => {
        fn main() -> std::process::ExitCode {
            $crate::run_stage::<$stage>(env!("CARGO_PKG_VERSION"), env!("STAGE_FINGERPRINT"))
        }
    };
}

pub(crate) fn run_stage_with<S: Stage>(
    version: &'static str,
    code: &str,
    arguments: impl IntoIterator<Item = OsString>,
) -> ExitCode {
    install_panic_hook(S::NAME);
    let program = Program {
        name: S::NAME,
        summary: S::SUMMARY,
        version,
        description: S::describe(version, code),
        work: |params| {
            let params: S::Params = serde_path_to_error::deserialize(params)?;
            Ok(Box::new(move |context| S::run(context, &params)))
        },
    };
    program.run(arguments.into_iter().collect())
}

/// A stage with checked parameters.
type Work = Box<dyn FnOnce(&Context) -> anyhow::Result<()>>;
/// Error of a parameter, with its path.
type ParamsError = serde_path_to_error::Error<serde_json::Error>;

/// Program of a stage, without the stage's type: its code is compiled here and not again in each
/// program.
struct Program {
    name: &'static str,
    summary: &'static str,
    version: &'static str,
    description: Description,
    /// Function that returns the stage's work with checked parameters.
    work: fn(Value) -> Result<Work, ParamsError>,
}

impl Program {
    fn run(&self, arguments: Vec<OsString>) -> ExitCode {
        match self.parse_and_run(arguments) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                let message = one_line(&error);
                report_line!("{}: {message}", self.name);
                if let Some(event) = failed_event(&message) {
                    io::stdout().write_all(event.as_bytes()).ok();
                }
                ExitCode::from(exit_code(&error))
            }
        }
    }

    fn parse_and_run(&self, arguments: Vec<OsString>) -> anyhow::Result<()> {
        let mut command = Arguments::command()
            .name(self.name)
            .about(self.summary)
            .after_help(render_help(&self.description))
            .mut_arg("from_checkpoint", |argument| argument.hide(!self.description.from_checkpoint))
            .mut_arg("threads", |argument| argument.help(threads_help()));
        if !self.version.is_empty() {
            command = command.version(self.version);
        }
        let arguments = match command.try_get_matches_from(arguments) {
            Ok(matches) => <Arguments as clap::FromArgMatches>::from_arg_matches(&matches)?,
            // `--help` and `--version` are errors, too; clap prints them and exits.
            Err(error) => error.exit(),
        };
        match arguments.command {
            Some(Command::Describe) => {
                print_lines(&serde_json::to_string_pretty(&self.description)?);
                Ok(())
            }
            None => self.execute(arguments),
        }
    }
}

/// Returns the help of `--threads`, with the default in this process.
fn threads_help() -> String {
    let Processors { count, limit } = processors();
    format!("Number of threads; doesn't affect the result [default: {limit}, here {count}]")
}

/// Arguments of a run.
struct CheckedArguments {
    /// Values of all parameters.
    params: Value,
    work: Work,
    threads: usize,
    inputs: BTreeMap<String, GivenInput>,
}

impl Program {
    fn execute(&self, arguments: Arguments) -> anyhow::Result<()> {
        let is_for_runner = arguments.progress == ProgressMode::Json;
        if is_for_runner {
            enable_failure_event();
        }
        let CheckedArguments { params, work, threads, inputs } =
            self.check_arguments(&arguments)?;
        let interrupted = stop_on_signals()?;
        if is_for_runner {
            end_with_runner(Arc::clone(&interrupted))?;
        }
        let output = arguments.output.expect("clap requires --output");
        let staging = Staging::new(&output)?;
        let end = EndClaim::default();
        end.enforce_deadline(self.name, &interrupted, staging.folder())?;
        if let Some(work) = &arguments.work {
            fs::create_dir_all(work)
                .with_context(|| format!("--work {}: cannot create the folder", work.display()))?;
        }
        let identities: Option<BTreeMap<&str, &str>> =
            inputs.iter().map(|(name, input)| Some((name.as_str(), input.identity()?))).collect();
        let identity = identities
            .map(|inputs| hash_json(&(&params, inputs, &self.description.code, &arguments.device)));
        let context = Context {
            threads,
            device: arguments.device,
            inputs,
            output: staging.folder().to_path_buf(),
            work: arguments.work,
            from_checkpoint: arguments.from_checkpoint,
            progress: arguments.progress,
            interrupted,
            identity,
            resumed: AtomicBool::new(false),
        };
        if arguments.threads.is_none() && arguments.progress == ProgressMode::Plain {
            context.log_line(format!(
                "{}: {}",
                format_count(threads, "thread"),
                processors().limit
            ));
        }
        let result = work(&context)
            .and_then(|()| context.check_interrupt())
            .and_then(|()| staging.complete(&self.description.output.kind));
        end.claim();
        result?;
        staging.publish(&output)
    }

    /// Checks the arguments.
    fn check_arguments(&self, arguments: &Arguments) -> anyhow::Result<CheckedArguments> {
        let description = &self.description;
        let Parameters { resolved, nested, context } =
            read_params(arguments.params.as_deref(), description)?;
        let work = (self.work)(nested).usage(context)?;
        let folders = input_folders(&arguments.inputs, description)?;
        // The runner checks rules about the stages that created the inputs, which are unknown here.
        let given = folders.iter().map(|(name, _)| ((*name).to_owned(), None)).collect();
        if let Some(problem) = description.broken_rule(&resolved, &given) {
            return Err(Failure::Usage(problem).into());
        }
        if arguments.from_checkpoint && !description.from_checkpoint {
            bail_usage!(
                "--from-checkpoint: stage {} doesn't support this option; leave it out",
                self.name
            );
        }
        let threads = match arguments.threads {
            Some(0) => {
                bail_usage!("--threads 0: at least 1 is required");
            }
            Some(n) => n,
            None => processors().count,
        };
        // An input's files are hashed in parallel. Without this pool, rayon would start one with
        // its default number of threads.
        start_threads(threads);
        let mut inputs = BTreeMap::new();
        for (name, folder) in folders {
            inputs.insert(name.to_owned(), GivenInput::open(name, folder)?);
        }
        Ok(CheckedArguments { params: resolved, work, threads, inputs })
    }
}

/// Interrupts the stage when its runner is killed, so that it writes a checkpoint and doesn't keep
/// running unobserved. The closed stdout reveals the runner's end even through a wrapper script,
/// which would be the stage's parent process.
fn end_with_runner(interrupted: Arc<AtomicBool>) -> io::Result<()> {
    if std::env::var_os(RUNNER_VARIABLE).is_none() {
        return Ok(());
    }
    std::thread::Builder::new().spawn(move || {
        let stdout = io::stdout();
        // The kernel reports the loss of a pipe's reader even if no event is requested.
        let mut pipe = [PollFd::new(&stdout, PollFlags::empty())];
        while poll(&mut pipe, None) == Err(Errno::INTR) {}
        if pipe[0].revents().contains(PollFlags::ERR) {
            interrupted.store(true, Ordering::SeqCst);
        }
    })?;
    Ok(())
}
