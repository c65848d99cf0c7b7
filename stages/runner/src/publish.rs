//! Publishing of what a sink made: written whole beside the old folder, then put in its place at
//! once. A folder is replaced only where all in it is ours and untouched. One that shows another
//! data set, or a whole run where the new one shows a part, is put aside ([`crate::aside`]).

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use artifact::{MANIFEST_FILE, Manifest, list_files};
use stage_call::StageFailure;
use store::{Locked, StoreError};

use crate::aside::{MARK, Mark, place_aside};
use crate::waiting::until_held;

/// Whether a folder shows this already, with all its files.
pub(crate) fn shows(target: &Path, identity: &str) -> bool {
    let is_whole =
        || Manifest::read(target).is_ok_and(|manifest| manifest.check_sizes(target).is_ok());
    Mark::read(target).is_some_and(|mark| mark.identity == identity) && is_whole()
}

/// A folder that was put in its place.
pub(crate) struct Published {
    pub(crate) folder: PathBuf,
    /// Where what stood there is now, if it was put aside.
    pub(crate) aside: Option<PathBuf>,
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
    let target = out.join(name);
    fs::create_dir_all(out).map_err(|e| StageFailure::at(out, &e))?;
    let _lock = lock_folder(out, stop)?;
    // With the lock held, what lies there is a killed run's.
    let fresh = out.join(format!(".{name}.nerf-sr-new"));
    remove(&fresh).map_err(|e| StageFailure::at(&fresh, &e))?;
    let aside = place_aside(made, &target, |folder| owned(folder, kind).is_ok());
    let placed = copy_folder(made, &fresh)
        .map_err(|e| StageFailure::at(&fresh, &e))
        .and_then(|()| put(&fresh, &target, kind));
    // What is left is the old page, or what couldn't be put there.
    if let (Ok(()), Some(aside)) = (&placed, &aside) {
        remove(aside)
            .and_then(|()| fs::rename(&fresh, aside))
            .map_err(|e| StageFailure::at(&fresh, &e))?;
    }
    remove(&fresh).ok();
    placed.map(|()| Published { folder: target, aside })
}

/// Puts a whole folder in the target's place; what was there takes the fresh one's name.
fn put(fresh: &Path, target: &Path, kind: &str) -> Result<(), StageFailure> {
    let fail = |e: io::Error| StageFailure::at(target, &e);
    match target.symlink_metadata() {
        Err(e) if e.kind() == io::ErrorKind::NotFound => {
            return fs::rename(fresh, target).map_err(fail);
        }
        Err(e) => return Err(fail(e)),
        Ok(_) => {}
    }
    owned(target, kind).map_err(|reason| StageFailure {
        code: 1,
        message: format!(
            "{reason}; nothing was replaced: move it away, or choose another folder with --out"
        ),
    })?;
    let flags = rustix::fs::RenameFlags::EXCHANGE;
    match rustix::fs::renameat_with(rustix::fs::CWD, fresh, rustix::fs::CWD, target, flags) {
        Ok(()) => Ok(()),
        // Not every file system can exchange: there the target is missing for a moment.
        Err(_) => {
            let old = fresh.with_extension("nerf-sr-old");
            remove(&old).map_err(fail)?;
            fs::rename(target, &old).map_err(fail)?;
            let placed = fs::rename(fresh, target);
            fs::rename(&old, if placed.is_ok() { fresh } else { target }).map_err(fail)?;
            placed.map_err(fail)
        }
    }
}

/// Why a folder may not be replaced.
#[derive(Debug, thiserror::Error)]
enum ForeignError {
    /// It is a file or a link.
    #[error("{0} is not a folder of nerf-sr's")]
    NoFolder(PathBuf),
    /// A file in it that no sink of ours put there.
    #[error("{0} is not nerf-sr's")]
    File(PathBuf),
    /// A file in it that isn't as a sink of ours left it.
    #[error("{0} was changed by somebody")]
    Changed(PathBuf),
    /// It can't be read.
    #[error("{folder}: {problem}")]
    Unreadable {
        /// The folder.
        folder: PathBuf,
        /// Why.
        problem: io::Error,
    },
    /// The files in it can't be listed.
    #[error("{0}")]
    Unlisted(io::Error),
}

/// Whether all in a folder is what a sink of ours put there; else which file isn't. An empty folder
/// may be replaced, too.
fn owned(target: &Path, kind: &str) -> Result<(), ForeignError> {
    let is_link = target.symlink_metadata().is_ok_and(|meta| meta.file_type().is_symlink());
    if is_link || !target.is_dir() {
        return Err(ForeignError::NoFolder(target.to_path_buf()));
    }
    let unreadable = |problem| ForeignError::Unreadable { folder: target.to_path_buf(), problem };
    let mut entries = fs::read_dir(target).map_err(unreadable)?;
    if entries.next().is_none() {
        return Ok(());
    }
    let files = list_files(target).map_err(ForeignError::Unlisted)?;
    let own = |file: &Path| file == Path::new(MANIFEST_FILE) || file == Path::new(MARK);
    let manifest = match Manifest::read(target) {
        Ok(manifest) if kind == manifest.kind => manifest,
        _ => {
            let first = files
                .iter()
                .map(|(file, _)| file.as_path())
                .find(|file| !own(file))
                .unwrap_or(Path::new(""));
            return Err(ForeignError::File(target.join(first)));
        }
    };
    let listed = |file: &Path| manifest.files.iter().any(|entry| Path::new(&entry.path) == file);
    if let Some((foreign, _)) = files.iter().find(|(file, _)| !own(file) && !listed(file)) {
        return Err(ForeignError::File(target.join(foreign)));
    }
    for entry in &manifest.files {
        // A page whose file somebody took away is still ours.
        if target.join(&entry.path).exists() {
            let single = Manifest { files: vec![entry.clone()], ..manifest.clone() };
            single
                .check_contents(target)
                .map_err(|_| ForeignError::Changed(target.join(&entry.path)))?;
        }
    }
    Ok(())
}

/// One publishes into a folder at a time, whatever store it works with.
fn lock_folder(folder: &Path, stop: &AtomicBool) -> Result<File, StageFailure> {
    let io = |source| StoreError::Io { path: folder.to_path_buf(), source };
    until_held(stop, &|_, _| {}, || {
        let file = File::open(folder).map_err(io)?;
        match file.try_lock() {
            Ok(()) => Ok(Locked::Held(file)),
            Err(TryLockError::WouldBlock) => Ok(Locked::By(None)),
            Err(TryLockError::Error(e)) => Err(io(e)),
        }
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

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_dir_all(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifact::write_json;
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

    fn publish_page(dir: &Path, text: &str, data_set: &str, is_whole: bool) -> Option<OsString> {
        let folder = made(dir, text);
        let data_sets = vec![data_set.to_owned()];
        let mark = Mark { identity: text.to_owned(), is_whole, data_sets };
        mark.write(&folder).unwrap();
        let out = dir.join("out");
        let published = publish(&folder, &out, "report", "page", &AtomicBool::new(false)).unwrap();
        published.aside.map(|aside| aside.file_name().unwrap().to_owned())
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

    fn all_files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
        let files = list_files(folder).unwrap().into_iter();
        files.map(|(relative, file)| (relative, fs::read(file).unwrap())).collect()
    }

    /// Whatever isn't ours stays to the byte, and is named.
    #[test]
    fn what_is_not_ours_is_not_replaced() {
        type Damage = fn(&Path);
        let cases: [(&str, Damage); 8] = [
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
