//! Writes `targets.rs`: names and texts of the repository's `pipelines/*.yaml`, sorted by name.

use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    let package = env::var_os("CARGO_MANIFEST_DIR").expect("cargo names the crate's folder");
    let shelf = Path::new(&package).join("../../../pipelines");
    let shelf = shelf.canonicalize().expect("the repository has pipelines/");
    println!("cargo::rerun-if-changed={}", shelf.display());
    let mut files: Vec<PathBuf> = fs::read_dir(&shelf)
        .expect("pipelines/ can be listed")
        .map(|entry| entry.expect("pipelines/ can be listed").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "yaml"))
        .collect();
    files.sort();
    let targets: String = files.iter().map(|file| target(file)).collect();
    let out = env::var_os("OUT_DIR").expect("cargo names the folder to write into");
    fs::write(Path::new(&out).join("targets.rs"), format!("&[\n{targets}]\n"))
        .expect("the folder can be written");
}

/// Returns a Rust tuple of a file's name and text.
fn target(file: &Path) -> String {
    let name = file.file_name().and_then(|name| name.to_str()).expect("the name is UTF-8");
    format!("    ({name:?}, include_str!({file:?})),\n")
}
