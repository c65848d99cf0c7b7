use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Write as _};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use artifact::{Failure, GivenInput, exit_code, hash_json, one_line, print_lines, report_line};
use clap::CommandFactory as _;
use contract::Description;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;

use crate::arguments::{Arguments, Command, input_folders, read_params};
use crate::context::Context;
use crate::deadline::End;
use crate::help::help_of;
use crate::panics::install_panic_hook;
use crate::progress::{ProgressMode, emit_events, failed_event};
use crate::signals::stop_on_signals;
use crate::stage::Stage;
use crate::staging::Staging;

/// Environment variable in which a runner tells its stages its process id, so that they see when it
/// is gone.
pub const RUNNER_VARIABLE: &str = "NERF_SR_RUNNER";

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
        end_with_runner(Arc::clone(&interrupted))?;
    }
    let output = arguments.output.expect("clap requires --output");
    let staging = Staging::new(&output)?;
    let end = End::default();
    end.enforce(S::NAME, &interrupted, staging.folder())?;
    if let Some(work) = &arguments.work {
        fs::create_dir_all(work)
            .with_context(|| format!("--work {}: cannot be made", work.display()))?;
    }
    let made_from: Option<BTreeMap<&str, &str>> =
        inputs.iter().map(|(name, input)| Some((name.as_str(), input.identity()?))).collect();
    let identity =
        made_from.map(|inputs| hash_json(&(&params, inputs, &description.code, &arguments.device)));
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
        goes_on: AtomicBool::new(false),
    };
    let done = S::run(&context, &params)
        .and_then(|()| context.check_interrupt())
        .and_then(|()| staging.complete(&description.output.kind));
    end.claim();
    done?;
    staging.publish(&output)
}

/// Lets the stage end as if interrupted, with a checkpoint, when the runner is killed, rather than
/// work on unseen: nobody reads its stdout then. A wrapper script between runner and stage passes
/// that on, while the parent process would be the wrapper.
fn end_with_runner(interrupted: Arc<AtomicBool>) -> io::Result<()> {
    if std::env::var_os(RUNNER_VARIABLE).is_none() {
        return Ok(());
    }
    std::thread::Builder::new().spawn(move || {
        let stdout = io::stdout();
        // No event is asked for: the kernel reports by itself that a pipe has lost its reader.
        let mut pipe = [PollFd::new(&stdout, PollFlags::empty())];
        while poll(&mut pipe, None) == Err(Errno::INTR) {}
        if pipe[0].revents().contains(PollFlags::ERR) {
            interrupted.store(true, Ordering::SeqCst);
        }
    })?;
    Ok(())
}
