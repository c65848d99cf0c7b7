use std::io;
use std::path::{Path, PathBuf};

use artifact::{printable, shortened};

/// What stands at a place where a file is wanted.
#[derive(Debug, thiserror::Error)]
pub enum Misplaced {
    /// Nothing.
    #[error("{} is not there", shown(path))]
    Nothing {
        /// The place.
        path: PathBuf,
    },
    /// Absolute path of another machine, no tail of which is a file of the data set.
    #[error("no file of the data set is at the end of the absolute path {}", shown(path))]
    Elsewhere {
        /// The path.
        path: PathBuf,
    },
    /// Something that is no file.
    #[error("{} is {kind}, not {wanted}", shown(path))]
    Kind {
        /// The place.
        path: PathBuf,
        /// What it is.
        kind: &'static str,
        /// What the file was to be.
        wanted: &'static str,
    },
    /// A link to nothing, there or on the way.
    #[error("{} is a symbolic link to {}, which is not there", shown(link), shown(target))]
    Dangling {
        /// The link.
        link: PathBuf,
        /// Where it leads.
        target: PathBuf,
    },
    /// A link that can't be followed, there or on the way.
    #[error("{} is a symbolic link that leads nowhere: {error}", shown(link))]
    Nowhere {
        /// The link.
        link: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// A file whose name is that of an editor's or a system's own file.
    #[error(
        "{} is named like an editor's or a system's own files, which are passed over; rename it",
        shown(path)
    )]
    PassedOver {
        /// The file.
        path: PathBuf,
    },
    /// A path that is longer than the system allows.
    #[error("{}: no file has so long a name ({bytes} bytes)", shortened(&shown(path)))]
    Long {
        /// The path.
        path: PathBuf,
        /// Length of the path.
        bytes: usize,
    },
    /// It can't be looked at.
    #[error("{} can't be looked at: {error}", shown(path))]
    Unseen {
        /// The place.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

/// A path for a message, on one line; bytes that aren't UTF-8 are spelled out, as in `\xFF`.
pub(crate) fn shown(path: &Path) -> String {
    match path.to_str() {
        Some(text) => printable(text).into_owned(),
        None => format!("{path:?}").trim_matches('"').to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt as _;

    use super::*;

    #[test]
    fn paths_are_shown_on_one_line() {
        assert_eq!(shown(Path::new("a\u{1b}[31m/b\n.png")), "a\\u{1b}[31m/b\\n.png");
        assert_eq!(shown(Path::new(OsStr::from_bytes(b"a\xff\n.png"))), "a\\xFF\\n.png");
    }
}
