use std::fs;
use std::path::Path;
use std::sync::atomic::Ordering;

use anyhow::Context as _;
use artifact::{MANIFEST_FILE, Manifest, sync_folder, temporary, write_json};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::context::Context;

/// In `--work`: finished parts of outputs, by what they were made from and by name. Each is a
/// folder with a manifest, so that one cut short is seen.
const PARTS: &str = "parts";
/// In a part's folder: what making it returned.
const VALUE: &str = "value.json";

impl Context {
    /// Makes a part of the output, `files`, unless an earlier run of the same code on the same
    /// inputs and parameters did and kept it in `--work`. What `make` returns is kept with it.
    /// Nothing is where an input has no manifest: it may have changed since.
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
        make: impl FnOnce() -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let Some((work, identity)) = self.work().zip(self.identity.as_deref()) else {
            return make();
        };
        let folder = work.join(PARTS).join(identity).join(name);
        if let Some(value) = self.restored(&folder, files) {
            if !self.goes_on.swap(true, Ordering::Relaxed) {
                self.say("going on after what an earlier run has made");
            }
            return Ok(value);
        }
        let value = make()?;
        self.keep(&folder, files, &value)
            .with_context(|| format!("cannot keep {}", folder.display()))?;
        Ok(value)
    }

    /// What was kept of a part, its files in the output; nothing where it isn't whole.
    fn restored<T: DeserializeOwned>(&self, folder: &Path, files: &[&str]) -> Option<T> {
        Manifest::read(folder).ok()?.check_contents(folder).ok()?;
        let value = serde_json::from_slice(&fs::read(folder.join(VALUE)).ok()?).ok()?;
        files
            .iter()
            .try_for_each(|file| copy(&folder.join(file), &self.output_path(file)?))
            .ok()?;
        Some(value)
    }

    fn keep(&self, folder: &Path, files: &[&str], value: &impl Serialize) -> anyhow::Result<()> {
        let parts = folder.parent().expect("it lies in --work");
        fs::create_dir_all(parts)?;
        let partial = temporary(0o777).tempdir_in(parts)?;
        for file in files {
            copy(&self.output_path(file)?, &partial.path().join(file))?;
        }
        write_json(&partial.path().join(VALUE), value)?;
        let manifest = Manifest::of_folder("part", partial.path())?;
        write_json(&partial.path().join(MANIFEST_FILE), &manifest)?;
        // One that isn't whole gives way.
        if folder.exists() {
            fs::remove_dir_all(folder)?;
        }
        fs::rename(partial.keep(), folder)?;
        Ok(sync_folder(parts)?)
    }
}

/// A second name for a file where that can be had, else a copy.
fn copy(from: &Path, to: &Path) -> anyhow::Result<()> {
    if let Some(folder) = to.parent() {
        fs::create_dir_all(folder)?;
    }
    if to.exists() {
        fs::remove_file(to)?;
    }
    if fs::hard_link(from, to).is_err() {
        fs::copy(from, to)?;
    }
    Ok(())
}
