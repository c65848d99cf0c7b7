use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use unicode_normalization::UnicodeNormalization as _;

use crate::file_status::check_file;

/// Names in a folder, grouped by [`folded`] form.
type Names = BTreeMap<String, Vec<String>>;

/// Cached listings of the folders below a data set's folder, to which paths are relative. Hidden
/// files, such as `.DS_Store` and macOS's `._IMG_0000.png`, are omitted.
pub(crate) struct Listings {
    root: PathBuf,
    folders: BTreeMap<PathBuf, Rc<Names>>,
}

impl Listings {
    pub(crate) fn new(root: &Path) -> Self {
        Self { root: root.to_path_buf(), folders: BTreeMap::new() }
    }

    /// Returns the data set's folder.
    pub(crate) fn root(&self) -> &Path {
        &self.root
    }

    /// Returns a folder's names in the order of their folded forms; none if the folder can't be
    /// listed.
    pub(crate) fn names(&mut self, folder: &Path) -> Vec<String> {
        self.listing(folder).values().flatten().cloned().collect()
    }

    /// Returns a folder's names that equal `name` if case and Unicode normal form are ignored.
    pub(crate) fn variants(&mut self, folder: &Path, name: &str) -> Vec<String> {
        self.listing(folder).get(&folded(name)).cloned().unwrap_or_default()
    }

    pub(crate) fn is_file(&self, path: &Path) -> bool {
        check_file(&self.root.join(path), "a file").is_ok()
    }

    pub(crate) fn is_folder(&self, path: &Path) -> bool {
        self.root.join(path).is_dir()
    }

    fn listing(&mut self, folder: &Path) -> Rc<Names> {
        if let Some(names) = self.folders.get(folder) {
            return Rc::clone(names);
        }
        let mut names = Names::new();
        let entries = std::fs::read_dir(self.root.join(folder)).into_iter().flatten().flatten();
        for entry in entries {
            // Names that aren't UTF-8 can't be in a data set's text files.
            let Ok(name) = entry.file_name().into_string() else { continue };
            if !name.starts_with('.') {
                names.entry(folded(&name)).or_default().push(name);
            }
        }
        for variants in names.values_mut() {
            variants.sort_unstable();
        }
        let names = Rc::new(names);
        self.folders.insert(folder.to_path_buf(), Rc::clone(&names));
        names
    }
}

/// Returns a name in its composed normal form: macOS decomposes `é` into `e` and an accent.
pub(super) fn composed(name: &str) -> String {
    name.nfc().collect()
}

/// Returns a name in composed normal form and lower case.
fn folded(name: &str) -> String {
    composed(name).to_lowercase()
}
