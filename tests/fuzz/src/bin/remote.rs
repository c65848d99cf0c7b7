//! Fuzzes archives as `nerf-sr-remote` imports them: index, manifests and records. The first byte
//! selects the part that the input replaces. The other parts match the input, so that no hash check
//! refuses the archive before the input is parsed. `pull` reads manifests and records by the same
//! code.
#![no_main]

use std::cell::RefCell;
use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use artifact::{FileEntry, Manifest};
use libfuzzer_sys::fuzz_target;
use serde_json::json;
use store::{Record, Store};

const BLOCK: usize = 512;
const FILE_BYTES: &[u8] = b"{\"psnr\": 31.25}";

/// Builder of an archive.
#[derive(Default)]
struct Archive {
    bytes: Vec<u8>,
    /// Byte offsets of the entries' headers.
    headers: Vec<usize>,
}

impl Archive {
    /// Adds an entry without checking its path.
    fn add(&mut self, path: &[u8], content: &[u8]) {
        if path.len() > 100 {
            self.add_raw(b"long", &[path, b"\0"].concat(), tar::EntryType::GNULongName);
        }
        self.add_raw(&path[..path.len().min(100)], content, tar::EntryType::Regular);
    }

    fn add_raw(&mut self, path: &[u8], content: &[u8], kind: tar::EntryType) {
        let mut header = tar::Header::new_gnu();
        header.as_old_mut().name[..path.len()].copy_from_slice(path);
        header.set_size(content.len() as u64);
        header.set_mode(0o644);
        header.set_entry_type(kind);
        header.set_cksum();
        self.headers.push(self.bytes.len());
        self.bytes.extend_from_slice(header.as_bytes());
        self.bytes.extend_from_slice(content);
        self.bytes.resize(self.bytes.len().next_multiple_of(BLOCK), 0);
    }

    /// Changes bytes and updates the headers' checksums. Each edit has three bytes: a little-endian
    /// offset of two, and the bits to flip.
    fn edit(&mut self, edits: &[u8]) {
        for edit in edits.chunks_exact(3) {
            let place = usize::from(u16::from_le_bytes([edit[0], edit[1]])) % self.bytes.len();
            self.bytes[place] ^= edit[2];
        }
        for &start in &self.headers {
            let block = &mut self.bytes[start..start + BLOCK];
            let mut header = tar::Header::new_gnu();
            header.as_mut_bytes().copy_from_slice(block);
            header.set_cksum();
            block.copy_from_slice(header.as_bytes());
        }
    }
}

fn text(value: &impl serde::Serialize) -> Vec<u8> {
    serde_json::to_vec(value).expect("JSON")
}

/// Returns the manifest of an artifact with one file, and the record of the action.
fn sample() -> (Manifest, Record) {
    let path = "metrics.json".to_owned();
    let blake3 = blake3::hash(FILE_BYTES).to_hex().to_string();
    let files = vec![FileEntry { path, size: FILE_BYTES.len() as u64, blake3 }];
    let manifest = Manifest { kind: "metrics".to_owned(), schema: 1, files };
    let key_parts = json!({"stage": "eval"}).as_object().expect("a map").clone();
    let output = manifest.identity();
    (manifest, Record { stage: "eval".to_owned(), key_parts, output, ..Record::default() })
}

/// Returns an archive of one artifact, given its manifest, and of records. `index` replaces the
/// valid index.
fn archive(manifest: &Manifest, mut records: Vec<Record>, index: Option<&[u8]>) -> Archive {
    let identity = manifest.identity();
    records.sort_by_key(Record::key);
    records.dedup_by_key(|record| record.key());
    let keys: Vec<String> = records.iter().map(Record::key).collect();
    let right = json!({"export": 1, "store": store::FORMAT, "artifact": identity,
        "objects": [identity], "actions": keys});
    let mut archive = Archive::default();
    archive.add(b"export.json", &index.map_or_else(|| text(&right), <[u8]>::to_vec));
    let object = format!("objects/{identity}");
    archive.add(format!("{object}/artifact.json").as_bytes(), &text(manifest));
    for file in &manifest.files {
        let content = if file.path == "metrics.json" { FILE_BYTES } else { &ZEROS };
        let content = &content[..content.len().min(file.size as usize)];
        archive.add(format!("{object}/{}", file.path).as_bytes(), content);
    }
    for (key, record) in keys.iter().zip(&records) {
        archive.add(format!("actions/{key}.json").as_bytes(), &text(record));
    }
    archive
}

const ZEROS: [u8; 8] = [0; 8];

/// Returns an archive with the fuzzer's manifest, whose files are replaced by short files of zeros.
fn with_manifest(data: &[u8]) -> Option<Archive> {
    let mut manifest: Manifest = serde_json::from_slice(data).ok()?;
    manifest.files.sort();
    manifest.files.dedup_by(|a, b| a.path == b.path);
    for file in &mut manifest.files {
        let zeros = &ZEROS[..file.size as usize % ZEROS.len()];
        (file.size, file.blake3) = (zeros.len() as u64, blake3::hash(zeros).to_hex().to_string());
        if file.path == "metrics.json" {
            file.size = FILE_BYTES.len() as u64;
            file.blake3 = blake3::hash(FILE_BYTES).to_hex().to_string();
        }
    }
    let record = Record { output: manifest.identity(), ..sample().1 };
    Some(archive(&manifest, vec![record], None))
}

fn with_record(data: &[u8]) -> Option<Archive> {
    let (manifest, record) = sample();
    Some(archive(&manifest, vec![record, serde_json::from_slice(data).ok()?], None))
}

/// Folder with a store and an archive, in memory.
struct World {
    dir: tempfile::TempDir,
    imports: usize,
}

thread_local! {
    static WORLD: RefCell<World> = {
        let memory = std::path::Path::new("/dev/shm");
        let dir = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        RefCell::new(World { dir: dir.expect("a temporary folder"), imports: 0 })
    };
}

impl World {
    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Imports an archive. The store must have intact objects, or after an error no content at all;
    /// no file may be written outside the store.
    fn import(&mut self, bytes: &[u8]) {
        let file = self.path("archive");
        fs::write(&file, bytes).expect("a file");
        let store = Store::open(&self.path("store")).expect("a store");
        let imported = remote::import(&store, &file, &Arc::new(AtomicBool::new(false)));
        let objects = store.objects().expect("objects");
        for object in &objects {
            store.verify(object).expect("a whole object");
        }
        let files = store.action_keys().expect("records");
        assert!(imported.is_ok() || (objects.is_empty() && files.is_empty()), "{imported:?}");
        let left = fs::read_dir(self.path("store/sinks")).expect("a folder").count();
        assert_eq!(left, 0, "a scratch folder is left");
        assert_eq!(fs::read_dir(self.dir.path()).expect("a folder").count(), 2);
        self.imports += 1;
        if imported.is_ok() || self.imports.is_multiple_of(100) {
            fs::remove_dir_all(self.path("store")).expect("an old store");
        }
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((which, data)) = data.split_first() else { return };
    let (manifest, record) = sample();
    let built = match which % 5 {
        0 => Some(Archive { bytes: data.to_vec(), headers: Vec::new() }),
        1 => {
            let mut archive = archive(&manifest, vec![record], None);
            archive.edit(data);
            Some(archive)
        }
        2 => Some(archive(&manifest, vec![record], Some(data))),
        3 => with_manifest(data),
        _ => with_record(data),
    };
    let Some(archive) = built else { return };
    WORLD.with_borrow_mut(|world| world.import(&archive.bytes));
});
