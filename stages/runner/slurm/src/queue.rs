use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Display, Formatter};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use serde::Serialize;

use crate::SlurmError;
use crate::commands::Slurm;
use crate::submission::{Submission, Task, list_submissions};

/// Format of `squeue`: ID, state, reason, and the script with its argument, which identifies a
/// task's job (docs/design/032).
const SQUEUE_FORMAT: &str = "%i|%T|%r|%o";

/// A job in the queue.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Job {
    /// Slurm's job ID.
    pub id: String,
    /// Slurm's state: `PENDING`, `RUNNING`.
    pub state: String,
    /// Slurm's reason for waiting; the text "None" if the job doesn't wait.
    pub reason: String,
    /// ID of the job's submission.
    pub submission: String,
    /// The job's task; the default task if the submission can't be read.
    #[serde(skip)]
    pub task: Task,
    /// Index of the job's task in the submission.
    #[serde(skip)]
    number: usize,
}

/// The jobs of a store that haven't ended.
#[derive(Clone, Debug, Default)]
pub struct Queue {
    /// Jobs in Slurm's order.
    pub jobs: Vec<Job>,
}

impl Job {
    /// True if the job may still finish its task.
    fn can_finish_task(&self) -> bool {
        !["COMPLETING", "STAGE_OUT"].contains(&self.state.as_str())
            && self.reason != "DependencyNeverSatisfied"
    }

    /// Parses a line of `squeue`; `None` if the line isn't a job of this store.
    fn parse(line: &str, root: &str) -> Option<Self> {
        let fields: Vec<&str> = line.splitn(4, '|').collect();
        let &[id, state, reason, command] = fields.as_slice() else { return None };
        let (script, number) = command.trim_end().rsplit_once(' ')?;
        let submission =
            script.strip_prefix(root)?.strip_prefix("/slurm/")?.strip_suffix("/job.sh")?;
        if submission.contains('/') {
            return None;
        }
        Some(Self {
            id: id.to_owned(),
            state: state.to_owned(),
            reason: reason.to_owned(),
            submission: submission.to_owned(),
            task: Task::default(),
            number: number.parse().ok()?,
        })
    }
}

impl Display for Job {
    /// Writes `job 17 pending: Dependency`.
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "job {} {}", self.id, self.state.to_lowercase())?;
        match self.reason.as_str() {
            "None" | "" => Ok(()),
            reason => write!(f, ": {reason}"),
        }
    }
}

impl Queue {
    /// Reads the jobs of all users who have submitted from this store, by one call of `squeue`.
    /// Slurm isn't called if the store has no submission.
    pub fn read(slurm: &Slurm, root: &Path) -> Result<Self, SlurmError> {
        let submissions = list_submissions(root)?;
        let owners =
            submissions.iter().filter_map(|(_, folder)| Some(folder.metadata().ok()?.uid()));
        let owners: BTreeSet<u32> = owners.collect();
        if owners.is_empty() {
            return Ok(Self::default());
        }
        let users: Vec<String> = owners.iter().map(u32::to_string).collect();
        let text = slurm.squeue(&users, SQUEUE_FORMAT)?;
        let root_text = root.to_string_lossy();
        let mut jobs: Vec<Job> =
            text.lines().filter_map(|line| Job::parse(line, &root_text)).collect();
        let mut submissions: BTreeMap<String, Option<Submission>> = BTreeMap::new();
        for job in &mut jobs {
            let submission = submissions
                .entry(job.submission.clone())
                .or_insert_with(|| Submission::read(root, &job.submission));
            let task = submission.as_ref().and_then(|submission| submission.tasks.get(job.number));
            job.task = task.cloned().unwrap_or_default();
        }
        Ok(Self { jobs })
    }

    /// Finds the job that may still finish a task.
    pub fn find_job(&self, identity: &str) -> Option<&Job> {
        self.jobs.iter().find(|job| job.task.identity == identity && job.can_finish_task())
    }

    /// Returns the IDs of the submissions with jobs in the queue.
    pub fn submissions(&self) -> BTreeSet<&str> {
        self.jobs.iter().map(|job| job.submission.as_str()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queue_lines_are_parsed() {
        for (line, expected) in [
            (
                "17|PENDING|Dependency|/a b/s/slurm/1-2-0/job.sh 4",
                Some(("17", "1-2-0", 4, "job 17 pending: Dependency", true)),
            ),
            (
                "18|RUNNING|None|/a b/s/slurm/1-2-0/job.sh 0",
                Some(("18", "1-2-0", 0, "job 18 running", true)),
            ),
            (
                "18|COMPLETING|None|/a b/s/slurm/1-2-0/job.sh 0",
                Some(("18", "1-2-0", 0, "job 18 completing", false)),
            ),
            (
                "19|PENDING|DependencyNeverSatisfied|/a b/s/slurm/x/job.sh 12",
                Some(("19", "x", 12, "job 19 pending: DependencyNeverSatisfied", false)),
            ),
            ("20|RUNNING|None|/a b/other/slurm/x/job.sh 1", None),
            ("21|RUNNING|None|/a b/s/slurm/x/y/job.sh 1", None),
            ("22|RUNNING|None|/a b/s/slurm/x/job.sh", None),
            ("23|RUNNING|None|(null)", None),
            ("24|RUNNING", None),
            ("slurm_load_jobs error", None),
            ("", None),
        ] {
            let job = Job::parse(line, "/a b/s");
            let found = job.as_ref().map(|j| {
                (j.id.as_str(), j.submission.as_str(), j.number, j.to_string(), j.can_finish_task())
            });
            assert_eq!(
                found,
                expected.map(|(id, submission, number, text, can_finish_task)| (
                    id,
                    submission,
                    number,
                    text.to_owned(),
                    can_finish_task
                )),
                "{line}"
            );
        }
    }

    #[test]
    fn squeue_runs_only_if_there_are_submissions() {
        let root = tempfile::tempdir().unwrap();
        assert!(Queue::read(&Slurm::in_folder("/nowhere"), root.path()).unwrap().jobs.is_empty());
        std::fs::create_dir_all(root.path().join("slurm/1-2-0")).unwrap();
        let problem =
            Queue::read(&Slurm::in_folder("/nowhere"), root.path()).unwrap_err().to_string();
        assert!(
            problem.starts_with("squeue: No such file") && problem.ends_with("on PATH"),
            "{problem}"
        );
    }
}
