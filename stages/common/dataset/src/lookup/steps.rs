use std::collections::BTreeSet;
use std::path::Path;

use artifact::counted;

use crate::misplaced::shown;

/// Names that one step of the lookup found.
#[derive(Default)]
struct Step {
    names: BTreeSet<String>,
    /// First of them, and its file.
    first: Option<(String, String)>,
}

impl Step {
    fn add(&mut self, name: &str, file: &Path) {
        self.names.insert(name.to_owned());
        self.first.get_or_insert_with(|| (name.to_owned(), shown(file)));
    }

    /// Returns a line with the number of names and the first of them, if any; `one` and `many`
    /// describe one name and several.
    fn note(&self, one: &str, many: &str) -> Option<String> {
        let (name, file) = self.first.as_ref()?;
        let count = self.names.len();
        let verb = if count == 1 { one } else { many };
        Some(format!("{} {verb} ({name} is {file})", counted(count, "file name")))
    }
}

/// Steps by which a name led to its file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Taken {
    pub(super) slashes: bool,
    pub(super) tail: bool,
    pub(super) stand_in: bool,
    pub(super) extension: bool,
    pub(super) case: bool,
}

/// Steps by which a data set's names led to files, for the log.
#[derive(Default)]
pub(super) struct Steps {
    slashes: Step,
    tail: Step,
    stand_in: Step,
    extension: Step,
    case: Step,
}

impl Steps {
    pub(super) fn record(&mut self, name: &str, file: &Path, taken: Taken) {
        for (is_taken, step) in [
            (taken.slashes, &mut self.slashes),
            (taken.tail, &mut self.tail),
            (taken.stand_in, &mut self.stand_in),
            (taken.extension, &mut self.extension),
            (taken.case, &mut self.case),
        ] {
            if is_taken {
                step.add(name, file);
            }
        }
    }

    /// Returns a line for each step that found a name. `removed` is the number of leading parts
    /// that absolute names lose, `stand_in` the folder that is read instead of `images`.
    pub(super) fn notes(&self, removed: Option<usize>, stand_in: Option<&str>) -> Vec<String> {
        let without = match removed.unwrap_or(0) {
            0 => "read as relative".to_owned(),
            1 => "read without the first part".to_owned(),
            count => format!("read without the first {count} parts"),
        };
        let stand_in = stand_in.unwrap_or_default();
        [
            self.slashes.note(
                "contains backslashes, read as slashes",
                "contain backslashes, read as slashes",
            ),
            self.tail.note(
                &format!("is an absolute path, {without}"),
                &format!("are absolute paths, {without}"),
            ),
            self.stand_in.note(
                &format!("is read from {stand_in}, because images is missing or empty"),
                &format!("are read from {stand_in}, because images is missing or empty"),
            ),
            self.extension.note(
                "differs from its file in the extension",
                "differ from their files in the extension",
            ),
            self.case.note("differs from its file in case", "differ from their files in case"),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}
