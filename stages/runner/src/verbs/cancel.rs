use std::process::ExitCode;

use artifact::{counted, print_line};
use slurm::{Queue, Slurm};
use store::Store;

/// Cancels the jobs of this store, or those of one stage. Jobs that need them go with them.
pub(crate) fn cancel(store: &Store, stage: Option<&str>) -> anyhow::Result<ExitCode> {
    let slurm = Slurm::default();
    let queue = Queue::read(&slurm, store.root())?;
    let jobs: Vec<_> =
        queue.jobs.iter().filter(|job| stage.is_none_or(|stage| job.task.stage == stage)).collect();
    slurm.cancel(&jobs.iter().map(|job| job.id.as_str()).collect::<Vec<_>>())?;
    for job in &jobs {
        print_line!("{}: {}", job.task.label, job);
    }
    let of_stage = stage.map(|stage| format!(" of {stage}")).unwrap_or_default();
    print_line!("cancelled {}{of_stage}", counted(jobs.len(), "job"));
    Ok(ExitCode::SUCCESS)
}
