//! Push and pull through a folder, with the real program.

mod common;

use std::fs;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};

use artifact::{MANIFEST_FILE, Manifest, write_json};
use common::{
    Setup, assert_clean, assert_equal, assert_tidy, command, make, make_pipe, said, succeed,
};
use store::{Record, Store};

#[test]
fn what_is_pushed_is_pulled() {
    let setup = Setup::new();
    let remote = setup.remote();
    let out = succeed(&mut command(setup.store.root(), &["push", &remote]));
    assert!(out.contains("4 actions pushed (13.6 MB), 0 already present"), "{out}");
    let out = succeed(&mut command(setup.store.root(), &["push", &remote]));
    assert!(out.contains("0 actions pushed (0 bytes), 4 already present"), "{out}");
    assert!(setup.store.runs().unwrap().is_empty(), "a push keeps nothing longer");
    let out = succeed(&mut command(&setup.path("other"), &["pull", &remote]));
    assert!(out.contains("4 actions pulled (13.6 MB), 0 already present"), "{out}");
    let other = Store::open(&setup.path("other")).unwrap();
    assert_equal(&setup.store, &other);
    assert_tidy(&other);
    let run = other.runs().unwrap().remove(0);
    assert!(
        run.ended_unix.is_some() && run.keys.len() == 4,
        "collection must leave what was pulled"
    );
    let out = succeed(&mut command(&setup.path("other"), &["pull", &remote]));
    assert!(out.contains("0 actions pulled (0 bytes), 4 already present"), "{out}");
    // The layout is a store's.
    let train = &setup.records[2];
    for file in [
        "format",
        &format!("actions/{}.json", train.key()),
        &format!("objects/{}/field.bin", train.output),
    ] {
        assert!(setup.path("remote").join(file).is_file(), "{file}");
    }
}

#[test]
fn some_are_selected() {
    let setup = Setup::pushed();
    let keys: Vec<String> = setup.records.iter().map(Record::key).collect();
    let (prep, eval) = (&setup.records[0].output[..8], &keys[3][..8]);
    for (name, words, expected) in [
        ("a", &["--key", eval][..], &[3][..]),
        ("b", &["--key", eval, "--history"], &[0, 2, 3]),
        ("c", &["--artifact", prep], &[0, 1]),
        ("d", &["--artifact", prep, "--key", eval], &[0, 1, 3]),
    ] {
        let (code, err, store) = setup.pull(name, words);
        assert_eq!((code, err.as_str()), (0, ""));
        let mut expected: Vec<&String> = expected.iter().map(|&index| &keys[index]).collect();
        expected.sort();
        assert_eq!(
            store.records().unwrap().iter().map(Record::key).collect::<Vec<_>>(),
            expected.into_iter().cloned().collect::<Vec<_>>()
        );
        assert_clean(&store);
    }
    let remote = setup.path("some").display().to_string();
    succeed(&mut command(setup.store.root(), &["push", &remote, "--artifact", prep]));
    assert_eq!(fs::read_dir(setup.path("some/actions")).unwrap().count(), 2);
    let (code, err, _) = setup.pull("e", &["--key", "zz"]);
    assert!(code == 2 && err.contains("no action \"zz\""), "{err}");
}

/// Pulling replaces an existing artifact only if it is damaged.
#[test]
fn what_is_here_is_not_overwritten() {
    let setup = Setup::pushed();
    let other = Store::open(&setup.path("other")).unwrap();
    let own = make(&other, "eval", &[], &[("metrics.json", b"mine".to_vec())]);
    let (code, _, _) = setup.pull("other", &[]);
    assert_eq!((code, other.hit(&own.key()).unwrap()), (0, Some(own)));
    let train = &setup.records[2];
    fs::write(other.object(&train.output).join("field.bin"), "cut short").unwrap();
    assert_eq!(setup.pull("other", &[]).0, 0);
    assert_clean(&other);
}

type Harm = fn(&Setup);

fn on_remote(setup: &Setup, record: usize, file: &str) -> PathBuf {
    setup.path("remote/objects").join(&setup.records[record].output).join(file)
}

fn record_file(setup: &Setup, record: usize) -> PathBuf {
    setup.path("remote/actions").join(format!("{}.json", setup.records[record].key()))
}

fn edit(path: &Path, change: impl FnOnce(&mut Vec<u8>)) {
    let mut bytes = fs::read(path).unwrap();
    change(&mut bytes);
    fs::write(path, bytes).unwrap();
}

fn replace(path: &Path, make: impl FnOnce(&Path)) {
    fs::remove_file(path).unwrap();
    make(path);
}

/// A record whose artifact's manifest names a file outside.
fn lead_outside(setup: &Setup, path: &str) {
    let mut manifest = Manifest::read(&setup.store.object(&setup.records[3].output)).unwrap();
    path.clone_into(&mut manifest.files[0].path);
    let record = Record { output: manifest.identity(), ..setup.records[3].clone() };
    let folder = setup.path("remote/objects").join(&record.output);
    fs::create_dir_all(&folder).unwrap();
    write_json(&folder.join(MANIFEST_FILE), &manifest).unwrap();
    write_json(&record_file(setup, 3), &record).unwrap();
}

/// Harm to eval on the remote: it is refused by name, nothing of it comes in, and the rest does.
#[test]
fn harm_is_refused_by_name() {
    let cases: &[(&str, &str, Harm)] = &[
        ("metrics.json", "differs from the manifest (blake3)", |s| {
            edit(&on_remote(s, 3, "metrics.json"), |b| b[3] ^= 1);
        }),
        ("metrics.json", "more than the 15 bytes", |s| {
            edit(&on_remote(s, 3, "metrics.json"), |b| b.push(b' '));
        }),
        ("metrics.json", "14 bytes, but 15 in the manifest", |s| {
            edit(&on_remote(s, 3, "metrics.json"), |b| b.truncate(14));
        }),
        ("metrics.json", "not found", |s| {
            fs::remove_file(on_remote(s, 3, "metrics.json")).unwrap();
        }),
        (MANIFEST_FILE, "not found", |s| {
            fs::remove_file(on_remote(s, 3, MANIFEST_FILE)).unwrap();
        }),
        (MANIFEST_FILE, "not a manifest", |s| {
            edit(&on_remote(s, 3, MANIFEST_FILE), |b| b.truncate(20));
        }),
        (MANIFEST_FILE, "its blake3 differs from the artifact's name", |s| {
            fs::copy(on_remote(s, 0, MANIFEST_FILE), on_remote(s, 3, MANIFEST_FILE))
                .map(|_| ())
                .unwrap();
        }),
        (MANIFEST_FILE, "not a path inside", |s| lead_outside(s, "../../../../evil")),
        (MANIFEST_FILE, "not a path inside", |s| lead_outside(s, "/tmp/evil")),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| lead_outside(s, MANIFEST_FILE)),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| {
            lead_outside(s, "./metrics.json");
        }),
        ("metrics.json", "is a named pipe (FIFO)", |s| {
            replace(&on_remote(s, 3, "metrics.json"), make_pipe);
        }),
        (MANIFEST_FILE, "is a named pipe (FIFO)", |s| {
            replace(&on_remote(s, 3, MANIFEST_FILE), make_pipe);
        }),
        (".json", "is a named pipe (FIFO)", |s| replace(&record_file(s, 3), make_pipe)),
        ("metrics.json", "symbolic links", |s| {
            replace(&on_remote(s, 3, "metrics.json"), |p| symlink("metrics.json", p).unwrap());
        }),
        (".json", "symbolic links", |s| {
            replace(&record_file(s, 3), |p| symlink(p.file_name().unwrap(), p).unwrap());
        }),
        (MANIFEST_FILE, "is a folder", |s| {
            replace(&on_remote(s, 3, MANIFEST_FILE), |p| fs::create_dir(p).unwrap());
        }),
        ("/xxxx", "File name too long", |s| lead_outside(s, &"x".repeat(300))),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| {
            lead_outside(s, &format!("{}x", "folder/".repeat(150)));
        }),
        (MANIFEST_FILE, "not a path inside", |s| lead_outside(s, &"../".repeat(2000))),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| {
            lead_outside(s, &format!("{}x", "a/".repeat(400)));
        }),
        (".json", "not a record", |s| edit(&record_file(s, 3), |b| b.truncate(40))),
        (".json", "its key differs from its name", |s| {
            fs::copy(record_file(s, 0), record_file(s, 3)).map(|_| ()).unwrap();
        }),
        (".json", "\"../../evil\" is not a hash", |s| {
            write_json(
                &record_file(s, 3),
                &Record { output: "../../evil".into(), ..s.records[3].clone() },
            )
            .unwrap();
        }),
        (".json", "is not a hash", |s| {
            write_json(
                &record_file(s, 3),
                &Record { made_of: vec!["/etc".into()], ..s.records[3].clone() },
            )
            .unwrap();
        }),
    ];
    // One push serves all cases.
    let pushed = Setup::pushed();
    for (name, reason, harm) in cases {
        let dir = tempfile::tempdir().unwrap();
        copy(&pushed.path("remote"), &dir.path().join("remote"));
        let setup = Setup { dir, store: pushed.store.clone(), records: pushed.records.clone() };
        harm(&setup);
        let (code, err, store) = setup.pull("other", &[]);
        let lines: Vec<&str> = err.lines().collect();
        assert!(
            code == 3 && lines.len() == 2 && lines[0].contains(name) && lines[0].contains(reason),
            "{reason}: {code} {err}"
        );
        assert!(lines[0].len() < 600, "{reason}: {err}");
        assert!(lines[1].contains("refused 1 of the records and artifacts"), "{err}");
        assert_eq!(
            (store.records().unwrap().len(), store.objects().unwrap().len()),
            (3, 2),
            "{reason}"
        );
        assert_clean(&store);
        assert_tidy(&store);
        assert!(!setup.path("evil").exists() && !Path::new("/tmp/evil").exists());
    }
}

fn copy(from: &Path, to: &Path) {
    for (relative, file) in artifact::list_files(from).unwrap() {
        let target = to.join(relative);
        fs::create_dir_all(target.parent().unwrap()).unwrap();
        fs::copy(file, target).unwrap();
    }
}

/// Whatever lies among the records, all records come in; what may be a lost one is named.
#[test]
fn odd_names_stop_nothing() {
    type Make = fn(&Path);
    let file: Make = |path| fs::write(path, "{}").unwrap();
    let cases: &[(&[u8], i32, Make)] = &[
        (b"\xff.json", 3, file),
        (b"\xff", 3, file),
        (b"notes.json", 3, file),
        (b"folder", 3, |path| fs::create_dir(path).unwrap()),
        (b"loop", 3, |path| symlink(".", path).unwrap()),
        (b"self", 3, |path| symlink("self", path).unwrap()),
        (b"gone", 3, |path| symlink("nowhere", path).unwrap()),
        (b"pipe", 3, make_pipe),
        (b"README", 0, file),
        (b"._notes.json", 0, file),
        (b"field.json#1", 0, file),
    ];
    let setup = Setup::pushed();
    for &(name, expected, make) in cases {
        let odd = setup.path("remote/actions").join(std::ffi::OsStr::from_bytes(name));
        make(&odd);
        let (code, err, store) = setup.pull("other", &[]);
        let lines: Vec<&str> = err.lines().collect();
        assert_eq!(code, expected, "{name:?}: {err}");
        if expected == 0 {
            assert!(lines.is_empty(), "{name:?}: {err}");
        } else {
            let shown = String::from_utf8_lossy(name);
            assert!(lines.len() == 2 && lines[0].contains(&*shown), "{name:?}: {err}");
        }
        assert_equal(&setup.store, &store);
        // Nor do they stop a push.
        succeed(&mut command(setup.store.root(), &["push", &setup.remote()]));
        fs::remove_dir_all(setup.path("other")).unwrap();
        if odd.is_dir() && !odd.is_symlink() {
            fs::remove_dir(&odd)
        } else {
            fs::remove_file(&odd)
        }
        .unwrap();
    }
}

fn refused(words: &[&str], store: &Path, code: i32, reason: &str) {
    let (found, _, err) = said(&mut command(store, words));
    assert!(
        found == code && err.contains(reason) && err.lines().count() == 1,
        "{words:?}: {found} {err}"
    );
}

#[test]
fn other_formats_and_places_are_refused_in_one_line() {
    let setup = Setup::pushed();
    let (remote, store) = (setup.remote(), setup.store.root());
    for text in ["2\n", "new", ""] {
        fs::write(setup.path("remote/format"), text).unwrap();
        refused(&["pull", &remote], &setup.path("other"), 3, "use the newer nerf-sr-remote");
        refused(&["push", &remote], store, 3, "use the newer nerf-sr-remote");
    }
    // A program that writes into a store of an older format marks the store, so that older
    // programs don't use its new entries.
    fs::write(setup.path("remote/format"), "0\n").unwrap();
    for (words, store, format) in [
        (["pull", &remote], setup.path("other").as_path(), "0\n"),
        (["push", &remote], store, "1\n"),
    ] {
        succeed(&mut command(store, &words));
        assert_eq!(fs::read_to_string(setup.path("remote/format")).unwrap(), format);
    }
    fs::remove_file(setup.path("remote/format")).unwrap();
    refused(&["pull", &remote], &setup.path("other"), 3, "nothing was pushed here");
    let inside = store.display().to_string();
    refused(&["push", &inside], store, 2, "the folder is a store");
    refused(&["pull", "gs://bucket"], &setup.path("other"), 2, "unknown scheme gs://");
    refused(&["pull", "s3://"], &setup.path("other"), 2, "bucket missing");
    refused(&["pull", "/nowhere"], &setup.path("other"), 3, "no such folder");
    refused(&["push", &remote], &setup.path("none"), 3, "not a store of nerf-sr");
    assert!(!setup.path("none").exists());
    fs::write(store.join("format"), "2\n").unwrap();
    for words in [&["push", &remote][..], &["export", "abc", "/tmp/x.tar"]] {
        refused(words, store, 1, "use the newer nerf-sr,");
    }
    refused(&["pull", &remote], store, 1, "use the newer nerf-sr,");
}

/// A flipped byte in the store that is pushed never arrives.
#[test]
fn a_damaged_artifact_is_not_pushed() {
    for (record, file) in [(3, "metrics.json"), (2, "field.bin")] {
        let setup = Setup::new();
        edit(&setup.store.object(&setup.records[record].output).join(file), |bytes| bytes[7] ^= 1);
        let (code, _, err) = said(&mut command(setup.store.root(), &["push", &setup.remote()]));
        assert!(code == 3 && err.contains(file) && err.contains("(blake3)"), "{err}");
        assert!(!on_remote(&setup, record, file).exists() && !record_file(&setup, record).exists());
        let (code, err, store) = setup.pull("other", &[]);
        assert_eq!((code, err.as_str()), (0, ""));
        assert_clean(&store);
    }
}

fn start(store: &Path, words: &[&str]) -> Child {
    command(store, words).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

#[test]
fn several_at_once_pull_into_one_store_and_push_to_one_remote() {
    let setup = Setup::new();
    let remote = setup.remote();
    for (store, words) in [
        (setup.store.root().to_path_buf(), ["push", &remote]),
        (setup.path("other"), ["pull", &remote]),
    ] {
        let children: Vec<_> = (0..4).map(|_| start(&store, &words)).collect();
        for child in children {
            let output = child.wait_with_output().unwrap();
            assert!(
                output.status.success(),
                "{words:?}: {}",
                String::from_utf8_lossy(&output.stderr)
            );
        }
    }
    let other = Store::open(&setup.path("other")).unwrap();
    assert_equal(&setup.store, &other);
    assert_tidy(&other);
}
