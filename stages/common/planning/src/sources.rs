//! Content hashes of folders outside the store.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use artifact::{hash_files, hash_json, list_files, write_atomically};
use serde::{Deserialize, Serialize};
use store::Store;

/// Hashes by the folder's path, kept as long as the files' paths, sizes and modification times
/// stay.
#[derive(Default, Serialize, Deserialize)]
struct HashCache(BTreeMap<String, Entry>);

#[derive(Serialize, Deserialize)]
struct Entry {
    listing: String,
    content: String,
}

/// A folder outside the store that has no content hash.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// It can't be found.
    #[error("{folder:?}: {problem}; name a folder that is there")]
    Absent {
        /// The folder.
        folder: PathBuf,
        /// Why.
        problem: io::Error,
    },
    /// It isn't a folder.
    #[error("{0:?}: not a folder")]
    NoFolder(PathBuf),
    /// A file in it can't be read.
    #[error("{folder:?}: {problem}")]
    Unreadable {
        /// The folder.
        folder: PathBuf,
        /// Why.
        problem: io::Error,
    },
}

/// The content hash of a folder outside the store.
pub(crate) fn hash_source(store: &Store, folder: &Path) -> Result<String, SourceError> {
    let fail = |problem| SourceError::Unreadable { folder: folder.to_path_buf(), problem };
    let absolute = folder
        .canonicalize()
        .map_err(|problem| SourceError::Absent { folder: folder.to_path_buf(), problem })?;
    if !absolute.is_dir() {
        return Err(SourceError::NoFolder(folder.to_path_buf()));
    }
    let files = list_files(&absolute).map_err(fail)?;
    let (listing, newest) = listing(&files).map_err(fail)?;
    let cache_file = store.root().join("cache/sources.json");
    let mut cache: HashCache = std::fs::read(&cache_file)
        .ok()
        .and_then(|b| serde_json::from_slice(&b).ok())
        .unwrap_or_default();
    let place = name_of(&absolute);
    if let Some(entry) = cache.0.get(&place).filter(|e| e.listing == listing) {
        return Ok(entry.content.clone());
    }
    let named = files.into_iter().map(|(relative, file)| (name_of(&relative), file)).collect();
    let content = hash_json(&hash_files(named).map_err(fail)?);
    // A file changed within the clock's grain could change again unseen; such a listing isn't kept.
    let settled = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .is_ok_and(|now| now.as_nanos().saturating_sub(newest) > 2_000_000_000);
    if settled {
        cache.0.insert(place, Entry { listing, content: content.clone() });
        if let Ok(bytes) = serde_json::to_vec(&cache) {
            write_atomically(&cache_file, &bytes).ok();
        }
    }
    Ok(content)
}

/// A hash of every file's path, size and time, and the newest time.
fn listing(files: &[(PathBuf, PathBuf)]) -> io::Result<(String, u128)> {
    let mut entries = Vec::with_capacity(files.len());
    let mut newest = 0;
    for (relative, file) in files {
        let meta = std::fs::metadata(file)?;
        let time = meta.modified()?.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        newest = newest.max(time);
        entries.push((name_of(relative), meta.len(), time.to_string()));
    }
    Ok((hash_json(&entries), newest))
}

/// A path as text, another for each path: names that aren't UTF-8 are written in hexadecimal after
/// a NUL, which no name has.
fn name_of(path: &Path) -> String {
    path.to_str().map_or_else(
        || {
            path.as_os_str()
                .as_encoded_bytes()
                .iter()
                .fold("\0".to_owned(), |text, byte| text + &format!("{byte:02x}"))
        },
        str::to_owned,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt as _;

    #[test]
    fn what_is_no_folder_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(&dir.path().join("store")).unwrap();
        let (file, absent) = (dir.path().join("file"), dir.path().join("absent"));
        std::fs::write(&file, "x").unwrap();
        let problem = |folder: &Path| hash_source(&store, folder).unwrap_err().to_string();
        assert_eq!(problem(&file), format!("{file:?}: not a folder"));
        let words = "No such file or directory (os error 2); name a folder that is there";
        assert_eq!(problem(&absent), format!("{absent:?}: {words}"));
    }

    /// Any file name is taken, and each makes a hash of its own.
    #[test]
    fn any_name_has_a_hash() {
        let dir = tempfile::tempdir().unwrap();
        let (store, data) =
            (Store::open(&dir.path().join("store")).unwrap(), dir.path().join("data"));
        let mut seen = std::collections::BTreeSet::new();
        for name in [
            &b"plain"[..],
            b"\xff",
            b"\xfe",
            b"new\nline",
            b"\x1b]0;title\x07",
            "übung 🎈".as_bytes(),
            b"ff",
        ] {
            std::fs::create_dir_all(&data).unwrap();
            std::fs::write(data.join(OsStr::from_bytes(name)), "x").unwrap();
            assert!(seen.insert(hash_source(&store, &data).unwrap()), "{name:?}");
            std::fs::remove_dir_all(&data).unwrap();
        }
    }
}
