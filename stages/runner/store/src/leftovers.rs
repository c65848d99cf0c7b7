use std::fs;

use crate::error::{StoreError, if_found, with_path};
use crate::folder::{Store, remove_if_found};
use crate::lock::Closed;

/// Folders whose files are written under a temporary name first, relative to the store.
const FOLDERS: [&str; 5] = ["", "actions", "cache", "cache/sources", "pins"];

impl Store {
    /// Returns the keys of finished actions whose folder in `partial/` remains, sorted: their
    /// runners were killed right after writing the record.
    pub fn leftover_partials(&self) -> Result<Vec<String>, StoreError> {
        let locked = self.locked_keys()?;
        let mut finished = Vec::new();
        for key in self.partials()? {
            if !locked.contains(&key) && self.hit(&key)?.is_some() {
                finished.push(key);
            }
        }
        Ok(finished)
    }

    /// Removes the temporary files of killed processes. Records, pins and the file `format` are
    /// written only under the lock [`Entered`](crate::Entered), which `Closed` excludes. Temporary
    /// files of `cache` may belong to a live process; a cache file that is lost is created again.
    pub fn remove_leftovers(&self, _: &Closed) -> Result<(), StoreError> {
        for folder in FOLDERS {
            let folder = self.root().join(folder);
            for entry in if_found(&folder, fs::read_dir(&folder))?.into_iter().flatten() {
                let entry = with_path(&folder, entry)?;
                if entry.file_name().to_str().is_some_and(is_temporary) {
                    remove_if_found(&entry.path())?;
                }
            }
        }
        Ok(())
    }
}

/// Returns whether a name is a temporary one of [`artifact::write_atomically`].
fn is_temporary(name: &str) -> bool {
    name.starts_with('.') && name.ends_with(".partial")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lock::Locked;
    use crate::testing::{begin, finish_action};

    #[test]
    fn temporary_files_of_killed_writers_are_removed() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let done = finish_action(&store, "a", "1234");
        for folder in FOLDERS {
            fs::create_dir_all(dir.path().join(folder)).unwrap();
            fs::write(dir.path().join(folder).join(".aB3xYz.partial"), "half").unwrap();
            fs::write(dir.path().join(folder).join("notes"), "mine").unwrap();
        }
        let key = done.key();
        fs::create_dir_all(store.partial(&key).join("work")).unwrap();
        begin(&store, "unfinished", None);
        let Locked::Acquired(closed) = store.try_close().unwrap() else { panic!("in use") };
        store.remove_leftovers(&closed).unwrap();
        for folder in FOLDERS {
            assert!(!dir.path().join(folder).join(".aB3xYz.partial").exists(), "{folder}");
            assert!(dir.path().join(folder).join("notes").exists(), "{folder}");
        }
        assert_eq!(store.hit(&key).unwrap(), Some(done));
        assert_eq!(store.leftover_partials().unwrap(), [key]);
    }
}
