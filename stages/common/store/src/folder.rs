use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use artifact::unix_time;

use crate::error::{StoreError, at};

/// Artifacts by content and actions by key, in one folder.
///
/// ```text
/// objects/HASH/         an artifact: artifact.json and its files
/// actions/KEY.json      a finished action: its whole key, its output, when, where, in how long
/// actions/KEY.log       what it said
/// partial/KEY/          an action that hasn't finished: action.json, what it said, and in work/
///                       its checkpoints
/// locks/KEY             one OS lock a key: the kernel drops it, whatever happens to the process
/// runs/ID.jsonl         what a run needs, written while it goes on
/// pins/NAME.jsonl       what is kept for good
/// gate                  entered by runs for moments, closed by garbage collection
/// format                version of all this
/// ```
///
/// An object is made in `partial/`, checked, hashed, fsynced and renamed; the record goes last. So
/// what is recorded is whole.
#[derive(Debug, Clone)]
pub struct Store {
    root: PathBuf,
    /// The format that this program knows.
    pub(crate) format: u32,
}

impl Store {
    /// What lies in the folder isn't looked at.
    pub(crate) fn new(root: &Path, format: u32) -> Self {
        Self { root: root.to_path_buf(), format }
    }

    /// Where the store is.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The folder of an object.
    pub fn object(&self, identity: &str) -> PathBuf {
        self.root.join("objects").join(identity)
    }

    /// The folder of an unfinished action.
    pub fn partial(&self, key: &str) -> PathBuf {
        self.root.join("partial").join(key)
    }

    /// A file that belongs to an action: `json` its record, `log` what it said.
    pub fn action(&self, key: &str, extension: &str) -> PathBuf {
        self.root.join("actions").join(format!("{key}.{extension}"))
    }

    /// The file of the lock between runs and garbage collection, opened.
    pub(crate) fn gate(&self) -> Result<File, StoreError> {
        let path = self.gate_path();
        at(&path, File::options().create(true).append(true).open(&path))
    }

    pub(crate) fn gate_path(&self) -> PathBuf {
        self.root.join("gate")
    }

    /// What a folder of the store holds, sorted; nothing where there is no such folder.
    pub(crate) fn names(&self, folder: &str) -> Result<Vec<String>, StoreError> {
        let folder = self.root.join(folder);
        let entries = match fs::read_dir(&folder) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => at(&folder, entries)?,
        };
        let mut names = Vec::new();
        for entry in entries {
            // A name that isn't UTF-8 is somebody else's.
            names.extend(at(&folder, entry)?.file_name().into_string().ok());
        }
        names.retain(|name| !name.starts_with('.'));
        names.sort_unstable();
        Ok(names)
    }

    /// Takes a file or folder out of sight at once; [`Store::empty_trash`] deletes it.
    pub(crate) fn discard(&self, path: &Path) -> Result<(), StoreError> {
        use io::ErrorKind::{AlreadyExists, DirectoryNotEmpty};
        loop {
            let place = self.root.join("trash").join(unique_name(unix_time())?);
            match fs::rename(path, place) {
                Err(error) if matches!(error.kind(), AlreadyExists | DirectoryNotEmpty) => {}
                result => return at(path, result),
            }
        }
    }

    /// Deletes what was removed. It may take its time, and may be cut short at any point.
    pub fn empty_trash(&self) -> Result<(), StoreError> {
        for name in self.names("trash")? {
            let path = self.root.join("trash").join(name);
            // Somebody else may empty it, too.
            at(&path, remove(&path))?;
        }
        Ok(())
    }
}

/// Removes a file, a link or a folder, if there is one.
pub(crate) fn remove(path: &Path) -> io::Result<()> {
    let removed = match path.symlink_metadata() {
        Ok(metadata) if metadata.is_dir() => fs::remove_dir_all(path),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    match removed {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

/// Returns a name that sorts by time and that nobody else gives: time, process and random digits.
/// The first process of every container has the number 1.
pub(crate) fn unique_name(unix: u64) -> Result<String, StoreError> {
    let random = getrandom::u32().map_err(io::Error::from);
    let random = at(Path::new("random numbers of the system"), random)?;
    Ok(format!("{unix}-{}-{random:08x}", std::process::id()))
}
