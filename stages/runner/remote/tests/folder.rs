//! Tests of push and pull through a folder, with the real program.

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
fn pushed_actions_are_pulled() {
    let setup = Setup::new();
    let remote = setup.remote();
    let out = succeed(&mut command(setup.store.root(), &["push", &remote]));
    assert!(out.contains("4 actions pushed (13.6 MB), 0 already present"), "{out}");
    let out = succeed(&mut command(setup.store.root(), &["push", &remote]));
    assert!(out.contains("0 actions pushed (0 bytes), 4 already present"), "{out}");
    assert!(setup.store.runs().unwrap().is_empty(), "a push must not protect actions");
    let out = succeed(&mut command(&setup.path("other"), &["pull", &remote]));
    assert!(out.contains("4 actions pulled (13.6 MB), 0 already present"), "{out}");
    let other = Store::open(&setup.path("other")).unwrap();
    assert_equal(&setup.store, &other);
    assert_tidy(&other);
    let run = other.runs().unwrap().remove(0);
    assert!(
        run.ended_unix.is_some() && run.keys.len() == 4,
        "pulled actions must be protected from collection"
    );
    let out = succeed(&mut command(&setup.path("other"), &["pull", &remote]));
    assert!(out.contains("0 actions pulled (0 bytes), 4 already present"), "{out}");
    // The remote has a store's layout.
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
fn selected_actions_are_pulled_and_pushed() {
    let setup = Setup::pushed();
    let keys: Vec<String> = setup.records.iter().map(Record::key).collect();
    let (prep, eval) = (&setup.records[0].output[..8], &keys[3][..8]);
    for (name, arguments, expected) in [
        ("a", &["--key", eval][..], &[3][..]),
        ("b", &["--key", eval, "--history"], &[0, 2, 3]),
        ("c", &["--artifact", prep], &[0, 1]),
        ("d", &["--artifact", prep, "--key", eval], &[0, 1, 3]),
    ] {
        let (code, err, store) = setup.pull(name, arguments);
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
fn undamaged_artifacts_are_not_overwritten() {
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

type Damage = fn(&Setup);

fn remote_file(setup: &Setup, record: usize, file: &str) -> PathBuf {
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

/// Writes a record to the remote, whose artifact's manifest names its first file `path`.
fn forge_path(setup: &Setup, path: &str) {
    let mut manifest = Manifest::read(&setup.store.object(&setup.records[3].output)).unwrap();
    path.clone_into(&mut manifest.files[0].path);
    let record = Record { output: manifest.identity(), ..setup.records[3].clone() };
    let folder = setup.path("remote/objects").join(&record.output);
    fs::create_dir_all(&folder).unwrap();
    write_json(&folder.join(MANIFEST_FILE), &manifest).unwrap();
    write_json(&record_file(setup, 3), &record).unwrap();
}

/// Damage to eval on the remote is reported with the file's name. Nothing of eval is pulled, all
/// other artifacts are.
#[test]
fn damaged_files_are_refused_by_name() {
    let cases: &[(&str, &str, Damage)] = &[
        ("metrics.json", "differs from the manifest (blake3)", |s| {
            edit(&remote_file(s, 3, "metrics.json"), |b| b[3] ^= 1);
        }),
        ("metrics.json", "more than the 15 bytes", |s| {
            edit(&remote_file(s, 3, "metrics.json"), |b| b.push(b' '));
        }),
        ("metrics.json", "14 bytes, but 15 in the manifest", |s| {
            edit(&remote_file(s, 3, "metrics.json"), |b| b.truncate(14));
        }),
        ("metrics.json", "not found", |s| {
            fs::remove_file(remote_file(s, 3, "metrics.json")).unwrap();
        }),
        (MANIFEST_FILE, "not found", |s| {
            fs::remove_file(remote_file(s, 3, MANIFEST_FILE)).unwrap();
        }),
        (MANIFEST_FILE, "not a manifest", |s| {
            edit(&remote_file(s, 3, MANIFEST_FILE), |b| b.truncate(20));
        }),
        (MANIFEST_FILE, "its blake3 differs from the artifact's name", |s| {
            fs::copy(remote_file(s, 0, MANIFEST_FILE), remote_file(s, 3, MANIFEST_FILE))
                .map(|_| ())
                .unwrap();
        }),
        (MANIFEST_FILE, "not a path inside", |s| forge_path(s, "../../../../evil")),
        (MANIFEST_FILE, "not a path inside", |s| forge_path(s, "/tmp/evil")),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| forge_path(s, MANIFEST_FILE)),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| {
            forge_path(s, "./metrics.json");
        }),
        ("metrics.json", "is a named pipe (FIFO)", |s| {
            replace(&remote_file(s, 3, "metrics.json"), make_pipe);
        }),
        (MANIFEST_FILE, "is a named pipe (FIFO)", |s| {
            replace(&remote_file(s, 3, MANIFEST_FILE), make_pipe);
        }),
        (".json", "is a named pipe (FIFO)", |s| replace(&record_file(s, 3), make_pipe)),
        ("metrics.json", "symbolic links", |s| {
            replace(&remote_file(s, 3, "metrics.json"), |p| symlink("metrics.json", p).unwrap());
        }),
        (".json", "symbolic links", |s| {
            replace(&record_file(s, 3), |p| symlink(p.file_name().unwrap(), p).unwrap());
        }),
        (MANIFEST_FILE, "is a folder", |s| {
            replace(&remote_file(s, 3, MANIFEST_FILE), |p| fs::create_dir(p).unwrap());
        }),
        ("/xxxx", "File name too long", |s| forge_path(s, &"x".repeat(300))),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| {
            forge_path(s, &format!("{}x", "folder/".repeat(150)));
        }),
        (MANIFEST_FILE, "not a path inside", |s| forge_path(s, &"../".repeat(2000))),
        (MANIFEST_FILE, "not the path of an artifact's file", |s| {
            forge_path(s, &format!("{}x", "a/".repeat(400)));
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
    for (name, reason, damage) in cases {
        let dir = tempfile::tempdir().unwrap();
        copy(&pushed.path("remote"), &dir.path().join("remote"));
        let setup = Setup { dir, store: pushed.store.clone(), records: pushed.records.clone() };
        damage(&setup);
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

/// All records are pulled despite unexpected files among them; a file that may be a misnamed record
/// is reported.
#[test]
fn unexpected_files_stop_neither_pull_nor_push() {
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
        let path = setup.path("remote/actions").join(std::ffi::OsStr::from_bytes(name));
        make(&path);
        let (code, err, store) = setup.pull("other", &[]);
        let lines: Vec<&str> = err.lines().collect();
        assert_eq!(code, expected, "{name:?}: {err}");
        if expected == 0 {
            assert!(lines.is_empty(), "{name:?}: {err}");
        } else {
            let printed_name = String::from_utf8_lossy(name);
            assert!(lines.len() == 2 && lines[0].contains(&*printed_name), "{name:?}: {err}");
        }
        assert_equal(&setup.store, &store);
        // A push succeeds, too.
        succeed(&mut command(setup.store.root(), &["push", &setup.remote()]));
        fs::remove_dir_all(setup.path("other")).unwrap();
        if path.is_dir() && !path.is_symlink() {
            fs::remove_dir(&path)
        } else {
            fs::remove_file(&path)
        }
        .unwrap();
    }
}

fn assert_refused(arguments: &[&str], store: &Path, code: i32, reason: &str) {
    let (found, _, err) = said(&mut command(store, arguments));
    assert!(
        found == code && err.contains(reason) && err.lines().count() == 1,
        "{arguments:?}: {found} {err}"
    );
}

#[test]
fn other_formats_and_locations_are_refused_in_one_line() {
    let setup = Setup::pushed();
    let (remote, store) = (setup.remote(), setup.store.root());
    for text in ["2\n", "new", ""] {
        fs::write(setup.path("remote/format"), text).unwrap();
        assert_refused(&["pull", &remote], &setup.path("other"), 3, "use the newer nerf-sr-remote");
        assert_refused(&["push", &remote], store, 3, "use the newer nerf-sr-remote");
    }
    // A program that writes into a store of an older format marks the store, so that older
    // programs don't use its new entries.
    fs::write(setup.path("remote/format"), "0\n").unwrap();
    for (arguments, store, format) in [
        (["pull", &remote], setup.path("other").as_path(), "0\n"),
        (["push", &remote], store, "1\n"),
    ] {
        succeed(&mut command(store, &arguments));
        assert_eq!(fs::read_to_string(setup.path("remote/format")).unwrap(), format);
    }
    fs::remove_file(setup.path("remote/format")).unwrap();
    assert_refused(&["pull", &remote], &setup.path("other"), 3, "nothing was pushed here");
    let store_path = store.display().to_string();
    assert_refused(&["push", &store_path], store, 2, "the folder is a store");
    assert_refused(&["pull", "gs://bucket"], &setup.path("other"), 2, "unknown scheme gs://");
    assert_refused(&["pull", "s3://"], &setup.path("other"), 2, "bucket missing");
    assert_refused(&["pull", "/nowhere"], &setup.path("other"), 3, "no such folder");
    assert_refused(&["push", &remote], &setup.path("none"), 3, "not a store of nerf-sr");
    assert!(!setup.path("none").exists());
    fs::write(store.join("format"), "2\n").unwrap();
    for arguments in [&["push", &remote][..], &["export", "abc", "/tmp/x.tar"]] {
        assert_refused(arguments, store, 1, "use the newer nerf-sr,");
    }
    assert_refused(&["pull", &remote], store, 1, "use the newer nerf-sr,");
}

/// An artifact with a flipped byte in the local store is not pushed.
#[test]
fn a_damaged_artifact_is_not_pushed() {
    for (record, file) in [(3, "metrics.json"), (2, "field.bin")] {
        let setup = Setup::new();
        edit(&setup.store.object(&setup.records[record].output).join(file), |bytes| bytes[7] ^= 1);
        let (code, _, err) = said(&mut command(setup.store.root(), &["push", &setup.remote()]));
        assert!(code == 3 && err.contains(file) && err.contains("(blake3)"), "{err}");
        assert!(
            !remote_file(&setup, record, file).exists() && !record_file(&setup, record).exists()
        );
        let (code, err, store) = setup.pull("other", &[]);
        assert_eq!((code, err.as_str()), (0, ""));
        assert_clean(&store);
    }
}

fn start(store: &Path, arguments: &[&str]) -> Child {
    command(store, arguments).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

#[test]
fn several_processes_share_a_store_and_a_remote() {
    let setup = Setup::new();
    let remote = setup.remote();
    for (store, arguments) in [
        (setup.store.root().to_path_buf(), ["push", &remote]),
        (setup.path("other"), ["pull", &remote]),
    ] {
        let children: Vec<_> = (0..4).map(|_| start(&store, &arguments)).collect();
        for child in children {
            let output = child.wait_with_output().unwrap();
            assert!(
                output.status.success(),
                "{arguments:?}: {}",
                String::from_utf8_lossy(&output.stderr)
            );
        }
    }
    let other = Store::open(&setup.path("other")).unwrap();
    assert_equal(&setup.store, &other);
    assert_tidy(&other);
}
