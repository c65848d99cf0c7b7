use std::fs::metadata;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

/// Maximum step of a file system's clock: FAT has two seconds.
const MAX_TICK_SECONDS: u64 = 2;

/// Size, times and inode of a file. If a settled stamp (`is_settled`) equals a later stamp of the
/// file, the content is unchanged (docs/design/002).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    /// Size in bytes.
    pub(crate) size: u64,
    /// Time of the last change of the content, as seconds and nanoseconds since 1970.
    modified: (i64, i64),
    /// Time of the last change of content, name, links or permissions. Programs can't set it.
    changed: (i64, i64),
    inode: u64,
}

impl Stamp {
    /// Reads the stamp of a file. Links are followed.
    pub fn of(file: &Path) -> io::Result<Self> {
        let meta = metadata(file)?;
        Ok(Self {
            size: meta.len(),
            modified: (meta.mtime(), meta.mtime_nsec()),
            changed: (meta.ctime(), meta.ctime_nsec()),
            inode: meta.ino(),
        })
    }

    /// Returns whether the file wasn't touched since `earlier`. Inodes aren't compared: exFAT, SMB
    /// and SSHFS give new ones to old files.
    pub fn is_untouched_since(&self, earlier: &Self) -> bool {
        Self { inode: earlier.inode, ..*self } == *earlier
    }

    /// Returns whether every later change of the file will change the stamp. A second change within
    /// one tick of the file system's clock leaves the times unchanged.
    pub(crate) fn is_settled(&self) -> bool {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs() as i64;
        let times = [self.modified.0, self.changed.0];
        times.iter().all(|time| now.abs_diff(*time) > MAX_TICK_SECONDS)
    }

    /// Returns the size and the time of the content's last change, which copies of a file may
    /// preserve.
    pub(crate) fn size_and_modified(&self) -> (u64, (i64, i64)) {
        (self.size, self.modified)
    }
}
