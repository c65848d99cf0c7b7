use store::is_hash;

/// Folder of a remote with its records.
pub(crate) const ACTIONS: &str = "actions";

/// Content of a remote's folder of records.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Listing {
    /// Keys of the records, sorted.
    pub(crate) keys: Vec<String>,
    /// Names that no record has, sorted.
    pub(crate) odd: Vec<String>,
}

impl Listing {
    /// Adds a file. Hidden files, logs and notes may lie beside the records.
    pub(crate) fn add(&mut self, name: &str) {
        match name.strip_suffix(".json") {
            Some(key) if is_hash(key) => self.keys.push(key.to_owned()),
            Some(_) if !name.starts_with('.') => self.odd.push(name.to_owned()),
            _ => {}
        }
    }

    pub(crate) fn sort(&mut self) {
        self.keys.sort_unstable();
        self.odd.sort_unstable();
    }
}
