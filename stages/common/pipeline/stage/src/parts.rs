use std::fs;
use std::path::Path;
use std::sync::atomic::Ordering;

use anyhow::Context as _;
use artifact::{MANIFEST_FILE, Manifest, sync_folder, temporary, write_json};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::context::Context;

/// Folder of `--work` with finished parts of outputs, by the hash of the stage's code, inputs and
/// parameters, and by the part's name. Each part is a folder with a manifest, so that an
/// incomplete part is recognised.
const PARTS_FOLDER: &str = "parts";
/// File of a part's folder with the value that `create` returned.
const VALUE_FILE: &str = "value.json";

impl Context {
    /// Creates a part of the output, `files`, or restores it from `--work` if an earlier run of the
    /// same code on the same inputs and parameters has created it. The value that `create` returns
    /// is stored with the files. Nothing is stored if an input has no manifest, since such an input
    /// may change between runs.
    ///
    /// ```no_run
    /// # fn of(context: &stage::Context) -> anyhow::Result<()> {
    /// for name in ["a", "b"] {
    ///     let file = format!("{name}.txt");
    ///     let letters: usize = context.part(name, &[&file], || {
    ///         std::fs::write(context.output_path(&file)?, name)?;
    ///         Ok(name.len())
    ///     })?;
    /// }
    /// # Ok(())
    /// # }
    /// ```
    pub fn part<T: Serialize + DeserializeOwned>(
        &self,
        name: &str,
        files: &[&str],
        create: impl FnOnce() -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let Some((work, identity)) = self.work().zip(self.identity.as_deref()) else {
            return create();
        };
        let folder = work.join(PARTS_FOLDER).join(identity).join(name);
        if let Some(value) = self.restore_part(&folder, files) {
            if !self.resumed.swap(true, Ordering::Relaxed) {
                self.log_line("resuming after the parts that an earlier run has finished");
            }
            return Ok(value);
        }
        let value = create()?;
        self.store_part(&folder, files, &value)
            .with_context(|| format!("cannot write {}", folder.display()))?;
        Ok(value)
    }

    /// Links, or copies, a stored part's files into the output and returns the part's value; `None`
    /// if the part is incomplete.
    fn restore_part<T: DeserializeOwned>(&self, folder: &Path, files: &[&str]) -> Option<T> {
        Manifest::read(folder).ok()?.check_contents(folder).ok()?;
        let value = serde_json::from_slice(&fs::read(folder.join(VALUE_FILE)).ok()?).ok()?;
        for file in files {
            link_or_copy(&folder.join(file), &self.output_path(file).ok()?).ok()?;
        }
        Some(value)
    }

    fn store_part(
        &self,
        folder: &Path,
        files: &[&str],
        value: &impl Serialize,
    ) -> anyhow::Result<()> {
        let parts = folder.parent().expect("the folder is in --work");
        fs::create_dir_all(parts)?;
        let partial = temporary(0o777).tempdir_in(parts)?;
        for file in files {
            link_or_copy(&self.output_path(file)?, &partial.path().join(file))?;
        }
        write_json(&partial.path().join(VALUE_FILE), value)?;
        let manifest = Manifest::of_folder("part", partial.path())?;
        write_json(&partial.path().join(MANIFEST_FILE), &manifest)?;
        // A folder of this name is incomplete, since it was not restored.
        if folder.exists() {
            fs::remove_dir_all(folder)?;
        }
        fs::rename(partial.keep(), folder)?;
        Ok(sync_folder(parts)?)
    }
}

/// Hard-links a file, or copies it if the file system can't link.
fn link_or_copy(source: &Path, target: &Path) -> anyhow::Result<()> {
    if let Some(folder) = target.parent() {
        fs::create_dir_all(folder)?;
    }
    if target.exists() {
        fs::remove_file(target)?;
    }
    if fs::hard_link(source, target).is_err() {
        fs::copy(source, target)?;
    }
    Ok(())
}
