use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use serde::Serialize;

use crate::commands::Slurm;
use crate::error::SlurmError;
use crate::submission::{Submission, Task, all};

/// Number, state, reason, and the script with its argument, by which a job is known.
const FORMAT: &str = "%i|%T|%r|%o";

/// A job in the queue.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Job {
    /// Its number.
    pub id: String,
    /// Slurm's word: `PENDING`, `RUNNING`.
    pub state: String,
    /// Why it waits; `None` where it doesn't.
    pub reason: String,
    /// Its submission.
    pub submission: String,
    /// What it does; nothing where the submission can't be read.
    #[serde(skip)]
    pub task: Task,
    #[serde(skip)]
    number: usize,
}

/// The jobs of a store that haven't ended.
#[derive(Clone, Debug, Default)]
pub struct Queue {
    /// As Slurm lists them.
    pub jobs: Vec<Job>,
}

impl Job {
    /// Whether the task may still become done by it.
    fn is_live(&self) -> bool {
        !["COMPLETING", "STAGE_OUT"].contains(&self.state.as_str())
            && self.reason != "DependencyNeverSatisfied"
    }

    /// As people read it: `job 17 pending: Dependency`.
    pub fn words(&self) -> String {
        let state = self.state.to_lowercase();
        match self.reason.as_str() {
            "None" | "" => format!("job {} {state}", self.id),
            reason => format!("job {} {state}: {reason}", self.id),
        }
    }

    /// A line of the queue, where it is of a job of this store.
    fn parse(line: &str, root: &str) -> Option<Self> {
        let mut fields = line.splitn(4, '|');
        let (id, state, reason, command) =
            (fields.next()?, fields.next()?, fields.next()?, fields.next()?);
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

impl Queue {
    /// Asks Slurm once for the jobs of all who have submitted from this store; not at all where
    /// nobody has.
    pub fn look(slurm: &Slurm, root: &Path) -> Result<Self, SlurmError> {
        let folders = all(root)?;
        let users: BTreeSet<u32> =
            folders.iter().filter_map(|(_, folder)| Some(folder.metadata().ok()?.uid())).collect();
        if users.is_empty() {
            return Ok(Self::default());
        }
        let users: Vec<String> = users.iter().map(u32::to_string).collect();
        let text = slurm.squeue(&users, FORMAT)?;
        let shown = root.to_string_lossy();
        let mut jobs: Vec<Job> = text.lines().filter_map(|line| Job::parse(line, &shown)).collect();
        let ids: BTreeSet<&str> = jobs.iter().map(|job| job.submission.as_str()).collect();
        let read = |id: &str| Some((id.to_owned(), Submission::read(root, id)?));
        let submissions: BTreeMap<String, Submission> = ids.into_iter().filter_map(read).collect();
        for job in &mut jobs {
            let task = submissions
                .get(&job.submission)
                .and_then(|submission| submission.tasks.get(job.number));
            job.task = task.cloned().unwrap_or_default();
        }
        Ok(Self { jobs })
    }

    /// The job by which a task may become done.
    pub fn job_of(&self, identity: &str) -> Option<&Job> {
        self.jobs.iter().find(|job| job.task.identity == identity && job.is_live())
    }

    /// The submissions of which a job hasn't ended.
    pub fn submissions(&self) -> BTreeSet<&str> {
        self.jobs.iter().map(|job| job.submission.as_str()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_the_queue() {
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
            let found = job
                .as_ref()
                .map(|j| (j.id.as_str(), j.submission.as_str(), j.number, j.words(), j.is_live()));
            assert_eq!(
                found,
                expected.map(|(id, run, number, words, live)| (
                    id,
                    run,
                    number,
                    words.to_owned(),
                    live
                )),
                "{line}"
            );
        }
    }

    #[test]
    fn without_submissions_nobody_is_asked() {
        let root = tempfile::tempdir().unwrap();
        assert!(Queue::look(&Slurm::in_folder("/nowhere"), root.path()).unwrap().jobs.is_empty());
        std::fs::create_dir_all(root.path().join("slurm/1-2-0")).unwrap();
        let problem =
            Queue::look(&Slurm::in_folder("/nowhere"), root.path()).unwrap_err().to_string();
        assert!(
            problem.starts_with("squeue: No such file") && problem.ends_with("on PATH"),
            "{problem}"
        );
    }
}
