use std::fs;
use std::path::PathBuf;

use crate::store::{Store, StoreError, at};

impl Store {
    /// Identities of all objects, sorted. Names that can't be an identity are somebody else's.
    pub fn objects(&self) -> Result<Vec<String>, StoreError> {
        let mut names = self.names("objects")?;
        names.retain(|name| is_identity(name));
        Ok(names)
    }

    /// Somebody else's files and folders among the objects, sorted.
    pub fn foreign_entries(&self) -> Result<Vec<PathBuf>, StoreError> {
        let folder = self.root().join("objects");
        let mut foreign = Vec::new();
        for entry in at(&folder, fs::read_dir(&folder))? {
            let entry = at(&folder, entry)?;
            if !entry.file_name().to_str().is_some_and(is_identity) {
                foreign.push(entry.path());
            }
        }
        foreign.sort_unstable();
        Ok(foreign)
    }
}

/// Whether a name is a hash as the store writes it: in lower case.
fn is_identity(name: &str) -> bool {
    name.len() == 64 && name.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A name is either an object's or foreign.
    #[test]
    fn a_name_in_upper_case_is_foreign() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let object = "0a".repeat(32);
        let others = [".hidden".to_owned(), "0".repeat(63), "0A".repeat(32), "g".repeat(64)];
        for name in others.iter().chain([&object]) {
            fs::create_dir(store.object(name)).unwrap();
        }
        assert_eq!(store.objects().unwrap(), [object]);
        assert_eq!(store.foreign_entries().unwrap(), others.map(|name| store.object(&name)));
    }
}
