use artifact::Damage;
use store::StoreError;

use crate::experiment::Selection;
use crate::file::PipelineError;
use crate::sources::SourceError;
use crate::stage_call::ProgramError;

/// Targets and settings of the command line.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// Stages to run; if empty, the file's default.
    pub targets: Vec<String>,
    /// Parameters as `[STAGE.]NAME=VALUE[,VALUE…]`.
    pub parameters: Vec<String>,
    /// Inputs as `[STAGE.]NAME=DIR[,DIR…]`.
    pub inputs: Vec<String>,
    /// Selected parts of an experiment.
    pub selection: Selection,
}

/// Error returned when there is no plan, its states can't be found, or a program isn't the planned
/// one.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// A pipeline file is invalid.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The command line or a stage's program is invalid.
    #[error("{0}")]
    Usage(String),
    /// A folder outside the store can't be used.
    #[error("stage {stage}: input {input}: {problem}")]
    Source {
        /// Stage with the input.
        stage: String,
        /// Name of the input.
        input: String,
        /// Problem and remedy.
        problem: SourceError,
    },
    /// An artifact in the store can't be used.
    #[error("{0}")]
    Artifact(Damage),
    /// The store can't be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A signal came while stages were described or inputs were hashed.
    #[error("interrupted")]
    Interrupted,
}

impl From<ProgramError> for PlanError {
    fn from(error: ProgramError) -> Self {
        Self::Usage(error.to_string())
    }
}
