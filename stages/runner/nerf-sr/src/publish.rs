//! Publishing of a sink's page: the page is copied next to the old one, then exchanged for it
//! atomically. A folder is replaced only if a sink wrote all of it and nobody has changed it
//! ([`crate::page`]). A page that shows a result which the new one lacks is archived.
//!
//! A kill may leave some of these next to a target `NAME`; the next publishing finishes the work:
//!
//! ```text
//! .NAME.nerf-sr-scrap   a partial copy or a partially deleted folder, without value
//! .NAME.nerf-sr-new     a complete page: the new one, or the old one after the exchange
//! .NAME.nerf-sr-old     the old page, if the file system can't exchange two folders
//! ```

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use anyhow::{Context as _, anyhow};
use artifact::{Manifest, list_files};
use rustix::fs::{CWD, RenameFlags, renameat_with};

use crate::page::{PageMark, archive_path, check_ownership};
use crate::waiting::lock_file;

/// True if the target is a page with this identity and all its files, and a killed publishing left
/// nothing of value next to it.
pub(crate) fn has_current_page(target: &Path, identity: &str) -> bool {
    let mark = PageMark::read(target).ok().flatten();
    mark.is_some_and(|mark| mark.identity == identity)
        && has_all_files(target)
        && ["new", "old"].iter().all(|suffix| matches!(exists(&hidden(target, suffix)), Ok(false)))
}

/// True if all files of a page's manifest exist with their sizes.
fn has_all_files(page: &Path) -> bool {
    Manifest::read(page).is_ok_and(|manifest| manifest.check_sizes(page).is_ok())
}

/// Publishes a sink's output, which contains a [`PageMark`], as `target`. `kind` is the output's
/// kind. Returns the new paths of earlier pages that were archived.
pub(crate) fn publish(
    output: &Path,
    target: &Path,
    kind: &str,
    stop: &AtomicBool,
) -> anyhow::Result<Vec<PathBuf>> {
    let out = target.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    // Runs with different stores may publish into the same folder, so the store's locks aren't
    // enough.
    let _lock = lock_file(out, File::options().read(true), stop)?;
    let mark = PageMark::read(output).with_context(|| output.display().to_string())?;
    let publishing = Publishing { target, kind, mark: mark.unwrap_or_default() };
    let result = publishing.finish_earlier().and_then(|mut archived| {
        archived.extend(publishing.replace(output)?);
        Ok(archived)
    });
    remove_folder(&hidden(target, "scrap")).ok();
    // Other errors name their files.
    result.map_err(|error| {
        if error.is::<io::Error>() { error.context(target.display().to_string()) } else { error }
    })
}

/// A publishing in progress; the target's parent folder is locked.
struct Publishing<'a> {
    target: &'a Path,
    kind: &'a str,
    /// Mark of the new page.
    mark: PageMark,
}

impl Publishing<'_> {
    /// Finishes a killed publishing. Returns the new paths of its pages that were archived.
    fn finish_earlier(&self) -> anyhow::Result<Vec<PathBuf>> {
        let (old, new) = (hidden(self.target, "old"), hidden(self.target, "new"));
        if !exists(self.target)? && exists(&old)? {
            fs::rename(&old, self.target)?;
        }
        let mut archived = Vec::new();
        for leftover in [old, new] {
            if exists(&leftover)? {
                self.check_ownership(&leftover)?;
                archived.extend(self.archive_or_delete_leftover(&leftover)?);
            }
        }
        Ok(archived)
    }

    /// Archives or deletes a page that a killed publishing left: the old page, or a new page that
    /// never replaced it. The page is archived if it is complete, isn't the page being published,
    /// and shows a result that the target's page lacks.
    fn archive_or_delete_leftover(&self, leftover: &Path) -> io::Result<Option<PathBuf>> {
        let mark = PageMark::read(leftover)?.unwrap_or_default();
        if !has_all_files(leftover) || mark.identity == self.mark.identity {
            return self.delete(leftover).map(|()| None);
        }
        let shown = PageMark::read(self.target)?;
        self.archive_or_delete(leftover, shown.as_ref().unwrap_or(&self.mark))
    }

    /// Replaces the target's page by a copy of `output`. Returns the new path of the old page if
    /// that was archived.
    fn replace(&self, output: &Path) -> anyhow::Result<Option<PathBuf>> {
        let (scrap, staged) = (hidden(self.target, "scrap"), hidden(self.target, "new"));
        remove_folder(&scrap)?;
        copy_folder(output, &scrap)?;
        fs::rename(&scrap, &staged)?;
        if let Err(refused) = self.exchange(&staged) {
            self.delete(&staged).ok();
            return Err(refused);
        }
        // After the exchange the old page is there, if one existed.
        let replaced = staged;
        Ok(self.archive_or_delete(&replaced, &self.mark)?)
    }

    /// Exchanges a page and the target's page. If the target doesn't exist, the page is moved.
    fn exchange(&self, page: &Path) -> anyhow::Result<()> {
        if !exists(self.target)? {
            return Ok(fs::rename(page, self.target)?);
        }
        self.check_ownership(self.target)?;
        let flags = RenameFlags::EXCHANGE;
        if renameat_with(CWD, page, CWD, self.target, flags).is_ok() {
            return Ok(());
        }
        // Not every file system can exchange two folders. Without that, the target doesn't exist
        // for a moment.
        let old = hidden(self.target, "old");
        self.move_page(self.target, &old)?;
        let moved = fs::rename(page, self.target);
        let destination = if moved.is_ok() { page } else { self.target };
        Ok(fs::rename(&old, destination).and(moved)?)
    }

    /// Archives a page that one with the mark `newer` replaces, or deletes it if it isn't worth
    /// archiving. Returns the page's new path.
    fn archive_or_delete(&self, page: &Path, newer: &PageMark) -> io::Result<Option<PathBuf>> {
        if !exists(page)? {
            return Ok(None);
        }
        let Some(archived) = archive_path(page, newer, self.target, self.kind)? else {
            return self.delete(page).map(|()| None);
        };
        if exists(&archived)? {
            self.delete(&archived)?;
        }
        self.move_page(page, &archived)?;
        Ok(Some(archived))
    }

    /// Moves a page to a new path. Overlay file systems move no folder of a lower layer, which is
    /// copied instead.
    fn move_page(&self, page: &Path, new: &Path) -> io::Result<()> {
        match fs::rename(page, new) {
            Err(e) if e.kind() == io::ErrorKind::CrossesDevices => {
                let scrap = hidden(self.target, "scrap");
                remove_folder(&scrap)?;
                copy_folder(page, &scrap)?;
                fs::rename(&scrap, new)?;
                remove_folder(page)
            }
            moved => moved,
        }
    }

    /// Deletes a folder that a sink wrote. The folder is renamed first, so that a kill leaves no
    /// partial page under a page's name.
    fn delete(&self, folder: &Path) -> io::Result<()> {
        let scrap = hidden(self.target, "scrap");
        remove_folder(&scrap)?;
        match fs::rename(folder, &scrap) {
            Err(e) if e.kind() == io::ErrorKind::CrossesDevices => remove_folder(folder),
            moved => moved.and_then(|()| remove_folder(&scrap)),
        }
    }

    fn check_ownership(&self, folder: &Path) -> anyhow::Result<()> {
        check_ownership(folder, self.kind).map_err(|reason| {
            anyhow!(
                "{reason}; nothing was replaced: move that file or folder away, or choose another \
                folder with --out"
            )
        })
    }
}

/// Returns the path of a hidden folder next to the target.
fn hidden(target: &Path, suffix: &str) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    target.with_file_name(format!(".{name}.nerf-sr-{suffix}"))
}

/// Copies a folder and syncs its files, so that a full disk is noticed before a page is replaced.
fn copy_folder(from: &Path, to: &Path) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for (relative, file) in list_files(from)? {
        let target = to.join(relative);
        if let Some(folder) = target.parent() {
            fs::create_dir_all(folder)?;
        }
        fs::copy(file, &target)?;
        File::open(&target)?.sync_all()?;
    }
    Ok(())
}

/// Returns whether a file, folder or link exists.
pub(crate) fn exists(path: &Path) -> io::Result<bool> {
    match path.symlink_metadata() {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(false),
        found => found.map(|_| true),
    }
}

/// Removes a folder if it exists.
pub(crate) fn remove_folder(path: &Path) -> io::Result<()> {
    match fs::remove_dir_all(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

#[cfg(test)]
#[path = "publish_tests.rs"]
mod tests;
