use std::fs;
use std::io;
use std::path::Path;

use artifact::write_atomically;

use crate::error::{StoreError, at, lock_error};
use crate::folder::Store;

/// Version of a store's layout. It grows when an older runner could harm what a newer one wrote.
pub const FORMAT: u32 = 1;

impl Store {
    /// Opens the store in a folder, making it where it isn't there. One of an older format gets
    /// this one's mark: from then on older runners leave it alone, those that are at work with it
    /// among them.
    pub fn open(root: &Path) -> Result<Self, StoreError> {
        Self::open_as(root, FORMAT)
    }

    /// As a program that knows this format.
    fn open_as(root: &Path, format: u32) -> Result<Self, StoreError> {
        at(root, fs::create_dir_all(root))?;
        let store = Self::new(root, format);
        if store.check_format()?.is_none_or(|found| found < format) {
            store.mark_format()?;
        }
        for folder in
            ["objects", "actions", "partial", "locks", "cache", "runs", "pins", "sinks", "trash"]
        {
            let path = root.join(folder);
            match fs::create_dir_all(&path) {
                // An old store that can't be written still shows what it has.
                Err(error) if error.kind() == io::ErrorKind::ReadOnlyFilesystem => {}
                result => at(&path, result)?,
            }
        }
        Ok(store)
    }

    /// The store's format, if it has its mark; a newer one is refused.
    pub(crate) fn check_format(&self) -> Result<Option<u32>, StoreError> {
        let path = self.root().join("format");
        match fs::read_to_string(&path) {
            Ok(text) => match text.trim().parse::<u32>() {
                Ok(found) if found <= self.format => Ok(Some(found)),
                _ => {
                    let found = text.trim().chars().take(20).collect();
                    Err(StoreError::Newer {
                        path: self.root().to_path_buf(),
                        found,
                        known: self.format,
                    })
                }
            },
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(StoreError::Io { path, source }),
        }
    }

    /// Marks the store as of this program's format. It is closed meanwhile: who enters before is
    /// done with it, who enters later sees the mark.
    fn mark_format(&self) -> Result<(), StoreError> {
        let gate = match self.gate() {
            Err(StoreError::Io { source, .. })
                if source.kind() == io::ErrorKind::ReadOnlyFilesystem =>
            {
                return Ok(());
            }
            gate => gate?,
        };
        gate.lock().map_err(|source| lock_error(&self.gate_path(), source))?;
        // A still newer program may have been faster.
        self.check_format()?;
        let path = self.root().join("format");
        at(&path, write_atomically(&path, format!("{}\n", self.format).as_bytes()))
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::MetadataExt as _;
    use std::thread::ScopedJoinHandle;

    use super::*;
    use crate::testing::{begin, entered, make};

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

    /// A newer program marks the store as its own when it opens it. An older one that is at work
    /// there changes nothing from then on.
    #[test]
    fn an_older_program_at_work_stops_when_a_newer_one_comes() {
        let dir = tempfile::tempdir().unwrap();
        let older = Store::open_as(dir.path(), 1).unwrap();
        let done = make(&older, "a", "1234");
        let checked = older.check(begin(&older, "b", Some("5678")), "text").unwrap();
        let newer = Store::open_as(dir.path(), 2).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "2\n");
        for refused in
            [older.try_enter().err(), older.try_close().err(), Store::open_as(dir.path(), 1).err()]
        {
            assert_eq!(
                refused.unwrap().to_string(),
                format!(
                    "{}: the store has format 2, this nerf-sr knows format 1; use the newer \
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
        // It makes what the older one left half made.
        let made = make(&newer, "b", "5678");
        assert_eq!(newer.hit(&made.key()).unwrap(), Some(made));
        Store::open_as(dir.path(), 2).unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "2\n");
    }

    /// How many wait for the lock of a store: the kernel lists them with an arrow.
    fn waiting(store: &Store) -> usize {
        let file = format!(":{} ", fs::metadata(store.gate_path()).unwrap().ino());
        let locks = fs::read_to_string("/proc/locks").unwrap();
        locks.lines().filter(|line| line.contains("->") && line.contains(&file)).count()
    }

    /// Who is inside when a newer program comes is waited for. Of several newer ones the newest has
    /// the store.
    #[test]
    fn a_newer_program_waits_for_who_is_inside() {
        let dir = tempfile::tempdir().unwrap();
        let older = Store::open_as(dir.path(), 1).unwrap();
        let inside = entered(&older);
        let formats = [2, 4, 3];
        let opened = std::thread::scope(|scope| {
            let root = dir.path();
            let openings =
                formats.map(|format| scope.spawn(move || Store::open_as(root, format).is_ok()));
            let has_opened = || openings.iter().any(ScopedJoinHandle::is_finished);
            while waiting(&older) < formats.len() && !has_opened() {
                std::thread::yield_now();
            }
            assert_eq!(
                fs::read_to_string(dir.path().join("format")).unwrap(),
                "1\n",
                "not while somebody is inside"
            );
            drop(inside);
            openings.map(|opening| opening.join().unwrap())
        });
        assert!(opened[1], "the newest");
        assert_eq!(fs::read_to_string(dir.path().join("format")).unwrap(), "4\n");
    }
}
