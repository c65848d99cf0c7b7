use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Write as _};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::contract::Description;
use anyhow::Context as _;
use artifact::{Failure, GivenInput, exit_code, hash_json, one_line, print_lines, report_line};
use clap::CommandFactory as _;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;

use crate::arguments::{Arguments, Command, input_folders, read_params};
use crate::context::Context;
use crate::help::render_help;
use crate::panics::install_panic_hook;
use crate::progress::{ProgressMode, enable_events, failed_event};
use crate::signals::{EndClaim, stop_on_signals};
use crate::stage::Stage;
use crate::staging::Staging;

/// Environment variable with the runner's process id, which tells a stage to watch its runner.
pub const RUNNER_VARIABLE: &str = "NERF_SR_RUNNER";

/// Runs a stage as a program: parses the arguments, checks and runs the stage, publishes the
/// output, and maps errors and panics to an exit code. A failure is reported in one line on stderr,
/// and with `--progress json` also as an event on stdout.
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
                io::stdout().write_all(event.as_bytes()).ok();
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
        .after_help(render_help(&description))
        .mut_arg("from_checkpoint", |argument| argument.hide(!S::FROM_CHECKPOINT));
    if !version.is_empty() {
        command = command.version(version);
    }
    let arguments = match command.clone().try_get_matches_from(arguments) {
        Ok(matches) => <Arguments as clap::FromArgMatches>::from_arg_matches(&matches)?,
        // `--help` and `--version` are errors, too; clap prints them and exits.
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
    let is_for_runner = arguments.progress == ProgressMode::Json;
    if is_for_runner {
        enable_events();
    }
    let (params, threads, inputs) = check_arguments::<S>(&arguments, description)?;
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().ok();
    let interrupted = stop_on_signals()?;
    if is_for_runner {
        end_with_runner(Arc::clone(&interrupted))?;
    }
    let output = arguments.output.expect("clap requires --output");
    let staging = Staging::new(&output)?;
    let end = EndClaim::default();
    end.enforce_deadline(S::NAME, &interrupted, staging.folder())?;
    if let Some(work) = &arguments.work {
        fs::create_dir_all(work)
            .with_context(|| format!("--work {}: cannot create the folder", work.display()))?;
    }
    let identities: Option<BTreeMap<&str, &str>> =
        inputs.iter().map(|(name, input)| Some((name.as_str(), input.identity()?))).collect();
    let identity = identities
        .map(|inputs| hash_json(&(&params, inputs, &description.code, &arguments.device)));
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
    let result = S::run(&context, &params)
        .and_then(|()| context.check_interrupt())
        .and_then(|()| staging.complete(&description.output.kind));
    end.claim();
    result?;
    staging.publish(&output)
}

/// Checks the arguments and returns the parameters, the number of threads, and the inputs.
fn check_arguments<S: Stage>(
    arguments: &Arguments,
    description: &Description,
) -> anyhow::Result<(S::Params, usize, BTreeMap<String, GivenInput>)> {
    let (resolved, params) = read_params::<S::Params>(arguments.params.as_deref(), description)?;
    let folders = input_folders(&arguments.inputs, description)?;
    // The runner checks rules about the stages that created the inputs, which are unknown here.
    let given = folders.iter().map(|(name, _)| ((*name).to_owned(), None)).collect();
    if let Some(problem) = description.broken_rule(&resolved, &given) {
        return Err(Failure::Usage(problem).into());
    }
    if arguments.from_checkpoint && !S::FROM_CHECKPOINT {
        let problem = format!(
            "--from-checkpoint: stage {} doesn't support this option; leave it out",
            S::NAME
        );
        return Err(Failure::Usage(problem).into());
    }
    let threads = match arguments.threads {
        Some(0) => {
            return Err(Failure::Usage("--threads 0: at least 1 is required".to_owned()).into());
        }
        Some(n) => n,
        None => std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
    };
    let mut inputs = BTreeMap::new();
    for (name, folder) in folders {
        inputs.insert(name.to_owned(), GivenInput::open(name, folder)?);
    }
    Ok((params, threads, inputs))
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
