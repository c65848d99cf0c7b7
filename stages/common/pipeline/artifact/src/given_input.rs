use std::fs;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::failure::{Failure, FailureExt};
use crate::manifest::{MANIFEST_FILE, Manifest};

/// Input folder of a stage, checked against its manifest if it has one.
#[derive(Debug, Clone)]
pub struct GivenInput {
    name: String,
    folder: PathBuf,
    /// Identity of the manifest; `None` without a manifest.
    identity: Option<String>,
}

impl GivenInput {
    /// Opens a folder as the input `name`. If the folder or, for a subtree, its parent has a
    /// manifest, the files are checked first.
    ///
    /// # Errors
    /// [`Failure::BadInput`] if the folder doesn't exist, or its files differ from the manifest.
    pub fn open(name: &str, folder: &Path) -> Result<Self, Failure> {
        let context = format!("input {name}: {}", folder.display());
        if !folder.exists() {
            return Err(Failure::BadInput(format!("{context}: no such folder")));
        }
        let absolute = folder.canonicalize().bad_input(&context)?;
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

    /// Returns the name of the input.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the identity of the manifest; `None` without a manifest.
    pub fn identity(&self) -> Option<&str> {
        self.identity.as_deref()
    }

    /// Returns the folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns the path of a file of the input.
    pub fn path(&self, file: &str) -> PathBuf {
        self.folder.join(file)
    }

    /// Reads a JSON file of the input.
    ///
    /// # Errors
    /// [`Failure::BadInput`] with input, file and field.
    pub fn read_json<T: DeserializeOwned>(&self, file: &str) -> Result<T, Failure> {
        let path = self.path(file);
        let context = format!("input {}: {}", self.name, path.display());
        let bytes = fs::read(&path).bad_input(&context)?;
        serde_path_to_error::deserialize(&mut serde_json::Deserializer::from_slice(&bytes))
            .bad_input(&context)
    }

    /// Reads a JSON file that the input may lack.
    ///
    /// # Errors
    /// Those of [`GivenInput::read_json`].
    pub fn read_optional_json<T: DeserializeOwned>(
        &self,
        file: &str,
    ) -> Result<Option<T>, Failure> {
        if self.path(file).exists() { self.read_json(file).map(Some) } else { Ok(None) }
    }
}
