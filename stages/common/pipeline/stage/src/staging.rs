use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use artifact::{Failure, MANIFEST_FILE, Manifest, bail_usage, write_json};

/// Unpublished output: a folder next to the final one. Unless published, the folder is removed.
pub(crate) struct Staging {
    folder: PathBuf,
}

impl Staging {
    /// Creates the folder. Fails if the output exists or can't be written.
    pub(crate) fn new(output: &Path) -> anyhow::Result<Self> {
        if output.exists() {
            bail_usage!("--output {}: already exists; choose a new folder", output.display());
        }
        let name = output.file_name().ok_or_else(|| {
            Failure::Usage(format!("--output {}: not the name of a folder", output.display()))
        })?;
        let folder = output.with_file_name(format!(".{}.partial", name.to_string_lossy()));
        if folder.exists() {
            fs::remove_dir_all(&folder)
                .with_context(|| format!("cannot remove {}", folder.display()))?;
        }
        fs::create_dir_all(&folder)
            .with_context(|| format!("--output {}: cannot create the folder", output.display()))?;
        Ok(Self { folder })
    }

    /// Returns the path of the unpublished folder.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Completes the folder with its manifest.
    pub(crate) fn complete(&self, kind: &str) -> anyhow::Result<()> {
        let manifest = Manifest::of_folder(kind, &self.folder).context("cannot hash the output")?;
        let path = self.folder.join(MANIFEST_FILE);
        write_json(&path, &manifest).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Renames the folder to its final name.
    pub(crate) fn publish(self, output: &Path) -> anyhow::Result<()> {
        fs::rename(&self.folder, output).with_context(|| {
            format!("cannot rename {} to {}", self.folder.display(), output.display())
        })
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.folder).ok();
    }
}
