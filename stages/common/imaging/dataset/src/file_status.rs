//! Checks of paths that should be files.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use artifact::{file_kind, is_ignored_name, printable, shortened};

/// Reason why a path isn't a readable file.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FileProblem {
    /// Nothing at the path.
    #[error("{0}")]
    Missing(String),
    /// Link that can't be followed, at the path or above it.
    #[error("{0}")]
    Link(String),
    /// Something that isn't a file or can't be accessed.
    #[error("{0}")]
    Unusable(String),
}

/// Returns a path for a message, on one line; bytes that aren't UTF-8 are escaped as `\xFF`.
pub(crate) fn path_text(path: &Path) -> String {
    match path.to_str() {
        Some(text) => printable(text).into_owned(),
        None => format!("{path:?}").trim_matches('"').to_owned(),
    }
}

/// Maximum length of a path in bytes, including a final NUL (Linux's `PATH_MAX`).
const MAX_PATH_BYTES: usize = 4096;

/// Fails unless a path is a file; `expected` describes the expected file in messages ("an image").
pub(crate) fn check_file(path: &Path, expected: &str) -> Result<(), FileProblem> {
    let name = path_text(path);
    let short_name = shortened(&name);
    let length = path.as_os_str().len();
    if length >= MAX_PATH_BYTES {
        let problem = format!("{short_name}: path is too long ({length} bytes)");
        return Err(FileProblem::Unusable(problem));
    }
    if path.file_name().is_some_and(is_ignored_name) {
        let problem = format!("{name} is named like editor and system files, which are ignored");
        return Err(FileProblem::Unusable(problem));
    }
    let error = match fs::metadata(path) {
        Ok(found) if found.is_file() => return Ok(()),
        Ok(found) => {
            let problem = format!("{name} is {}, not {expected}", file_kind(found.file_type()));
            return Err(FileProblem::Unusable(problem));
        }
        Err(error) => error,
    };
    Err(match (first_bad_link(path), error.kind()) {
        (Some(link), kind) => {
            let target = path_text(&fs::read_link(link).unwrap_or_default());
            let link = path_text(link);
            FileProblem::Link(if kind == ErrorKind::NotFound {
                format!("{link} is a symbolic link to {target}, which does not exist")
            } else {
                format!("{link} is a symbolic link that cannot be followed: {error}")
            })
        }
        (None, ErrorKind::InvalidFilename) => FileProblem::Unusable(format!(
            "{short_name}: a name in the path is too long (usual maximum 255 bytes)"
        )),
        (None, ErrorKind::NotFound | ErrorKind::NotADirectory) => {
            FileProblem::Missing(format!("{name} not found"))
        }
        (None, _) => FileProblem::Unusable(format!("cannot access {name}: {error}")),
    })
}

/// Finds the first link along a path that can't be followed.
fn first_bad_link(path: &Path) -> Option<&Path> {
    let mut ancestors: Vec<&Path> =
        path.ancestors().filter(|a| !a.as_os_str().is_empty()).collect();
    ancestors.reverse();
    ancestors.into_iter().find(|ancestor| {
        fs::symlink_metadata(ancestor).is_ok_and(|m| m.is_symlink())
            && fs::metadata(ancestor).is_err()
    })
}

/// True if a file's name begins with a dot, such as `.DS_Store` and macOS's `._IMG_0000.png`, which
/// are not photographs.
pub(crate) fn is_hidden(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."))
}

/// Returns a folder's entries that aren't hidden, sorted; none if the folder can't be read.
pub(crate) fn visible_entries(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> =
        entries.map(|entry| entry.path()).filter(|path| !is_hidden(path)).collect();
    paths.sort();
    paths
}

/// Returns the folders in a folder, sorted, without hidden ones.
pub(crate) fn sub_folders(folder: &Path) -> Vec<PathBuf> {
    visible_entries(folder).into_iter().filter(|path| path.is_dir()).collect()
}

/// Returns the folder that contains a path: `.` for a name alone.
pub(crate) fn parent_folder(path: &Path) -> PathBuf {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    parent.unwrap_or(Path::new(".")).to_path_buf()
}

/// Returns the last part of a path; empty if there is none in UTF-8.
pub(crate) fn name_text(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

/// Fails if a path is, or leads through, a link that can't be followed.
pub(crate) fn check_link(path: &Path) -> Result<(), FileProblem> {
    match check_file(path, "a folder") {
        Err(problem @ FileProblem::Link(_)) => Err(problem),
        _ => Ok(()),
    }
}

/// Returns whether a file exists; fails if something else is in its place.
pub(crate) fn is_file(path: &Path) -> Result<bool, FileProblem> {
    match check_file(path, "a file") {
        Ok(()) => Ok(true),
        Err(FileProblem::Missing(_)) => Ok(false),
        Err(problem) => Err(problem),
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt as _;
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn messages_name_the_kind_of_non_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name);
        fs::write(path("file"), "").unwrap();
        fs::create_dir(path("folder")).unwrap();
        let _listening = UnixListener::bind(path("socket")).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(path("pipe")).status().unwrap().success());
        symlink("/dev/zero", path("device")).unwrap();
        symlink("loop", path("loop")).unwrap();
        symlink("gone", path("dangling")).unwrap();
        symlink("file", path("link")).unwrap();
        let found = |name: &str| check_file(&path(name), "an image");
        assert!(found("file").is_ok() && found("link").is_ok());
        for (name, expected) in [
            ("folder", "folder is a folder, not an image"),
            ("pipe", "pipe is a named pipe (FIFO), not an image"),
            ("socket", "socket is a socket, not an image"),
            ("device", "device is a device, not an image"),
            ("loop", "loop is a symbolic link that cannot be followed"),
            ("loop/x.png", "loop is a symbolic link that cannot be followed"),
            ("dangling/x.png", "dangling is a symbolic link to gone, which does not exist"),
            ("dangling", "dangling is a symbolic link to gone, which does not exist"),
            ("._x.png", "._x.png is named like editor and system files"),
            (&"y".repeat(300), ": a name in the path is too long"),
            (&"z/".repeat(1 << 20), ": path is too long"),
        ] {
            let problem = found(name).unwrap_err();
            assert!(!matches!(problem, FileProblem::Missing(_)), "{problem}");
            let text = problem.to_string();
            assert!(text.contains(expected), "{text}");
        }
        for (name, expected) in
            [("nothing", "nothing not found"), ("file/x.png", "file/x.png not found")]
        {
            let problem = found(name).unwrap_err();
            assert!(matches!(problem, FileProblem::Missing(_)), "{problem}");
            let text = problem.to_string();
            assert!(text.contains(expected), "{text}");
        }
    }

    #[test]
    fn paths_are_printed_on_one_line() {
        assert_eq!(path_text(Path::new("a\u{1b}[31m/b\n.png")), "a\\u{1b}[31m/b\\n.png");
        assert_eq!(path_text(Path::new(OsStr::from_bytes(b"a\xff\n.png"))), "a\\xFF\\n.png");
    }
}
