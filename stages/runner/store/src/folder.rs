use std::fs::{self, File};
use std::io;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use artifact::unix_time;

use crate::error::{StoreError, if_found, with_path};

/// Store of artifacts by content and of actions by key, in one folder.
///
/// ```text
/// objects/HASH/         an artifact: artifact.json and its files
/// actions/KEY.json      record of a finished action: key, output, time, machine, duration
/// actions/KEY.log       log of a finished action
/// partial/KEY/          an unfinished action: action.json, log, and checkpoints in work/
/// locks/KEY             one OS lock per key, which the kernel releases when the process ends
/// runs/ID.jsonl         actions that a run needs, written during the run
/// pins/NAME.jsonl       actions that are kept until unpinned
/// gate                  reader-writer lock: runs hold it briefly as readers, garbage collection
///                       as the writer
/// sinks/ID/             temporary files of a run's sinks and of `run --watch`
/// slurm/ID/             tasks that a run submitted to a cluster
/// cache/                programs' descriptions, and hashes of input folders outside the store
/// trash/                files and folders that are about to be deleted
/// format                version of this layout
/// ```
///
/// An object is created in `partial/`, checked, hashed, fsynced and renamed, and its record is
/// written last. So a record's object is complete.
#[derive(Debug, Clone)]
pub struct Store {
    root: PathBuf,
    /// Format that this program supports.
    pub(crate) format: u32,
}

impl Store {
    /// Creates the value without reading the folder.
    pub(crate) fn new(root: &Path, format: u32) -> Self {
        Self { root: root.to_path_buf(), format }
    }

    /// Returns the folder of the store.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Returns the folder of an object.
    pub fn object(&self, identity: &str) -> PathBuf {
        self.root.join("objects").join(identity)
    }

    /// Returns the folder of an unfinished action.
    pub fn partial(&self, key: &str) -> PathBuf {
        self.root.join("partial").join(key)
    }

    /// Returns the path of an action's record (`json`) or log (`log`).
    pub fn action(&self, key: &str, extension: &str) -> PathBuf {
        self.root.join("actions").join(format!("{key}.{extension}"))
    }

    /// Opens the file of the lock between runs and garbage collection.
    pub(crate) fn open_gate(&self) -> Result<File, StoreError> {
        let path = self.gate_path();
        with_path(&path, File::options().create(true).append(true).open(&path))
    }

    pub(crate) fn gate_path(&self) -> PathBuf {
        self.root.join("gate")
    }

    /// Lists the names in a folder of the store, sorted and without hidden ones; empty if the
    /// folder is not found.
    pub(crate) fn list_names(&self, folder: &str) -> Result<Vec<String>, StoreError> {
        let folder = self.root.join(folder);
        let mut names = Vec::new();
        for entry in if_found(&folder, fs::read_dir(&folder))?.into_iter().flatten() {
            // A name that isn't UTF-8 doesn't belong to the store.
            names.extend(with_path(&folder, entry)?.file_name().into_string().ok());
        }
        names.retain(|name| !name.starts_with('.'));
        names.sort_unstable();
        Ok(names)
    }

    /// Moves a file or folder to the trash, which [`Store::empty_trash`] deletes; returns whether
    /// it existed.
    pub(crate) fn move_to_trash(&self, path: &Path) -> Result<bool, StoreError> {
        use io::ErrorKind::{AlreadyExists, CrossesDevices, DirectoryNotEmpty, PermissionDenied};
        loop {
            let trashed = self.root.join("trash").join(unique_name(unix_time())?);
            let moved = match fs::rename(path, &trashed) {
                Err(error) if error.kind() == PermissionDenied => {
                    make_writable(path).ok();
                    fs::rename(path, &trashed)
                }
                // Overlay file systems move no folder of a lower layer.
                Err(error) if error.kind() == CrossesDevices => {
                    return remove_if_found(path).map(|()| true);
                }
                moved => moved,
            };
            match moved {
                Err(error) if matches!(error.kind(), AlreadyExists | DirectoryNotEmpty) => {}
                result => return Ok(if_found(path, result)?.is_some()),
            }
        }
    }

    /// Deletes the content of the trash, and returns the first error at the end. Several processes
    /// may do so, and may be killed meanwhile.
    pub fn empty_trash(&self) -> Result<(), StoreError> {
        let trash = self.root.join("trash");
        let names = self.list_names("trash")?.into_iter();
        names.map(|name| remove_if_found(&trash.join(name))).fold(Ok(()), Result::and)
    }
}

/// Removes a file, a link or a folder, if it exists.
pub(crate) fn remove_if_found(path: &Path) -> Result<(), StoreError> {
    let removed = match path.symlink_metadata() {
        Ok(metadata) if metadata.is_dir() => fs::remove_dir_all(path).or_else(|error| {
            if error.kind() != io::ErrorKind::PermissionDenied {
                return Err(error);
            }
            make_writable(path).ok();
            fs::remove_dir_all(path)
        }),
        Ok(_) => fs::remove_file(path),
        Err(error) => Err(error),
    };
    if_found(path, removed).map(|_| ())
}

/// Gives the owner all permissions on a folder and its subfolders, without which no folder can be
/// moved or deleted. A stage may have removed the permissions. Files stay unchanged.
pub(crate) fn make_writable(path: &Path) -> io::Result<()> {
    let metadata = path.symlink_metadata()?;
    if !metadata.is_dir() {
        return Ok(());
    }
    let mode = metadata.permissions().mode();
    if mode & 0o700 != 0o700 {
        fs::set_permissions(path, fs::Permissions::from_mode(mode | 0o700))?;
    }
    fs::read_dir(path)?.try_for_each(|entry| make_writable(&entry?.path()))
}

/// Returns a unique name that sorts by time: time, process id and random digits. The digits matter,
/// since the first process of every container has the id 1.
pub(crate) fn unique_name(unix: u64) -> Result<String, StoreError> {
    let random = getrandom::u32().map_err(io::Error::from);
    let random = with_path(Path::new("random numbers of the system"), random)?;
    Ok(format!("{unix}-{}-{random:08x}", std::process::id()))
}
