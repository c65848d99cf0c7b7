use std::fs;
use std::io;

use crate::error::{StoreError, at};
use crate::folder::{Store, remove};
use crate::lock::Closed;

/// Folders of the store whose files are written under a temporary name first; the store's own
/// folder is the first.
const FOLDERS: [&str; 5] = ["", "actions", "cache", "cache/sources", "pins"];

impl Store {
    /// Finished actions whose folders of work are still there, sorted: their runners were killed
    /// right after they had written the record.
    pub fn finished_partials(&self) -> Result<Vec<String>, StoreError> {
        let locked = self.locked_keys()?;
        let mut finished = Vec::new();
        for key in self.partials()? {
            if !locked.contains(&key) && self.hit(&key)?.is_some() {
                finished.push(key);
            }
        }
        Ok(finished)
    }

    /// Removes the temporary files of writers that were killed. Whoever writes records, pins or the
    /// format has entered the store, so none of them is at work now. A file of `cache` that is lost
    /// is written again.
    pub fn remove_leftovers(&self, _: &Closed) -> Result<(), StoreError> {
        for folder in FOLDERS {
            let folder = self.root().join(folder);
            let entries = match fs::read_dir(&folder) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                entries => at(&folder, entries)?,
            };
            for entry in entries {
                let entry = at(&folder, entry)?;
                if entry.file_name().to_str().is_some_and(is_temporary) {
                    at(&entry.path(), remove(&entry.path()))?;
                }
            }
        }
        Ok(())
    }
}

/// Returns whether [`artifact::write_atomically`] gives such names.
fn is_temporary(name: &str) -> bool {
    name.starts_with('.') && name.ends_with(".partial")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lock::Locked;
    use crate::testing::{begin, make};

    #[test]
    fn temporary_files_of_killed_writers_go() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let done = make(&store, "a", "1234");
        for folder in FOLDERS {
            fs::create_dir_all(dir.path().join(folder)).unwrap();
            fs::write(dir.path().join(folder).join(".aB3xYz.partial"), "half").unwrap();
            fs::write(dir.path().join(folder).join("notes"), "mine").unwrap();
        }
        let key = done.key();
        fs::create_dir_all(store.partial(&key).join("work")).unwrap();
        begin(&store, "unfinished", None);
        let Locked::Held(closed) = store.try_close().unwrap() else { panic!("somebody is in") };
        store.remove_leftovers(&closed).unwrap();
        for folder in FOLDERS {
            assert!(!dir.path().join(folder).join(".aB3xYz.partial").exists(), "{folder}");
            assert!(dir.path().join(folder).join("notes").exists(), "{folder}");
        }
        assert_eq!(store.hit(&key).unwrap(), Some(done));
        assert_eq!(store.finished_partials().unwrap(), [key]);
    }
}
