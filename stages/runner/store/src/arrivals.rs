use std::path::{Path, PathBuf};

use artifact::{Damage, MANIFEST_FILE, Manifest};

use crate::action::Record;
use crate::error::StoreError;
use crate::folder::Store;
use crate::lock::Entered;
use crate::objects::make_durable;

/// Artifact from another store, checked in a scratch folder of this store.
#[derive(Debug)]
pub struct Arrival {
    folder: PathBuf,
    identity: String,
    /// True if a damaged object is to be replaced.
    replaces: bool,
}

impl Store {
    /// Checks an artifact from another store, its files against the manifest and the manifest
    /// against the identity, and makes it durable. Then [`Store::import_object`] is fast, unless it
    /// replaces a damaged object, which it hashes again.
    pub fn check_arrival(&self, folder: &Path, identity: &str) -> Result<Arrival, StoreError> {
        let manifest = Manifest::read(folder)?;
        if manifest.identity() != identity {
            return Err(Damage::Content { path: folder.join(MANIFEST_FILE) }.into());
        }
        manifest.check_contents(folder)?;
        make_durable(folder, &manifest)?;
        let replaces =
            self.object(identity).symlink_metadata().is_ok() && self.verify(identity).is_err();
        Ok(Arrival { folder: folder.to_path_buf(), identity: identity.to_owned(), replaces })
    }

    /// Moves a checked object into place, unless the store has a complete one.
    pub fn import_object(&self, _: &Entered, arrival: &Arrival) -> Result<(), StoreError> {
        // An object that another process has stored meanwhile isn't hashed again.
        let is_stored = !arrival.replaces && self.is_complete(&arrival.identity)?;
        self.install_object(&arrival.folder, &arrival.identity, is_stored)
    }

    /// Writes a record from another store, whose object is imported first; returns whether the
    /// record was written. An existing record stays, unless only the new one's object is complete.
    pub fn import_record(&self, _: &Entered, record: &Record) -> Result<bool, StoreError> {
        if let Some(existing) = self.record(&record.key())?
            && (existing == *record
                || self.is_complete(&existing.output)?
                || !self.is_complete(&record.output)?)
        {
            return Ok(false);
        }
        self.write_record(record)?;
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use artifact::write_json;

    use super::*;
    use crate::testing::entered;

    /// Writes an artifact into a scratch folder; returns the folder and the identity.
    fn write_arrival(store: &Store, content: &str) -> (PathBuf, String) {
        let folder = store.scratch("run").join("arriving");
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join("x"), content).unwrap();
        let manifest = Manifest::of_folder("text", &folder).unwrap();
        write_json(&folder.join(MANIFEST_FILE), &manifest).unwrap();
        (folder, manifest.identity())
    }

    fn record(output: &str, host: &str) -> Record {
        Record {
            stage: "s".to_owned(),
            output: output.to_owned(),
            host: host.to_owned(),
            ..Record::default()
        }
    }

    /// Imports an artifact and its record; returns whether the record is new, and the identity.
    fn import_from(store: &Store, entered: &Entered, host: &str) -> (bool, String) {
        let (folder, identity) = write_arrival(store, "1234");
        store.import_object(entered, &store.check_arrival(&folder, &identity).unwrap()).unwrap();
        (store.import_record(entered, &record(&identity, host)).unwrap(), identity)
    }

    #[test]
    fn existing_records_stay_and_damaged_objects_are_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let entered = entered(&store);
        let (is_new, identity) = import_from(&store, &entered, "first");
        assert!(is_new);
        assert!(!import_from(&store, &entered, "second").0);
        let key = record("", "").key();
        assert_eq!(store.hit(&key).unwrap().unwrap().host, "first");
        fs::write(store.object(&identity).join("x"), "12").unwrap();
        import_from(&store, &entered, "third");
        store.verify(&identity).unwrap();
        assert_eq!(store.hit(&key).unwrap().unwrap().host, "first");
    }

    #[test]
    fn incomplete_or_changed_artifacts_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let (folder, identity) = write_arrival(&store, "1234");
        assert!(matches!(
            store.check_arrival(&folder, &"0".repeat(64)),
            Err(StoreError::Damage(Damage::Content { .. }))
        ));
        fs::write(folder.join("x"), "1235").unwrap();
        assert!(matches!(
            store.check_arrival(&folder, &identity),
            Err(StoreError::Damage(Damage::Content { .. }))
        ));
        fs::remove_file(folder.join("x")).unwrap();
        assert!(matches!(
            store.check_arrival(&folder, &identity),
            Err(StoreError::Damage(Damage::Missing { .. }))
        ));
        assert!(store.objects().unwrap().is_empty());
    }
}
