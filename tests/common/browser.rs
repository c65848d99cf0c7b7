//! Helper for tests in a real browser: node runs the scripts of `tests/browser`, which control
//! Debian's Chromium.

use std::ffi::OsStr;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// Runs `tests/browser/SCRIPT` and returns the JSON that the script prints. Without an installed
/// browser, prints that the test is skipped and returns `None`.
#[track_caller]
pub fn run_in_browser<A: AsRef<OsStr>>(
    script: &str,
    arguments: impl IntoIterator<Item = A>,
) -> Option<serde_json::Value> {
    let root = super::root();
    let packages = root.join("target/browser");
    let chromium = chromium();
    // `complete` is a copy of the lock file with which the packages were installed.
    let [installed, required] =
        [packages.join("complete"), root.join("tests/browser/package-lock.json")]
            .map(|file| std::fs::read(file).ok());
    if chromium.is_none() || installed != required {
        eprintln!("skipped: no browser (apt-get install chromium; scripts/setup-browser.sh)");
        return None;
    }
    let output = Command::new("node")
        .arg(root.join("tests/browser").join(script))
        .args(arguments)
        .env("NERF_SR_BROWSER", packages)
        .env("NERF_SR_CHROMIUM", chromium.unwrap())
        .stdin(Stdio::null())
        .output()
        .expect("cannot start node");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{script}: {errors}");
    Some(serde_json::from_slice(&output.stdout).unwrap_or_else(|error| {
        panic!("{script} printed no JSON ({error}): {}", String::from_utf8_lossy(&output.stdout))
    }))
}

fn chromium() -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|folder| folder.join("chromium")).find(|file| file.exists())
}
