use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::Path;

use crate::arguments::Order;
use crate::commands::Slurm;
use crate::error::SlurmError;
use crate::queue::Queue;
use crate::site::Site;
use crate::submission::{Submission, lock};

/// What jobs are submitted with.
pub struct Terms<'a> {
    /// Slurm's programs.
    pub slurm: &'a Slurm,
    /// The cluster's own wishes.
    pub site: &'a Site,
    /// What a job runs, with the submission's folder and the task's number as further arguments.
    pub command: &'a [&'a OsStr],
    /// What that reads besides.
    pub plan: &'a [u8],
    /// Where it runs.
    pub folder: &'a Path,
    /// Whether to stop here.
    pub is_stopped: &'a dyn Fn() -> bool,
}

/// What submitting came to.
#[derive(Debug, Default)]
pub struct Submitted {
    /// The jobs that are new: the task's number, the job's own.
    pub jobs: Vec<(usize, String)>,
    /// Tasks that a job in the queue will do.
    pub queued: usize,
    /// Tasks left out, for want of room or because of an error.
    pub left: usize,
    /// Why it ended early.
    pub error: Option<SlurmError>,
}

impl Submission {
    /// Submits a job for each task that isn't done and isn't queued. `done` says what is; it is
    /// asked after the queue, so that no task falls between both. The folder is written before the
    /// first job is submitted, and only then.
    pub fn submit<E: From<SlurmError>>(
        &self,
        root: &Path,
        terms: &Terms<'_>,
        done: impl FnOnce() -> Result<Vec<bool>, E>,
    ) -> Result<Submitted, E> {
        let Some(_lock) = lock(root, terms.is_stopped)? else { return Ok(Submitted::default()) };
        let queue = Queue::look(terms.slurm, root)?;
        let done = done()?;
        let mut submitted = Submitted::default();
        let mut room = terms.site.max_submit.saturating_sub(queue.jobs.len());
        let mut new: BTreeMap<&str, String> = BTreeMap::new();
        let mut ids: Vec<Option<String>> = vec![None; self.tasks.len()];
        for number in (0..self.tasks.len()).filter(|&number| !done[number]) {
            let task = &self.tasks[number];
            // Two blocks of a pipeline may come to one task.
            let before = queue
                .job_of(&task.identity)
                .map(|job| &job.id)
                .or_else(|| new.get(task.identity.as_str()));
            if let Some(id) = before {
                ids[number] = Some(id.clone());
                submitted.queued += 1;
                continue;
            }
            let is_ready = task.parents.iter().all(|&parent| done[parent] || ids[parent].is_some());
            if room == 0 || !is_ready || submitted.error.is_some() || (terms.is_stopped)() {
                submitted.left += 1;
                continue;
            }
            if submitted.jobs.is_empty() {
                self.write(terms.plan, terms.site, terms.command)?;
            }
            match self.submit_one(number, &ids, terms) {
                Ok(id) => {
                    room -= 1;
                    ids[number] = Some(id.clone());
                    new.insert(&task.identity, id.clone());
                    submitted.jobs.push((number, id));
                }
                Err(error) => {
                    submitted.left += 1;
                    submitted.error = Some(error);
                }
            }
        }
        Ok(submitted)
    }

    fn submit_one(
        &self,
        number: usize,
        ids: &[Option<String>],
        terms: &Terms<'_>,
    ) -> Result<String, SlurmError> {
        let task = &self.tasks[number];
        let mut after: Vec<&str> =
            task.parents.iter().filter_map(|&parent| ids[parent].as_deref()).collect();
        after.sort_unstable_by_key(|id| (id.len(), *id));
        after.dedup();
        let order = Order {
            name: &task.label,
            resources: &task.resources,
            site: terms.site,
            after: &after,
            folder: terms.folder,
            log: &self.log(number),
            script: &self.script(),
            number,
        };
        terms.slurm.sbatch(&order.arguments())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::submission::{Task, all};
    use std::path::PathBuf;
    use std::process::Command;

    /// A store, and programs that play Slurm's: `sbatch` writes its arguments down and counts,
    /// `squeue` prints a file.
    struct Fake {
        dir: tempfile::TempDir,
    }

    fn task(name: &str, parents: &[usize]) -> Task {
        Task {
            stage: name.into(),
            label: name.into(),
            identity: format!("id-{name}"),
            parents: parents.to_vec(),
            ..Task::default()
        }
    }

    fn queue_line(folder: &Path, (id, state, n): &(&str, &str, usize)) -> String {
        let here = folder.display();
        format!("{id}|{state}|None|{here}/slurm/one/job.sh {n}\n")
    }

    fn tells_apart(w: &&str) -> bool {
        w.starts_with("--job-name") || w.starts_with("--dep") || w.starts_with("--kill")
    }

    impl Fake {
        fn new() -> Self {
            let fake = Self { dir: tempfile::tempdir().unwrap() };
            std::fs::create_dir(fake.path("bin")).unwrap();
            std::fs::write(fake.path("queue"), "").unwrap();
            let here = fake.dir.path().display();
            fake.program(
                "sbatch",
                &format!(
                    "echo \"$@\" >> {here}/argv\nn=$(wc -l < \
                {here}/argv)\n[ \"$n\" -le ${{MOST:-3}} ] || \
                {{ echo 'sbatch: error: QOSMaxSubmitJobPerUserLimit' >&2; exit 1; }}\necho $((100 \
                + n))"
                ),
            );
            fake.program("squeue", &format!("echo \"$@\" >> {here}/asked\ncat {here}/queue"));
            fake
        }

        fn path(&self, name: &str) -> PathBuf {
            self.dir.path().join(name)
        }

        /// Written by another process: a file that this one has open can't be run.
        fn program(&self, name: &str, text: &str) {
            let source = self.path("source");
            std::fs::write(&source, format!("#!/bin/sh\n{text}\n")).unwrap();
            let status = Command::new("install")
                .args(["-m", "755"])
                .arg(source)
                .arg(self.path("bin").join(name))
                .status();
            assert!(status.unwrap().success());
        }

        /// A chain of two, and one by itself.
        fn submit(&self, id: &str, done: [bool; 3], most: usize) -> Submitted {
            let tasks = vec![task("prep", &[]), task("train", &[0, 0]), task("other", &[])];
            let (slurm, site) =
                (Slurm::in_folder(self.path("bin")), Site { max_submit: most, ..Site::default() });
            let terms = Terms {
                slurm: &slurm,
                site: &site,
                command: &[OsStr::new("run")],
                plan: b"{}",
                folder: Path::new("/work"),
                is_stopped: &|| false,
            };
            let submission = Submission::new(self.dir.path(), id, tasks);
            submission.submit::<SlurmError>(self.dir.path(), &terms, || Ok(done.to_vec())).unwrap()
        }

        /// What stands in the queue: jobs of the submission "one".
        fn queue(&self, jobs: &[(&str, &str, usize)]) {
            let lines = jobs.iter().map(|job| queue_line(self.dir.path(), job));
            std::fs::write(self.path("queue"), lines.collect::<String>()).unwrap();
        }

        /// The arguments that tell jobs apart, a call each.
        fn argv(&self) -> Vec<String> {
            let text = std::fs::read_to_string(self.path("argv")).unwrap_or_default();
            text.lines()
                .map(|line| line.split(' ').filter(tells_apart).collect::<Vec<_>>().join(" "))
                .collect()
        }
    }

    #[test]
    fn a_job_waits_for_those_that_were_submitted() {
        let fake = Fake::new();
        let submitted = fake.submit("one", [false; 3], 10);
        assert_eq!(
            submitted.jobs,
            [(0, "101".to_owned()), (1, "102".to_owned()), (2, "103".to_owned())]
        );
        let train = "--job-name=train --dependency=afterok:101 --kill-on-invalid-dep=yes";
        assert_eq!(fake.argv(), ["--job-name=prep", train, "--job-name=other"]);
        let script = std::fs::read_to_string(fake.path("slurm/one/job.sh")).unwrap();
        assert!(
            script
                .ends_with(&format!("exec 'run' '{}' \"$1\"\n", fake.path("slurm/one").display())),
            "{script}"
        );
    }

    #[test]
    fn what_is_done_is_not_waited_for() {
        let fake = Fake::new();
        assert_eq!(fake.submit("one", [true, false, true], 10).jobs.len(), 1);
        assert_eq!(fake.argv(), ["--job-name=train"]);
        let nothing = fake.submit("two", [true; 3], 10);
        assert!(
            nothing.jobs.is_empty() && all(fake.dir.path()).unwrap().len() == 1,
            "a submission without jobs leaves nothing"
        );
    }

    #[test]
    fn what_is_queued_is_not_submitted_again() {
        let fake = Fake::new();
        fake.submit("one", [false; 3], 10);
        fake.queue(&[("101", "RUNNING", 0), ("103", "PENDING", 2)]);
        let second = fake.submit("two", [false, false, false], 10);
        // The fake refuses a fourth call: train was cancelled, and waits for the queued job.
        assert_eq!((second.queued, second.left), (2, 1));
        assert_eq!(
            fake.argv()[3],
            "--job-name=train --dependency=afterok:101 --kill-on-invalid-dep=yes"
        );
        assert_eq!(second.error.unwrap().to_string(), "sbatch: error: QOSMaxSubmitJobPerUserLimit");
        fake.queue(&[("101", "COMPLETING", 0)]);
        assert_eq!(
            fake.submit("three", [false, true, true], 10).queued,
            0,
            "a job at its end makes nothing any more"
        );
        let asked = std::fs::read_to_string(fake.path("asked")).unwrap();
        assert_eq!(
            asked.lines().count(),
            2,
            "once a submission, and not before there was one: {asked}"
        );
    }

    #[test]
    fn the_queue_is_bounded() {
        let fake = Fake::new();
        let first = fake.submit("one", [false; 3], 1);
        assert_eq!((first.jobs.len(), first.left), (1, 2));
        fake.queue(&[("101", "RUNNING", 0)]);
        let second = fake.submit("two", [false; 3], 1);
        assert_eq!((second.jobs.len(), second.queued, second.left), (0, 1, 2));
        fake.queue(&[]);
        let third = fake.submit("three", [true, false, false], 2);
        assert_eq!((third.jobs.len(), third.left), (2, 0));
    }
}
