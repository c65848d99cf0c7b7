use std::fs;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::failure::{Failure, FailureExt};
use crate::manifest::{MANIFEST_FILE, Manifest};

/// An input that was given: a folder, checked against its manifest where it has one.
#[derive(Debug, Clone)]
pub struct GivenInput {
    name: String,
    folder: PathBuf,
    /// Its manifest's, where it has one.
    identity: Option<String>,
}

impl GivenInput {
    /// A folder under an input's name. With a manifest in it or above it (a subtree), its files are
    /// checked first.
    ///
    /// # Errors
    /// [`Failure::BadInput`] where there is no such folder, or its files aren't the manifest's.
    pub fn open(name: &str, folder: &Path) -> Result<Self, Failure> {
        if !folder.exists() {
            return Err(Failure::BadInput(format!(
                "input {name}: {}: no such folder",
                folder.display()
            )));
        }
        let absolute =
            folder.canonicalize().bad_input(format!("input {name}: {}", folder.display()))?;
        let manifest = if absolute.join(MANIFEST_FILE).is_file() {
            Some(Manifest::read(&absolute))
        } else if let (Some(parent), Some(subtree)) =
            (absolute.parent(), absolute.file_name().and_then(|n| n.to_str()))
            && parent.join(MANIFEST_FILE).is_file()
        {
            Some(Manifest::read(parent).map(|manifest| manifest.subtree(subtree)))
        } else {
            None
        };
        let manifest = manifest.transpose().bad_input(format!("input {name}"))?;
        if let Some(manifest) = &manifest {
            manifest.check_contents(&absolute).bad_input(format!("input {name}"))?;
        }
        let identity = manifest.map(|manifest| manifest.identity());
        Ok(Self { name: name.to_owned(), folder: folder.to_path_buf(), identity })
    }

    /// The input's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its manifest's identity; nothing where it has no manifest.
    pub fn identity(&self) -> Option<&str> {
        self.identity.as_deref()
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// A file of the input.
    pub fn path(&self, file: &str) -> PathBuf {
        self.folder.join(file)
    }

    /// A JSON file of the input.
    ///
    /// # Errors
    /// [`Failure::BadInput`] with input, file and field.
    pub fn read_json<T: DeserializeOwned>(&self, file: &str) -> Result<T, Failure> {
        let path = self.path(file);
        let place = format!("input {}: {}", self.name, path.display());
        let bytes = fs::read(&path).bad_input(&place)?;
        serde_path_to_error::deserialize(&mut serde_json::Deserializer::from_slice(&bytes))
            .bad_input(&place)
    }
}
