//! Tests of a push and pull that is killed, interrupted, or waits for a server, with the real
//! program.

mod common;

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use common::{Setup, assert_clean, assert_equal, bytes, command, make, succeed};
use store::Store;

/// A server that accepts connections and never answers does not delay an interrupt.
#[test]
fn an_interrupt_ends_the_wait_for_a_silent_server() {
    let dir = tempfile::tempdir().unwrap();
    let server = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mut command = command(&dir.path().join("store"), &["pull", "s3://bucket"]);
    command.env("AWS_ENDPOINT_URL", format!("http://{}", server.local_addr().unwrap()));
    command.env("AWS_ACCESS_KEY_ID", "x").env("AWS_SECRET_ACCESS_KEY", "x");
    let child = command.stderr(Stdio::piped()).spawn().unwrap();
    let _connection = server.accept().unwrap();
    interrupt(&child);
    let since = Instant::now();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(since.elapsed() < Duration::from_secs(20));
}

fn interrupt(child: &std::process::Child) {
    assert!(
        std::process::Command::new("kill")
            .args(["-INT", &child.id().to_string()])
            .status()
            .unwrap()
            .success()
    );
}

/// Number of attempts to stop a push or pull.
const ATTEMPTS: u32 = 12;

/// Adds artifacts large enough that a kill comes in the middle of their transfer.
fn add_large_artifacts(setup: &Setup) {
    for index in 0..12 {
        let files = [("a", bytes(2 << 20, index)), ("b/c", bytes(9 << 20, index + 100))];
        make(&setup.store, &format!("stage{index}"), &[], &files);
    }
}

/// Kills or interrupts a command at varied moments, runs `check` after each attempt, and finally
/// lets the command finish. `destination` is emptied after each run that finishes. Returns the
/// number of stopped runs.
fn stop_often(store: &Path, arguments: &[&str], destination: &Path, check: impl Fn()) -> usize {
    let since = Instant::now();
    succeed(&mut command(store, arguments));
    let duration = since.elapsed();
    fs::remove_dir_all(destination).unwrap();
    let mut stopped = 0;
    for attempt in 0..ATTEMPTS {
        let mut child =
            command(store, arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(duration * (1 + attempt * 7 % ATTEMPTS) / ATTEMPTS);
        if attempt % 3 == 0 {
            interrupt(&child);
        } else {
            child.kill().unwrap();
        }
        let status = child.wait().unwrap();
        assert!(matches!(status.code(), None | Some(0 | 130)), "{status}");
        stopped += usize::from(!status.success());
        check();
        if status.success() {
            fs::remove_dir_all(destination).unwrap();
        }
    }
    succeed(&mut command(store, arguments));
    check();
    stopped
}

#[test]
fn stopped_transfers_leave_no_partial_artifact() {
    let setup = Setup::new();
    add_large_artifacts(&setup);
    let remote = setup.remote();
    let stopped = stop_often(setup.store.root(), &["push", &remote], &setup.path("remote"), || {
        // Every record on the remote has its complete artifact there.
        let (code, err, pulled) = setup.pull("seen", &[]);
        assert!(
            code == 0 || err.contains("nothing was pushed here") || err.contains("no such folder"),
            "{code} {err}"
        );
        assert_clean(&pulled);
        fs::remove_dir_all(setup.path("seen")).unwrap();
    });
    assert!(stopped > 2, "{stopped}");
    let stopped =
        stop_often(&setup.path("other"), &["pull", &remote], &setup.path("other"), || {
            if setup.path("other").exists() {
                assert_clean(&Store::open(&setup.path("other")).unwrap());
            }
        });
    assert!(stopped > 2, "{stopped}");
    assert_equal(&setup.store, &Store::open(&setup.path("other")).unwrap());
}
