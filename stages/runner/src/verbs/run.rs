use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, anyhow};
use artifact::{Failure, SUMMARY_FILE};

use crate::execute::{self, Options};
use crate::plan::Request;
use crate::session::Session;
use crate::sink::{Shown, show};

/// Makes what the targets need and shows it.
pub(crate) fn run(session: &Session, what: &Request, options: &Options, out: &Path) -> anyhow::Result<ExitCode> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    let plan = session.plan_to_run(what, &stop)?;
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
