//! Build-time hash of what a stage is made of: the code part of an action's key.
//!
//! A stage's `build.rs` calls [`emit`]; its `main.rs` reads `env!("STAGE_FINGERPRINT")`. The hash
//! covers the sources of the stage's crate and of the workspace crates it uses, the part of
//! `Cargo.lock` they reach, compiler, target, profile and features. It never covers the binary's
//! bytes or an absolute path, so that moving or rebuilding a checkout reruns nothing.
//!
//! ```no_run
//! // build.rs
//! fingerprint::emit();
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::{env, fs};

use toml::{Table, Value};

/// Environment of a build script that changes the machine code.
const BUILD_ENV: [&str; 5] = ["TARGET", "PROFILE", "OPT_LEVEL", "DEBUG", "CARGO_ENCODED_RUSTFLAGS"];

/// Sets `STAGE_FINGERPRINT` for the crate being built.
///
/// # Panics
/// When called outside a Cargo build script or when a manifest can't be read: the build must not go
/// on with a shorter key.
pub fn emit() {
    let crate_dir = PathBuf::from(
        env::var("CARGO_MANIFEST_DIR").expect("fingerprint::emit runs in a build script"),
    );
    let root = crate_dir
        .ancestors()
        .find(|dir| dir.join("Cargo.lock").is_file())
        .expect("the workspace has a Cargo.lock")
        .to_path_buf();
    println!("cargo:rerun-if-changed={}", root.join("Cargo.lock").display());
    println!("cargo:rerun-if-changed={}", root.join("Cargo.toml").display());

    let mut hash = Hash::default();
    let rustc = env::var("RUSTC").expect("cargo names the compiler");
    let version = std::process::Command::new(rustc)
        .arg("-vV")
        .output()
        .expect("the compiler tells its version");
    hash.part("rustc", &version.stdout);
    for name in BUILD_ENV {
        println!("cargo:rerun-if-env-changed={name}");
        hash.part(name, env::var(name).unwrap_or_default().as_bytes());
    }
    let features: BTreeSet<String> =
        env::vars().map(|(k, _)| k).filter(|k| k.starts_with("CARGO_FEATURE_")).collect();
    for feature in features {
        hash.part("feature", feature.as_bytes());
    }

    let workspace = read_toml(&root.join("Cargo.toml"));
    hash.part(
        "profile",
        workspace.get("profile").map(ToString::to_string).unwrap_or_default().as_bytes(),
    );
    let crates = workspace_crates(&root, &workspace, &crate_dir);
    for (name, krate) in &crates {
        println!("cargo:rerun-if-changed={}", krate.dir.display());
        hash.part("crate", name.as_bytes());
        hash.part(
            "Cargo.toml",
            &fs::read(krate.dir.join("Cargo.toml")).expect("a crate has a manifest"),
        );
        for entry in walkdir::WalkDir::new(krate.dir.join("src")).sort_by_file_name() {
            let entry = entry.expect("sources can be listed");
            if entry.file_type().is_file() {
                let path =
                    entry.path().strip_prefix(&krate.dir).expect("a walk stays below its root");
                hash.part(
                    &path.to_string_lossy(),
                    &fs::read(entry.path()).expect("sources can be read"),
                );
            }
        }
    }
    for line in locked(&read_toml(&root.join("Cargo.lock")), &crates) {
        hash.part("locked", line.as_bytes());
    }
    println!("cargo:rustc-env=STAGE_FINGERPRINT={}", hash.0.finalize().to_hex());
}

#[derive(Default)]
struct Hash(blake3::Hasher);

impl Hash {
    /// Length-prefixed, so that no two lists of parts read alike.
    fn part(&mut self, name: &str, bytes: &[u8]) {
        for piece in [name.as_bytes(), bytes] {
            self.0.update(&(piece.len() as u64).to_le_bytes()).update(piece);
        }
    }
}

struct Crate {
    dir: PathBuf,
    /// Names under `[dependencies]` and `[build-dependencies]`; tests can't change an artifact.
    dependencies: Vec<String>,
}

fn read_toml(path: &Path) -> Table {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    text.parse().unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The crate at `start` and every workspace crate it reaches.
fn workspace_crates(root: &Path, workspace: &Table, start: &Path) -> BTreeMap<String, Crate> {
    let shared =
        workspace.get("workspace").and_then(|w| w.get("dependencies")).and_then(Value::as_table);
    let mut found = BTreeMap::new();
    let mut waiting = vec![start.to_path_buf()];
    while let Some(dir) = waiting.pop() {
        let manifest = read_toml(&dir.join("Cargo.toml"));
        let name = manifest["package"]["name"].as_str().expect("a package has a name").to_owned();
        if found.contains_key(&name) {
            continue;
        }
        let mut dependencies = Vec::new();
        for section in ["dependencies", "build-dependencies"] {
            for (name, spec) in
                manifest.get(section).and_then(Value::as_table).into_iter().flatten()
            {
                dependencies.push(name.clone());
                let path = match spec.get("path") {
                    Some(path) => path.as_str().map(|p| dir.join(p)),
                    None => shared
                        .and_then(|s| s.get(name))
                        .and_then(|s| s.get("path"))
                        .and_then(Value::as_str)
                        .map(|p| root.join(p)),
                };
                waiting.extend(path);
            }
        }
        found.insert(name, Crate { dir, dependencies });
    }
    found
}

/// `name version checksum` of every package outside the workspace that `crates` reach, sorted.
fn locked(lock: &Table, crates: &BTreeMap<String, Crate>) -> BTreeSet<String> {
    let packages: Vec<&Table> = lock
        .get("package")
        .and_then(Value::as_array)
        .into_iter()
        .flatten()
        .filter_map(Value::as_table)
        .collect();
    let text = |package: &Table, key: &str| {
        package.get(key).and_then(Value::as_str).unwrap_or_default().to_owned()
    };
    let mut reached = BTreeSet::new();
    let mut waiting: Vec<String> = crates.values().flat_map(|c| c.dependencies.clone()).collect();
    let mut seen = BTreeSet::new();
    while let Some(wanted) = waiting.pop() {
        if !seen.insert(wanted.clone()) {
            continue;
        }
        // "name" or "name version": the second where two versions are locked.
        let mut words = wanted.split(' ');
        let (name, version) = (words.next().unwrap_or_default(), words.next());
        for package in &packages {
            if text(package, "name") != name
                || version.is_some_and(|v| v != text(package, "version"))
            {
                continue;
            }
            if package.contains_key("checksum") {
                reached.insert(format!(
                    "{name} {} {}",
                    text(package, "version"),
                    text(package, "checksum")
                ));
                let next =
                    package.get("dependencies").and_then(Value::as_array).into_iter().flatten();
                waiting.extend(next.filter_map(Value::as_str).map(str::to_owned));
            }
        }
    }
    reached
}
