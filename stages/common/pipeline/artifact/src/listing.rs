//! Lists of a folder's files, and checks of paths from files.

use std::ffi::OsStr;
use std::fs::{self, FileType, Metadata};
use std::io::{self, ErrorKind};
use std::os::unix::fs::FileTypeExt as _;
use std::path::{Component, Path, PathBuf};

use crate::text::shortened;

/// Lists all files below a folder, sorted by name. Follows symbolic links. Fails for a link to a
/// folder that contains it, and for a FIFO, socket or device, since reading one may block forever.
pub fn list_files(folder: &Path) -> io::Result<ListedFiles> {
    list_unless(folder, |_| false)
}

/// Files of a folder: path relative to the folder, and full path.
pub type ListedFiles = Vec<(PathBuf, PathBuf)>;

/// Lists the files of a user's folder like [`list_files`], without the ignored ones. Returns the
/// relative paths of the ignored files second.
pub fn list_source_files(folder: &Path) -> io::Result<(ListedFiles, Vec<PathBuf>)> {
    let mut ignored = Vec::new();
    let files = list_unless(folder, |path| {
        let is_ignored = is_ignored(path);
        if is_ignored {
            ignored.push(path.strip_prefix(folder).unwrap_or(path).to_path_buf());
        }
        is_ignored
    })?;
    Ok((files, ignored))
}

/// Lists the files below a folder for which `is_excluded` is false. Errors of excluded paths, such
/// as dangling links, are ignored.
fn list_unless(
    folder: &Path,
    mut is_excluded: impl FnMut(&Path) -> bool,
) -> io::Result<ListedFiles> {
    let mut found = Vec::new();
    for entry in walkdir::WalkDir::new(folder).follow_links(true).sort_by_file_name() {
        let path = match &entry {
            Ok(entry) if entry.file_type().is_dir() => None,
            Ok(entry) => Some(entry.path()),
            Err(error) => error.path(),
        };
        if path.is_some_and(&mut is_excluded) {
            continue;
        }
        let entry = entry.map_err(|error| match (error.path(), error.loop_ancestor()) {
            (Some(link), Some(folder)) => io::Error::other(format!(
                "{link:?} is a link to {folder:?}, a folder that contains it; remove the link"
            )),
            _ => io::Error::from(error),
        })?;
        let kind = entry.file_type();
        if kind.is_file() {
            let relative =
                entry.path().strip_prefix(folder).map_err(io::Error::other)?.to_path_buf();
            found.push((relative, entry.into_path()));
        } else if !kind.is_dir() {
            return Err(io::Error::other(format!(
                "{:?} is {}, which cannot be hashed; remove it",
                entry.path(),
                file_kind(kind)
            )));
        }
    }
    Ok(found)
}

/// True if a file in a user's folder is neither hashed nor read: a dangling link, or a file with an
/// ignored name.
fn is_ignored(path: &Path) -> bool {
    path.file_name().is_some_and(is_ignored_name) || is_dangling(path)
}

/// True for the name of an editor's lock or swap file (`.#x` of Emacs, `.~lock.x#` of LibreOffice,
/// `.x.swp` of Vim) or of a file of macOS (`.DS_Store`, `._x`). Programs create and delete such
/// files at any time; they are not part of a data set.
pub fn is_ignored_name(name: &OsStr) -> bool {
    let name = name.as_encoded_bytes();
    name == b".DS_Store"
        || name.starts_with(b".#")
        || name.starts_with(b"._")
        || (name.starts_with(b".~lock.") && name.ends_with(b"#"))
        || (name.starts_with(b".") && name.ends_with(b".swp"))
}

/// True for a link whose target doesn't exist. A target that can't be reached for another reason
/// may exist.
fn is_dangling(path: &Path) -> bool {
    let is_link = fs::symlink_metadata(path).is_ok_and(|link| link.is_symlink());
    is_link && fs::metadata(path).is_err_and(|error| error.kind() == ErrorKind::NotFound)
}

/// Lists the regular files of a stage's output, sorted by name. Fails if the output is not a
/// folder, or contains anything but folders and regular files. Links are refused because they would
/// couple the artifact to files of the user.
pub fn list_output_files(output: &Path) -> io::Result<Vec<(PathBuf, Metadata)>> {
    let mut files = Vec::new();
    let entries = walkdir::WalkDir::new(output).follow_root_links(false).sort_by_file_name();
    for entry in entries {
        let entry = entry?;
        let kind = entry.file_type();
        if kind.is_file() && entry.depth() > 0 {
            let metadata = entry.metadata()?;
            files.push((entry.into_path(), metadata));
        } else if !kind.is_dir() {
            let problem = format!(
                "{} is {}; an output is a folder of folders and regular files only",
                entry.path().display(),
                file_kind(kind)
            );
            return Err(io::Error::new(ErrorKind::InvalidData, problem));
        }
    }
    Ok(files)
}

/// Names a file type, with an article.
pub fn file_kind(file_type: FileType) -> &'static str {
    if file_type.is_file() {
        "a regular file"
    } else if file_type.is_dir() {
        "a folder"
    } else if file_type.is_symlink() {
        "a symbolic link"
    } else if file_type.is_fifo() {
        "a named pipe (FIFO)"
    } else if file_type.is_socket() {
        "a socket"
    } else {
        "a device"
    }
}

/// Error returned for a path that is empty, contains NUL or leaves its folder.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{:?} is not a path inside the folder", shortened(.0))]
pub struct PathError(String);

/// Parses a relative, `/`-separated path from a file that may be hostile. Fails if the path is
/// empty, contains NUL or could leave its folder.
pub fn relative_path(text: &str) -> Result<PathBuf, PathError> {
    let path = Path::new(text);
    let stays_inside =
        path.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    let inside: PathBuf =
        path.components().filter(|part| matches!(part, Component::Normal(_))).collect();
    if inside.as_os_str().is_empty() || !stays_inside || text.contains('\0') {
        // A hostile file may consist of one long path.
        return Err(PathError(text.chars().take(200).collect()));
    }
    Ok(inside)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    /// Creates a folder with the files `b.txt` and `train/a.txt`.
    fn example() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("train")).unwrap();
        fs::write(dir.path().join("train/a.txt"), "alpha").unwrap();
        fs::write(dir.path().join("b.txt"), "beta").unwrap();
        dir
    }

    #[test]
    fn a_link_to_its_own_parent_is_named() {
        let dir = example();
        symlink(dir.path(), dir.path().join("train/loop")).unwrap();
        let message = list_files(dir.path()).unwrap_err().to_string();
        assert!(
            message.contains("train/loop") && message.contains("a folder that contains it"),
            "{message}"
        );
    }

    /// Dangling links and editors' files are ignored in a user's folder, but not in an artifact.
    #[test]
    fn editor_files_in_a_users_folder_are_ignored() {
        let dir = example();
        let path = |name: &str| dir.path().join(name);
        let ignored = [".#b.txt", ".DS_Store", ".b.txt.swp", ".~lock.b.txt#", "._b.txt"];
        for name in ignored {
            fs::write(path(name), "").unwrap();
        }
        symlink("nowhere", path("train/gone")).unwrap();
        symlink("b.txt", path("c.txt")).unwrap();
        let names = |files: Vec<(PathBuf, PathBuf)>| {
            files.into_iter().map(|(relative, _)| relative.display().to_string()).collect()
        };
        let (files, left_out) = list_source_files(dir.path()).unwrap();
        let files: Vec<String> = names(files);
        assert_eq!(files, ["b.txt", "c.txt", "train/a.txt"]);
        let left_out: BTreeSet<String> = left_out.iter().map(|p| p.display().to_string()).collect();
        let expected = ignored.iter().chain(&["train/gone"]).map(|name| (*name).to_owned());
        assert_eq!(left_out, expected.collect());
        assert!(list_files(dir.path()).unwrap_err().to_string().contains("train/gone"));
        fs::remove_file(path("train/gone")).unwrap();
        assert_eq!(list_files(dir.path()).unwrap().len(), files.len() + ignored.len());
        // A circular link, or one to an unreadable file, is not dangling.
        symlink("round", path("round")).unwrap();
        assert!(list_source_files(dir.path()).unwrap_err().to_string().contains("round"));
    }

    #[test]
    fn a_socket_is_named() {
        let dir = example();
        let _socket = UnixListener::bind(dir.path().join("train/s")).unwrap();
        let message = list_files(dir.path()).unwrap_err().to_string();
        assert!(message.contains("train/s") && message.contains("remove it"), "{message}");
    }

    #[test]
    fn a_manifest_cannot_point_outside() {
        for path in ["../x", "/etc/passwd", "a/../../x", "", "a\0b"] {
            assert!(relative_path(path).is_err(), "{path:?}");
        }
        assert_eq!(relative_path("./train/r_0").unwrap(), Path::new("train/r_0"));
    }

    #[test]
    fn only_folders_and_regular_files_are_plain() {
        type Change = fn(&Path);
        let cases: [(&str, Change); 6] = [
            ("out is a symbolic link", |out| {
                fs::rename(out, out.with_extension("real")).unwrap();
                symlink(out.with_extension("real"), out).unwrap();
            }),
            ("out is a regular file", |out| {
                fs::remove_dir_all(out).unwrap();
                fs::write(out, "").unwrap();
            }),
            ("out/in/link is a symbolic link", |out| symlink("a", out.join("in/link")).unwrap()),
            ("out/in/loop is a symbolic link", |out| symlink("..", out.join("in/loop")).unwrap()),
            ("out/gone is a symbolic link", |out| symlink("nowhere", out.join("gone")).unwrap()),
            ("out/socket is a socket", |out| drop(UnixListener::bind(out.join("socket")).unwrap())),
        ];
        for (expected, change) in cases {
            let dir = tempfile::tempdir().unwrap();
            let out = dir.path().join("out");
            fs::create_dir_all(out.join("in")).unwrap();
            fs::write(out.join("in/a"), "").unwrap();
            let files = list_output_files(&out).unwrap();
            assert_eq!(
                files.into_iter().map(|file| file.0).collect::<Vec<_>>(),
                [out.join("in/a")]
            );
            change(&out);
            let message = list_output_files(&out).unwrap_err().to_string();
            assert!(message.contains(expected) && !message.contains('\n'), "{expected}: {message}");
        }
    }
}
