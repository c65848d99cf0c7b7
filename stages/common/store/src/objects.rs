use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use artifact::{Damage, MANIFEST_FILE, Manifest, sync_folder, write_json_atomically};

use crate::error::{StoreError, at};
use crate::folder::Store;

impl Store {
    /// Identities of all objects, sorted. Names that can't be an identity are somebody else's.
    pub fn objects(&self) -> Result<Vec<String>, StoreError> {
        let mut names = self.names("objects")?;
        names.retain(|name| is_hash(name));
        Ok(names)
    }

    /// Somebody else's files and folders among the objects, sorted.
    pub fn foreign_entries(&self) -> Result<Vec<PathBuf>, StoreError> {
        let folder = self.root().join("objects");
        let mut foreign = Vec::new();
        for entry in at(&folder, fs::read_dir(&folder))? {
            let entry = at(&folder, entry)?;
            if !entry.file_name().to_str().is_some_and(is_hash) {
                foreign.push(entry.path());
            }
        }
        foreign.sort_unstable();
        Ok(foreign)
    }

    /// Returns whether an object has its own manifest and files of the right sizes; no content is
    /// read. An object that can't be read is an error.
    pub fn is_whole(&self, identity: &str) -> Result<bool, Damage> {
        let manifest = self.own_manifest(identity);
        match manifest.and_then(|manifest| manifest.check_sizes(&self.object(identity))) {
            Ok(()) => Ok(true),
            Err(unreadable @ Damage::Unreadable { .. }) => Err(unreadable),
            Err(_) => Ok(false),
        }
    }

    /// An object's manifest.
    pub fn manifest(&self, identity: &str) -> Result<Manifest, Damage> {
        Manifest::read(&self.object(identity))
    }

    /// Re-hashes one object.
    pub fn verify(&self, identity: &str) -> Result<(), Damage> {
        self.own_manifest(identity)?.check_contents(&self.object(identity))
    }

    /// Returns an object's manifest if the manifest is the object's own.
    fn own_manifest(&self, identity: &str) -> Result<Manifest, Damage> {
        let manifest = self.manifest(identity)?;
        if manifest.identity() != identity {
            return Err(Damage::Content { path: self.object(identity).join(MANIFEST_FILE) });
        }
        Ok(manifest)
    }

    /// Writes an object's manifest again if the files beside it have the object's identity; returns
    /// whether they have.
    pub(crate) fn repair(&self, identity: &str, kind: &str) -> Result<bool, StoreError> {
        use io::ErrorKind::{NotADirectory, NotFound, Other};
        let object = self.object(identity);
        let found = match Manifest::of_folder(kind, &object) {
            // Files are missing, or have names that no manifest can have.
            Err(error) if matches!(error.kind(), NotFound | NotADirectory | Other) => {
                return Ok(false);
            }
            found => at(&object, found)?,
        };
        if found.identity() != identity {
            return Ok(false);
        }
        let path = object.join(MANIFEST_FILE);
        at(&path, write_json_atomically(&path, &found))?;
        Ok(true)
    }

    /// Moves a checked folder to an object's place, unless a whole object `is_there`. Two actions
    /// may make one object at once: it is moved where there is nothing, and what is there then
    /// stays if it is whole.
    pub(crate) fn place(
        &self,
        folder: &Path,
        identity: &str,
        is_there: bool,
    ) -> Result<(), StoreError> {
        use io::ErrorKind::{AlreadyExists, DirectoryNotEmpty, NotADirectory};
        let object = self.object(identity);
        if is_there && object.exists() {
            return Ok(());
        }
        loop {
            match fs::rename(folder, &object) {
                Ok(()) => return at(&object, sync_folder(&self.root().join("objects"))),
                Err(error)
                    if matches!(
                        error.kind(),
                        AlreadyExists | DirectoryNotEmpty | NotADirectory
                    ) => {}
                Err(source) => return Err(StoreError::Io { path: object, source }),
            }
            match self.verify(identity) {
                Ok(()) => return Ok(()),
                Err(unreadable @ Damage::Unreadable { .. }) => return Err(unreadable.into()),
                Err(_) => {}
            }
            match self.discard(&object) {
                // The other action was faster.
                Err(StoreError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
                result => result?,
            }
        }
    }

    /// Removes an object; records that name it count as absent from then on. Somebody else may have
    /// removed it already.
    pub fn remove_object(&self, identity: &str) -> Result<(), StoreError> {
        match self.discard(&self.object(identity)) {
            Err(StoreError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                Ok(())
            }
            result => result,
        }
    }
}

/// Whether a name can be a key or an identity, in lower case as the store writes them: no other
/// becomes part of a path.
pub fn is_hash(name: &str) -> bool {
    name.len() == 64 && name.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

/// Makes the files of an artifact durable, its manifest among them.
pub(crate) fn make_durable(folder: &Path, manifest: &Manifest) -> Result<(), StoreError> {
    for file in manifest.files.iter().map(|file| file.path.as_str()).chain([MANIFEST_FILE]) {
        let path = folder.join(file);
        at(&path, File::open(&path).and_then(|f| f.sync_all()))?;
    }
    at(folder, sync_folder(folder))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::action::Record;
    use crate::testing::{UNREADABLE, begin, entered, make};

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

    #[test]
    fn names_that_no_path_is_made_of() {
        assert!(is_hash(&"0a".repeat(32)));
        for name in ["", "..", &"0A".repeat(32), &"g".repeat(64), &"0".repeat(63), "/etc/passwd"] {
            assert!(!is_hash(name), "{name}");
        }
    }

    /// An object that can't be read may be whole: it is neither a miss nor replaced.
    #[test]
    fn unreadable_objects_are_errors() {
        let [folder, looped] = UNREADABLE;
        for (file, damage) in [(MANIFEST_FILE, folder), (MANIFEST_FILE, looped), ("x", looped)] {
            let dir = tempfile::tempdir().unwrap();
            let store = Store::open(dir.path()).unwrap();
            let done = make(&store, "a", "1234");
            let path = store.object(&done.output).join(file);
            damage(&path);
            let checked = store.check(begin(&store, "b", Some("1234")), "text").unwrap();
            for problem in [
                store.is_whole(&done.output).map_err(StoreError::from).err(),
                store.hit(&done.key()).err(),
                store.verify(&done.output).map_err(StoreError::from).err(),
                store.publish(&entered(&store), checked, Record::default()).err(),
            ] {
                let said = problem.unwrap().to_string();
                let words = format!("cannot read {}", path.display());
                assert!(said.starts_with(&words) && !said.contains("--remove"), "{said}");
            }
            assert!(path.symlink_metadata().is_ok(), "it stays");
        }
    }

    /// Actions with different keys mend one damaged object at once, again and again.
    #[test]
    fn actions_at_once_make_one_object() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let output = make(&store, "a", "1234").output;
        for round in 0..200 {
            fs::write(store.object(&output).join("x"), "4321").unwrap();
            std::thread::scope(|scope| {
                for action in 0..3 {
                    let store = &store;
                    scope.spawn(move || {
                        assert_eq!(
                            make(store, &format!("{round} {action}"), "1234").output.len(),
                            64
                        );
                    });
                }
            });
            store.verify(&output).unwrap();
        }
    }
}
