//! Files that `export` may replace and `import` may read, and leftovers of killed commands.

mod common;

use std::fs;
use std::os::unix::fs::{FileTypeExt as _, symlink};
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, SystemTime};

use common::{Setup, command, make_pipe, said, said_in_time, succeed};

/// Lists the entries of a folder with kind and content.
fn listing(folder: &Path) -> Vec<String> {
    let mut all: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| {
            let path = entry.unwrap().path();
            let kind = path.symlink_metadata().unwrap().file_type();
            let content = if kind.is_file() { fs::read(&path).unwrap() } else { Vec::new() };
            format!("{path:?} {kind:?} {content:?}")
        })
        .collect();
    all.sort();
    all
}

/// Only a regular file is replaced, and only with --force.
#[test]
fn export_replaces_only_files_and_only_with_force() {
    type Create = fn(&Path);
    let cases: &[(&str, &str, Create)] = &[
        ("file", "the file exists", |path| fs::write(path, "precious").unwrap()),
        ("pipe", "is a named pipe (FIFO)", make_pipe),
        ("socket", "is a socket", |path| drop(UnixListener::bind(path).unwrap())),
        ("folder", "is a folder", |path| fs::create_dir(path).unwrap()),
        ("link", "is a symbolic link", |path| {
            fs::write(path.with_extension("real"), "precious").unwrap();
            symlink(path.with_extension("real"), path).unwrap();
        }),
        ("dangling", "is a symbolic link", |path| symlink("nowhere", path).unwrap()),
        ("device", "is a device", |path| {
            let output = Command::new("mknod").arg(path).args(["c", "1", "3"]).output();
            if !path.symlink_metadata().is_ok_and(|found| found.file_type().is_char_device()) {
                eprintln!("only root creates devices: {output:?}; testing a link to one");
                symlink("/dev/null", path).unwrap();
            }
        }),
    ];
    let setup = Setup::new();
    let artifact = setup.records[3].output.as_str();
    for (name, reason, create) in cases {
        let folder = setup.path(&format!("{name}-folder"));
        fs::create_dir(&folder).unwrap();
        let file = folder.join(name);
        create(&file);
        let before = listing(&folder);
        for options in [&[][..], &["--force"]] {
            if *name == "file" && !options.is_empty() {
                continue;
            }
            let arguments = [&["export", artifact, file.to_str().unwrap()], options].concat();
            let (code, out, err) = said(&mut command(setup.store.root(), &arguments));
            let is_reported = err.contains(reason) || (*name == "device" && err.contains("link"));
            assert!(
                code == 2 && is_reported && err.lines().count() == 1,
                "{name}: {code} {out}{err}"
            );
            assert_eq!(listing(&folder), before, "{name}");
        }
    }
    let file = setup.path("file-folder/file").display().to_string();
    succeed(&mut command(setup.store.root(), &["export", artifact, &file, "--force"]));
    succeed(&mut command(&setup.path("other"), &["import", &file]));
    assert_eq!(listing(&setup.path("file-folder")).len(), 1);
}

/// Import doesn't wait for a pipe without a writer, and doesn't read an endless device.
#[test]
fn import_reads_regular_files_only() {
    let dir = tempfile::tempdir().unwrap();
    make_pipe(&dir.path().join("pipe"));
    symlink("pipe", dir.path().join("link")).unwrap();
    drop(UnixListener::bind(dir.path().join("socket")).unwrap());
    for (file, reason) in [
        ("pipe", "is a named pipe (FIFO)"),
        ("link", "is a named pipe (FIFO)"),
        ("socket", "is a socket"),
        ("/dev/zero", "is a device"),
        (".", "is a folder"),
        ("nothing", "No such file"),
    ] {
        let file = dir.path().join(file).display().to_string();
        let (code, _, err) =
            said_in_time(&mut command(&dir.path().join("store"), &["import", &file]));
        assert!(code == 3 && err.contains(reason) && err.lines().count() == 1, "{file}: {err}");
    }
}

/// Writes a file of a command that was killed `age` ago.
fn write_leftover(path: &Path, age: Duration) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, "half").unwrap();
    for path in [path, path.parent().unwrap()] {
        fs::File::open(path).unwrap().set_modified(SystemTime::now() - age).unwrap();
    }
}

/// The next command removes leftovers of killed commands, but no file that may be in use, and no
/// user's file.
#[test]
fn leftovers_of_killed_commands_are_removed() {
    let setup = Setup::pushed();
    let long_ago = Duration::from_secs(2 * 3600);
    let removed = ["remote/uploads/push-a1B2c3/0#1", "exports/.nerf-sr-export-a1B2c3.partial"];
    let user = ["remote/uploads/notes", "exports/.a1B2c3.partial", "exports/notes.partial"];
    let in_use = ["remote/uploads/push-d4E5f6/1", "exports/.nerf-sr-export-d4E5f6.partial"];
    for file in removed.iter().chain(&user) {
        write_leftover(&setup.path(file), long_ago);
    }
    for file in in_use {
        write_leftover(&setup.path(file), Duration::ZERO);
    }
    let store = setup.store.root();
    succeed(&mut command(store, &["push", &setup.remote()]));
    let file = setup.path("exports/eval.tar").display().to_string();
    succeed(&mut command(store, &["export", &setup.records[3].output, &file]));
    for file in removed {
        assert!(!setup.path(file).exists(), "{file}");
    }
    for file in user.iter().chain(&in_use) {
        assert!(setup.path(file).exists(), "{file}");
    }
    assert_eq!(setup.pull("other", &[]).0, 0);
    let entries = fs::read_dir(setup.path("remote/uploads")).unwrap();
    assert_eq!(entries.count(), 2, "push leaves no uploads");
}
