//! Export and import with the real program, including imports of hostile archives.

mod common;

use std::fs;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use artifact::{FileEntry, Manifest};
use common::{assert_clean, assert_equal, assert_tidy, command, said, sample, succeed};
use serde_json::{Value, json};
use store::{Record, Store};

fn export(dir: &Path, store: &Store, target: &str, options: &[&str]) -> PathBuf {
    let file = dir.join("export.tar");
    let name = file.display().to_string();
    let arguments: Vec<&str> =
        ["export", target, &name, "--force"].into_iter().chain(options.iter().copied()).collect();
    succeed(&mut command(store.root(), &arguments));
    file
}

fn import(file: &Path, store: &Path) -> (i32, String, String) {
    said(&mut command(store, &["import", &file.display().to_string()]))
}

#[test]
fn an_artifact_is_exported_with_its_history() {
    let dir = tempfile::tempdir().unwrap();
    let (store, records) = sample(&dir.path().join("store"));
    let eval = &records[3];
    let file = export(dir.path(), &store, &eval.output[..9], &[]);
    let bytes = fs::read(&file).unwrap();
    // Equal histories give equal bytes, requested by the artifact's hash or by the action's key.
    let (equal_store, _) = sample(&dir.path().join("again"));
    assert!(bytes == fs::read(export(dir.path(), &equal_store, &eval.key(), &[])).unwrap());
    let other = dir.path().join("other");
    let (code, out, err) = import(&file, &other);
    assert!(
        code == 0 && err.is_empty() && out.contains("3 records and 3 artifacts read"),
        "{out}{err}"
    );
    let other = Store::open(&other).unwrap();
    assert_clean(&other);
    assert_tidy(&other);
    for record in [&records[0], &records[2], eval] {
        assert_eq!(other.hit(&record.key()).unwrap().as_ref(), Some(record));
    }
    let (code, out, _) = import(&file, other.root());
    assert!(code == 0 && out.contains("0 new records"), "{out}");
    // An artifact that two actions created is exported with the records of both.
    export(dir.path(), &store, &records[0].output, &[]);
    assert!(import(&file, other.root()).1.contains("2 records and 1 artifact read"));
    assert_equal(&store, &other);
    assert!(store.runs().unwrap().is_empty());
}

#[test]
fn a_history_may_be_exported_as_records_only() {
    let dir = tempfile::tempdir().unwrap();
    let (store, records) = sample(&dir.path().join("store"));
    let file = export(dir.path(), &store, &records[3].key(), &["--records-only"]);
    assert!(fs::metadata(&file).unwrap().len() < 20_000);
    let other = dir.path().join("other");
    assert!(import(&file, &other).1.contains("3 records and 1 artifact read"));
    let other = Store::open(&other).unwrap();
    assert_eq!(other.hit(&records[3].key()).unwrap().as_ref(), Some(&records[3]));
    assert_eq!(other.record(&records[2].key()).unwrap().as_ref(), Some(&records[2]));
    assert_eq!(other.hit(&records[2].key()).unwrap(), None);
    // The artifacts can be imported later.
    let file = export(dir.path(), &store, &records[3].key(), &[]);
    import(&file, other.root());
    assert_clean(&other);
}

#[track_caller]
fn assert_not_exported(dir: &Path, store: &Store, target: &str, code: i32, reason: &str) {
    let file = dir.join("x.tar").display().to_string();
    let (found, _, err) = said(&mut command(store.root(), &["export", target, &file]));
    assert!(found == code && err.contains(reason) && err.lines().count() == 1, "{found} {err}");
    assert_eq!(fs::read_dir(dir).unwrap().count(), 1, "nothing must be left behind");
}

#[test]
fn damaged_artifacts_are_not_exported() {
    let dir = tempfile::tempdir().unwrap();
    let (store, records) = sample(&dir.path().join("store"));
    assert_not_exported(dir.path(), &store, "zz", 2, "no artifact or action \"zz\"");
    let path = store.object(&records[3].output).join("metrics.json");
    fs::write(&path, "{\"psnr\": 31.26}").unwrap();
    assert_not_exported(
        dir.path(),
        &store,
        &records[3].key(),
        3,
        "metrics.json: the content differs from the manifest",
    );
    fs::remove_file(&path).unwrap();
    assert_not_exported(dir.path(), &store, &records[3].key(), 3, "the artifact is incomplete");
}

/// Entry of an archive.
#[derive(Clone)]
struct Entry {
    path: String,
    kind: tar::EntryType,
    /// Size in the header, if it differs from that of `bytes`.
    size: Option<u64>,
    bytes: Vec<u8>,
}

fn regular_entry(path: &str, bytes: &[u8]) -> Entry {
    Entry {
        path: path.to_owned(),
        kind: tar::EntryType::Regular,
        size: None,
        bytes: bytes.to_vec(),
    }
}

fn entries_of(file: &Path) -> Vec<Entry> {
    let mut archive = tar::Archive::new(fs::File::open(file).unwrap());
    let entries = archive.entries().unwrap().map(|entry| {
        let mut entry = entry.unwrap();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        regular_entry(entry.path().unwrap().to_str().unwrap(), &bytes)
    });
    entries.collect()
}

/// Returns the archive of entries, without the checks that a library would make.
fn tar_bytes(entries: &[Entry]) -> Vec<u8> {
    let mut out = Vec::new();
    for entry in entries {
        let mut header = tar::Header::new_gnu();
        header.as_old_mut().name[..entry.path.len()].copy_from_slice(entry.path.as_bytes());
        header.set_size(entry.size.unwrap_or(entry.bytes.len() as u64));
        header.set_mode(0o644);
        header.set_entry_type(entry.kind);
        if entry.kind.is_symlink() || entry.kind.is_hard_link() {
            header.set_link_name("/etc/passwd").unwrap();
        }
        header.set_cksum();
        out.extend_from_slice(header.as_bytes());
        out.extend_from_slice(&entry.bytes);
        out.resize(out.len().next_multiple_of(512), 0);
    }
    out.resize(out.len() + 1024, 0);
    out
}

/// Archive of one small artifact, for changes of any part.
struct Sample {
    entries: Vec<Entry>,
    record: Record,
    manifest: Manifest,
}

const INDEX: usize = 0;
const MANIFEST: usize = 1;
const FILE: usize = 2;
const RECORD: usize = 3;

impl Sample {
    /// Changes the index.
    fn index(&mut self, change: impl FnOnce(&mut Value)) {
        let mut index: Value = serde_json::from_slice(&self.entries[INDEX].bytes).unwrap();
        change(&mut index);
        self.entries[INDEX].bytes = serde_json::to_vec(&index).unwrap();
    }

    /// Changes the manifest, and everything that depends on it.
    fn manifest(&mut self, change: impl FnOnce(&mut Manifest)) {
        change(&mut self.manifest);
        let identity = self.manifest.identity();
        let record = Record { output: identity.clone(), ..self.record.clone() };
        self.index(|index| {
            (index["objects"], index["artifact"]) = (json!([identity]), json!(identity));
        });
        let path = |file: &str| format!("objects/{identity}/{file}");
        self.entries[MANIFEST] =
            regular_entry(&path("artifact.json"), &serde_json::to_vec(&self.manifest).unwrap());
        self.entries[FILE].path = path(&self.manifest.files[0].path);
        self.entries[RECORD].bytes = serde_json::to_vec(&record).unwrap();
    }

    /// Changes the record, but not its name.
    fn record(&mut self, change: impl FnOnce(&mut Record)) {
        let mut record = self.record.clone();
        change(&mut record);
        self.entries[RECORD].bytes = serde_json::to_vec(&record).unwrap();
    }
}

type Harm = fn(&mut Sample);

/// Changes of an archive, each with the reason of its refusal.
const HARM: &[(&str, Harm)] = &[
    ("found \"../../evil\"", |s| s.entries[FILE].path = "../../evil".into()),
    ("found \"/tmp/evil\"", |s| s.entries[FILE].path = "/tmp/evil".into()),
    ("not a path inside", |s| s.manifest(|m| m.files[0].path = "../../../../evil".into())),
    ("not a path inside", |s| s.manifest(|m| m.files[0].path = "/tmp/evil".into())),
    ("not the path of", |s| s.manifest(|m| m.files[0].path = "artifact.json".into())),
    ("not sorted", |s| s.manifest(|m| m.files.push(m.files[0].clone()))),
    ("the total size exceeds 64 bits", |s| {
        s.manifest(|m| {
            let huge = ["x", "y"].map(|path| FileEntry {
                path: path.into(),
                size: u64::MAX,
                blake3: String::new(),
            });
            m.files.extend(huge);
        });
    }),
    ("schema 2", |s| s.manifest(|m| m.schema = 2)),
    ("not a regular file (Symlink)", |s| s.entries[FILE].kind = tar::EntryType::Symlink),
    ("not a regular file (Link)", |s| s.entries[FILE].kind = tar::EntryType::Link),
    ("not a regular file (Directory)", |s| s.entries[FILE].kind = tar::EntryType::Directory),
    ("not a regular file (Fifo)", |s| s.entries[FILE].kind = tar::EntryType::Fifo),
    ("not a regular file (GNUSparse)", |s| s.entries[FILE].kind = tar::EntryType::GNUSparse),
    ("not a regular file (XHeader)", |s| s.entries[FILE].kind = tar::EntryType::XHeader),
    ("expected \"export.json\"", |s| {
        let long = vec![b'x'; 1 << 20];
        s.entries
            .insert(0, Entry { kind: tar::EntryType::GNULongName, ..regular_entry("long", &long) });
    }),
    ("not a regular file (GNULongName)", |s| {
        let long =
            Entry { kind: tar::EntryType::GNULongName, ..regular_entry("long", b"export.json") };
        s.entries.splice(0..0, [long.clone(), long]);
    }),
    ("17 bytes, but 15 in the manifest", |s| s.entries[FILE].bytes.extend(b"  ")),
    ("14 bytes, but 15 in the manifest", |s| s.entries[FILE].bytes.truncate(14)),
    ("9000000000 bytes, but", |s| s.entries[FILE].size = Some(9_000_000_000)),
    ("has 9000000000 bytes, more than", |s| s.entries[INDEX].size = Some(9_000_000_000)),
    ("has 9000000000 bytes, more than", |s| s.entries[RECORD].size = Some(9_000_000_000)),
    ("the archive ends within", |s| s.entries[RECORD].size = Some(1_000_000)),
    ("metrics.json: the content differs from the manifest", |s| s.entries[FILE].bytes[3] ^= 1),
    ("its blake3 differs from the artifact's name", |s| {
        let manifest = Manifest { kind: "other".into(), ..s.manifest.clone() };
        s.entries[MANIFEST].bytes = serde_json::to_vec(&manifest).unwrap();
    }),
    ("not a manifest", |s| s.entries[MANIFEST].bytes = b"[]".to_vec()),
    ("not a record", |s| s.entries[RECORD].bytes = b"{}".to_vec()),
    ("its key differs from its name", |s| {
        s.record(|r| drop(r.key_parts.insert("x".into(), json!(1))));
    }),
    ("is not a hash", |s| s.record(|r| r.output = "../../../evil".into())),
    ("is not a hash", |s| s.record(|r| r.made_of = vec!["/tmp/evil".into()])),
    ("no record of the artifact", |s| s.record(|r| r.output = "0".repeat(64))),
    ("no record of the artifact", |s| s.index(|i| i["artifact"] = json!("0".repeat(64)))),
    ("not sorted hashes", |s| s.index(|i| i["objects"] = json!(["../../evil"]))),
    ("not sorted hashes", |s| {
        s.index(|i| i["actions"] = json!([i["actions"][0], i["actions"][0]]));
    }),
    ("export format 2", |s| s.index(|i| i["export"] = json!(2))),
    ("store format 2", |s| s.index(|i| i["store"] = json!(2))),
    ("the export format is missing or not a whole number", |s| s.index(|i| *i = json!([]))),
    ("unknown field `more`", |s| s.index(|i| i["more"] = json!(1))),
    ("after the last entry", |s| s.entries.push(regular_entry("more", b""))),
    ("the archive ends before \"actions/", |s| s.entries.truncate(RECORD)),
    ("expected \"export.json\", found", |s| drop(s.entries.remove(INDEX))),
    ("expected \"objects/", |s| s.entries.swap(MANIFEST, FILE)),
];

fn small_export(dir: &Path) -> (Vec<Entry>, Record, Manifest) {
    let store = Store::open(&dir.join("store")).unwrap();
    let record =
        common::make(&store, "eval", &[], &[("metrics.json", b"{\"psnr\": 31.25}".to_vec())]);
    let entries = entries_of(&export(dir, &store, &record.output, &[]));
    let manifest = store.manifest(&record.output).unwrap();
    (entries, record, manifest)
}

/// Checks that the import of an archive is refused in one line and leaves nothing behind.
fn assert_refused(dir: &Path, bytes: &[u8], reason: &str) {
    let (file, folder) = (dir.join("hostile.tar"), dir.join("inner/other"));
    fs::write(&file, bytes).unwrap();
    let (code, _, err) = import(&file, &folder);
    assert!(
        code == 3 && err.contains(reason) && err.lines().count() == 1,
        "{reason}: {code} {err}"
    );
    let other = Store::open(&folder).unwrap();
    assert!(
        other.objects().unwrap().is_empty() && other.action_keys().unwrap().is_empty(),
        "{reason}"
    );
    assert_tidy(&other);
    fs::remove_dir_all(dir.join("inner")).unwrap();
    let names: Vec<_> =
        fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(names.len(), 3, "{reason}: {names:?}");
    assert!(!Path::new("/tmp/evil").exists());
}

#[test]
fn hostile_archives_are_refused_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let (entries, record, manifest) = small_export(dir.path());
    let sample =
        || Sample { entries: entries.clone(), record: record.clone(), manifest: manifest.clone() };
    let bytes = tar_bytes(&sample().entries);
    fs::write(dir.path().join("hostile.tar"), &bytes).unwrap();
    assert_eq!(
        import(&dir.path().join("hostile.tar"), &dir.path().join("fine")).0,
        0,
        "an unchanged archive must be imported"
    );
    fs::remove_dir_all(dir.path().join("fine")).unwrap();
    for (reason, harm) in HARM {
        let mut sample = sample();
        harm(&mut sample);
        assert_refused(dir.path(), &tar_bytes(&sample.entries), reason);
    }
}

/// A cut archive is refused. With a flipped bit, an archive is refused or its artifact is intact.
#[test]
fn damaged_archives_import_nothing_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let (entries, record, _) = small_export(dir.path());
    let intact = tar_bytes(&entries);
    let end = intact.len() - 1024;
    for length in [0, 1, 511, 512, 700, 1024, 1536, 2048, 2600, end - 600, end - 512] {
        assert_refused(dir.path(), &intact[..length], "");
    }
    assert_refused(dir.path(), b"neither tar nor anything else\n", "not a tar file");
    assert_refused(dir.path(), &vec![b'x'; 2048], "not a tar file");
    for position in (0..end).step_by(41) {
        let mut bytes = intact.clone();
        bytes[position] ^= 1;
        let file = dir.path().join("flipped.tar");
        fs::write(&file, bytes).unwrap();
        let (code, _, err) = import(&file, &dir.path().join("flipped"));
        let store = Store::open(&dir.path().join("flipped")).unwrap();
        // A flipped bit may be in padding, or in text of a record that no hash covers.
        assert!(
            code == 0
                || (code == 3 && err.lines().count() == 1 && store.objects().unwrap().is_empty()),
            "{position}: {code} {err}"
        );
        store.objects().unwrap().iter().for_each(|object| assert_eq!(*object, record.output));
        assert_clean(&store);
        fs::remove_dir_all(store.root()).unwrap();
    }
}
