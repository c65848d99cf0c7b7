use std::fs::{FileType, Metadata};
use std::io;
use std::os::unix::fs::FileTypeExt as _;
use std::path::{Path, PathBuf};

/// Something in a stage's output that an artifact may not contain.
#[derive(Debug, thiserror::Error)]
pub enum NotPlain {
    /// A link or a special file: its content is elsewhere, or has no end.
    #[error("{path} is {kind}; write folders and regular files only")]
    Kind {
        /// The file, or the output itself.
        path: PathBuf,
        /// Kind of file, with its article.
        kind: &'static str,
    },
    /// The output can't be listed.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// Lists the regular files of a stage's output, in the order of names. Fails if the output is not a
/// folder, or contains anything but folders and regular files. Links are not followed: an artifact
/// with a link would change with a file of the user's, and writing to the artifact would change
/// that file.
pub fn plain_files(output: &Path) -> Result<Vec<(PathBuf, Metadata)>, NotPlain> {
    let mut files = Vec::new();
    let entries = walkdir::WalkDir::new(output).follow_root_links(false).sort_by_file_name();
    for entry in entries {
        let entry = entry.map_err(io::Error::from)?;
        let kind = entry.file_type();
        if kind.is_file() && entry.depth() > 0 {
            let metadata = entry.metadata().map_err(io::Error::from)?;
            files.push((entry.into_path(), metadata));
        } else if !kind.is_dir() {
            return Err(NotPlain::Kind { path: entry.into_path(), kind: file_kind(kind) });
        }
    }
    Ok(files)
}

/// Returns the name of a kind of file, with its article.
pub fn file_kind(of: FileType) -> &'static str {
    if of.is_file() {
        "a regular file"
    } else if of.is_dir() {
        "a folder"
    } else if of.is_symlink() {
        "a symbolic link"
    } else if of.is_fifo() {
        "a named pipe (FIFO)"
    } else if of.is_socket() {
        "a socket"
    } else {
        "a device"
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn only_folders_and_regular_files_are_plain() {
        type Harm = fn(&Path);
        let cases: [(&str, Harm); 6] = [
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
        for (words, harm) in cases {
            let dir = tempfile::tempdir().unwrap();
            let out = dir.path().join("out");
            fs::create_dir_all(out.join("in")).unwrap();
            fs::write(out.join("in/a"), "").unwrap();
            let files = plain_files(&out).unwrap();
            assert_eq!(
                files.into_iter().map(|file| file.0).collect::<Vec<_>>(),
                [out.join("in/a")]
            );
            harm(&out);
            let message = plain_files(&out).unwrap_err().to_string();
            assert!(message.contains(words) && !message.contains('\n'), "{words}: {message}");
        }
    }
}
