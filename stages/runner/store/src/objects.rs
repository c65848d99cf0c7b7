use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use artifact::{Damage, MANIFEST_FILE, Manifest, sync_folder, write_json_atomically};

use crate::error::{StoreError, with_path};
use crate::folder::Store;

impl Store {
    /// Returns the identities of all objects, sorted; names that aren't hashes are foreign.
    pub fn objects(&self) -> Result<Vec<String>, StoreError> {
        let mut names = self.list_names("objects")?;
        names.retain(|name| is_hash(name));
        Ok(names)
    }

    /// Returns the files and folders among the objects that don't belong to the store, sorted.
    pub fn foreign_entries(&self) -> Result<Vec<PathBuf>, StoreError> {
        let folder = self.root().join("objects");
        let mut foreign = Vec::new();
        for entry in with_path(&folder, fs::read_dir(&folder))? {
            let entry = with_path(&folder, entry)?;
            if !entry.file_name().to_str().is_some_and(is_hash) {
                foreign.push(entry.path());
            }
        }
        foreign.sort_unstable();
        Ok(foreign)
    }

    /// Returns whether an object is complete: it has its own manifest and all files of the right
    /// sizes, whose content is not read. Fails if the object can't be read.
    pub fn is_complete(&self, identity: &str) -> Result<bool, Damage> {
        let manifest = self.own_manifest(identity);
        match manifest.and_then(|manifest| manifest.check_sizes(&self.object(identity))) {
            Ok(()) => Ok(true),
            Err(unreadable @ Damage::Unreadable { .. }) => Err(unreadable),
            Err(_) => Ok(false),
        }
    }

    /// Reads the manifest of an object.
    pub fn manifest(&self, identity: &str) -> Result<Manifest, Damage> {
        Manifest::read(&self.object(identity))
    }

    /// Checks an object by hashing all files.
    pub fn verify(&self, identity: &str) -> Result<(), Damage> {
        self.own_manifest(identity)?.check_contents(&self.object(identity))
    }

    /// Reads the manifest of an object; fails if the manifest belongs to another object.
    fn own_manifest(&self, identity: &str) -> Result<Manifest, Damage> {
        let manifest = self.manifest(identity)?;
        if manifest.identity() != identity {
            return Err(Damage::Content { path: self.object(identity).join(MANIFEST_FILE) });
        }
        Ok(manifest)
    }

    /// Rewrites the manifest of an object if its files have the object's identity. Returns whether
    /// the manifest was rewritten.
    pub(crate) fn repair(&self, identity: &str, kind: &str) -> Result<bool, StoreError> {
        use io::ErrorKind::{NotADirectory, NotFound, Other};
        let object = self.object(identity);
        let found = match Manifest::of_folder(kind, &object) {
            // A file is missing, or its name is not UTF-8.
            Err(error) if matches!(error.kind(), NotFound | NotADirectory | Other) => {
                return Ok(false);
            }
            found => with_path(&object, found)?,
        };
        if found.identity() != identity {
            return Ok(false);
        }
        let path = object.join(MANIFEST_FILE);
        with_path(&path, write_json_atomically(&path, &found))?;
        Ok(true)
    }

    /// Moves a checked folder to the path of an object. `is_stored`: the caller has found the
    /// object complete; then the folder is moved only if the object no longer exists. Two actions
    /// may create the same object concurrently: an undamaged object stays, a damaged one is
    /// replaced.
    pub(crate) fn install_object(
        &self,
        folder: &Path,
        identity: &str,
        is_stored: bool,
    ) -> Result<(), StoreError> {
        use io::ErrorKind::{AlreadyExists, DirectoryNotEmpty, NotADirectory};
        let object = self.object(identity);
        if is_stored && object.exists() {
            return Ok(());
        }
        loop {
            match fs::rename(folder, &object) {
                Err(error)
                    if matches!(
                        error.kind(),
                        AlreadyExists | DirectoryNotEmpty | NotADirectory
                    ) => {}
                renamed => {
                    with_path(&object, renamed)?;
                    return with_path(&object, sync_folder(&self.root().join("objects")));
                }
            }
            match self.verify(identity) {
                Ok(()) => return Ok(()),
                Err(unreadable @ Damage::Unreadable { .. }) => return Err(unreadable.into()),
                Err(_) => self.move_to_trash(&object)?,
            };
        }
    }

    /// Removes an object, if it exists; records that refer to it count as absent from then on.
    pub fn remove_object(&self, identity: &str) -> Result<(), StoreError> {
        self.move_to_trash(&self.object(identity)).map(|_| ())
    }
}

/// Returns whether a name is a hash in lower-case hexadecimal, as keys and identities are. Other
/// names must not become parts of paths.
pub fn is_hash(name: &str) -> bool {
    name.len() == 64 && name.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

/// Makes the files of an artifact durable, including its manifest, with their entries in folders.
pub(crate) fn make_durable(folder: &Path, manifest: &Manifest) -> Result<(), StoreError> {
    let mut folders = BTreeSet::from([Path::new("")]);
    for file in manifest.files.iter().map(|file| file.path.as_str()).chain([MANIFEST_FILE]) {
        let path = folder.join(file);
        with_path(&path, File::open(&path).and_then(|f| f.sync_all()))?;
        folders.extend(Path::new(file).ancestors().skip(1));
    }
    for path in folders.into_iter().map(|part| folder.join(part)) {
        with_path(&path, sync_folder(&path))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::action::Record;
    use crate::testing::{UNREADABLE, begin, entered, finish_action};

    /// Every name in the folder is either an object's hash or foreign.
    #[test]
    fn names_that_are_not_hashes_are_foreign() {
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
    fn a_hash_has_64_lower_case_digits() {
        assert!(is_hash(&"0a".repeat(32)));
        for name in ["", "..", &"0A".repeat(32), &"g".repeat(64), &"0".repeat(63), "/etc/passwd"] {
            assert!(!is_hash(name), "{name}");
        }
    }

    /// An unreadable object may be complete: it is neither a miss nor replaced.
    #[test]
    fn unreadable_objects_are_errors() {
        let [folder, looped] = UNREADABLE;
        for (file, damage) in [(MANIFEST_FILE, folder), (MANIFEST_FILE, looped), ("x", looped)] {
            let dir = tempfile::tempdir().unwrap();
            let store = Store::open(dir.path()).unwrap();
            let done = finish_action(&store, "a", "1234");
            let path = store.object(&done.output).join(file);
            damage(&path);
            let checked = store.check(begin(&store, "b", Some("1234")), "text").unwrap();
            for problem in [
                store.is_complete(&done.output).map_err(StoreError::from).err(),
                store.hit(&done.key()).err(),
                store.verify(&done.output).map_err(StoreError::from).err(),
                store.publish(&entered(&store), checked, Record::default()).err(),
            ] {
                let message = problem.unwrap().to_string();
                let start = format!("cannot read {}", path.display());
                assert!(message.starts_with(&start) && !message.contains("--remove"), "{message}");
            }
            assert!(path.symlink_metadata().is_ok(), "{} is kept", path.display());
        }
    }

    /// Actions with different keys repair one damaged object concurrently.
    #[test]
    fn concurrent_actions_publish_one_object() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        let output = finish_action(&store, "a", "1234").output;
        for round in 0..200 {
            fs::write(store.object(&output).join("x"), "4321").unwrap();
            std::thread::scope(|scope| {
                for action in 0..3 {
                    let store = &store;
                    scope.spawn(move || {
                        assert_eq!(
                            finish_action(store, &format!("{round} {action}"), "1234").output.len(),
                            64
                        );
                    });
                }
            });
            store.verify(&output).unwrap();
        }
    }
}
