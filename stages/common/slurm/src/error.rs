use std::path::{Path, PathBuf};

/// What can go wrong with Slurm.
#[derive(Debug, thiserror::Error)]
pub enum SlurmError {
    /// A program of Slurm's isn't there.
    #[error("{program}: {source}; run this where Slurm's programs are on PATH")]
    Absent {
        /// Its name.
        program: &'static str,
        /// Why it can't be started.
        source: std::io::Error,
    },
    /// A program of Slurm's refused.
    #[error("{program}: {said}")]
    Refused {
        /// Its name.
        program: &'static str,
        /// What it said.
        said: String,
    },
    /// A file can't be used.
    #[error("{path}: {problem}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what to do.
        problem: String,
    },
}

impl SlurmError {
    pub(crate) fn file(path: &Path, problem: impl std::fmt::Display) -> Self {
        Self::File { path: path.to_path_buf(), problem: problem.to_string() }
    }
}
