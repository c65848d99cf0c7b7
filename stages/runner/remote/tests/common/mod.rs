//! Store with a few finished actions, and calls of `nerf-sr-remote`.

#![allow(dead_code, reason = "no test uses all of these helpers")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::json;
use store::{Entered, Locked, Record, Store, Unfinished};

/// Enters a store. Retries, because a child that another thread has just forked holds the gate of a
/// new store until its exec.
pub(crate) fn entered(store: &Store) -> Entered {
    let start = Instant::now();
    while start.elapsed() < MAX_DURATION {
        if let Locked::Acquired(entered) = store.try_enter().unwrap() {
            return entered;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("the store stays closed")
}

/// Carries out an action as a runner does. Returns its record.
pub(crate) fn make(
    store: &Store,
    stage: &str,
    made_of: &[&Record],
    files: &[(&str, Vec<u8>)],
) -> Record {
    let key_parts = json!({ "stage": stage }).as_object().unwrap().clone();
    let made_of: Vec<String> = made_of.iter().map(|record| record.key()).collect();
    let stage = stage.to_owned();
    let action = Unfinished { stage, key_parts, made_of, started_unix: 7, ..Default::default() };
    let attempt = store.begin(&entered(store), &action, &json!({})).unwrap();
    for (path, bytes) in files {
        let file = attempt.output.join(path);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, bytes).unwrap();
    }
    let checked = store.check(attempt, "text").unwrap();
    let Unfinished { stage, key_parts, made_of, started_unix, .. } = action;
    let record = Record {
        stage,
        key_parts,
        made_of,
        started_unix,
        host: "here".into(),
        ..Record::default()
    };
    store.publish(&entered(store), checked, record).unwrap()
}

fn next_byte(state: &mut u64) -> u8 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 56) as u8
}

/// Returns random bytes, which neither compression nor sparse files make smaller.
pub(crate) fn bytes(count: usize, seed: u64) -> Vec<u8> {
    let mut state = seed;
    (0..count).map(|_| next_byte(&mut state)).collect()
}

/// Creates a store of four actions. `prep` and `again` create equal artifacts; `train` has the
/// input `prep` and a file in several parts; `eval` has the inputs `prep` and `train`.
pub(crate) fn sample(folder: &Path) -> (Store, Vec<Record>) {
    let store = Store::open(folder).unwrap();
    let images = [
        ("train/Bäume 写真.png", bytes(3000, 1)),
        ("train/50% ~ [a]#12", bytes(2000, 2)),
        ("train/r_0#1", bytes(10, 3)),
        ("empty", Vec::new()),
        ("views.json", b"{\"views\": []}".to_vec()),
    ];
    let prep = make(&store, "prep", &[], &images);
    let again = make(&store, "again", &[], &images);
    assert_eq!(prep.output, again.output);
    let long_path = format!("{}/{}.bin", "folder".repeat(15), "name".repeat(20));
    let train = make(
        &store,
        "train",
        &[&prep],
        &[("field.bin", bytes((13 << 20) + 5, 4)), (&long_path, bytes(100, 5))],
    );
    let eval =
        make(&store, "eval", &[&prep, &train], &[("metrics.json", b"{\"psnr\": 31.25}".to_vec())]);
    (store, vec![prep, again, train, eval])
}

/// Returns a command of the program on a store, without AWS settings from the environment.
pub(crate) fn command(store: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nerf-sr-remote"));
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("AWS_")) {
        command.env_remove(name);
    }
    command.args(arguments).arg("--store").arg(store).stdin(Stdio::null());
    command
}

/// Runs a command. Returns its exit code, stdout and stderr.
pub(crate) fn said(command: &mut Command) -> (i32, String, String) {
    code_and_texts(command.output().unwrap())
}

pub(crate) fn make_pipe(path: &Path) {
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
}

/// Maximum duration of a command that has nothing to wait for.
const MAX_DURATION: Duration = Duration::from_secs(60);

/// Runs a command like [`said`], but kills a command that runs longer than [`MAX_DURATION`].
pub(crate) fn said_in_time(command: &mut Command) -> (i32, String, String) {
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let pid = child.id().to_string();
    let (sender, receiver) = std::sync::mpsc::channel();
    std::thread::spawn(move || sender.send(child.wait_with_output()));
    let output = receiver.recv_timeout(MAX_DURATION).unwrap_or_else(|_| {
        Command::new("kill").args(["-KILL", &pid]).status().unwrap();
        panic!("killed after {MAX_DURATION:?}: {command:?}")
    });
    code_and_texts(output.unwrap())
}

fn code_and_texts(output: Output) -> (i32, String, String) {
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap_or(-1), text(output.stdout), text(output.stderr))
}

/// Runs a command that must succeed. Returns its stdout.
pub(crate) fn succeed(command: &mut Command) -> String {
    let (code, out, err) = said(command);
    assert_eq!(code, 0, "{out}{err}");
    out
}

/// Checks that every record has a complete artifact, and that every object is undamaged.
pub(crate) fn assert_clean(store: &Store) {
    for record in store.records().unwrap() {
        assert_eq!(store.hit(&record.key()).unwrap().as_ref(), Some(&record));
    }
    for object in store.objects().unwrap() {
        store.verify(&object).unwrap();
    }
}

/// Checks that no scratch folder and no unfinished action is left.
pub(crate) fn assert_tidy(store: &Store) {
    assert_eq!(fs::read_dir(store.root().join("sinks")).unwrap().count(), 0);
    assert!(store.partials().unwrap().is_empty());
}

/// Checks that two stores have equal records and objects, and that the second store is clean.
pub(crate) fn assert_equal(first: &Store, second: &Store) {
    assert_clean(second);
    assert_eq!(first.records().unwrap(), second.records().unwrap());
    assert_eq!(first.objects().unwrap(), second.objects().unwrap());
}

/// Sample store in a folder of its own, and the path of a remote next to it.
pub(crate) struct Setup {
    pub(crate) dir: tempfile::TempDir,
    pub(crate) store: Store,
    pub(crate) records: Vec<Record>,
}

impl Setup {
    pub(crate) fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let (store, records) = sample(&dir.path().join("store"));
        Self { dir, store, records }
    }

    pub(crate) fn pushed() -> Self {
        let setup = Self::new();
        succeed(&mut command(setup.store.root(), &["push", &setup.remote()]));
        setup
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub(crate) fn remote(&self) -> String {
        self.path("remote").display().to_string()
    }

    /// Pulls into a store. Returns the exit code, stderr and the store.
    pub(crate) fn pull(&self, store: &str, arguments: &[&str]) -> (i32, String, Store) {
        let remote = self.remote();
        let arguments: Vec<&str> =
            ["pull", &remote].into_iter().chain(arguments.iter().copied()).collect();
        let (code, _, err) = said_in_time(&mut command(&self.path(store), &arguments));
        (code, err, Store::open(&self.path(store)).unwrap())
    }
}
