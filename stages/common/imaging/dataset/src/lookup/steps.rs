use std::collections::BTreeSet;
use std::path::Path;

use artifact::format_count;

use crate::file_status::path_text;

/// Names that one step of the lookup found.
#[derive(Default)]
struct Step {
    names: BTreeSet<String>,
    /// First name, and its file.
    first: Option<(String, String)>,
}

impl Step {
    fn add(&mut self, name: &str, file: &Path) {
        self.names.insert(name.to_owned());
        self.first.get_or_insert_with(|| (name.to_owned(), path_text(file)));
    }

    /// Returns a note with the number of names and the first of them, if any; `how` describes the
    /// step.
    fn note(&self, how: &str) -> Option<String> {
        let (name, file) = self.first.as_ref()?;
        let names = format_count(self.names.len(), "file name");
        Some(format!("{names} found {how} (first: {name} is {file})"))
    }
}

/// Steps that led from a name to its file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct StepsTaken {
    pub(super) slashes: bool,
    pub(super) tail: bool,
    pub(super) substitute: bool,
    pub(super) extension: bool,
    pub(super) form: bool,
    pub(super) case: bool,
}

/// Steps that led from a data set's names to files, for the log.
#[derive(Default)]
pub(super) struct Steps {
    slashes: Step,
    tail: Step,
    substitute: Step,
    extension: Step,
    form: Step,
    case: Step,
}

impl Steps {
    pub(super) fn record(&mut self, name: &str, file: &Path, taken: StepsTaken) {
        for (is_taken, step) in [
            (taken.slashes, &mut self.slashes),
            (taken.tail, &mut self.tail),
            (taken.substitute, &mut self.substitute),
            (taken.extension, &mut self.extension),
            (taken.form, &mut self.form),
            (taken.case, &mut self.case),
        ] {
            if is_taken {
                step.add(name, file);
            }
        }
    }

    /// Returns a note for each step that found a name. `removed` is the number of leading parts
    /// removed from names, `substitute` the folder that is read instead of `images`.
    pub(super) fn notes(&self, removed: Option<usize>, substitute: Option<&str>) -> Vec<String> {
        let tail = match removed.unwrap_or(0) {
            0 => "by reading absolute paths as relative ones".to_owned(),
            1 => "without the first part of their paths".to_owned(),
            count => format!("without the first {count} parts of their paths"),
        };
        let substitute =
            format!("in {}, because images is missing or empty", substitute.unwrap_or_default());
        [
            self.slashes.note("with slashes instead of backslashes"),
            self.tail.note(&tail),
            self.substitute.note(&substitute),
            self.extension.note("with a different extension"),
            self.form.note("in a different Unicode normal form"),
            self.case.note("in a different case"),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}
