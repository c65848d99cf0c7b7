use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use artifact::{Store, hash_folder, hash_json, write_atomically};
use serde::{Deserialize, Serialize};

/// Content hashes of folders outside the store, kept by their files' paths, sizes and modification times.
#[derive(Default, Serialize, Deserialize)]
struct Cache(BTreeMap<PathBuf, Entry>);

#[derive(Serialize, Deserialize)]
struct Entry {
    listing: String,
    content: String,
}

/// The content hash of a folder outside the store.
pub(crate) fn hash_source(store: &Store, folder: &Path) -> Result<String, String> {
    let fail = |e: std::io::Error| format!("{}: {e}; name a folder that is there", folder.display());
    let absolute = folder.canonicalize().map_err(fail)?;
    if !absolute.is_dir() {
        return Err(format!("{}: not a folder", folder.display()));
    }
    let (listing, newest) = list(&absolute).map_err(fail)?;
    let cache_file = store.root().join("cache/sources.json");
    let mut cache: Cache = std::fs::read(&cache_file).ok().and_then(|b| serde_json::from_slice(&b).ok()).unwrap_or_default();
    if let Some(entry) = cache.0.get(&absolute).filter(|e| e.listing == listing) {
        return Ok(entry.content.clone());
    }
    let content = hash_json(&hash_folder(&absolute).map_err(fail)?);
    // A file changed within the clock's grain could change again unseen; such a listing isn't kept.
    let settled =
        SystemTime::now().duration_since(UNIX_EPOCH).is_ok_and(|now| now.as_nanos().saturating_sub(newest) > 2_000_000_000);
    if settled {
        cache.0.insert(absolute, Entry { listing, content: content.clone() });
        if let Ok(bytes) = serde_json::to_vec(&cache) {
            write_atomically(&cache_file, &bytes).ok();
        }
    }
    Ok(content)
}

/// A hash of every file's path, size and time, and the newest time.
fn list(folder: &Path) -> std::io::Result<(String, u128)> {
    let mut files = Vec::new();
    let mut newest = 0;
    let mut waiting = vec![folder.to_path_buf()];
    while let Some(folder) = waiting.pop() {
        for entry in std::fs::read_dir(&folder)? {
            let path = entry?.path();
            let meta = std::fs::metadata(&path)?;
            if meta.is_dir() {
                waiting.push(path);
            } else {
                let time = meta.modified()?.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
                newest = newest.max(time);
                files.push((path, meta.len(), time.to_string()));
            }
        }
    }
    files.sort();
    Ok((hash_json(&files), newest))
}
