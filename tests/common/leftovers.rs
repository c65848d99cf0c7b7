//! Files of a project: lasting files, and leftovers of unfinished commands.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;

/// Contents of files by path.
pub type Files = BTreeMap<String, Vec<u8>>;

/// Reads all files below a folder.
pub fn files_below(folder: &Path) -> Files {
    let mut files = Files::new();
    for entry in walkdir::WalkDir::new(folder) {
        let entry = entry.unwrap();
        if entry.file_type().is_file() {
            let path = entry.path().strip_prefix(folder).unwrap().to_str().unwrap();
            files.insert(path.to_owned(), std::fs::read(entry.path()).unwrap());
        }
    }
    files
}

/// Folders of a project that are stores.
const STORES: [&str; 2] = [".nerf-sr", "other"];
/// Folders of a store that are empty after garbage collection if no run is in progress.
const EMPTY_FOLDERS: [&str; 3] = ["trash", "sinks", "partial"];

/// Returns whether a file exists only during a command or after an interrupted command.
pub fn is_leftover(path: &str) -> bool {
    let parts: Vec<&str> = path.split('/').collect();
    let is_temporary = |name: &&str| {
        let is_hidden = name.starts_with('.');
        name.contains('#')
            || is_hidden && (name.ends_with(".partial") || name.contains(".nerf-sr-"))
    };
    let (root, folder) = (parts[0], parts.get(1).copied().unwrap_or_default());
    let is_in_temporary_folder = root == "shared" && folder == "uploads"
        || STORES.contains(&root) && EMPTY_FOLDERS.contains(&folder);
    is_in_temporary_folder
        || parts.iter().any(is_temporary)
        || parts.iter().any(|name| name.starts_with(".nerf-sr-"))
}

/// Returns the part of a file's content that is equal in equal runs, without times and process IDs;
/// `None` if the file has no such part.
pub fn lasting(path: &str, content: &[u8]) -> Option<Vec<u8>> {
    let parts: Vec<&str> = path.split('/').collect();
    let (name, folder) = (parts[parts.len() - 1], parts.iter().rev().nth(1).copied());
    let in_store = STORES.contains(&parts[0]);
    match folder {
        _ if is_leftover(path) || [".shows", "gate"].contains(&name) => None,
        Some("actions") if name.ends_with(".json") => {
            let record: Value = serde_json::from_slice(content).unwrap();
            Some(record["output"].to_string().into_bytes())
        }
        Some("pins") => {
            let text = String::from_utf8_lossy(content);
            Some(text.lines().skip(1).collect::<String>().into_bytes())
        }
        _ if in_store && parts[1] != "objects" => None,
        _ => Some(content.to_vec()),
    }
}

/// Reads the lasting contents of a project's files.
pub fn lasting_files(folder: &Path) -> Files {
    let mut files = Files::new();
    for (path, content) in files_below(folder) {
        if let Some(content) = lasting(&path, &content) {
            files.insert(path, content);
        }
    }
    files
}
