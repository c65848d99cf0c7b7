//! Publishing where earlier pages, leftovers of kills or a user's files exist.

use super::*;
use crate::page::MARK_FILE;
use artifact::{MANIFEST_FILE, write_json};
use std::collections::BTreeSet;
use std::ffi::OsString;

/// Creates a folder like a sink's output.
fn sink_output(dir: &Path, text: &str) -> PathBuf {
    let folder = dir.join("made");
    remove_folder(&folder).unwrap();
    fs::create_dir_all(folder.join("views")).unwrap();
    fs::write(folder.join("index.html"), text).unwrap();
    fs::write(folder.join("views/a.png"), "png").unwrap();
    write_json(&folder.join(MANIFEST_FILE), &Manifest::of_folder("page", &folder).unwrap())
        .unwrap();
    let results = Some(BTreeSet::new());
    let mark = PageMark { identity: text.to_owned(), results, data_sets: Vec::new() };
    mark.write(&folder).unwrap();
    folder
}

/// Publishes a sink's output as `out/report`.
fn publish_output(dir: &Path, text: &str) -> anyhow::Result<PathBuf> {
    let target = dir.join("out/report");
    publish(&sink_output(dir, text), &target, "page", &AtomicBool::new(false)).map(|_| target)
}

#[test]
fn a_page_replaces_a_page() {
    let dir = tempfile::tempdir().unwrap();
    let target = publish_output(dir.path(), "one").unwrap();
    assert!(has_current_page(&target, "one") && !has_current_page(&target, "two"));
    publish_output(dir.path(), "two").unwrap();
    assert_eq!(fs::read_to_string(target.join("index.html")).unwrap(), "two");
    // A page that lost a file is incomplete, but still nerf-sr's.
    fs::remove_file(target.join("views/a.png")).unwrap();
    publish_output(dir.path(), "two").unwrap();
    assert!(target.join("views/a.png").exists());
    assert_eq!(fs::read_dir(dir.path().join("out")).unwrap().count(), 1, "nothing else is left");
    let empty = dir.path().join("out/report");
    remove_folder(&empty).unwrap();
    fs::create_dir(&empty).unwrap();
    publish_output(dir.path(), "three").unwrap();
}

#[test]
fn a_folder_of_empty_folders_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("out/report/plans");
    fs::create_dir_all(&folder).unwrap();
    let message = publish_output(dir.path(), "one").unwrap_err().to_string();
    assert!(message.contains("was not written by nerf-sr") && folder.exists(), "{message}");
}

/// Creates a data set's page like a sink's output, with one result if the page is complete.
fn page(dir: &Path, text: &str, data_set: &str, is_complete: bool) -> PathBuf {
    page_of(dir, text, data_set, if is_complete { &["eval"] } else { &[] })
}

fn page_of(dir: &Path, text: &str, data_set: &str, results: &[&str]) -> PathBuf {
    let folder = sink_output(dir, text);
    let data_sets = vec![data_set.to_owned()];
    let results = Some(results.iter().map(|result| format!("{data_set}: {result}")).collect());
    let mark = PageMark { identity: text.to_owned(), results, data_sets };
    mark.write(&folder).unwrap();
    folder
}

fn publish_page(dir: &Path, text: &str, data_set: &str, is_complete: bool) -> Option<OsString> {
    let (folder, target) = (page(dir, text, data_set, is_complete), dir.join("out/report"));
    let archived = publish(&folder, &target, "page", &AtomicBool::new(false)).unwrap();
    assert!(archived.len() <= 1);
    archived.first().map(|page| page.file_name().unwrap().to_owned())
}

fn page_text(dir: &Path, folder: &str) -> String {
    fs::read_to_string(dir.join("out").join(folder).join("index.html")).unwrap()
}

/// Publishing the pages of several data sets in turn keeps their complete pages.
#[test]
fn pages_of_other_data_sets_are_archived() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(publish_page(dir.path(), "lego 1", "data/lego", true), None);
    assert_eq!(
        publish_page(dir.path(), "lego 2", "data/lego", true),
        None,
        "a newer page of the same data set"
    );
    assert_eq!(publish_page(dir.path(), "chair 1", "data/chair", true).unwrap(), "report-lego");
    assert_eq!(publish_page(dir.path(), "lego 3", "data/lego", true).unwrap(), "report-chair");
    assert_eq!(
        (page_text(dir.path(), "report"), page_text(dir.path(), "report-lego")),
        ("lego 3".into(), "lego 2".into())
    );
    assert_eq!(publish_page(dir.path(), "lego broken", "data/lego", false).unwrap(), "report-lego");
    assert_eq!(page_text(dir.path(), "report-lego"), "lego 3");
    // A page without a result has nothing that another page lacks.
    assert_eq!(publish_page(dir.path(), "other 1", "more/lego", true), None);
    // A data set of the same name has its own archive. An archive with a user's file is kept.
    assert_eq!(publish_page(dir.path(), "chair 2", "data/chair", true).unwrap(), "report-lego-2");
    fs::write(dir.path().join("out/report-lego-2/notes.txt"), "precious").unwrap();
    publish_page(dir.path(), "other 2", "more/lego", true);
    assert_eq!(publish_page(dir.path(), "chair 3", "data/chair", true).unwrap(), "report-lego-3");
    assert_eq!(
        (page_text(dir.path(), "report-lego"), page_text(dir.path(), "report-lego-2")),
        ("lego 3".into(), "other 1".into())
    );
    assert_eq!(
        (page_text(dir.path(), "report-lego-3"), page_text(dir.path(), "report")),
        ("other 2".into(), "chair 3".into())
    );
}

/// A page is archived if it has a result that the new page lacks.
#[test]
fn a_page_with_more_results_is_archived() {
    let dir = tempfile::tempdir().unwrap();
    let target = dir.path().join("out/report");
    for (text, results, archived) in [
        ("one", &["eval"][..], None),
        ("both", &["eval", "eval-refined"], None),
        ("one again", &["eval"], Some("report-lego")),
        ("sweep", &["eval [rays=1]"], Some("report-lego-2")),
    ] {
        let folder = page_of(dir.path(), text, "lego", results);
        let found = publish(&folder, &target, "page", &AtomicBool::new(false)).unwrap();
        let found = found.first().map(|path| path.file_name().unwrap().to_str().unwrap());
        assert_eq!(found, archived, "{text}");
    }
}

/// Returns the folders of `out` with their pages' texts, sorted.
fn pages(dir: &Path) -> Vec<String> {
    let names = fs::read_dir(dir.join("out")).unwrap();
    let mut pages: Vec<String> = names
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .map(|name| format!("{name}: {}", page_text(dir, &name)))
        .collect();
    pages.sort();
    pages
}

/// The next publishing completes a killed one: no complete page is lost.
#[test]
fn pages_left_by_a_kill_are_archived() {
    const NEW: &str = ".report.nerf-sr-new";
    const OLD: &str = ".report.nerf-sr-old";
    type Leftovers<'a> = &'a [(&'a str, &'a str, &'a str, bool)];
    let lego = ("lego 1", "lego", true);
    let cases: [(&str, Leftovers<'_>, &[&str]); 8] = [
        (
            "exchanged, and killed before the old page was archived",
            &[("report", "chair 1", "chair", true), (NEW, lego.0, lego.1, lego.2)],
            &["report-lego: lego 1", "report: chair 2"],
        ),
        (
            "a complete page before an incomplete one",
            &[("report", "chair 1", "chair", false), (NEW, "chair 0", "chair", true)],
            &["report-chair: chair 0", "report: chair 2"],
        ),
        (
            "a page that was to be deleted",
            &[("report", "chair 1", "chair", true), (NEW, "chair 0", "chair", true)],
            &["report: chair 2"],
        ),
        (
            "copied, and killed before the copy replaced the old page",
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
            "without exchange, killed before the third rename",
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
    for (case, leftovers, expected) in cases {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("out")).unwrap();
        for (name, text, data_set, is_complete) in leftovers {
            let folder = page(dir.path(), text, data_set, *is_complete);
            fs::rename(folder, dir.path().join("out").join(name)).unwrap();
        }
        publish_page(dir.path(), "chair 2", "chair", true);
        assert_eq!(pages(dir.path()), expected, "{case}");
    }
}

/// A leftover must be finished or removed, even if the page itself is current.
#[test]
fn a_page_next_to_a_leftover_is_not_up_to_date() {
    let dir = tempfile::tempdir().unwrap();
    let target = publish_output(dir.path(), "one").unwrap();
    for name in [".report.nerf-sr-new", ".report.nerf-sr-old"] {
        let leftover = target.with_file_name(name);
        fs::create_dir(&leftover).unwrap();
        assert!(!has_current_page(&target, "one"), "{name}");
        publish_output(dir.path(), "one").unwrap();
        assert!(has_current_page(&target, "one") && !leftover.exists(), "{name}");
    }
}

/// An incomplete copy isn't a page, and a user's files are never deleted.
#[test]
fn leftovers_that_are_no_pages_are_not_archived() {
    let dir = tempfile::tempdir().unwrap();
    publish_page(dir.path(), "chair 1", "chair", true);
    let leftover = dir.path().join("out/.report.nerf-sr-new");
    fs::rename(page(dir.path(), "lego 1", "lego", true), &leftover).unwrap();
    fs::remove_file(leftover.join("index.html")).unwrap();
    publish_page(dir.path(), "chair 2", "chair", true);
    assert_eq!(pages(dir.path()), ["report: chair 2"]);
    for (file, expected) in [
        ("notes.txt", "notes.txt was not written by nerf-sr"),
        ("index.html", "index.html was changed"),
    ] {
        fs::rename(page(dir.path(), "lego 1", "lego", true), &leftover).unwrap();
        fs::write(leftover.join(file), "precious").unwrap();
        let message = publish_output(dir.path(), "chair 3").unwrap_err().to_string();
        assert!(
            message.contains(expected) && message.contains("move that file or folder away"),
            "{message}"
        );
        assert_eq!(fs::read_to_string(leftover.join(file)).unwrap(), "precious");
        assert_eq!(page_text(dir.path(), "report"), "chair 2");
        remove_folder(&leftover).unwrap();
    }
}

fn all_files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let files = list_files(folder).unwrap().into_iter();
    files.map(|(relative, file)| (relative, fs::read(file).unwrap())).collect()
}

/// Files that nerf-sr didn't write stay unchanged, and the message names them.
#[test]
fn foreign_files_are_not_replaced() {
    type Damage = fn(&Path);
    let cases: [(&str, Damage); 9] = [
        ("cannot read ", |t| {
            fs::remove_file(t.join(MARK_FILE)).unwrap();
            fs::create_dir(t.join(MARK_FILE)).unwrap();
        }),
        ("report/notes.txt was not written by nerf-sr", |t| {
            fs::write(t.join("notes.txt"), "precious").unwrap();
        }),
        ("report/views/mine.png was not written by nerf-sr", |t| {
            fs::write(t.join("views/mine.png"), "precious").unwrap();
        }),
        ("report/index.html was changed", |t| {
            fs::write(t.join("index.html"), "my own words").unwrap();
        }),
        ("index.html was not written by nerf-sr", |t| {
            fs::remove_file(t.join(MANIFEST_FILE)).unwrap();
        }),
        ("index.html was not written by nerf-sr", |t| {
            fs::write(t.join(MANIFEST_FILE), "{}").unwrap();
        }),
        ("report contains an artifact of kind scene, not ", |t| {
            let manifest = Manifest { kind: "scene".into(), ..Manifest::read(t).unwrap() };
            write_json(&t.join(MANIFEST_FILE), &manifest).unwrap();
        }),
        ("report is not a folder", |t| {
            fs::rename(t, t.with_extension("real")).unwrap();
            std::os::unix::fs::symlink(t.with_extension("real"), t).unwrap();
        }),
        ("report is not a folder", |t| {
            remove_folder(t).unwrap();
            fs::write(t, "precious").unwrap();
        }),
    ];
    for (expected, damage) in cases {
        let dir = tempfile::tempdir().unwrap();
        let target = publish_output(dir.path(), "one").unwrap();
        damage(&target);
        let before = all_files(&dir.path().join("out"));
        let message = publish_output(dir.path(), "two").unwrap_err().to_string();
        assert!(message.contains(expected) && message.contains("--out"), "{expected}: {message}");
        assert_eq!(all_files(&dir.path().join("out")), before, "{expected}");
    }
}
