//! Programs installed by the script of `make install`.

#![allow(unreachable_pub, reason = "shared by several test binaries")]

use std::path::{Path, PathBuf};
use std::process::Command;

use super::common::{Finished, bin, root};

/// Installs the built programs into a folder. Returns false if libtorch is missing.
pub fn install(prefix: &Path) -> bool {
    let given = std::env::var_os("LIBTORCH").map(PathBuf::from);
    let libtorch = given.unwrap_or_else(|| root().join(".libtorch"));
    if !libtorch.join("lib").is_dir() {
        eprintln!("skipped: {}/lib not found; run `make setup`", libtorch.display());
        return false;
    }
    let mut install = Command::new(root().join("scripts/install.sh"));
    install.arg(prefix).arg(libtorch).env("BUILT", bin("nerf-sr").parent().unwrap());
    let installed = Finished::of(install.output().unwrap());
    assert_eq!(installed.code, 0, "{}", installed.stderr);
    true
}
