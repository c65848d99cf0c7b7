use std::fs::{self, File};
use std::io::{self, Write as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use artifact::unix_time;
use serde::{Deserialize, Serialize};

use crate::error::{StoreError, at, is_taken};
use crate::folder::Store;

/// The lock on a key; held while it, or a process that was handed its [`KeyLock::file`], lives.
#[derive(Debug)]
pub struct KeyLock {
    file: File,
}

impl KeyLock {
    /// The lock's file, to be handed to the stage as its standard input, which reads as empty. So
    /// the lock outlives a runner that is killed while its stage still writes.
    pub fn file(&self) -> &File {
        &self.file
    }
}

/// Who took a lock: the content of its file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Holder {
    /// The runner's process.
    pub pid: u32,
    /// The machine it runs on.
    pub host: String,
    /// When it took the lock, seconds since 1970.
    pub since_unix: u64,
}

impl Holder {
    /// This process, now.
    pub fn this_process() -> Self {
        Self { pid: std::process::id(), host: host_name(), since_unix: unix_time() }
    }
}

/// This machine's name; empty where the system doesn't say.
pub fn host_name() -> String {
    fs::read_to_string("/proc/sys/kernel/hostname").map(|h| h.trim().to_owned()).unwrap_or_default()
}

/// What an attempt at a lock came to.
#[derive(Debug)]
pub enum Locked<T> {
    /// It is held now.
    Held(T),
    /// Somebody else holds it, as far as is known this one.
    By(Option<Holder>),
}

/// The store is entered: no garbage is collected while this lives. A runner enters for the moments
/// in which it looks for an artifact and writes down that it needs it, or takes an artifact in.
#[derive(Debug)]
pub struct Entered {
    /// None in a store that can't be written: nobody collects garbage there.
    _file: Option<File>,
}

/// The store is closed: nobody enters while this lives, so that garbage can be told from what a run
/// has just made.
#[derive(Debug)]
pub struct Closed {
    _file: File,
}

impl Store {
    /// Takes the lock of a key unless somebody holds it. Take it, look for the record again, then
    /// act.
    pub fn try_lock(&self, key: &str) -> Result<Locked<KeyLock>, StoreError> {
        let path = self.lock_path(key);
        loop {
            let mut file =
                at(&path, File::options().create(true).read(true).append(true).open(&path))?;
            if !is_taken(&path, file.try_lock())? {
                return Ok(Locked::By(holder_in(&path)));
            }
            // Garbage collection may have removed the file between opening and locking: then the
            // lock is another file's.
            if is_at(&file, &path) {
                let text = serde_json::to_string(&Holder::this_process()).unwrap_or_default();
                // Who holds it is for people; the lock is held either way.
                file.set_len(0).and_then(|()| file.write_all(text.as_bytes())).ok();
                return Ok(Locked::Held(KeyLock { file }));
            }
        }
    }

    /// Keys whose locks somebody holds, sorted.
    pub fn locked_keys(&self) -> Result<Vec<String>, StoreError> {
        let mut locked = Vec::new();
        for key in self.lock_files()? {
            if is_locked(&self.lock_path(&key))? {
                locked.push(key);
            }
        }
        Ok(locked)
    }

    /// Keys that have a lock's file, held or not, sorted.
    pub fn lock_files(&self) -> Result<Vec<String>, StoreError> {
        self.names("locks")
    }

    /// Removes a key's lock file unless somebody holds the lock.
    pub fn remove_lock(&self, key: &str) -> Result<(), StoreError> {
        if let Locked::Held(lock) = self.try_lock(key)? {
            let path = self.lock_path(key);
            at(&path, fs::remove_file(&path))?;
            drop(lock);
        }
        Ok(())
    }

    fn lock_path(&self, key: &str) -> PathBuf {
        self.root().join("locks").join(key)
    }

    /// Enters the store unless it is closed, or a newer program has marked it meanwhile.
    pub fn try_enter(&self) -> Result<Locked<Entered>, StoreError> {
        let path = self.gate_path();
        let file = match self.gate() {
            Err(StoreError::Io { source, .. })
                if source.kind() == io::ErrorKind::ReadOnlyFilesystem =>
            {
                return Ok(Locked::Held(Entered { _file: None }));
            }
            // Who may only read the store keeps garbage collection away, too.
            Err(StoreError::Io { source, .. })
                if source.kind() == io::ErrorKind::PermissionDenied =>
            {
                at(&path, File::open(&path))?
            }
            file => file?,
        };
        if !is_taken(&path, file.try_lock_shared())? {
            return Ok(Locked::By(holder_in(&path)));
        }
        self.check_format()?;
        Ok(Locked::Held(Entered { _file: Some(file) }))
    }

    /// Closes the store unless somebody is inside, or a newer program has marked it meanwhile.
    pub fn try_close(&self) -> Result<Locked<Closed>, StoreError> {
        let mut file = self.gate()?;
        if !is_taken(&self.gate_path(), file.try_lock())? {
            return Ok(Locked::By(None));
        }
        self.check_format()?;
        let text = serde_json::to_string(&Holder::this_process()).unwrap_or_default();
        file.set_len(0).and_then(|()| file.write_all(text.as_bytes())).ok();
        Ok(Locked::Held(Closed { _file: file }))
    }
}

/// Returns whether somebody holds the lock of a file; nobody does if the file is not found.
pub(crate) fn is_locked(path: &Path) -> Result<bool, StoreError> {
    let file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        file => at(path, file)?,
    };
    Ok(!is_taken(path, file.try_lock_shared())?)
}

fn holder_in(path: &Path) -> Option<Holder> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

/// Whether an open file is the one that its path names now.
fn is_at(file: &File, path: &Path) -> bool {
    let identity = |meta: fs::Metadata| (meta.dev(), meta.ino());
    file.metadata()
        .map(identity)
        .ok()
        .is_some_and(|open| fs::metadata(path).map(identity).is_ok_and(|named| named == open))
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

    fn held<T>(locked: Locked<T>) -> T {
        match locked {
            Locked::Held(lock) => lock,
            Locked::By(holder) => panic!("held by {holder:?}"),
        }
    }

    #[test]
    fn a_lock_is_exclusive_and_dropped_with_its_last_owner() {
        let (_dir, store) = store();
        let lock = held(store.try_lock("k").unwrap());
        let shared = lock.file().try_clone().unwrap();
        let Locked::By(Some(holder)) = store.try_lock("k").unwrap() else { panic!("not held") };
        assert_eq!((holder.pid, holder.host), (std::process::id(), host_name()));
        drop(lock);
        assert!(
            matches!(store.try_lock("k").unwrap(), Locked::By(Some(_))),
            "the stage still holds it"
        );
        drop(shared);
        held(store.try_lock("k").unwrap());
    }

    /// The stage's standard input reads as empty, whatever the lock's file says.
    #[test]
    fn a_shared_lock_reads_as_empty() {
        let (_dir, store) = store();
        for _ in 0..2 {
            let lock = held(store.try_lock("k").unwrap());
            let mut text = String::new();
            io::Read::read_to_string(&mut lock.file(), &mut text).unwrap();
            assert_eq!(text, "");
        }
    }

    #[test]
    fn a_lock_file_in_use_is_not_removed() {
        let (dir, store) = store();
        let lock = held(store.try_lock("k").unwrap());
        store.remove_lock("k").unwrap();
        assert!(dir.path().join("locks/k").exists());
        drop(lock);
        store.remove_lock("k").unwrap();
        assert!(!dir.path().join("locks/k").exists());
    }

    /// A lock's file that can't be read may be held.
    #[test]
    fn unreadable_locks_are_errors() {
        let (dir, store) = store();
        drop(held(store.try_lock("k").unwrap()));
        assert!(store.locked_keys().unwrap().is_empty());
        let [_, loops] = UNREADABLE;
        loops(&dir.path().join("locks/k"));
        let said = store.locked_keys().unwrap_err().to_string();
        assert!(said.contains("locks/k: "), "{said}");
    }

    #[test]
    fn nobody_enters_a_closed_store() {
        let (_dir, store) = store();
        let (one, two) = (held(store.try_enter().unwrap()), held(store.try_enter().unwrap()));
        assert!(matches!(store.try_close().unwrap(), Locked::By(None)));
        drop((one, two));
        let closed = held(store.try_close().unwrap());
        assert!(matches!(store.try_enter().unwrap(), Locked::By(Some(_))));
        drop(closed);
        held(store.try_enter().unwrap());
    }
}
