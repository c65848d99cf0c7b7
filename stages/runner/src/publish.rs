//! Publishing of what a sink made: written whole next to the old folder, then put in its place at
//! once. A folder is replaced only where all in it is ours and untouched ([`crate::owned`]). One
//! that shows another data set, or a whole run where the new one shows a part, is put aside
//! ([`crate::aside`]).
//!
//! A kill may leave one of these next to a target `NAME`; the next publishing ends what was begun:
//!
//! ```text
//! .NAME.nerf-sr-scrap   half a copy, or a folder half deleted: of no value
//! .NAME.nerf-sr-new     a whole page: the new one, or the old one in exchange for it
//! .NAME.nerf-sr-old     the old page, where the file system can't exchange two folders
//! ```

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use artifact::{Manifest, list_files};
use stage_call::StageFailure;
use store::{Locked, StoreError, is_taken};

use crate::aside::{Mark, place_aside};
use crate::owned::owned;
use crate::waiting::until_held;

/// Returns whether a folder shows this already, with all its files, and no killed publishing left
/// anything of value next to it.
pub(crate) fn shows(target: &Path, identity: &str) -> bool {
    let is_marked = Mark::read(target).ok().flatten().is_some_and(|mark| mark.identity == identity);
    let leftovers = [hidden(target, "new"), hidden(target, "old")];
    is_marked && is_whole(target) && leftovers.iter().all(|path| matches!(exists(path), Ok(false)))
}

/// Returns whether all files of a page's manifest are there.
fn is_whole(page: &Path) -> bool {
    Manifest::read(page).is_ok_and(|manifest| manifest.check_sizes(page).is_ok())
}

/// A folder that was put in its place.
pub(crate) struct Published {
    pub(crate) folder: PathBuf,
    /// Folders of pages that were put aside: the replaced page, and one that a killed publishing
    /// left.
    pub(crate) aside: Vec<PathBuf>,
}

/// Puts a made folder, with its mark, in a target's place. `out` is the target's folder, `kind`
/// what the sink makes.
pub(crate) fn publish(
    made: &Path,
    out: &Path,
    name: &str,
    kind: &str,
    stop: &AtomicBool,
) -> Result<Published, StageFailure> {
    fs::create_dir_all(out).map_err(|e| StageFailure::at(out, &e))?;
    let _lock = lock_folder(out, stop)?;
    let mark = Mark::read(made).map_err(|e| StageFailure::at(made, &e))?.unwrap_or_default();
    let spot = Spot { target: out.join(name), kind };
    let mut aside = spot.settle(&mark)?;
    let replaced = spot.replace(made, &mark);
    remove(&spot.hidden("scrap")).ok();
    aside.extend(replaced?);
    Ok(Published { folder: spot.target, aside })
}

/// The place of a sink's page, its folder locked.
struct Spot<'a> {
    target: PathBuf,
    kind: &'a str,
}

impl Spot<'_> {
    fn hidden(&self, what: &str) -> PathBuf {
        hidden(&self.target, what)
    }

    /// Ends what a killed publishing began; returns where whole pages went that it left. `made` is
    /// the mark of the page that comes next.
    fn settle(&self, made: &Mark) -> Result<Vec<PathBuf>, StageFailure> {
        let fail = |e: io::Error| StageFailure::at(&self.target, &e);
        let (old, new) = (self.hidden("old"), self.hidden("new"));
        if exists(&old).map_err(fail)? && !exists(&self.target).map_err(fail)? {
            fs::rename(&old, &self.target).map_err(fail)?;
        }
        let mut aside = Vec::new();
        for leftover in [old, new] {
            if exists(&leftover).map_err(fail)? {
                self.check_owned(&leftover)?;
                aside.extend(self.retire_leftover(&leftover, made).map_err(fail)?);
            }
        }
        Ok(aside)
    }

    /// Retires a leftover as its own publishing would have: it was to be replaced by what the target
    /// shows now, or to replace that.
    fn retire_leftover(&self, leftover: &Path, made: &Mark) -> io::Result<Option<PathBuf>> {
        let mark = Mark::read(leftover)?.unwrap_or_default();
        if !is_whole(leftover) || mark.identity == made.identity {
            return self.discard(leftover).map(|()| None);
        }
        let shown = Mark::read(&self.target)?.unwrap_or_else(|| made.clone());
        self.retire(leftover, &shown)
    }

    /// Puts a page in the target's place and retires the one that was there; returns where that went
    /// if it was put aside.
    fn replace(&self, made: &Path, mark: &Mark) -> Result<Option<PathBuf>, StageFailure> {
        let (scrap, page) = (self.hidden("scrap"), self.hidden("new"));
        remove(&scrap)
            .and_then(|()| copy_folder(made, &scrap))
            .and_then(|()| fs::rename(&scrap, &page))
            .map_err(|e| StageFailure::at(&scrap, &e))?;
        if let Err(refused) = self.put(&page) {
            self.discard(&page).ok();
            return Err(refused);
        }
        self.retire(&page, mark).map_err(|e| StageFailure::at(&page, &e))
    }

    /// Puts a whole page in the target's place; what was there takes the page's name.
    fn put(&self, page: &Path) -> Result<(), StageFailure> {
        let target = &self.target;
        let fail = |e: io::Error| StageFailure::at(target, &e);
        if !exists(target).map_err(fail)? {
            return fs::rename(page, target).map_err(fail);
        }
        self.check_owned(target)?;
        let flags = rustix::fs::RenameFlags::EXCHANGE;
        match rustix::fs::renameat_with(rustix::fs::CWD, page, rustix::fs::CWD, target, flags) {
            Ok(()) => Ok(()),
            // Not every file system can exchange: there the target is missing for a moment.
            Err(_) => {
                let old = self.hidden("old");
                fs::rename(target, &old).map_err(fail)?;
                let placed = fs::rename(page, target);
                fs::rename(&old, if placed.is_ok() { page } else { target }).map_err(fail)?;
                placed.map_err(fail)
            }
        }
    }

    /// Puts a page aside if its mark says that it is worth keeping from what came instead; otherwise
    /// deletes it. Returns where the page is, if there was one and it was kept.
    fn retire(&self, page: &Path, newer: &Mark) -> io::Result<Option<PathBuf>> {
        if !exists(page)? {
            return Ok(None);
        }
        let is_ours = |folder: &Path| owned(folder, self.kind).is_ok();
        let Some(aside) = place_aside(page, newer, &self.target, is_ours)? else {
            return self.discard(page).map(|()| None);
        };
        if exists(&aside)? {
            self.discard(&aside)?;
        }
        fs::rename(page, &aside)?;
        Ok(Some(aside))
    }

    /// Deletes a folder that is ours. It is given up at once: a kill leaves no half of it under a
    /// page's name.
    fn discard(&self, folder: &Path) -> io::Result<()> {
        let scrap = self.hidden("scrap");
        remove(&scrap)?;
        fs::rename(folder, &scrap)?;
        remove(&scrap)
    }

    fn check_owned(&self, folder: &Path) -> Result<(), StageFailure> {
        owned(folder, self.kind).map_err(|reason| StageFailure {
            code: 1,
            message: format!(
                "{reason}; nothing was replaced: move it away, or choose another folder with --out"
            ),
        })
    }
}

/// A hidden name next to a target.
fn hidden(target: &Path, what: &str) -> PathBuf {
    let name = target.file_name().unwrap_or_default().to_string_lossy();
    target.with_file_name(format!(".{name}.nerf-sr-{what}"))
}

/// One publishes into a folder at a time, whatever store it works with.
fn lock_folder(folder: &Path, stop: &AtomicBool) -> Result<File, StageFailure> {
    let io = |source| StoreError::Io { path: folder.to_path_buf(), source };
    until_held(stop, &|_, _| {}, || {
        let file = File::open(folder).map_err(io)?;
        Ok(if is_taken(folder, file.try_lock())? { Locked::Held(file) } else { Locked::By(None) })
    })
}

/// Copies, so that a full disk is noticed before anything is replaced.
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

fn exists(path: &Path) -> io::Result<bool> {
    match path.symlink_metadata() {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(false),
        found => found.map(|_| true),
    }
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_dir_all(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

#[cfg(test)]
#[path = "publish_tests.rs"]
mod tests;
