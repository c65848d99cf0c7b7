use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use artifact::format_count;

use crate::file_status::path_text;

/// Step that led from a name to its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Step {
    /// Backslashes are read as slashes.
    Slashes,
    /// Leading parts of the path are removed.
    Tail,
    /// A reduced copy of the folder `images` is read.
    Substitute,
    /// The file has a different extension.
    Extension,
    /// The file's name has a different Unicode normal form.
    Form,
    /// The file's name has a different case.
    Case,
}

/// Names that one step of the lookup found.
struct Found {
    names: BTreeSet<String>,
    /// First name with its file, as text.
    first: String,
}

/// Steps that led from a data set's names to files, for the log.
#[derive(Default)]
pub(super) struct Steps(BTreeMap<Step, Found>);

impl Steps {
    pub(super) fn record(&mut self, name: &str, file: &Path, steps: Vec<Step>) {
        for step in steps {
            let found = self.0.entry(step).or_insert_with(|| Found {
                names: BTreeSet::new(),
                first: format!("{name} is {}", path_text(file)),
            });
            found.names.insert(name.to_owned());
        }
    }

    /// Returns a note for each step that found a name. `removed` is the number of leading parts
    /// removed from names, `substitute` the folder that is read instead of `images`.
    pub(super) fn notes(&self, removed: Option<usize>, substitute: Option<&str>) -> Vec<String> {
        let mut notes = Vec::new();
        for (step, Found { names, first }) in &self.0 {
            let how = match (step, removed.unwrap_or(0)) {
                (Step::Slashes, _) => "with slashes instead of backslashes".to_owned(),
                (Step::Tail, 0) => "by reading absolute paths as relative ones".to_owned(),
                (Step::Tail, 1) => "without the first part of their paths".to_owned(),
                (Step::Tail, count) => format!("without the first {count} parts of their paths"),
                (Step::Substitute, _) => {
                    let substitute = substitute.unwrap_or_default();
                    format!("in {substitute}, because images is missing or empty")
                }
                (Step::Extension, _) => "with a different extension".to_owned(),
                (Step::Form, _) => "in a different Unicode normal form".to_owned(),
                (Step::Case, _) => "in a different case".to_owned(),
            };
            let count = format_count(names.len(), "file name");
            notes.push(format!("{count} found {how} (first: {first})"));
        }
        notes
    }
}
