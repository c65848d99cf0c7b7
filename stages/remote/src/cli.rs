use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, print_line, report_line};
use clap::{CommandFactory as _, Parser, Subcommand};
use store::Store;

use crate::destination::Destination;
use crate::export::export;
use crate::import::import;
use crate::pull::pull;
use crate::push::push;
use crate::remote::{Access, Remote};
use crate::selection::Selection;
use crate::transfer::FILES_AT_ONCE;

const NAME: &str = "nerf-sr-remote";

/// Shares a store of nerf-sr between machines: finished actions and their artifacts.
///
/// REMOTE is a folder, or s3://bucket/prefix with credentials, region and endpoint from the usual
/// AWS_… variables.
#[derive(Parser)]
#[command(name = NAME, version)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
    /// The store
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
    /// Copy what the remote lacks to it
    Push {
        /// A folder or s3://bucket/prefix
        remote: String,
        #[command(flatten)]
        selection: Selection,
    },
    /// Copy what the store lacks from the remote; everything is verified first
    Pull {
        /// A folder or s3://bucket/prefix
        remote: String,
        #[command(flatten)]
        selection: Selection,
    },
    /// Write one artifact with its whole history as one file
    Export {
        /// An artifact's hash or an action's key, or how it begins
        what: String,
        /// Path of the file to create, a tar
        file: PathBuf,
        /// Replace an existing regular file
        #[arg(long)]
        force: bool,
        /// Of the history, write the records alone
        #[arg(long)]
        records_only: bool,
    },
    /// Read what `export` wrote; everything is verified first
    Import {
        /// The file
        file: PathBuf,
    },
    /// Print shell completions
    Completions {
        /// For which shell
        shell: clap_complete::Shell,
    },
    /// Write man pages of all verbs into a folder; `make install` calls this
    #[command(hide = true)]
    Man {
        /// The folder
        folder: PathBuf,
    },
}

/// The program: exit code 0 when all is copied, 1 when it failed, 2 for a wrong command line, 3 for
/// what was refused, 130 when it was interrupted.
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
            let (store, remote) = (existing(&cli.store)?, Remote::open(&remote, Access::Write)?);
            block_on(&stop, push(&store, &remote, &selection, &stop))
        }
        Verb::Pull { remote, selection } => {
            let remote = Remote::open(&remote, Access::Read)?;
            let store = Store::open(&cli.store)?;
            block_on(&stop, pull(&store, &remote, &selection, &stop))
        }
        Verb::Export { what, file, force, records_only } => {
            let destination = Destination { file: &file, force };
            export(&existing(&cli.store)?, &what, destination, records_only, &stop)
        }
        Verb::Import { file } => {
            let imported = import(&Store::open(&cli.store)?, &file, &stop)?;
            print_line!("{}: {imported}", file.display());
            Ok(())
        }
        Verb::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), NAME, &mut script);
            // Whoever asked for it may have gone.
            std::io::stdout().write_all(&script).ok();
            Ok(())
        }
        Verb::Man { folder } => std::fs::create_dir_all(&folder)
            .and_then(|()| clap_mangen::generate_to(Cli::command(), &folder))
            .with_context(|| format!("cannot write man pages into {}", folder.display())),
    }
}

/// A store to read from; none is made.
fn existing(folder: &Path) -> anyhow::Result<Store> {
    if !folder.join("objects").is_dir() {
        let message = format!("{}: no store of nerf-sr; name one with --store", folder.display());
        return Err(Failure::BadInput(message).into());
    }
    Ok(Store::open(folder)?)
}

/// Transfers read and write files in their threads; there are as many as transfers at once.
fn block_on(
    stop: &Arc<AtomicBool>,
    work: impl Future<Output = anyhow::Result<()>>,
) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(FILES_AT_ONCE)
        .enable_all()
        .build()?;
    let result = runtime.block_on(async {
        tokio::select! {
            result = work => result,
            () = stopped(stop) => Err(Failure::Interrupted.into()),
        }
    });
    // A server that is silent holds nobody up.
    runtime.shutdown_timeout(Duration::from_secs(1));
    result
}

/// Ends a while after a signal: transfers look at it themselves, unless the other side is silent.
async fn stopped(stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    tokio::time::sleep(Duration::from_secs(2)).await;
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_sound() {
        use super::*;
        Cli::command().debug_assert();
    }
}
