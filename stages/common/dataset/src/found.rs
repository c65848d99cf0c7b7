use std::fs;
use std::io::ErrorKind;
use std::path::Path;

use artifact::{file_kind, is_ignored_name};

use crate::error::DatasetError;
use crate::misplaced::Misplaced;

/// What stands at a place where a file is wanted.
#[derive(Debug)]
pub(crate) enum Found {
    /// A file.
    File,
    /// Nothing.
    Nothing(Misplaced),
    /// Something that can't be read as a file.
    Other(Misplaced),
}

/// Maximum length of a path in bytes (Linux's `PATH_MAX`).
const MAX_PATH_BYTES: usize = 4096;

/// Looks at a place where a file is wanted, which `wanted` names ("an image").
pub(crate) fn find(path: &Path, wanted: &'static str) -> Found {
    let path_buf = || path.to_path_buf();
    let bytes = path.as_os_str().len();
    if bytes > MAX_PATH_BYTES {
        return Found::Other(Misplaced::Long { path: path_buf(), bytes });
    }
    if path.file_name().is_some_and(is_ignored_name) {
        return Found::Other(Misplaced::PassedOver { path: path_buf() });
    }
    match fs::metadata(path) {
        Ok(there) if there.is_file() => Found::File,
        Ok(there) => Found::Other(Misplaced::Kind {
            path: path_buf(),
            kind: file_kind(there.file_type()),
            wanted,
        }),
        Err(error) => match (broken_link(path), error.kind()) {
            (Some(link), ErrorKind::NotFound) => {
                let target = fs::read_link(link).unwrap_or_default();
                Found::Other(Misplaced::Dangling { link: link.to_path_buf(), target })
            }
            (None, ErrorKind::InvalidFilename) => {
                Found::Other(Misplaced::Long { path: path_buf(), bytes })
            }
            (Some(link), _) => Found::Other(Misplaced::Nowhere { link: link.to_path_buf(), error }),
            (None, ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                Found::Nothing(Misplaced::Nothing { path: path_buf() })
            }
            (None, _) => Found::Other(Misplaced::Unseen { path: path_buf(), error }),
        },
    }
}

/// The first link on the way to a place that can't be followed.
fn broken_link(path: &Path) -> Option<&Path> {
    let mut ways: Vec<&Path> = path.ancestors().filter(|way| !way.as_os_str().is_empty()).collect();
    ways.reverse();
    ways.into_iter().find(|way| {
        fs::symlink_metadata(way).is_ok_and(|m| m.is_symlink()) && fs::metadata(way).is_err()
    })
}

/// True if a file's name begins with a dot: `.DS_Store` and macOS's `._IMG_0000.png` are nobody's
/// photographs.
pub(crate) fn is_hidden(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."))
}

/// Fails if a path is a dangling link, or leads through one.
pub(crate) fn check_link(path: &Path) -> Result<(), DatasetError> {
    match find(path, "a folder") {
        Found::Other(found @ (Misplaced::Dangling { .. } | Misplaced::Nowhere { .. })) => {
            Err(DatasetError::Place(found))
        }
        _ => Ok(()),
    }
}

/// Whether a file is there; something else in its place is refused.
pub(crate) fn is_file(path: &Path) -> Result<bool, DatasetError> {
    match find(path, "a file") {
        Found::File => Ok(true),
        Found::Nothing(_) => Ok(false),
        Found::Other(found) => Err(DatasetError::Place(found)),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn what_is_no_file_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        fs::write(at("file"), "").unwrap();
        fs::create_dir(at("folder")).unwrap();
        let _listening = UnixListener::bind(at("socket")).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(at("pipe")).status().unwrap().success());
        symlink("/dev/zero", at("device")).unwrap();
        symlink("loop", at("loop")).unwrap();
        symlink("gone", at("dangling")).unwrap();
        symlink("file", at("link")).unwrap();
        let found = |name: &str| find(&at(name), "an image");
        assert!(matches!((found("file"), found("link")), (Found::File, Found::File)));
        for (name, words) in [
            ("folder", "folder is a folder, not an image"),
            ("pipe", "pipe is a named pipe (FIFO), not an image"),
            ("socket", "socket is a socket, not an image"),
            ("device", "device is a device, not an image"),
            ("loop", "loop is a symbolic link that leads nowhere"),
            ("loop/x.png", "loop is a symbolic link that leads nowhere"),
            ("dangling/x.png", "dangling is a symbolic link to gone, which is not there"),
            ("dangling", "dangling is a symbolic link to gone, which is not there"),
            ("._x.png", "._x.png is named like an editor's or a system's own files"),
            (&"y".repeat(300), ": no file has so long a name"),
            (&"z/".repeat(1 << 20), ": no file has so long a name"),
        ] {
            let Found::Other(it) = found(name) else { panic!("{name}: {:?}", found(name)) };
            let text = it.to_string();
            assert!(text.contains(words), "{text}");
        }
        for (name, words) in
            [("nothing", "nothing is not there"), ("file/x.png", "file/x.png is not there")]
        {
            let Found::Nothing(it) = found(name) else { panic!("{name}: {:?}", found(name)) };
            let text = it.to_string();
            assert!(text.contains(words), "{text}");
        }
    }
}
