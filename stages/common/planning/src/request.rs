use artifact::Damage;
use stage_call::Interrupted;
use store::StoreError;

use crate::experiment::Selection;
use crate::part::PipelineError;
use crate::sources::SourceError;

/// What is asked for on the command line.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// Stages to make; empty: the file's default.
    pub targets: Vec<String>,
    /// `name=value[,value…]`, the name with or without its stage.
    pub parameters: Vec<String>,
    /// `input=DIR[,DIR…]`, likewise.
    pub inputs: Vec<String>,
    /// What of an experiment is wanted.
    pub choice: Selection,
}

/// Why there is no plan.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The file is wrong.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The command line is wrong.
    #[error("{0}")]
    Usage(String),
    /// A source folder is wrong.
    #[error("stage {stage}: input {input}: {problem}")]
    Source {
        /// The stage that takes it.
        stage: String,
        /// The stage's input.
        input: String,
        /// What is wrong, and what to do.
        problem: SourceError,
    },
    /// An artifact in the store can't be used.
    #[error("{0}")]
    Artifact(Damage),
    /// The store can't be read: whether an artifact is there isn't known.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A signal came while stages were asked what they are, or inputs were hashed.
    #[error("interrupted")]
    Interrupted,
}

impl From<Interrupted> for PlanError {
    fn from(_: Interrupted) -> Self {
        Self::Interrupted
    }
}
