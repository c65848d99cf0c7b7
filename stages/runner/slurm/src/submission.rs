use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::SlurmError;
use crate::resources::Resources;
use crate::site::Site;
use crate::submit::SubmitOptions;

/// A task for a job.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Task {
    /// Name of the stage.
    pub stage: String,
    /// Human-readable label, used as the job's name.
    pub label: String,
    /// Identity of the task: equal identities in two submissions mean the same task.
    pub identity: String,
    /// Indices of the tasks that must be done first. All are smaller than this task's index.
    pub parents: Vec<usize>,
    /// Resources that the job requests.
    #[serde(default, skip_serializing_if = "Resources::is_empty")]
    pub resources: Resources,
}

/// Tasks submitted together: the folder `slurm/ID` of a store.
///
/// ```text
/// slurm/ID/tasks.json   the tasks, in order of their numbers
/// slurm/ID/plan.json    the caller's data for the jobs' command
/// slurm/ID/job.sh       the script of every job; its argument is the task's number
/// slurm/ID/N.log        output of task N's job
/// slurm/lock            locked while a process submits
/// ```
#[derive(Debug)]
pub struct Submission {
    /// Name of the folder.
    pub id: String,
    /// Tasks, each after its parents.
    pub tasks: Vec<Task>,
    folder: PathBuf,
}

const TASKS: &str = "tasks.json";
const SCRIPT: &str = "job.sh";

impl Submission {
    /// Creates a submission in memory; [`Self::submit`] writes its folder.
    pub fn new(root: &Path, id: &str, tasks: Vec<Task>) -> Self {
        Self { id: id.to_owned(), tasks, folder: root.join("slurm").join(id) }
    }

    /// Reads a submission; `None` if its tasks can't be read.
    pub fn read(root: &Path, id: &str) -> Option<Self> {
        let empty = Self::new(root, id, Vec::new());
        let tasks = serde_json::from_slice(&fs::read(empty.folder.join(TASKS)).ok()?).ok()?;
        Some(Self { tasks, ..empty })
    }

    /// Returns the path of the command's data in a submission's folder.
    pub fn plan_path(folder: &Path) -> PathBuf {
        folder.join("plan.json")
    }

    /// Returns the path of the log of a task's job.
    pub fn log_path(&self, number: usize) -> PathBuf {
        self.folder.join(format!("{number}.log"))
    }

    pub(crate) fn script_path(&self) -> PathBuf {
        self.folder.join(SCRIPT)
    }

    /// Writes the folder, whole or not at all. The script calls the command with the folder and
    /// a task's number.
    pub(crate) fn write(&self, options: &SubmitOptions<'_>) -> Result<(), SlurmError> {
        let SubmitOptions { plan, site, command, .. } = options;
        let partial = self.folder.with_file_name(format!(".{}.new", self.id));
        let command = [*command, &[self.folder.as_os_str()]].concat();
        let tasks =
            serde_json::to_vec(&self.tasks).map_err(|e| SlurmError::file(&self.folder, e))?;
        fs::create_dir_all(&partial)
            .and_then(|()| fs::write(partial.join(TASKS), tasks))
            .and_then(|()| fs::write(Self::plan_path(&partial), plan))
            .and_then(|()| fs::write(partial.join(SCRIPT), script(site, &command)))
            .and_then(|()| fs::rename(&partial, &self.folder))
            .map_err(|e| SlurmError::file(&self.folder, e))
    }
}

/// Lists the IDs and folders of a store's submissions, oldest first.
pub fn list_submissions(root: &Path) -> Result<Vec<(String, PathBuf)>, SlurmError> {
    let folder = root.join("slurm");
    let entries = match fs::read_dir(&folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(|e| SlurmError::file(&folder, e))?,
    };
    let mut submissions = Vec::new();
    for entry in entries {
        let path = entry.map_err(|e| SlurmError::file(&folder, e))?.path();
        let is_folder = match fs::metadata(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => false,
            meta => meta.map_err(|e| SlurmError::file(&path, e))?.is_dir(),
        };
        let id = path.file_name().and_then(OsStr::to_str).filter(|id| !id.starts_with('.'));
        if let Some(id) = id.filter(|_| is_folder) {
            submissions.push((id.to_owned(), path));
        }
    }
    // IDs begin with the time of submission.
    submissions.sort();
    Ok(submissions)
}

/// Finds the newest log of each task whose job has started, by the task's identity.
pub fn newest_logs(root: &Path) -> Result<BTreeMap<String, PathBuf>, SlurmError> {
    let mut logs = BTreeMap::new();
    for (id, _) in list_submissions(root)? {
        let Some(submission) = Submission::read(root, &id) else { continue };
        for (number, task) in submission.tasks.iter().enumerate() {
            let log = submission.log_path(number);
            if log.is_file() {
                logs.insert(task.identity.clone(), log);
            }
        }
    }
    Ok(logs)
}

/// Returns the path of the file that a process locks while it submits, so that two processes don't
/// submit the same task.
pub fn lock_path(root: &Path) -> PathBuf {
    root.join("slurm/lock")
}

/// Returns the script: the site's set-up lines, then `exec` of the command, so that Slurm's signals
/// reach the command.
fn script(site: &Site, command: &[&OsStr]) -> Vec<u8> {
    let mut text =
        b"#!/bin/bash\n# Runs one task of a submission; $1 is its index.\nset -e\n".to_vec();
    for line in &site.setup {
        text.extend_from_slice(line.as_bytes());
        text.push(b'\n');
    }
    text.extend_from_slice(b"exec");
    for word in command {
        text.push(b' ');
        text.extend(shell_quoted(word.as_encoded_bytes()));
    }
    text.extend_from_slice(b" \"$1\"\n");
    text
}

/// Returns a word in single quotes for a POSIX shell.
fn shell_quoted(word: &[u8]) -> Vec<u8> {
    let parts: Vec<&[u8]> = word.split(|&byte| byte == b'\'').collect();
    [b"'", &parts.join(&br"'\''"[..])[..], b"'"].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::Slurm;
    use std::process::Command;

    fn task(identity: &str) -> Task {
        Task {
            stage: "prep".into(),
            label: "prep".into(),
            identity: identity.into(),
            ..Task::default()
        }
    }

    #[test]
    fn submissions_are_read_back() {
        let root = tempfile::tempdir().unwrap();
        assert!(list_submissions(root.path()).unwrap().is_empty());
        let options = SubmitOptions {
            slurm: &Slurm::default(),
            site: &Site::default(),
            command: &[OsStr::new("true")],
            plan: b"{}",
            working_folder: Path::new("/work"),
            is_stopped: &|| false,
        };
        for id in ["b", "a"] {
            let submission = Submission::new(root.path(), id, vec![task("x"), task(id)]);
            submission.write(&options).unwrap();
            fs::write(submission.log_path(1), id).unwrap();
        }
        fs::create_dir(root.path().join("slurm/.c.new")).unwrap();
        let ids: Vec<String> =
            list_submissions(root.path()).unwrap().into_iter().map(|(id, _)| id).collect();
        assert_eq!(ids, ["a", "b"]);
        assert_eq!(Submission::read(root.path(), "a").unwrap().tasks, [task("x"), task("a")]);
        assert!(Submission::read(root.path(), "c").is_none());
        let logs = newest_logs(root.path()).unwrap();
        assert_eq!(logs.keys().collect::<Vec<_>>(), ["a", "b"], "x has no log");
        assert!(logs["b"].ends_with("slurm/b/1.log"));
    }

    /// The shell itself prints the arguments that it read.
    #[test]
    fn a_shell_passes_on_equal_arguments() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("job.sh");
        let site = Site { setup: vec!["export GREETING='good day'".to_owned()], ..Site::default() };
        let awkward = "a b'c\"$HOME`x`\\*";
        let print = "printf '[%s]' \"$GREETING\" \"$@\"";
        let arguments = ["sh", "-c", print, "sh", awkward].map(OsStr::new);
        std::fs::write(&path, script(&site, &arguments)).unwrap();
        let output = Command::new("bash").arg(&path).arg("17").output().unwrap();
        assert_eq!(String::from_utf8_lossy(&output.stdout), format!("[good day][{awkward}][17]"));
        let failing = Site { setup: vec!["false".to_owned()], ..Site::default() };
        std::fs::write(&path, script(&failing, &[OsStr::new("true")])).unwrap();
        assert!(
            !Command::new("bash").arg(&path).status().unwrap().success(),
            "a set-up line that fails must end the job"
        );
    }
}
