use std::fs::{self, File};
use std::io::{self, Write as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use artifact::unix_time;
use serde::{Deserialize, Serialize};

use crate::error::{StoreError, if_found, is_lock_acquired, with_path};
use crate::folder::Store;

/// Lock on a key, held as long as this value or a process that has inherited its [`KeyLock::file`].
#[derive(Debug)]
pub struct KeyLock {
    /// The lock's file, which the stage inherits as its standard input and reads as empty. So the
    /// lock outlives a runner that is killed while its stage still writes.
    pub file: File,
}

/// Process that holds a lock, as recorded in the lock's file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holder {
    /// Id of the process.
    pub pid: u32,
    /// Name of the machine.
    pub host: String,
    /// Time at which the lock was acquired, in seconds since 1970.
    pub since_unix: u64,
}

impl Holder {
    /// Returns this process with the current time.
    pub fn this_process() -> Self {
        Self { pid: std::process::id(), host: host_name(), since_unix: unix_time() }
    }
}

/// Returns the name of this machine; empty if unknown.
pub fn host_name() -> String {
    fs::read_to_string("/proc/sys/kernel/hostname").map(|h| h.trim().to_owned()).unwrap_or_default()
}

/// Result of an attempt to acquire a lock.
#[derive(Debug)]
pub enum Locked<T> {
    /// The lock is acquired.
    Acquired(T),
    /// Another process holds the lock; `None` if the process is unknown.
    HeldBy(Option<Holder>),
}

/// Shared lock of the store: while it exists, no garbage is collected. A runner holds it briefly,
/// to find an artifact and record that it needs the artifact, or to publish one.
#[derive(Debug)]
pub struct Entered {
    /// `None` for a store on a read-only file system, where no garbage is collected.
    _file: Option<File>,
}

/// Exclusive lock of the store: while it exists, no process enters, so that garbage is
/// distinguishable from artifacts that a run has just created.
#[derive(Debug)]
pub struct Closed {
    _file: File,
}

impl Store {
    /// Tries to acquire the lock of a key. The caller must look for the record again afterwards,
    /// since the previous holder may have written it.
    pub fn try_lock(&self, key: &str) -> Result<Locked<KeyLock>, StoreError> {
        let path = self.lock_path(key);
        loop {
            let mut file =
                with_path(&path, File::options().create(true).read(true).append(true).open(&path))?;
            if !is_lock_acquired(&path, file.try_lock())? {
                return Ok(Locked::HeldBy(read_holder(&path)));
            }
            // If garbage collection has removed the file between opening and locking, the lock is
            // that of another file.
            if is_file_at(&file, &path) {
                write_holder(&mut file);
                return Ok(Locked::Acquired(KeyLock { file }));
            }
        }
    }

    /// Returns the keys whose locks are held, sorted.
    pub fn locked_keys(&self) -> Result<Vec<String>, StoreError> {
        let mut locked = Vec::new();
        for key in self.lock_files()? {
            if is_locked(&self.lock_path(&key))? {
                locked.push(key);
            }
        }
        Ok(locked)
    }

    /// Returns the keys that have a lock file, held or not, sorted.
    pub fn lock_files(&self) -> Result<Vec<String>, StoreError> {
        self.list_names("locks")
    }

    /// Removes the lock file of a key unless the lock is held.
    pub fn remove_lock(&self, key: &str) -> Result<(), StoreError> {
        if let Locked::Acquired(lock) = self.try_lock(key)? {
            let path = self.lock_path(key);
            with_path(&path, fs::remove_file(&path))?;
            drop(lock);
        }
        Ok(())
    }

    fn lock_path(&self, key: &str) -> PathBuf {
        self.root().join("locks").join(key)
    }

    /// Tries to enter the store. Fails if a newer program has marked the store.
    pub fn try_enter(&self) -> Result<Locked<Entered>, StoreError> {
        use io::ErrorKind::{PermissionDenied, ReadOnlyFilesystem};
        let path = self.gate_path();
        let file = match self.open_gate() {
            Err(StoreError::Io { source, .. }) if source.kind() == ReadOnlyFilesystem => {
                return Ok(Locked::Acquired(Entered { _file: None }));
            }
            // A user who may only read the store excludes garbage collection, too.
            Err(StoreError::Io { source, .. }) if source.kind() == PermissionDenied => {
                with_path(&path, File::open(&path))?
            }
            file => file?,
        };
        if !is_lock_acquired(&path, file.try_lock_shared())? {
            return Ok(Locked::HeldBy(read_holder(&path)));
        }
        self.check_format()?;
        Ok(Locked::Acquired(Entered { _file: Some(file) }))
    }

    /// Tries to close the store. Fails if a newer program has marked the store.
    pub fn try_close(&self) -> Result<Locked<Closed>, StoreError> {
        let mut file = self.open_gate()?;
        if !is_lock_acquired(&self.gate_path(), file.try_lock())? {
            return Ok(Locked::HeldBy(None));
        }
        self.check_format()?;
        write_holder(&mut file);
        Ok(Locked::Acquired(Closed { _file: file }))
    }
}

/// Returns whether the lock of a file is held; false if the file is not found.
pub(crate) fn is_locked(path: &Path) -> Result<bool, StoreError> {
    let Some(file) = if_found(path, File::open(path))? else { return Ok(false) };
    Ok(!is_lock_acquired(path, file.try_lock_shared())?)
}

fn read_holder(path: &Path) -> Option<Holder> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

/// Writes this process to a lock file. The lock is valid even if that fails.
fn write_holder(file: &mut File) {
    let text = serde_json::to_string(&Holder::this_process()).unwrap_or_default();
    file.set_len(0).and_then(|()| file.write_all(text.as_bytes())).ok();
}

/// Returns whether an open file is the file at `path`.
fn is_file_at(file: &File, path: &Path) -> bool {
    match (file.metadata(), fs::metadata(path)) {
        (Ok(open), Ok(named)) => open.dev() == named.dev() && open.ino() == named.ino(),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::UNREADABLE;

    fn store() -> (tempfile::TempDir, Store) {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        (dir, store)
    }

    fn acquired<T>(locked: Locked<T>) -> T {
        match locked {
            Locked::Acquired(lock) => lock,
            Locked::HeldBy(holder) => panic!("held by {holder:?}"),
        }
    }

    #[test]
    fn a_lock_is_exclusive_and_dropped_with_its_last_owner() {
        let (_dir, store) = store();
        let lock = acquired(store.try_lock("k").unwrap());
        let shared = lock.file.try_clone().unwrap();
        let Locked::HeldBy(Some(holder)) = store.try_lock("k").unwrap() else { panic!("not held") };
        assert_eq!((holder.pid, holder.host), (std::process::id(), host_name()));
        drop(lock);
        assert!(
            matches!(store.try_lock("k").unwrap(), Locked::HeldBy(Some(_))),
            "the stage still holds the lock"
        );
        drop(shared);
        acquired(store.try_lock("k").unwrap());
    }

    /// The stage's standard input reads as empty, although the lock's file has content.
    #[test]
    fn a_shared_lock_reads_as_empty() {
        let (_dir, store) = store();
        for _ in 0..2 {
            let lock = acquired(store.try_lock("k").unwrap());
            let mut text = String::new();
            io::Read::read_to_string(&mut &lock.file, &mut text).unwrap();
            assert_eq!(text, "");
        }
    }

    #[test]
    fn a_lock_file_in_use_is_not_removed() {
        let (dir, store) = store();
        let lock = acquired(store.try_lock("k").unwrap());
        store.remove_lock("k").unwrap();
        assert!(dir.path().join("locks/k").exists());
        drop(lock);
        store.remove_lock("k").unwrap();
        assert!(!dir.path().join("locks/k").exists());
    }

    /// A lock whose file can't be read may be held.
    #[test]
    fn unreadable_locks_are_errors() {
        let (dir, store) = store();
        drop(acquired(store.try_lock("k").unwrap()));
        assert!(store.locked_keys().unwrap().is_empty());
        let [_, replace_by_loop] = UNREADABLE;
        replace_by_loop(&dir.path().join("locks/k"));
        let message = store.locked_keys().unwrap_err().to_string();
        assert!(message.contains("locks/k: "), "{message}");
    }

    #[test]
    fn nobody_enters_a_closed_store() {
        let (_dir, store) = store();
        let (first, second) =
            (acquired(store.try_enter().unwrap()), acquired(store.try_enter().unwrap()));
        assert!(matches!(store.try_close().unwrap(), Locked::HeldBy(None)));
        drop((first, second));
        let closed = acquired(store.try_close().unwrap());
        assert!(matches!(store.try_enter().unwrap(), Locked::HeldBy(Some(_))));
        drop(closed);
        acquired(store.try_enter().unwrap());
    }
}
