use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, bail_bad_input, print_line, report_line};
use clap::{CommandFactory as _, Parser, Subcommand};
use store::Store;

use crate::export::{Destination, export};
use crate::import::import;
use crate::pull::pull;
use crate::push::push;
use crate::remote::{Access, Remote};
use crate::selection::Selection;
use crate::transfer::MAX_CONCURRENT_FILES;

const NAME: &str = "nerf-sr-remote";

/// Share finished actions and their artifacts between stores of nerf-sr.
///
/// REMOTE is a folder, or s3://bucket/prefix with credentials, region and endpoint from the usual
/// AWS_… variables.
#[derive(Parser)]
#[command(name = NAME, version)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
    /// Folder of the store
    #[arg(
        long,
        global = true,
        default_value = ".nerf-sr",
        value_name = "DIR",
        env = "NERF_SR_STORE"
    )]
    store: PathBuf,
}

#[derive(Subcommand)]
enum Verb {
    /// Copy missing actions to the remote
    Push {
        /// A folder or s3://bucket/prefix
        remote: String,
        #[command(flatten)]
        selection: Selection,
    },
    /// Copy missing actions from the remote, after verification
    Pull {
        /// A folder or s3://bucket/prefix
        remote: String,
        #[command(flatten)]
        selection: Selection,
    },
    /// Write one artifact with its history to a file
    Export {
        /// Hash of an artifact or key of an action, or the beginning of either
        what: String,
        /// Path of the tar file to create
        file: PathBuf,
        /// Replace an existing regular file
        #[arg(long)]
        force: bool,
        /// Write the artifact and the records of its history, but not the history's artifacts
        #[arg(long)]
        records_only: bool,
    },
    /// Import a file written by `export`, after verification
    Import {
        /// Path of the file
        file: PathBuf,
    },
    /// Print shell completions
    Completions {
        /// Name of the shell
        shell: clap_complete::Shell,
    },
    /// Write man pages of all verbs into a folder; `make install` calls this
    #[command(hide = true)]
    Man {
        /// Path of the folder
        folder: PathBuf,
    },
}

/// Runs the program. The exit code is 0 for success, 1 for a failure, 2 for a wrong command line, 3
/// for refused data, and 130 for an interruption.
pub fn main() -> ExitCode {
    stage::install_panic_hook(NAME);
    match run(Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            report_line!("{NAME}: {}", artifact::one_line(&error));
            ExitCode::from(artifact::exit_code(&error))
        }
    }
}

fn run(cli: Cli) -> anyhow::Result<()> {
    let stop = stage::stop_on_signals()?;
    match cli.verb {
        Verb::Push { remote, selection } => {
            let store = open_existing(&cli.store)?;
            let remote = Remote::open(&remote, Access::Write)?;
            block_on(&stop, push(&store, &remote, &selection, &stop))
        }
        Verb::Pull { remote, selection } => {
            let remote = Remote::open(&remote, Access::Read)?;
            let store = Store::open(&cli.store)?;
            block_on(&stop, pull(&store, &remote, &selection, &stop))
        }
        Verb::Export { what, file, force, records_only } => {
            let destination = Destination { file: &file, force };
            export(&open_existing(&cli.store)?, &what, destination, records_only, &stop)
        }
        Verb::Import { file } => {
            let imported = import(&Store::open(&cli.store)?, &file, &stop)?;
            print_line!("{}: {imported}", file.display());
            Ok(())
        }
        Verb::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), NAME, &mut script);
            // The reader may have closed stdout.
            std::io::stdout().write_all(&script).ok();
            Ok(())
        }
        Verb::Man { folder } => std::fs::create_dir_all(&folder)
            .and_then(|()| clap_mangen::generate_to(Cli::command(), &folder))
            .with_context(|| format!("cannot write man pages into {}", folder.display())),
    }
}

/// Opens a store to read from; fails if it doesn't exist.
fn open_existing(folder: &Path) -> anyhow::Result<Store> {
    if !folder.join("objects").is_dir() {
        bail_bad_input!("{}: not a store of nerf-sr; choose one with --store", folder.display());
    }
    Ok(Store::open(folder)?)
}

/// Interval between two checks for a signal; chosen by hand.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Time after a signal in which transfers stop by themselves; chosen by hand.
const GRACE_TIME: Duration = Duration::from_secs(2);

/// Runs transfers on as many threads as concurrent files, since they block on files.
fn block_on(
    stop: &Arc<AtomicBool>,
    work: impl Future<Output = anyhow::Result<()>>,
) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(MAX_CONCURRENT_FILES)
        .enable_all()
        .build()?;
    let result = runtime.block_on(async {
        tokio::select! {
            result = work => result,
            () = wait_for_signal(stop) => Err(Failure::Interrupted.into()),
        }
    });
    // Connections to an unresponsive server must not delay the end; the second is chosen by hand.
    runtime.shutdown_timeout(Duration::from_secs(1));
    result
}

/// Returns [`GRACE_TIME`] after a signal: transfers stop by themselves by then, unless a server is
/// unresponsive.
async fn wait_for_signal(stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        tokio::time::sleep(POLL_INTERVAL).await;
    }
    tokio::time::sleep(GRACE_TIME).await;
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_sound() {
        use super::*;
        Cli::command().debug_assert();
    }
}
