use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

/// Returns advice on a failed file operation, to end a message with: whose file refuses access, and
/// how users share a store. Empty for other errors.
pub fn advice(path: &Path, error: &io::Error) -> String {
    if error.kind() != io::ErrorKind::PermissionDenied {
        return String::new();
    }
    // A file that does not exist, or hides behind its folder, is refused by the folder.
    let owner = path.ancestors().find_map(|place| place.symlink_metadata().ok());
    let owner = owner.map(|meta| format!("; owned by user {}", meta.uid())).unwrap_or_default();
    format!("{owner}; share a store through a group and umask 002, or choose another with --store")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advice_names_the_owner_of_what_refuses_access() {
        let dir = tempfile::tempdir().unwrap();
        let owner = dir.path().metadata().unwrap().uid();
        let path = dir.path().join("absent/file");
        let said = advice(&path, &io::Error::from(io::ErrorKind::PermissionDenied));
        assert!(said.starts_with(&format!("; owned by user {owner}; share a store")), "{said}");
        assert_eq!(advice(&path, &io::Error::from(io::ErrorKind::NotFound)), "");
    }
}
