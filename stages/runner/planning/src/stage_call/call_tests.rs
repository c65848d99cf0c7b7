//! Lines and peak memory of a stage, as reported to the caller.

use std::sync::Mutex;

use serde_json::json;

use super::*;

/// Watcher that collects lines, and creates a file at the first one.
struct Lines {
    lines: Mutex<Vec<String>>,
    seen_file: PathBuf,
}

impl Watcher for Lines {
    fn progress(&self, _: &Event) {}

    fn stderr_line(&self, line: &str) {
        self.lines.lock().unwrap().push(line.to_owned());
        std::fs::write(&self.seen_file, "").unwrap();
    }
}

/// Runs a shell script as a stage. Returns its lines and the reason of its failure.
fn lines_and_reason(script: &str) -> (Vec<String>, Option<String>) {
    let (lines, result) = run(script);
    (lines, result.err().map(|failure| failure.message))
}

/// Runs a shell script as a stage; `$SEEN` is the file that its first line creates. Returns its
/// lines and its result.
fn run(script: &str) -> (Vec<String>, Result<Usage, StageFailure>) {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let seen_file = file("seen");
    let text = format!("#!/bin/sh\nSEEN='{}'\n{script}\n", seen_file.display());
    std::fs::write(file("source"), text).unwrap();
    // Another process writes the program: a file that this process has open can't be run.
    let mut install = Command::new("install");
    assert!(
        install
            .args(["-m", "755"])
            .args([file("source"), file("stage")])
            .status()
            .unwrap()
            .success()
    );
    let description = json!({"name": "make", "version": "", "code": "", "summary": "",
        "parameters": {}, "inputs": {}, "output": {"kind": "x"}});
    let description: Description = serde_json::from_value(description).unwrap();
    let call = Call {
        label: "make",
        program: &file("stage"),
        description: &description,
        params: &file("params.json"),
        inputs: &[],
        hashes: &[],
        output: &file("output"),
        work: None,
        from_checkpoint: false,
        device: "cpu",
        threads: 1,
        lock: None,
    };
    let watcher = Lines { lines: Mutex::default(), seen_file };
    let (usage, result) = call.run(&file("log"), &watcher, &AtomicBool::new(false));
    (watcher.lines.into_inner().unwrap(), result.map(|()| usage))
}

/// A stage's peak memory includes the programs that the stage calls, but not the runner.
#[test]
fn peak_memory_excludes_the_runner() {
    let large = std::hint::black_box(vec![1u8; 100_000_000]);
    let peak_of = |script: &str| run(script).1.unwrap().peak_memory;
    let small = peak_of("sleep 0.3");
    assert!((100_000..20_000_000).contains(&small), "{small}");
    drop(large);
    let with_children =
        peak_of("tail -c 200000000 /dev/zero | head -c 200000000 | tail -n 1 >/dev/null");
    assert!(with_children > 150_000_000, "{with_children}");
}

/// The stage waits until its only line is reported: a long training would still be running.
#[test]
fn lines_are_reported_while_the_stage_runs() {
    let wait = "for i in $(seq 600); do [ -e $SEEN ] && exit 0; sleep 0.1; done; exit 9";
    let (lines, failure) = lines_and_reason(&format!("echo resumed at step 5 >&2; {wait}"));
    assert_eq!((lines, failure), (vec!["resumed at step 5".to_owned()], None));
}

/// A process that has left the stage's group may keep the stage's pipes open for ever, silently or
/// not. All lines of the stage itself are read.
#[test]
fn a_process_outside_the_group_does_not_delay_the_end() {
    for daemon in ["sleep 1000", "yes"] {
        let started = Instant::now();
        let (lines, failure) = lines_and_reason(&format!(
            "setsid {daemon} & echo $! >&2; until [ \"$(ps -o sid= -p $! | tr -d ' ')\" = $! ]; \
            do sleep 0.01; done; echo make: bad >&2; exit 3"
        ));
        let id = lines[0].parse().ok().and_then(rustix::process::Pid::from_raw).unwrap();
        rustix::process::kill_process(id, rustix::process::Signal::KILL).ok();
        assert_eq!(failure.as_deref(), Some("bad"), "{lines:?}");
        assert!(lines[1].contains("still runs") && lines.len() == 2, "{lines:?}");
        assert!(started.elapsed() < Duration::from_secs(100));
    }
}

/// The caller prints the reason, so it isn't one of the lines, even if the stage ends late.
#[test]
fn the_reason_of_a_failure_is_printed_once() {
    for (script, lines, reason) in [
        ("echo one >&2; echo make: bad >&2; sleep 1; exit 3", vec!["one"], "bad"),
        ("echo one >&2; echo ValueError: bad >&2; exit 1", vec!["one"], "ValueError: bad"),
        ("echo one >&2; echo two >&2", vec!["one", "two"], ""),
    ] {
        let (found, failure) = lines_and_reason(script);
        assert_eq!(
            (found, failure.unwrap_or_default().as_str()),
            (lines.iter().map(|l| (*l).to_owned()).collect(), reason)
        );
    }
}
