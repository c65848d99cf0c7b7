//! Push and pull through moto's S3-compatible server: `python3 -m pip install 'moto[server]'`.

mod common;

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{assert_clean, assert_equal, assert_tidy, bytes, make, said, sample};
use store::Store;

const REMOTE: &str = "s3://shared/team/store";

/// Process of moto's server, ended with the test.
struct Server {
    child: Child,
    port: u16,
}

impl Drop for Server {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

impl Server {
    /// Starts the server; `None` if moto isn't installed.
    fn start() -> Option<Self> {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let mut command = Command::new("moto_server");
        command
            .args(["-H", "127.0.0.1", "-p", &port.to_string()])
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let mut server = Self { child: command.spawn().ok()?, port };
        let since = Instant::now();
        while TcpStream::connect(("127.0.0.1", port)).is_err() {
            // A pyenv shim exits with 127 if no Python has moto.
            let ended = server.child.try_wait().unwrap();
            if ended.is_some_and(|status| status.code() == Some(127)) {
                return None;
            }
            assert!(
                ended.is_none() && since.elapsed() < Duration::from_secs(60),
                "moto_server doesn't answer"
            );
            std::thread::sleep(Duration::from_millis(100));
        }
        server.request("PUT", "shared", b"");
        Some(server)
    }

    fn request(&self, method: &str, path: &str, body: &[u8]) -> Vec<u8> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        let length = body.len();
        // moto reads only the credential, and checks no signature.
        let authorization = "AWS4-HMAC-SHA256 Credential=test/20260101/us-east-1/s3/aws4_request, \
            SignedHeaders=host, Signature=0";
        let head = format!(
            "{method} /{path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: {authorization}\r\n\
            Connection: close\r\n"
        );
        let head = format!("{head}Content-Length: {length}\r\n\r\n");
        stream.write_all(&[head.as_bytes(), body].concat()).unwrap();
        let mut response = Vec::new();
        stream.read_to_end(&mut response).unwrap();
        let (end, status) = (
            response.windows(4).position(|w| w == b"\r\n\r\n").unwrap(),
            String::from_utf8_lossy(&response[9..12]),
        );
        assert!(status.starts_with('2'), "{method} {path}: {status}");
        response.split_off(end + 4)
    }

    fn command(&self, store: &Path, arguments: &[&str]) -> Command {
        let mut command = common::command(store, arguments);
        command
            .env("AWS_ENDPOINT_URL", format!("http://127.0.0.1:{}", self.port))
            .env("AWS_DEFAULT_REGION", "us-east-1");
        command.env("AWS_ACCESS_KEY_ID", "test").env("AWS_SECRET_ACCESS_KEY", "test");
        command
    }

    fn succeed(&self, store: &Path, arguments: &[&str]) -> String {
        common::succeed(&mut self.command(store, arguments))
    }
}

#[test]
fn two_machines_share_a_store_through_s3() {
    let Some(server) = Server::start() else {
        eprintln!("skipped: no moto_server (python3 -m pip install 'moto[server]')");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let folder = |name: &str| dir.path().join(name);
    let (store, records) = sample(&folder("store"));
    // An empty prefix is reported.
    let (code, _, err) = said(&mut server.command(&folder("other"), &["pull", REMOTE]));
    assert!(
        code == 3 && err.contains("nothing was pushed here") && err.lines().count() == 1,
        "{err}"
    );
    let out = server.succeed(store.root(), &["push", REMOTE]);
    assert!(out.contains("4 actions pushed (13.6 MB), 0 already present"), "{out}");
    server.succeed(&folder("other"), &["pull", REMOTE]);
    let other = Store::open(&folder("other")).unwrap();
    assert_equal(&store, &other);
    assert_tidy(&other);
    assert!(
        server
            .succeed(store.root(), &["push", REMOTE])
            .contains("0 actions pushed (0 bytes), 4 already present")
    );
    assert!(
        server
            .succeed(other.root(), &["pull", REMOTE])
            .contains("0 actions pulled (0 bytes), 4 already present")
    );
    // An action of the other machine is pulled.
    make(&other, "more", &[&records[3]], &[("x", bytes(1000, 9))]);
    server.succeed(other.root(), &["push", REMOTE]);
    server.succeed(store.root(), &["pull", REMOTE]);
    assert_equal(&other, &store);

    let file = format!("objects/{}/metrics.json", records[3].output);
    let path = format!("shared/team/store/{file}");
    let mut content = server.request("GET", &path, b"");
    assert_eq!(content, fs::read(store.object(&records[3].output).join("metrics.json")).unwrap());
    content[3] ^= 1;
    server.request("PUT", &path, &content);
    let (code, _, err) = said(&mut server.command(&folder("third"), &["pull", REMOTE]));
    assert!(
        code == 3
            && err.contains(&format!("{REMOTE}/{file}: the content differs from the manifest")),
        "{err}"
    );
    let third = Store::open(&folder("third")).unwrap();
    assert_eq!(third.records().unwrap().len(), 4, "the other actions are pulled");
    assert_clean(&third);
    // Apply the message's remedy.
    server.request("DELETE", &path, b"");
    server.request("DELETE", &format!("shared/team/store/actions/{}.json", records[3].key()), b"");
    server.succeed(store.root(), &["push", REMOTE]);
    server.succeed(third.root(), &["pull", REMOTE]);
    assert_equal(&store, &third);

    // Newer formats are refused on either side.
    fs::write(third.root().join("format"), "2\n").unwrap();
    let (code, _, err) = said(&mut server.command(third.root(), &["push", REMOTE]));
    assert!(
        code == 1 && err.contains("the store has format 2") && err.lines().count() == 1,
        "{err}"
    );
    server.request("PUT", "shared/team/store/format", b"2\n");
    for (store, verb) in [(&folder("fourth"), "pull"), (&folder("store"), "push")] {
        let (code, _, err) = said(&mut server.command(store, &[verb, REMOTE]));
        assert!(
            code == 3 && err.contains("the remote has format 2") && err.lines().count() == 1,
            "{err}"
        );
    }
}

#[test]
fn a_missing_bucket_is_reported_on_one_line() {
    let Some(server) = Server::start() else {
        eprintln!("skipped: no moto_server (python3 -m pip install 'moto[server]')");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = sample(&dir.path().join("store"));
    let (code, _, err) = said(&mut server.command(store.root(), &["push", "s3://another"]));
    assert!(code == 1 && err.contains("s3://another") && err.lines().count() == 1, "{err}");
}
