use std::fmt::Display;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use crate::text::printable;
use crate::type_words::in_words;

/// Error that a program exits with. The kind, and so the exit code, tells the user what to change.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// Wrong arguments or parameters: exit code 2.
    #[error("{0}")]
    Usage(String),
    /// Unusable input: exit code 3.
    #[error("{0}")]
    BadInput(String),
    /// Numerical failure (NaN, divergence): exit code 4.
    #[error("{0}")]
    Numerical(String),
    /// Interruption by a signal, after which another run can resume from `--work`: exit code 130.
    #[error("interrupted; run again to resume")]
    Interrupted,
}

impl Failure {
    /// Returns the exit code.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::BadInput(_) => 3,
            Self::Numerical(_) => 4,
            Self::Interrupted => 130,
        }
    }
}

/// Returns from a function with [`Failure::Usage`]; the arguments are those of [`format!`].
#[macro_export]
macro_rules! bail_usage {
    ($($text:tt)*) => {
        return Err($crate::Failure::Usage(format!($($text)*)).into())
    };
}

/// Returns from a function with [`Failure::BadInput`]; the arguments are those of [`format!`].
#[macro_export]
macro_rules! bail_bad_input {
    ($($text:tt)*) => {
        return Err($crate::Failure::BadInput(format!($($text)*)).into())
    };
}

/// Returns the exit code of the [`Failure`] in an error's chain; 1 without one.
pub fn exit_code(error: &anyhow::Error) -> u8 {
    error.chain().find_map(|cause| cause.downcast_ref::<Failure>()).map_or(1, Failure::exit_code)
}

/// Formats an error and its causes on one line, with serde's type names in plain words and control
/// characters escaped.
pub fn one_line(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        // Some libraries repeat the message of the source in their own.
        if !text.contains(&cause) {
            text = if text.is_empty() { cause } else { format!("{text}: {cause}") };
        }
    }
    printable(&in_words(&text.replace('\n', " "))).into_owned()
}

/// Conversion of any error to a [`Failure`].
pub trait FailureExt<T> {
    /// Converts to [`Failure::BadInput`]; `context` names the input.
    fn bad_input(self, context: impl Display) -> Result<T, Failure>;
    /// Converts to [`Failure::Usage`]; `context` names the argument.
    fn usage(self, context: impl Display) -> Result<T, Failure>;
}

impl<T, E: Into<anyhow::Error>> FailureExt<T> for Result<T, E> {
    fn bad_input(self, context: impl Display) -> Result<T, Failure> {
        self.map_err(|e| Failure::BadInput(format!("{context}: {}", one_line(&e.into()))))
    }

    fn usage(self, context: impl Display) -> Result<T, Failure> {
        self.map_err(|e| Failure::Usage(format!("{context}: {}", one_line(&e.into()))))
    }
}

/// Returns advice for the end of a message about a file to which access was denied. Users who don't
/// own the file learn its owner and how users can share a store. Empty for other errors.
pub fn permission_advice(path: &Path, error: &io::Error) -> String {
    if error.kind() != io::ErrorKind::PermissionDenied {
        return String::new();
    }
    // If the file doesn't exist or can't be reached, its folder refuses access.
    let owner = path.ancestors().find_map(|path| Some(path.symlink_metadata().ok()?.uid()));
    // `/proc/self` belongs to the user of this process.
    let user = Path::new("/proc/self").metadata().ok().map(|meta| meta.uid());
    access_advice(owner, user)
}

fn access_advice(owner: Option<u32>, user: Option<u32>) -> String {
    if owner.is_some() && owner == user {
        return "; you own it: allow access with chmod".to_owned();
    }
    let owner = owner.map(|owner| format!("; owned by user {owner}")).unwrap_or_default();
    format!("{owner}; share a store through a group and umask 002, or choose another with --store")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped() {
        let error =
            anyhow::anyhow!("r_\u{1b}]0;PWN\u{7}.png: No such file").context("frame 3\nof many");
        assert_eq!(one_line(&error), r"frame 3 of many: r_\u{1b}]0;PWN\u{7}.png: No such file");
        let bad = Err::<(), _>(error).bad_input("input scene").unwrap_err();
        assert_eq!(
            one_line(&bad.into()),
            r"input scene: frame 3 of many: r_\u{1b}]0;PWN\u{7}.png: No such file"
        );
    }

    #[test]
    fn advice_depends_on_the_owner_of_an_inaccessible_folder() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("absent/file");
        let advice = permission_advice(&path, &io::Error::from(io::ErrorKind::PermissionDenied));
        assert_eq!(advice, "; you own it: allow access with chmod");
        let advice = access_advice(Some(3), Some(4));
        assert!(advice.starts_with("; owned by user 3; share a store"), "{advice}");
        assert!(access_advice(None, None).starts_with("; share a store"));
        assert_eq!(permission_advice(&path, &io::Error::from(io::ErrorKind::NotFound)), "");
    }
}
