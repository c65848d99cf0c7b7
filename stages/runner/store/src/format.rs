use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use artifact::write_atomically;

use crate::error::{StoreError, if_found, lock_error, with_path};
use crate::folder::Store;

/// Version of the store's layout; increases if an older runner could damage a newer one's files.
pub const FORMAT: u32 = 1;

impl Store {
    /// Opens the store in a folder, which is created if necessary. An older store is marked with
    /// this program's format. After that, older runners, including those in progress, don't change
    /// the store.
    pub fn open(root: &Path) -> Result<Self, StoreError> {
        Self::open_as(root, FORMAT)
    }

    /// Opens the store like a program that supports `format`.
    fn open_as(root: &Path, format: u32) -> Result<Self, StoreError> {
        with_path(root, fs::create_dir_all(root))?;
        let store = Self::new(root, format);
        if store.check_format()?.is_none_or(|found| found < format) {
            store.mark_format()?;
        }
        for folder in
            ["objects", "actions", "partial", "locks", "cache", "runs", "pins", "sinks", "trash"]
        {
            let path = root.join(folder);
            match fs::create_dir_all(&path) {
                // An old store on a read-only file system can still be read.
                Err(error) if error.kind() == io::ErrorKind::ReadOnlyFilesystem => {}
                result => with_path(&path, result)?,
            }
        }
        store.check_file_systems()?;
        Ok(store)
    }

    /// Fails if folders between which files are moved are on different file systems.
    fn check_file_systems(&self) -> Result<(), StoreError> {
        let mut first = None;
        for folder in ["partial", "objects", "actions", "trash"] {
            let path = self.root().join(folder);
            let Some(device) = if_found(&path, path.metadata())?.map(|meta| meta.dev()) else {
                continue;
            };
            let &mut (other, expected) = first.get_or_insert((folder, device));
            if device != expected {
                return Err(StoreError::Unsupported(format!(
                    "{}: {other} and {folder} are on different file systems; move the whole store \
                    to one of them, and give its folder with --store",
                    self.root().display()
                )));
            }
        }
        Ok(())
    }

    /// Reads the store's format; `None` for an unmarked store. Fails for a newer format.
    pub(crate) fn check_format(&self) -> Result<Option<u32>, StoreError> {
        let path = self.root().join("format");
        let Some(text) = if_found(&path, fs::read_to_string(&path))? else { return Ok(None) };
        match text.trim().parse::<u32>() {
            Ok(found) if found <= self.format => Ok(Some(found)),
            _ => Err(StoreError::Unsupported(format!(
                "{}: the store has format {}, this nerf-sr supports format {}; use the newer \
                nerf-sr, or another folder with --store",
                self.root().display(),
                text.trim().chars().take(20).collect::<String>(),
                self.format
            ))),
        }
    }

    /// Marks the store with this program's format, except on a read-only file system. Waits for the
    /// store's exclusive lock, so no other process has a lock of the store meanwhile. Each process
    /// that acquires one later checks the mark.
    fn mark_format(&self) -> Result<(), StoreError> {
        let gate = match self.open_gate() {
            Err(StoreError::Io { source, .. })
                if source.kind() == io::ErrorKind::ReadOnlyFilesystem =>
            {
                return Ok(());
            }
            gate => gate?,
        };
        gate.lock().map_err(|source| lock_error(&self.gate_path(), source))?;
        // A newer program may have marked the store meanwhile.
        self.check_format()?;
        let path = self.root().join("format");
        with_path(&path, write_atomically(&path, format!("{}\n", self.format).as_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::thread::ScopedJoinHandle;

    use super::*;
    use crate::testing::{begin, entered, finish_action};

    #[test]
    fn a_newer_store_is_refused_in_one_line() {
        let dir = tempfile::tempdir().unwrap();
        Store::open(dir.path()).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "1\n");
        Store::open(dir.path()).unwrap();
        for text in ["2\n", "99", "", "new"] {
            fs::write(dir.path().join("format"), text).unwrap();
            let message = Store::open(dir.path()).unwrap_err().to_string();
            assert!(
                message.contains("use the newer nerf-sr") && !message.contains('\n'),
                "{message}"
            );
        }
    }

    #[test]
    fn a_store_on_two_file_systems_is_refused() {
        for folder in ["partial", "objects", "actions", "trash"] {
            let dir = tempfile::tempdir().unwrap();
            symlink("/proc", dir.path().join(folder)).unwrap();
            let message = Store::open(dir.path()).unwrap_err().to_string();
            assert!(message.contains("are on different file systems"), "{folder}: {message}");
        }
    }

    /// A newer program marks a store when opening it. Then an older program changes nothing.
    #[test]
    fn a_running_older_program_is_refused_after_a_newer_one() {
        let dir = tempfile::tempdir().unwrap();
        let older = Store::open_as(dir.path(), 1).unwrap();
        let done = finish_action(&older, "a", "1234");
        let checked = older.check(begin(&older, "b", Some("5678")), "text").unwrap();
        let newer = Store::open_as(dir.path(), 2).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "2\n");
        for error in
            [older.try_enter().err(), older.try_close().err(), Store::open_as(dir.path(), 1).err()]
        {
            assert_eq!(
                error.unwrap().to_string(),
                format!(
                    "{}: the store has format 2, this nerf-sr supports format 1; use the newer \
                    nerf-sr, or another folder with --store",
                    dir.path().display()
                )
            );
        }
        drop(checked);
        assert_eq!(
            (newer.objects().unwrap(), newer.hit(&done.key()).unwrap()),
            (vec![done.output.clone()], Some(done))
        );
        // The newer program completes the action of the older one.
        let completed = finish_action(&newer, "b", "5678");
        assert_eq!(newer.hit(&completed.key()).unwrap(), Some(completed));
        Store::open_as(dir.path(), 2).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "2\n");
    }

    /// Returns the number of processes waiting for the lock of a store (from `/proc/locks`).
    fn waiting_count(store: &Store) -> usize {
        let file = format!(":{} ", fs::metadata(store.gate_path()).unwrap().ino());
        let locks = fs::read_to_string("/proc/locks").unwrap();
        locks.lines().filter(|line| line.contains("->") && line.contains(&file)).count()
    }

    /// A newer program waits until others have released the store. Of several, the newest wins.
    #[test]
    fn a_newer_program_waits_until_others_release_the_store() {
        let dir = tempfile::tempdir().unwrap();
        let older = Store::open_as(dir.path(), 1).unwrap();
        let inside = entered(&older);
        let formats = [2, 4, 3];
        let opened = std::thread::scope(|scope| {
            let root = dir.path();
            let openings =
                formats.map(|format| scope.spawn(move || Store::open_as(root, format).is_ok()));
            let has_opened = || openings.iter().any(ScopedJoinHandle::is_finished);
            while waiting_count(&older) < formats.len() && !has_opened() {
                std::thread::yield_now();
            }
            assert_eq!(
                fs::read_to_string(dir.path().join("format")).unwrap(),
                "1\n",
                "unchanged while another process is inside"
            );
            drop(inside);
            openings.map(|opening| opening.join().unwrap())
        });
        assert!(opened[1], "the newest has opened the store");
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "4\n");
    }
}
