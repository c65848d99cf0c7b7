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
    is_marked && is_whole(target) && leftovers.iter().all(|path| path.symlink_metadata().is_err())
}

/// Returns whether all files of a page's manifest are there.
fn is_whole(page: &Path) -> bool {
    Manifest::read(page).is_ok_and(|manifest| manifest.check_sizes(page).is_ok())
}

/// A folder that was put in its place.
pub(crate) struct Published {
    pub(crate) folder: PathBuf,
    /// Where pages are now that were put aside: the one that stood there, and one that a killed
    /// publishing left.
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
mod tests {
    use super::*;
    use crate::aside::MARK;
    use artifact::{MANIFEST_FILE, write_json};
    use std::ffi::OsString;

    /// A folder as a sink leaves it.
    fn made(dir: &Path, text: &str) -> PathBuf {
        let folder = dir.join("made");
        remove(&folder).unwrap();
        fs::create_dir_all(folder.join("views")).unwrap();
        fs::write(folder.join("index.html"), text).unwrap();
        fs::write(folder.join("views/a.png"), "png").unwrap();
        write_json(&folder.join(MANIFEST_FILE), &Manifest::of_folder("page", &folder).unwrap())
            .unwrap();
        let mark = Mark { identity: text.to_owned(), is_whole: true, data_sets: Vec::new() };
        mark.write(&folder).unwrap();
        folder
    }

    fn published(dir: &Path, text: &str) -> Result<PathBuf, StageFailure> {
        publish(&made(dir, text), &dir.join("out"), "report", "page", &AtomicBool::new(false))
            .map(|published| published.folder)
    }

    #[test]
    fn a_page_replaces_a_page() {
        let dir = tempfile::tempdir().unwrap();
        let target = published(dir.path(), "one").unwrap();
        assert!(shows(&target, "one") && !shows(&target, "two"));
        published(dir.path(), "two").unwrap();
        assert_eq!(fs::read_to_string(target.join("index.html")).unwrap(), "two");
        // One that lost a file is no longer whole, but ours.
        fs::remove_file(target.join("views/a.png")).unwrap();
        published(dir.path(), "two").unwrap();
        assert!(target.join("views/a.png").exists());
        assert_eq!(
            fs::read_dir(dir.path().join("out")).unwrap().count(),
            1,
            "nothing is left beside"
        );
        let empty = dir.path().join("out/report");
        remove(&empty).unwrap();
        fs::create_dir(&empty).unwrap();
        published(dir.path(), "three").unwrap();
    }

    /// A page of a data set as a sink leaves it.
    fn page(dir: &Path, text: &str, data_set: &str, is_whole: bool) -> PathBuf {
        let folder = made(dir, text);
        let data_sets = vec![data_set.to_owned()];
        let mark = Mark { identity: text.to_owned(), is_whole, data_sets };
        mark.write(&folder).unwrap();
        folder
    }

    fn publish_page(dir: &Path, text: &str, data_set: &str, is_whole: bool) -> Option<OsString> {
        let (folder, out) = (page(dir, text, data_set, is_whole), dir.join("out"));
        let published = publish(&folder, &out, "report", "page", &AtomicBool::new(false)).unwrap();
        assert!(published.aside.len() <= 1);
        published.aside.first().map(|aside| aside.file_name().unwrap().to_owned())
    }

    fn page_text(dir: &Path, folder: &str) -> String {
        fs::read_to_string(dir.join("out").join(folder).join("index.html")).unwrap()
    }

    /// Pages of data sets, one after the other: what was whole before is found again.
    #[test]
    fn what_shows_something_else_is_put_aside() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(publish_page(dir.path(), "lego 1", "data/lego", true), None);
        assert_eq!(
            publish_page(dir.path(), "lego 2", "data/lego", true),
            None,
            "a newer one of the same"
        );
        assert_eq!(publish_page(dir.path(), "chair 1", "data/chair", true).unwrap(), "report-lego");
        assert_eq!(publish_page(dir.path(), "lego 3", "data/lego", true).unwrap(), "report-chair");
        assert_eq!(
            (page_text(dir.path(), "report"), page_text(dir.path(), "report-lego")),
            ("lego 3".into(), "lego 2".into())
        );
        assert_eq!(
            publish_page(dir.path(), "lego broken", "data/lego", false).unwrap(),
            "report-lego"
        );
        assert_eq!(page_text(dir.path(), "report-lego"), "lego 3");
        // Another folder of that name has its own place, and so has what isn't ours.
        assert_eq!(
            publish_page(dir.path(), "other 1", "more/lego", true).unwrap(),
            "report-lego-2"
        );
        fs::write(dir.path().join("out/report-lego-2/notes.txt"), "precious").unwrap();
        assert_eq!(
            publish_page(dir.path(), "chair 2", "data/chair", true).unwrap(),
            "report-lego-3"
        );
        assert_eq!(
            (page_text(dir.path(), "report-lego"), page_text(dir.path(), "report-lego-2")),
            ("lego 3".into(), "lego broken".into())
        );
        assert_eq!(
            (page_text(dir.path(), "report-lego-3"), page_text(dir.path(), "report")),
            ("other 1".into(), "chair 2".into())
        );
    }

    /// Folders of `out` with the text of each one's page, sorted.
    fn pages(dir: &Path) -> Vec<String> {
        let names = fs::read_dir(dir.join("out")).unwrap();
        let mut pages: Vec<String> = names
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .map(|name| format!("{name}: {}", page_text(dir, &name)))
            .collect();
        pages.sort();
        pages
    }

    /// What a kill leaves of a publishing is ended by the next one: whole pages are found again.
    #[test]
    fn pages_left_by_a_kill_are_put_aside() {
        const NEW: &str = ".report.nerf-sr-new";
        const OLD: &str = ".report.nerf-sr-old";
        type Lying<'a> = &'a [(&'a str, &'a str, &'a str, bool)];
        let lego = ("lego 1", "lego", true);
        let cases: [(&str, Lying<'_>, &[&str]); 8] = [
            (
                "exchanged, and killed before the old page was put aside",
                &[("report", "chair 1", "chair", true), (NEW, lego.0, lego.1, lego.2)],
                &["report-lego: lego 1", "report: chair 2"],
            ),
            (
                "a whole page before a part of one",
                &[("report", "chair 1", "chair", false), (NEW, "chair 0", "chair", true)],
                &["report-chair: chair 0", "report: chair 2"],
            ),
            (
                "one that was to be deleted",
                &[("report", "chair 1", "chair", true), (NEW, "chair 0", "chair", true)],
                &["report: chair 2"],
            ),
            (
                "copied, and killed before it was put in its place",
                &[("report", lego.0, lego.1, lego.2), (NEW, "chair 2", "chair", true)],
                &["report-lego: lego 1", "report: chair 2"],
            ),
            ("the first page of all", &[(NEW, "chair 2", "chair", true)], &["report: chair 2"]),
            (
                "without exchange, killed between two renames",
                &[(OLD, lego.0, lego.1, lego.2), (NEW, "chair 2", "chair", true)],
                &["report-lego: lego 1", "report: chair 2"],
            ),
            (
                "without exchange, killed before the third",
                &[("report", "chair 1", "chair", true), (OLD, lego.0, lego.1, lego.2)],
                &["report-lego: lego 1", "report: chair 2"],
            ),
            (
                "killed while an older page was deleted",
                &[
                    ("report", "chair 1", "chair", true),
                    (NEW, lego.0, lego.1, lego.2),
                    (".report.nerf-sr-scrap", "lego 0", "lego", true),
                ],
                &["report-lego: lego 1", "report: chair 2"],
            ),
        ];
        for (what, lying, expected) in cases {
            let dir = tempfile::tempdir().unwrap();
            fs::create_dir(dir.path().join("out")).unwrap();
            for (name, text, data_set, is_whole) in lying {
                let made = page(dir.path(), text, data_set, *is_whole);
                fs::rename(made, dir.path().join("out").join(name)).unwrap();
            }
            publish_page(dir.path(), "chair 2", "chair", true);
            assert_eq!(pages(dir.path()), expected, "{what}");
        }
    }

    /// A leftover means that there is something to do, even where the page itself is right.
    #[test]
    fn a_page_with_a_leftover_beside_it_is_not_up_to_date() {
        let dir = tempfile::tempdir().unwrap();
        let target = published(dir.path(), "one").unwrap();
        for name in [".report.nerf-sr-new", ".report.nerf-sr-old"] {
            let leftover = target.with_file_name(name);
            fs::create_dir(&leftover).unwrap();
            assert!(!shows(&target, "one"), "{name}");
            published(dir.path(), "one").unwrap();
            assert!(shows(&target, "one") && !leftover.exists(), "{name}");
        }
    }

    /// Half a copy is no page; somebody's files are nobody else's to delete.
    #[test]
    fn leftovers_that_are_no_pages_are_not_put_aside() {
        let dir = tempfile::tempdir().unwrap();
        publish_page(dir.path(), "chair 1", "chair", true);
        let leftover = dir.path().join("out/.report.nerf-sr-new");
        fs::rename(page(dir.path(), "lego 1", "lego", true), &leftover).unwrap();
        fs::remove_file(leftover.join("index.html")).unwrap();
        publish_page(dir.path(), "chair 2", "chair", true);
        assert_eq!(pages(dir.path()), ["report: chair 2"]);
        for (file, words) in
            [("notes.txt", "notes.txt is not nerf-sr's"), ("index.html", "index.html was changed")]
        {
            fs::rename(page(dir.path(), "lego 1", "lego", true), &leftover).unwrap();
            fs::write(leftover.join(file), "precious").unwrap();
            let message = published(dir.path(), "chair 3").unwrap_err().message;
            assert!(message.contains(words) && message.contains("move it away"), "{message}");
            assert_eq!(fs::read_to_string(leftover.join(file)).unwrap(), "precious");
            assert_eq!(page_text(dir.path(), "report"), "chair 2");
            remove(&leftover).unwrap();
        }
    }

    fn all_files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
        let files = list_files(folder).unwrap().into_iter();
        files.map(|(relative, file)| (relative, fs::read(file).unwrap())).collect()
    }

    /// Whatever isn't ours stays to the byte, and is named.
    #[test]
    fn what_is_not_ours_is_not_replaced() {
        type Damage = fn(&Path);
        let cases: [(&str, Damage); 9] = [
            ("cannot read ", |t| {
                fs::remove_file(t.join(MARK)).unwrap();
                fs::create_dir(t.join(MARK)).unwrap();
            }),
            ("report/notes.txt is not nerf-sr's", |t| {
                fs::write(t.join("notes.txt"), "precious").unwrap();
            }),
            ("report/views/mine.png is not nerf-sr's", |t| {
                fs::write(t.join("views/mine.png"), "precious").unwrap();
            }),
            ("report/index.html was changed", |t| {
                fs::write(t.join("index.html"), "my own words").unwrap();
            }),
            ("index.html is not nerf-sr's", |t| fs::remove_file(t.join(MANIFEST_FILE)).unwrap()),
            ("index.html is not nerf-sr's", |t| fs::write(t.join(MANIFEST_FILE), "{}").unwrap()),
            ("index.html is not nerf-sr's", |t| {
                let manifest = Manifest { kind: "scene".into(), ..Manifest::read(t).unwrap() };
                write_json(&t.join(MANIFEST_FILE), &manifest).unwrap();
            }),
            ("report is not a folder", |t| {
                fs::rename(t, t.with_extension("real")).unwrap();
                std::os::unix::fs::symlink(t.with_extension("real"), t).unwrap();
            }),
            ("report is not a folder", |t| {
                remove(t).unwrap();
                fs::write(t, "precious").unwrap();
            }),
        ];
        for (words, damage) in cases {
            let dir = tempfile::tempdir().unwrap();
            let target = published(dir.path(), "one").unwrap();
            damage(&target);
            let before = all_files(&dir.path().join("out"));
            let message = published(dir.path(), "two").unwrap_err().message;
            assert!(message.contains(words) && message.contains("--out"), "{words}: {message}");
            assert_eq!(all_files(&dir.path().join("out")), before, "{words}");
        }
    }
}
