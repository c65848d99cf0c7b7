use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use crate::found::{Found, find};

/// Names in a folder, by their lower-case form.
type Names = BTreeMap<String, Vec<String>>;

/// Folders below a data set's folder, each listed at most once, on first use. Paths are relative to
/// the data set's folder. Names that begin with a dot are left out: `.DS_Store` and macOS's
/// `._IMG_0000.png` are nobody's photographs.
pub(crate) struct Listings {
    root: PathBuf,
    folders: BTreeMap<PathBuf, Rc<Names>>,
}

impl Listings {
    pub(crate) fn new(root: &Path) -> Self {
        Self { root: root.to_path_buf(), folders: BTreeMap::new() }
    }

    /// Data set's folder.
    pub(crate) fn root(&self) -> &Path {
        &self.root
    }

    /// Returns a folder's names in the order of their lower-case forms; none where the folder
    /// cannot be listed.
    pub(crate) fn names(&mut self, folder: &Path) -> Vec<String> {
        self.listed(folder).values().flatten().cloned().collect()
    }

    /// Returns a folder's names that equal `name` but for case.
    pub(crate) fn alike(&mut self, folder: &Path, name: &str) -> Vec<String> {
        self.listed(folder).get(&name.to_lowercase()).cloned().unwrap_or_default()
    }

    pub(crate) fn is_file(&self, path: &Path) -> bool {
        matches!(find(&self.root.join(path), "a file"), Found::File)
    }

    pub(crate) fn is_folder(&self, path: &Path) -> bool {
        self.root.join(path).is_dir()
    }

    fn listed(&mut self, folder: &Path) -> Rc<Names> {
        if let Some(names) = self.folders.get(folder) {
            return Rc::clone(names);
        }
        let mut names = Names::new();
        let entries = std::fs::read_dir(self.root.join(folder)).into_iter().flatten().flatten();
        for entry in entries {
            // A name that isn't UTF-8 equals no name that a text file writes.
            let Ok(name) = entry.file_name().into_string() else { continue };
            if !name.starts_with('.') {
                names.entry(name.to_lowercase()).or_default().push(name);
            }
        }
        names.values_mut().for_each(|same| same.sort_unstable());
        let names = Rc::new(names);
        self.folders.insert(folder.to_path_buf(), Rc::clone(&names));
        names
    }
}
