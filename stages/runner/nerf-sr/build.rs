//! Writes `targets.rs`: folders, names and texts of the repository's `pipelines/*.yaml` and
//! `experiments/*.yaml`, sorted by name.

use std::path::{Path, PathBuf};
use std::{env, fs};

/// Folders whose files `nerf-sr init` writes.
const FOLDERS: [&str; 2] = ["pipelines", "experiments"];

fn main() {
    let package = env::var_os("CARGO_MANIFEST_DIR").expect("cargo names the crate's folder");
    let targets: String = FOLDERS
        .iter()
        .map(|folder| targets(folder, &Path::new(&package).join("../../..")))
        .collect();
    let out = env::var_os("OUT_DIR").expect("cargo names the folder to write into");
    fs::write(Path::new(&out).join("targets.rs"), format!("&[\n{targets}]\n"))
        .expect("the folder can be written");
}

/// Returns Rust tuples of the folder, names and texts of a folder's files in the repository.
fn targets(folder: &str, repository: &Path) -> String {
    let shelf = repository.join(folder).canonicalize().expect("the repository has the folder");
    println!("cargo::rerun-if-changed={}", shelf.display());
    let mut files: Vec<PathBuf> = fs::read_dir(&shelf)
        .expect("the folder can be listed")
        .map(|entry| entry.expect("the folder can be listed").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "yaml"))
        .collect();
    files.sort();
    let mut list = String::new();
    for file in files {
        let name = file.file_name().and_then(|name| name.to_str()).expect("the name is UTF-8");
        list += &format!("    ({folder:?}, {name:?}, include_str!({file:?})),\n");
    }
    list
}
