use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt as _;

use super::*;

fn store_and_data() -> (tempfile::TempDir, Store, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(&dir.path().join("store")).unwrap();
    let data = dir.path().join("data");
    fs::create_dir(&data).unwrap();
    (dir, store, data)
}

fn hash_of(store: &Store, folder: &Path) -> String {
    Source::read(store, folder, None).unwrap().content_hash()
}

/// Writes a file with an old modification time, as unpacking an archive does.
fn unpack(file: &Path, text: &str) {
    fs::write(file, text).unwrap();
    let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000);
    File::options().write(true).open(file).unwrap().set_modified(time).unwrap();
}

/// Reads a folder after its files have become old enough for the cache.
fn read_settled(store: &Store, folder: &Path) -> Source {
    std::thread::sleep(Duration::from_secs(4));
    Source::read(store, folder, None).unwrap()
}

#[test]
fn a_source_must_be_a_folder() {
    let (dir, store, _) = store_and_data();
    let (file, absent) = (dir.path().join("file"), dir.path().join("absent"));
    fs::write(&file, "x").unwrap();
    let problem = |folder: &Path| Source::read(&store, folder, None).unwrap_err().to_string();
    assert_eq!(problem(&file), format!("{file:?}: not a folder"));
    assert_eq!(problem(&absent), format!("{absent:?}: no such folder; name an existing one"));
}

#[test]
fn editors_temporary_files_do_not_change_the_hash() {
    let (_dir, store, data) = store_and_data();
    fs::write(data.join("transforms.json"), "{}").unwrap();
    let before = hash_of(&store, &data);
    std::os::unix::fs::symlink("me@host.1", data.join(".#transforms.json")).unwrap();
    fs::write(data.join("._transforms.json"), "x").unwrap();
    assert_eq!(hash_of(&store, &data), before);
}

/// Every file name is allowed, and each gives a different hash.
#[test]
fn any_name_has_a_hash() {
    let (_dir, store, data) = store_and_data();
    let mut hashes = std::collections::BTreeSet::new();
    for name in [
        &b"plain"[..],
        b"\xff",
        b"\xfe",
        b"new\nline",
        b"\x1b]0;title\x07",
        "übung 🎈".as_bytes(),
        b"ff",
    ] {
        fs::create_dir_all(&data).unwrap();
        fs::write(data.join(OsStr::from_bytes(name)), "x").unwrap();
        assert!(hashes.insert(hash_of(&store, &data)), "{name:?}");
        fs::remove_dir_all(&data).unwrap();
    }
}

/// Exchanging two files of one archive changes neither names, sizes nor times.
#[test]
fn exchanged_files_are_hashed_again() {
    let (_dir, store, data) = store_and_data();
    let [a, b, third] = ["a", "b", "third"].map(|name| data.join(name));
    unpack(&a, "one");
    unpack(&b, "two");
    let before = read_settled(&store, &data);
    fs::rename(&a, &third).unwrap();
    fs::rename(&b, &a).unwrap();
    fs::rename(&third, &b).unwrap();
    let after = Source::read(&store, &data, None).unwrap();
    assert_ne!(after.content_hash(), before.content_hash());
    assert_eq!(after.change_since(&before).as_deref(), Some("a was changed"));
}

/// A file that was changed counts as changed, even if content and time were restored.
#[test]
fn every_change_of_a_file_is_reported() {
    let (_dir, store, data) = store_and_data();
    let (file, other) = (data.join("a"), data.join("b"));
    unpack(&file, "one");
    let before = Source::read(&store, &data, None).unwrap();
    let change = || Source::read(&store, &data, None).unwrap().change_since(&before);
    assert_eq!(change(), None);
    fs::write(&other, "").unwrap();
    assert_eq!(change().as_deref(), Some("b was added"));
    fs::remove_file(&other).unwrap();
    assert_eq!(change(), None);
    std::thread::sleep(Duration::from_millis(20));
    unpack(&file, "two");
    assert_eq!(change().as_deref(), Some("a was changed"));
    unpack(&file, "one");
    assert_eq!(hash_of(&store, &data), before.content_hash());
    assert_eq!(change().as_deref(), Some("a was changed"));
    fs::remove_file(&file).unwrap();
    assert_eq!(change().as_deref(), Some("a was removed"));
}

/// Files with known stamps aren't read: even wrong hashes in the cache are used.
#[test]
fn a_known_file_is_not_read_again() {
    let (_dir, store, data) = store_and_data();
    unpack(&data.join("a"), "one");
    let before = read_settled(&store, &data);
    let cache = CacheFile::new(&store, &data.canonicalize().unwrap());
    let mut files = cache.files();
    files.get_mut("a").unwrap().blake3 = "0".repeat(64);
    cache.write(&files);
    assert_ne!(hash_of(&store, &data), before.content_hash());
    // A damaged cache counts as empty.
    fs::write(&cache.path, "{").unwrap();
    assert_eq!(hash_of(&store, &data), before.content_hash());
}

#[test]
fn hashing_stops_at_a_signal_and_reports_progress() {
    let (_dir, store, data) = store_and_data();
    File::create(data.join("large")).unwrap().set_len(1 << 40).unwrap();
    let stop = AtomicBool::new(true);
    let result = Source::read(&store, &data, Some(&stop));
    assert!(matches!(result, Err(SourceError::Interrupted)), "{result:?}");
    let progress = HashProgress::default();
    assert_eq!(progress.message(Path::new("data")), "listing the files of data");
    progress.done.store(1_500_000_000, Ordering::Relaxed);
    progress.total.store(30_000_000_000, Ordering::Relaxed);
    assert_eq!(progress.message(Path::new("data")), "hashing data: 1.5 GB of 30.0 GB");
}

#[test]
fn a_socket_is_refused_instead_of_read() {
    let (_dir, store, data) = store_and_data();
    let _socket = std::os::unix::net::UnixListener::bind(data.join("r_0.png")).unwrap();
    let problem = Source::read(&store, &data, None).unwrap_err().to_string();
    assert!(problem.contains("r_0.png") && problem.contains("is a socket"), "{problem}");
}
