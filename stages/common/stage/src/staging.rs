use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use artifact::{Failure, MANIFEST_FILE, Manifest, write_json};

/// The output while it is being made: beside its final place, removed unless published.
pub(crate) struct Staging {
    folder: PathBuf,
}

impl Staging {
    /// Makes the folder. Fails where the output is there already, or can't be written.
    pub(crate) fn new(output: &Path) -> anyhow::Result<Self> {
        if output.exists() {
            return Err(Failure::Usage(format!(
                "--output {}: exists already; name a new folder",
                output.display()
            ))
            .into());
        }
        let name = output.file_name().ok_or_else(|| {
            Failure::Usage(format!("--output {}: not a folder name", output.display()))
        })?;
        let folder = output.with_file_name(format!(".{}.partial", name.to_string_lossy()));
        if folder.exists() {
            fs::remove_dir_all(&folder)
                .with_context(|| format!("cannot clear {}", folder.display()))?;
        }
        fs::create_dir_all(&folder)
            .with_context(|| format!("--output {}: cannot write there", output.display()))?;
        Ok(Self { folder })
    }

    /// Where it is being made.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Adds the manifest, after which the folder is complete.
    pub(crate) fn complete(&self, kind: &str) -> anyhow::Result<()> {
        let manifest = Manifest::of_folder(kind, &self.folder).context("cannot hash the output")?;
        let path = self.folder.join(MANIFEST_FILE);
        write_json(&path, &manifest).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Gives the folder its final name.
    pub(crate) fn publish(self, output: &Path) -> anyhow::Result<()> {
        fs::rename(&self.folder, output)
            .with_context(|| format!("cannot write {}", output.display()))
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.folder).ok();
    }
}
