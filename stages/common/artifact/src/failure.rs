use std::fmt::Display;

use crate::printable::printable;

/// What went wrong, by what the user does next. Each kind has its exit code.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// Wrong arguments or parameters: exit code 2.
    #[error("{0}")]
    Usage(String),
    /// An input that can't be used: exit code 3.
    #[error("{0}")]
    BadInput(String),
    /// The numbers went wrong (NaN, divergence): exit code 4.
    #[error("{0}")]
    Numerical(String),
    /// Stopped by a signal; `--work` holds what resumes it: exit code 130.
    #[error("interrupted; run again to resume")]
    Interrupted,
}

impl Failure {
    /// The exit code of its kind.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::BadInput(_) => 3,
            Self::Numerical(_) => 4,
            Self::Interrupted => 130,
        }
    }
}

/// The exit code of an error: that of the [`Failure`] in its chain, else 1.
pub fn exit_code(error: &anyhow::Error) -> u8 {
    error.chain().find_map(|cause| cause.downcast_ref::<Failure>()).map_or(1, Failure::exit_code)
}

/// An error and its causes on one line, control characters spelled out.
pub fn one_line(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        // A library that prints its source in its own message would say it twice.
        if !text.contains(&cause) {
            text = if text.is_empty() { cause } else { format!("{text}: {cause}") };
        }
    }
    printable(&text.replace('\n', " ")).into_owned()
}

/// Turns any error into a [`Failure`] of a kind.
pub trait FailureExt<T> {
    /// The input can't be used: exit code 3. `context` says where.
    fn bad_input(self, context: impl Display) -> Result<T, Failure>;
    /// The parameters are wrong: exit code 2. `context` says which.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_from_files_move_no_terminal() {
        let error =
            anyhow::anyhow!("r_\u{1b}]0;PWN\u{7}.png: No such file").context("frame 3\nof many");
        assert_eq!(one_line(&error), r"frame 3 of many: r_\u{1b}]0;PWN\u{7}.png: No such file");
        let bad = Err::<(), _>(error).bad_input("input scene").unwrap_err();
        assert_eq!(
            one_line(&bad.into()),
            r"input scene: frame 3 of many: r_\u{1b}]0;PWN\u{7}.png: No such file"
        );
    }
}
