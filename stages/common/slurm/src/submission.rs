use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::error::SlurmError;
use crate::resources::Resources;
use crate::script::script;
use crate::site::Site;

/// Something to be done by a job.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Task {
    /// Name of its stage.
    pub stage: String,
    /// As people read it; the job's name.
    pub label: String,
    /// Tasks of any submission with one identity are one task.
    pub identity: String,
    /// The tasks that must be done first, by their numbers, which are smaller.
    pub parents: Vec<usize>,
    /// What it needs.
    #[serde(default, skip_serializing_if = "Resources::is_empty")]
    pub resources: Resources,
}

/// Tasks that were submitted at once: `slurm/ID` in a store.
///
/// ```text
/// slurm/ID/tasks.json   the tasks; a task's number is its place
/// slurm/ID/plan.json    what the job's command reads; the caller's own
/// slurm/ID/job.sh       the script of every job; its argument is the number
/// slurm/ID/N.log        what the job of task N said
/// slurm/lock            held while somebody submits
/// ```
#[derive(Debug)]
pub struct Submission {
    /// Its name.
    pub id: String,
    /// Its tasks, each after those it needs.
    pub tasks: Vec<Task>,
    folder: PathBuf,
}

const TASKS: &str = "tasks.json";
const SCRIPT: &str = "job.sh";

/// Between two attempts at the lock.
const ATTEMPT_INTERVAL: Duration = Duration::from_millis(50);

impl Submission {
    /// A submission to be, in a store's folder.
    pub fn new(root: &Path, id: &str, tasks: Vec<Task>) -> Self {
        Self { id: id.to_owned(), tasks, folder: root.join("slurm").join(id) }
    }

    /// One that was made; `None` where it isn't whole.
    pub fn read(root: &Path, id: &str) -> Option<Self> {
        let empty = Self::new(root, id, Vec::new());
        let tasks = serde_json::from_slice(&fs::read(empty.folder.join(TASKS)).ok()?).ok()?;
        Some(Self { tasks, ..empty })
    }

    /// Where the command's own file lies in a submission's folder.
    pub fn plan(folder: &Path) -> PathBuf {
        folder.join("plan.json")
    }

    /// What the job of a task says.
    pub fn log(&self, number: usize) -> PathBuf {
        self.folder.join(format!("{number}.log"))
    }

    pub(crate) fn script(&self) -> PathBuf {
        self.folder.join(SCRIPT)
    }

    /// Writes the folder, whole or not at all. The command gets the folder and a task's number.
    pub(crate) fn write(
        &self,
        plan: &[u8],
        site: &Site,
        command: &[&OsStr],
    ) -> Result<(), SlurmError> {
        let fresh = self.folder.with_file_name(format!(".{}.new", self.id));
        let command = [command, &[self.folder.as_os_str()]].concat();
        let tasks =
            serde_json::to_vec(&self.tasks).map_err(|e| SlurmError::file(&self.folder, e))?;
        fs::create_dir_all(&fresh)
            .and_then(|()| fs::write(fresh.join(TASKS), tasks))
            .and_then(|()| fs::write(Self::plan(&fresh), plan))
            .and_then(|()| fs::write(fresh.join(SCRIPT), script(site, &command)))
            .and_then(|()| fs::rename(&fresh, &self.folder))
            .map_err(|e| SlurmError::file(&self.folder, e))
    }
}

/// The names of all submissions in a store, sorted, with their folders.
pub fn all(root: &Path) -> Result<Vec<(String, PathBuf)>, SlurmError> {
    let folder = root.join("slurm");
    let entries = match fs::read_dir(&folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(|e| SlurmError::file(&folder, e))?,
    };
    let mut named = Vec::new();
    for entry in entries {
        let path = entry.map_err(|e| SlurmError::file(&folder, e))?.path();
        let is_folder = match fs::metadata(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => false,
            meta => meta.map_err(|e| SlurmError::file(&path, e))?.is_dir(),
        };
        let id = path.file_name().and_then(OsStr::to_str).filter(|id| !id.starts_with('.'));
        if let Some(id) = id.filter(|_| is_folder) {
            named.push((id.to_owned(), path));
        }
    }
    named.sort();
    Ok(named)
}

/// The newest job's log of each task that a job has begun, by the task's identity.
pub fn job_logs(root: &Path) -> Result<BTreeMap<String, PathBuf>, SlurmError> {
    let mut logs = BTreeMap::new();
    // Names begin with the time: the newest comes last.
    for submission in all(root)?.iter().filter_map(|(id, _)| Submission::read(root, id)) {
        let numbered = submission
            .tasks
            .iter()
            .enumerate()
            .map(|(number, task)| (task, submission.log(number)));
        logs.extend(
            numbered
                .filter(|(_, log)| log.is_file())
                .map(|(task, log)| (task.identity.clone(), log)),
        );
    }
    Ok(logs)
}

/// One submits at a time, so that two don't submit the same. `None` where the wait was given up.
pub(crate) fn lock(root: &Path, is_stopped: &dyn Fn() -> bool) -> Result<Option<File>, SlurmError> {
    let path = root.join("slurm/lock");
    let fail = |e: io::Error| SlurmError::file(&path, e);
    fs::create_dir_all(root.join("slurm")).map_err(fail)?;
    let file = File::options().create(true).append(true).open(&path).map_err(fail)?;
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(Some(file)),
            Err(TryLockError::WouldBlock) if is_stopped() => return Ok(None),
            Err(TryLockError::WouldBlock) => std::thread::sleep(ATTEMPT_INTERVAL),
            Err(TryLockError::Error(error)) => return Err(fail(error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn task(identity: &str) -> Task {
        Task {
            stage: "prep".into(),
            label: "prep".into(),
            identity: identity.into(),
            ..Task::default()
        }
    }

    #[test]
    fn a_submission_is_read_again() {
        let root = tempfile::tempdir().unwrap();
        assert!(all(root.path()).unwrap().is_empty());
        for id in ["b", "a"] {
            let submission = Submission::new(root.path(), id, vec![task("x"), task(id)]);
            submission.write(b"{}", &Site::default(), &[OsStr::new("true")]).unwrap();
            fs::write(submission.log(1), id).unwrap();
        }
        fs::create_dir(root.path().join("slurm/.c.new")).unwrap();
        let ids: Vec<String> = all(root.path()).unwrap().into_iter().map(|(id, _)| id).collect();
        assert_eq!(ids, ["a", "b"]);
        assert_eq!(Submission::read(root.path(), "a").unwrap().tasks, [task("x"), task("a")]);
        assert!(Submission::read(root.path(), "c").is_none());
        let logs = job_logs(root.path()).unwrap();
        assert_eq!(logs.keys().collect::<Vec<_>>(), ["a", "b"], "x has none");
        assert!(logs["b"].ends_with("slurm/b/1.log"));
    }

    #[test]
    fn one_submits_at_a_time() {
        let root = tempfile::tempdir().unwrap();
        let held = lock(root.path(), &|| false).unwrap();
        assert!(held.is_some() && lock(root.path(), &|| true).unwrap().is_none());
        drop(held);
        assert!(lock(root.path(), &|| true).unwrap().is_some());
    }
}
