use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::{OsStrExt as _, OsStringExt as _};
use std::path::Path;

use crate::SlurmError;
use crate::commands::Slurm;
use crate::queue::Queue;
use crate::site::Site;
use crate::submission::{Submission, Task};

/// Maximum length of a job's name in characters, so that `squeue`'s table stays readable; chosen by
/// hand.
const MAX_NAME_CHARS: usize = 100;

/// Options of [`Submission::submit`].
pub struct SubmitOptions<'a> {
    /// Slurm's programs.
    pub slurm: &'a Slurm,
    /// Settings of the cluster.
    pub site: &'a Site,
    /// Command of a job. The submission's folder and the task's number are appended.
    pub command: &'a [&'a OsStr],
    /// Data that the command reads from [`Submission::plan_path`].
    pub plan: &'a [u8],
    /// Working directory of the jobs.
    pub working_folder: &'a Path,
    /// Callback that returns true to stop submitting.
    pub is_stopped: &'a dyn Fn() -> bool,
}

/// Result of [`Submission::submit`].
#[derive(Debug, Default)]
pub struct Submitted {
    /// Task index and job ID of each new job.
    pub jobs: Vec<(usize, String)>,
    /// Number of tasks with a job that was queued before, or submitted for an equal task.
    pub already_queued: usize,
    /// Number of unfinished tasks without a job: the queue is full, submitting failed or was
    /// stopped, or a parent has no job.
    pub remaining: usize,
    /// Error that ended submitting.
    pub error: Option<SlurmError>,
}

impl Submission {
    /// Submits a job for each task that is neither done nor queued. `find_done` returns a flag per
    /// task, true if the task is done. `find_done` is called after the queue is read, so that a
    /// task that ends in between counts as done. The submission's folder is written before the
    /// first job; without jobs, no folder is written. The caller has locked [`crate::lock_path`].
    pub fn submit<E: From<SlurmError>>(
        &self,
        root: &Path,
        options: &SubmitOptions<'_>,
        find_done: impl FnOnce() -> Result<Vec<bool>, E>,
    ) -> Result<Submitted, E> {
        let queue = Queue::read(options.slurm, root)?;
        let done = find_done()?;
        let mut submitted = Submitted::default();
        let mut room = options.site.max_submit.saturating_sub(queue.jobs.len());
        let mut new: BTreeMap<&str, String> = BTreeMap::new();
        let mut ids: Vec<Option<String>> = vec![None; self.tasks.len()];
        for number in (0..self.tasks.len()).filter(|&number| !done[number]) {
            let task = &self.tasks[number];
            // Two blocks of a pipeline may be the same task, so `new` is searched, too.
            let queued = queue.find_job(&task.identity).map(|job| &job.id);
            if let Some(id) = queued.or_else(|| new.get(task.identity.as_str())) {
                ids[number] = Some(id.clone());
                submitted.already_queued += 1;
                continue;
            }
            let is_ready = task.parents.iter().all(|&parent| done[parent] || ids[parent].is_some());
            if room == 0 || !is_ready || submitted.error.is_some() || (options.is_stopped)() {
                submitted.remaining += 1;
                continue;
            }
            if submitted.jobs.is_empty() {
                self.write(options)?;
            }
            match self.submit_task(number, &ids, options) {
                Ok(id) => {
                    room -= 1;
                    ids[number] = Some(id.clone());
                    new.insert(&task.identity, id.clone());
                    submitted.jobs.push((number, id));
                }
                Err(error) => {
                    submitted.remaining += 1;
                    submitted.error = Some(error);
                }
            }
        }
        Ok(submitted)
    }

    /// Submits the job of one task and returns its ID. `ids` are earlier tasks' job IDs.
    fn submit_task(
        &self,
        number: usize,
        ids: &[Option<String>],
        options: &SubmitOptions<'_>,
    ) -> Result<String, SlurmError> {
        let parents = &self.tasks[number].parents;
        let mut after: Vec<&str> =
            parents.iter().filter_map(|&parent| ids[parent].as_deref()).collect();
        after.sort_unstable_by_key(|id| (id.len(), *id));
        after.dedup();
        options.slurm.sbatch(&self.arguments(number, &after, options))
    }

    /// Returns the arguments of `sbatch` for a task's job. `after` are the IDs of jobs that must
    /// succeed first. The site's own arguments come last, so that they win.
    fn arguments(
        &self,
        number: usize,
        after: &[&str],
        options: &SubmitOptions<'_>,
    ) -> Vec<OsString> {
        let SubmitOptions { site, working_folder, .. } = options;
        let Task { label, resources, .. } = &self.tasks[number];
        let printable = label.chars().map(|c| if c.is_control() { ' ' } else { c });
        let name: String = printable.take(MAX_NAME_CHARS).collect();
        let mut arguments: Vec<OsString> =
            ["--parsable", "--nodes=1", "--ntasks=1", "--requeue", "--open-mode=append"]
                .map(OsString::from)
                .into();
        arguments.push(option("--job-name", name));
        arguments.push(option("--chdir", working_folder));
        arguments.push(option("--output", escape_patterns(&self.log_path(number))));
        arguments.push(option("--signal", format!("B:USR1@{}", site.notice.seconds)));
        let optional = [
            ("--cpus-per-task", resources.cpus.map(|n| n.to_string())),
            ("--mem", resources.mem.map(|memory| format!("{}M", memory.mib))),
            ("--gres", resources.gpus.filter(|&n| n > 0).map(|n| format!("gpu:{n}"))),
            ("--time", resources.time.map(|time| time.minutes().to_string())),
            ("--partition", site.partition.clone()),
            ("--account", site.account.clone()),
            ("--qos", site.qos.clone()),
        ];
        for (name, value) in optional {
            arguments.extend(value.map(|value| option(name, value)));
        }
        if !after.is_empty() {
            arguments.push(option("--dependency", format!("afterok:{}", after.join(":"))));
            arguments.push("--kill-on-invalid-dep=yes".into());
        }
        arguments.extend(site.arguments.iter().map(OsString::from));
        arguments.push(self.script_path().into());
        arguments.push(number.to_string().into());
        arguments
    }
}

/// Returns `NAME=VALUE`.
fn option(name: &str, value: impl AsRef<OsStr>) -> OsString {
    let mut argument = OsString::from(name);
    argument.push("=");
    argument.push(value);
    argument
}

/// Doubles each `%` of a log's path, which Slurm would read as a filename pattern.
fn escape_patterns(path: &Path) -> OsString {
    let parts: Vec<&[u8]> = path.as_os_str().as_bytes().split(|&byte| byte == b'%').collect();
    OsString::from_vec(parts.join(&b"%%"[..]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::submission::list_submissions;
    use std::path::PathBuf;
    use std::process::Command;

    /// Store, and substitutes for Slurm's programs: `sbatch` logs its arguments and numbers the
    /// jobs, `squeue` prints a file.
    struct FakeSlurm {
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
        let store = folder.display();
        format!("{id}|{state}|None|{store}/slurm/one/job.sh {n}\n")
    }

    fn is_job_specific(argument: &&str) -> bool {
        argument.starts_with("--job-name")
            || argument.starts_with("--dep")
            || argument.starts_with("--kill")
    }

    impl FakeSlurm {
        fn new() -> Self {
            let fake = Self { dir: tempfile::tempdir().unwrap() };
            std::fs::create_dir(fake.path("bin")).unwrap();
            std::fs::write(fake.path("queue"), "").unwrap();
            let store = fake.dir.path().display();
            fake.program(
                "sbatch",
                &format!(
                    "echo \"$@\" >> {store}/argv\nn=$(wc -l < \
                {store}/argv)\n[ \"$n\" -le ${{MOST:-3}} ] || \
                {{ echo 'sbatch: error: QOSMaxSubmitJobPerUserLimit' >&2; exit 1; }}\necho $((100 \
                + n))"
                ),
            );
            fake.program("squeue", &format!("echo \"$@\" >> {store}/asked\ncat {store}/queue"));
            fake
        }

        fn path(&self, name: &str) -> PathBuf {
            self.dir.path().join(name)
        }

        /// Installs a program in another process: a file that this process has open can't be run.
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

        /// Submits a chain of two tasks, and an independent task.
        fn submit(&self, id: &str, done: [bool; 3], max_submit: usize) -> Submitted {
            let tasks = vec![task("prep", &[]), task("train", &[0, 0]), task("other", &[])];
            let (slurm, site) =
                (Slurm::in_folder(self.path("bin")), Site { max_submit, ..Site::default() });
            let options = SubmitOptions {
                slurm: &slurm,
                site: &site,
                command: &[OsStr::new("run")],
                plan: b"{}",
                working_folder: Path::new("/work"),
                is_stopped: &|| false,
            };
            let submission = Submission::new(self.dir.path(), id, tasks);
            submission
                .submit::<SlurmError>(self.dir.path(), &options, || Ok(done.to_vec()))
                .unwrap()
        }

        /// Sets the queue to jobs of the submission "one".
        fn queue(&self, jobs: &[(&str, &str, usize)]) {
            let lines = jobs.iter().map(|job| queue_line(self.dir.path(), job));
            std::fs::write(self.path("queue"), lines.collect::<String>()).unwrap();
        }

        /// Returns the arguments that distinguish jobs, one line per call.
        fn argv(&self) -> Vec<String> {
            let text = std::fs::read_to_string(self.path("argv")).unwrap_or_default();
            text.lines()
                .map(|line| line.split(' ').filter(is_job_specific).collect::<Vec<_>>().join(" "))
                .collect()
        }
    }

    #[test]
    fn a_job_waits_for_its_submitted_parents() {
        let fake = FakeSlurm::new();
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
    fn finished_tasks_are_not_waited_for() {
        let fake = FakeSlurm::new();
        assert_eq!(fake.submit("one", [true, false, true], 10).jobs.len(), 1);
        assert_eq!(fake.argv(), ["--job-name=train"]);
        let empty = fake.submit("two", [true; 3], 10);
        assert!(
            empty.jobs.is_empty() && list_submissions(fake.dir.path()).unwrap().len() == 1,
            "a submission without jobs leaves nothing"
        );
    }

    #[test]
    fn queued_tasks_are_not_submitted_again() {
        let fake = FakeSlurm::new();
        fake.submit("one", [false; 3], 10);
        fake.queue(&[("101", "RUNNING", 0), ("103", "PENDING", 2)]);
        let second = fake.submit("two", [false, false, false], 10);
        // Train was cancelled and is submitted again, after the queued job; the fake refuses this
        // fourth call.
        assert_eq!((second.already_queued, second.remaining), (2, 1));
        assert_eq!(
            fake.argv()[3],
            "--job-name=train --dependency=afterok:101 --kill-on-invalid-dep=yes"
        );
        assert_eq!(second.error.unwrap().to_string(), "sbatch: error: QOSMaxSubmitJobPerUserLimit");
        fake.queue(&[("101", "COMPLETING", 0)]);
        assert_eq!(
            fake.submit("three", [false, true, true], 10).already_queued,
            0,
            "a completing job finishes no task"
        );
        let queries = std::fs::read_to_string(fake.path("asked")).unwrap();
        assert_eq!(
            queries.lines().count(),
            2,
            "one query per submission, and none before the first: {queries}"
        );
    }

    #[test]
    fn the_queue_is_bounded() {
        let fake = FakeSlurm::new();
        let first = fake.submit("one", [false; 3], 1);
        assert_eq!((first.jobs.len(), first.remaining), (1, 2));
        fake.queue(&[("101", "RUNNING", 0)]);
        let second = fake.submit("two", [false; 3], 1);
        assert_eq!((second.jobs.len(), second.already_queued, second.remaining), (0, 1, 2));
        fake.queue(&[]);
        let third = fake.submit("three", [true, false, false], 2);
        assert_eq!((third.jobs.len(), third.remaining), (2, 0));
    }

    fn joined_arguments(resources: &str, site: &str, after: &[&str]) -> String {
        let task = Task {
            label: "train-ss [supersample=2]".to_owned(),
            resources: serde_yaml::from_str(resources).unwrap(),
            ..Task::default()
        };
        let site: Site = serde_yaml::from_str(site).unwrap();
        let submission = Submission::new(Path::new("/s/50%"), "a", vec![Task::default(), task]);
        let options = SubmitOptions {
            slurm: &Slurm::default(),
            site: &site,
            command: &[],
            plan: b"{}",
            working_folder: Path::new("/work"),
            is_stopped: &|| false,
        };
        let arguments: Vec<String> = submission
            .arguments(1, after, &options)
            .into_iter()
            .map(|argument| argument.into_string().unwrap())
            .collect();
        arguments.join("|")
    }

    const COMMON: &str = "--parsable|--nodes=1|--ntasks=1|--requeue|--open-mode=append|\
        --job-name=train-ss [supersample=2]|--chdir=/work|--output=/s/50%%/slurm/a/1.log|\
        --signal=B:USR1@90";

    #[test]
    fn each_request_is_an_argument() {
        for (resources, site, after, expected) in [
            ("{}", "{}", &[][..], ""),
            (
                "{cpus: 4, mem: 8G, gpus: 1, time: 2h}",
                "{}",
                &[],
                "|--cpus-per-task=4|--mem=8192M|--gres=gpu:1|--time=120",
            ),
            ("{gpus: 0, time: 61s}", "{}", &[], "|--time=2"),
            ("{}", "{partition: a, account: b, qos: c}", &[], "|--partition=a|--account=b|--qos=c"),
            ("{}", "{}", &["5", "6"], "|--dependency=afterok:5:6|--kill-on-invalid-dep=yes"),
            (
                "{time: 1h}",
                "{arguments: [--exclusive, --time=5]}",
                &["5"],
                "|--time=60|--dependency=afterok:5|--kill-on-invalid-dep=yes|--exclusive|--time=5",
            ),
        ] {
            assert_eq!(
                joined_arguments(resources, site, after),
                format!("{COMMON}{expected}|/s/50%/slurm/a/job.sh|1")
            );
        }
    }
}
