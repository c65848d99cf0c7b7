use std::fs::{self, FileType};
use std::io::ErrorKind;
use std::os::unix::fs::FileTypeExt as _;
use std::path::Path;

use crate::error::{DatasetError, shown};

/// What stands at a place where a file is wanted.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Found {
    /// A file.
    File,
    /// Nothing, in words.
    Nothing(String),
    /// Something that can't be read as a file, in words.
    Other(String),
}

/// Looks at a place where a file is wanted, which `wanted` names ("an image").
pub(crate) fn find(path: &Path, wanted: &str) -> Found {
    match fs::metadata(path) {
        Ok(there) if there.is_file() => Found::File,
        Ok(there) => {
            Found::Other(format!("{} is {}, not {wanted}", shown(path), kind(there.file_type())))
        }
        Err(error) => match (broken_link(path), error.kind()) {
            (Some(link), ErrorKind::NotFound) => {
                let target = fs::read_link(link).unwrap_or_default();
                let words = format!(
                    "{} is a symbolic link to {}, which is not there",
                    shown(link),
                    shown(&target)
                );
                if link == path { Found::Nothing(words) } else { Found::Other(words) }
            }
            (Some(link), _) => Found::Other(format!(
                "{} is a symbolic link that leads nowhere: {error}",
                shown(link)
            )),
            (None, ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                Found::Nothing(format!("{} is not there", shown(path)))
            }
            (None, _) => Found::Other(format!("{} can't be looked at: {error}", shown(path))),
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

fn kind(of: FileType) -> &'static str {
    if of.is_dir() {
        "a folder"
    } else if of.is_fifo() {
        "a named pipe (FIFO)"
    } else if of.is_socket() {
        "a socket"
    } else {
        "a device"
    }
}

/// Whether a file is there; something else in its place is refused.
pub(crate) fn is_file(path: &Path) -> Result<bool, DatasetError> {
    match find(path, "a file") {
        Found::File => Ok(true),
        Found::Nothing(_) => Ok(false),
        Found::Other(reason) => Err(DatasetError::Place { reason }),
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
        assert_eq!((found("file"), found("link")), (Found::File, Found::File));
        for (name, words) in [
            ("folder", "folder is a folder, not an image"),
            ("pipe", "pipe is a named pipe (FIFO), not an image"),
            ("socket", "socket is a socket, not an image"),
            ("device", "device is a device, not an image"),
            ("loop", "loop is a symbolic link that leads nowhere"),
            ("loop/x.png", "loop is a symbolic link that leads nowhere"),
            ("dangling/x.png", "dangling is a symbolic link to gone, which is not there"),
        ] {
            let Found::Other(text) = found(name) else { panic!("{name}: {:?}", found(name)) };
            assert!(text.contains(words), "{text}");
        }
        for (name, words) in [
            ("nothing", "nothing is not there"),
            ("file/x.png", "file/x.png is not there"),
            ("dangling", "dangling is a symbolic link to gone, which is not there"),
        ] {
            let Found::Nothing(text) = found(name) else { panic!("{name}: {:?}", found(name)) };
            assert!(text.contains(words), "{text}");
        }
    }
}
