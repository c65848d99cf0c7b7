use std::path::Path;

/// Where an input's text leads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source<'a> {
    /// To a folder outside the store.
    Folder(&'a Path),
    /// To another stage's artifact, or a folder of it.
    Stage { name: &'a str, subtree: Option<&'a str> },
}

impl<'a> Source<'a> {
    pub(crate) fn of(text: &'a str) -> Self {
        if text.starts_with(['/', '.', '~']) {
            return Self::Folder(Path::new(text));
        }
        match text.split_once('/') {
            Some((name, folder)) => Self::Stage { name, subtree: Some(folder) },
            None => Self::Stage { name: text, subtree: None },
        }
    }

    /// The stage that it leads to.
    pub(crate) fn stage(self) -> Option<&'a str> {
        match self {
            Self::Folder(_) => None,
            Self::Stage { name, .. } => Some(name),
        }
    }
}

/// What in a block an error is about.
#[derive(Clone, Copy, Debug)]
pub enum Part<'a> {
    /// The block as a whole.
    Block,
    /// One of its own keys: `run`, `extends`.
    Field(&'a str),
    /// An input.
    Input(&'a str),
    /// A parameter.
    Parameter(&'a str),
}

/// A pipeline.yaml that can't be used: file, line, what to do.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{place}: {problem}")]
pub struct PipelineError {
    /// File and, where known, line.
    pub place: String,
    /// What is wrong and what to do.
    pub problem: String,
}
