//! Push and pull that are killed, interrupted, or wait for a server, with the real program.

mod common;

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use common::{Setup, assert_clean, assert_equal, bytes, command, make, succeed};
use store::Store;

/// A server that takes connections and says nothing holds up nobody who interrupts.
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

/// Number of times that a push or pull is stopped.
const TURNS: u32 = 12;

/// A store with enough in it that a kill comes in the middle.
fn much(setup: &Setup) {
    for index in 0..12 {
        let files = [("a", bytes(2 << 20, index)), ("b/c", bytes(9 << 20, index + 100))];
        make(&setup.store, &format!("stage{index}"), &[], &files);
    }
}

/// Kills, interrupts, begins anew what got to its end in the folder it fills, and at last lets end;
/// how often it was stopped.
fn stop_often(store: &Path, words: &[&str], fills: &Path, after: impl Fn()) -> usize {
    let since = Instant::now();
    succeed(&mut command(store, words));
    let whole = since.elapsed();
    fs::remove_dir_all(fills).unwrap();
    let mut stopped = 0;
    for turn in 0..TURNS {
        let mut child =
            command(store, words).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(whole * (1 + turn * 7 % TURNS) / TURNS);
        if turn % 3 == 0 {
            interrupt(&child);
        } else {
            child.kill().unwrap();
        }
        let status = child.wait().unwrap();
        assert!(matches!(status.code(), None | Some(0 | 130)), "{status}");
        stopped += usize::from(!status.success());
        after();
        if status.success() {
            fs::remove_dir_all(fills).unwrap();
        }
    }
    succeed(&mut command(store, words));
    after();
    stopped
}

#[test]
fn kills_leave_nothing_half_seen() {
    let setup = Setup::new();
    much(&setup);
    let remote = setup.remote();
    let stopped = stop_often(setup.store.root(), &["push", &remote], &setup.path("remote"), || {
        // Whatever has a record on the remote is whole there.
        let (code, err, seen) = setup.pull("seen", &[]);
        assert!(
            code == 0 || err.contains("nothing was pushed here") || err.contains("no such folder"),
            "{code} {err}"
        );
        assert_clean(&seen);
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
