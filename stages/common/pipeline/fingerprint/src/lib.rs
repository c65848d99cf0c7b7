//! Build-time hash of a stage's code, which is part of an action's key.
//!
//! The stages' build script calls [`emit`]; a stage's `main.rs` reads `env!("STAGE_FINGERPRINT")`.
//! The hash covers the sources of the stage's crate and of the workspace crates that it depends on,
//! their part of `Cargo.lock`, compiler, target and profile. The binary's bytes and absolute paths
//! are excluded, so that moving or rebuilding a checkout doesn't rerun anything. So are comments,
//! line breaks and unit tests, which can't change a result.
//!
//! Cargo features are excluded, too. A feature (`torch`) only adds functions, without which a stage
//! fails and has no result, so results are equal with and without the feature. Optional
//! dependencies are always included.
//!
//! ```no_run
//! // build.rs
//! fingerprint::emit();
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::{env, fs};

use proc_macro2::{Delimiter, TokenStream, TokenTree};
use toml::{Table, Value};

/// Environment variables of a build script that change the machine code.
const BUILD_ENV: [&str; 5] = ["TARGET", "PROFILE", "OPT_LEVEL", "DEBUG", "CARGO_ENCODED_RUSTFLAGS"];

/// Sets `STAGE_FINGERPRINT` for the crate being built, and the library path of its program to the
/// program's folder, into which `make install` copies libtorch.
///
/// # Panics
/// If called outside a Cargo build script or if a manifest can't be read, since the build must not
/// continue with an incomplete key.
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
    let version =
        std::process::Command::new(rustc).arg("-vV").output().expect("rustc -vV succeeds");
    hash.part("rustc", &version.stdout);
    for name in BUILD_ENV {
        println!("cargo:rerun-if-env-changed={name}");
        hash.part(name, env::var(name).unwrap_or_default().as_bytes());
    }

    for dir in add_sources(&mut hash, &root, &crate_dir) {
        println!("cargo:rerun-if-changed={}", dir.display());
    }
    println!("cargo:rustc-link-arg-bins=-Wl,-rpath,$ORIGIN");
    println!("cargo:rustc-env=STAGE_FINGERPRINT={}", hash.0.finalize().to_hex());
}

/// Hashes the profiles, and the manifests, sources and locked packages of a crate and of the
/// workspace crates that it depends on. Returns the folders of these crates.
fn add_sources(hash: &mut Hash, root: &Path, crate_dir: &Path) -> Vec<PathBuf> {
    let workspace = read_toml(&root.join("Cargo.toml"));
    let profile = workspace.get("profile").map(ToString::to_string).unwrap_or_default();
    hash.part("profile", profile.as_bytes());
    let crates = workspace_crates(root, &workspace, crate_dir);
    for (name, krate) in &crates {
        hash.part("crate", name.as_bytes());
        let manifest = fs::read(krate.dir.join("Cargo.toml")).expect("a crate has a manifest");
        hash.part("Cargo.toml", &manifest);
        for entry in walkdir::WalkDir::new(krate.dir.join("src")).sort_by_file_name() {
            let entry = entry.expect("sources can be listed");
            if entry.file_type().is_file() && !is_unit_test(entry.path()) {
                let path = entry.path().strip_prefix(&krate.dir);
                let path = path.expect("a walk stays below its root").to_string_lossy();
                let bytes = fs::read(entry.path()).expect("sources can be read");
                hash.part(&path, &compiled_part(entry.path(), bytes));
            }
        }
    }
    for line in locked(&read_toml(&root.join("Cargo.lock")), &crates) {
        hash.part("locked", line.as_bytes());
    }
    crates.into_values().map(|krate| krate.dir).collect()
}

fn is_rust(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "rs")
}

/// True for a module of unit tests in a file of its own: `tests.rs` or `NAME_tests.rs`.
fn is_unit_test(path: &Path) -> bool {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    is_rust(path) && (stem == "tests" || stem.ends_with("_tests"))
}

/// Returns the part of a file that the compiler turns into a program: the tokens of Rust code
/// without comments and unit tests, or all bytes of another file.
fn compiled_part(path: &Path, bytes: Vec<u8>) -> Vec<u8> {
    if !is_rust(path) {
        return bytes;
    }
    match String::from_utf8_lossy(&bytes).parse() {
        Ok(tokens) => program_tokens(tokens).to_string().into_bytes(),
        // Rust code that isn't tokens doesn't compile, so its key is never used.
        Err(_) => bytes,
    }
}

/// Returns tokens without doc comments and items for tests.
fn program_tokens(tokens: TokenStream) -> TokenStream {
    let mut kept = Vec::new();
    let mut tokens = tokens.into_iter();
    while let Some(token) = tokens.next() {
        let TokenTree::Group(group) = token else {
            kept.push(token);
            continue;
        };
        let attribute = match group.delimiter() {
            Delimiter::Bracket if follows_hash(&kept) => group.stream().to_string(),
            _ => String::new(),
        };
        let is_test = attribute == "cfg (test)" || attribute == "cfg(test)";
        if is_test || attribute.starts_with("doc =") {
            // Removes `#` or `#!`.
            while kept.pop().is_some_and(|token| token.to_string() != "#") {}
        } else {
            let inner = program_tokens(group.stream());
            kept.push(proc_macro2::Group::new(group.delimiter(), inner).into());
        }
        if is_test {
            // An attribute's item ends here or later: what is left of it is hashed.
            tokens.find(|token| match token {
                TokenTree::Group(group) => group.delimiter() == Delimiter::Brace,
                TokenTree::Punct(mark) => ",;".contains(mark.as_char()),
                _ => false,
            });
        }
    }
    kept.into_iter().collect()
}

/// True if tokens end with `#` or `#!`, after which an attribute follows.
fn follows_hash(tokens: &[TokenTree]) -> bool {
    let mut marks = tokens.iter().rev().map(|token| match token {
        TokenTree::Punct(mark) => mark.as_char(),
        _ => ' ',
    });
    match marks.next() {
        Some('!') => marks.next() == Some('#'),
        mark => mark == Some('#'),
    }
}

#[derive(Default)]
struct Hash(blake3::Hasher);

impl Hash {
    /// Adds a part with its length, so that different lists of parts never have equal bytes.
    fn part(&mut self, name: &str, bytes: &[u8]) {
        for piece in [name.as_bytes(), bytes] {
            self.0.update(&(piece.len() as u64).to_le_bytes()).update(piece);
        }
    }
}

struct Crate {
    dir: PathBuf,
    /// Names under `[dependencies]` and `[build-dependencies]`, including those of single systems.
    /// Dependencies of tests can't change an artifact.
    dependencies: Vec<String>,
}

fn read_toml(path: &Path) -> Table {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    text.parse().unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Finds the crate at `start` and all workspace crates that it depends on, directly or not.
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
        for (name, spec) in dependencies_of(&manifest) {
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
        found.insert(name, Crate { dir, dependencies });
    }
    found
}

/// Returns the dependencies of a crate, without those of tests. Dependencies of other systems
/// (`[target.SYSTEM.dependencies]`) are included; at worst a key changes unnecessarily.
fn dependencies_of(manifest: &Table) -> Vec<(&String, &Value)> {
    let systems = manifest.get("target").and_then(Value::as_table).into_iter().flatten();
    let mut found = Vec::new();
    for table in systems.filter_map(|(_, system)| system.as_table()).chain([manifest]) {
        for section in ["dependencies", "build-dependencies"] {
            found.extend(table.get(section).and_then(Value::as_table).into_iter().flatten());
        }
    }
    found
}

/// Returns `name version checksum` of all packages outside the workspace that `crates` depend on,
/// directly or not.
fn locked(lock: &Table, crates: &BTreeMap<String, Crate>) -> BTreeSet<String> {
    let packages: Vec<&Table> = lock
        .get("package")
        .and_then(Value::as_array)
        .into_iter()
        .flatten()
        .filter_map(Value::as_table)
        .collect();
    let mut reached = BTreeSet::new();
    let mut waiting: Vec<String> = crates.values().flat_map(|c| c.dependencies.clone()).collect();
    let mut seen = BTreeSet::new();
    while let Some(dependency) = waiting.pop() {
        if !seen.insert(dependency.clone()) {
            continue;
        }
        // Cargo.lock writes "name", or "name version" if several versions are locked.
        let mut words = dependency.split(' ');
        let (name, version) = (words.next().unwrap_or_default(), words.next());
        for package in &packages {
            let found = text(package, "version");
            if text(package, "name") != name
                || version.is_some_and(|version| version != found)
                || !package.contains_key("checksum")
            {
                continue;
            }
            reached.insert(format!("{name} {found} {}", text(package, "checksum")));
            let next = package.get("dependencies").and_then(Value::as_array).into_iter().flatten();
            waiting.extend(next.filter_map(Value::as_str).map(str::to_owned));
        }
    }
    reached
}

fn text<'a>(package: &'a Table, key: &str) -> &'a str {
    package.get(key).and_then(Value::as_str).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Workspace of four crates. `stage` depends on `shared`, on `extra` with a feature, and on the
    /// package `linux` on one system; `shared` depends on the package `used`. `other` is unused.
    const FILES: [(&str, &str); 13] = [
        (
            "Cargo.toml",
            "[workspace.dependencies]\nshared = {path = \"shared\"}\nextra = {path = \"extra\"}\n\
             used = \"1\"\n\
             [profile.release]\nlto = true\n",
        ),
        (
            "Cargo.lock",
            "[[package]]\nname = \"stage\"\nversion = \"1.0.0\"\ndependencies = [\"shared\"]\n\
             [[package]]\nname = \"used\"\nversion = \"1.0.0\"\nchecksum = \"aa\"\n\
             dependencies = [\"deep\"]\n\
             [[package]]\nname = \"deep\"\nversion = \"1.0.0\"\nchecksum = \"bb\"\n\
             [[package]]\nname = \"linux\"\nversion = \"1.0.0\"\nchecksum = \"dd\"\n\
             [[package]]\nname = \"stray\"\nversion = \"1.0.0\"\nchecksum = \"cc\"\n",
        ),
        (
            "stage/Cargo.toml",
            "[package]\nname = \"stage\"\n[features]\nmore = [\"dep:extra\"]\n\
             [dependencies]\nshared = {workspace = true}\n\
             extra = {workspace = true, optional = true}\n[dev-dependencies]\nstray = \"1\"\n\
             [target.'cfg(target_os = \"linux\")'.dependencies]\nlinux = \"1\"\n",
        ),
        ("stage/src/main.rs", "#![warn(missing_docs)]\n//! A stage.\nfn main() { work(1); }"),
        ("stage/src/unit_tests.rs", "const TESTED: u8 = 1;"),
        ("stage/src/unit_tests.txt", "1"),
        ("stage/tests/it.rs", "const TESTED: u8 = 1;"),
        (
            "shared/Cargo.toml",
            "[package]\nname = \"shared\"\n[dependencies]\nused = {workspace = true}\n",
        ),
        (
            "shared/src/lib.rs",
            "/// Numbers.\n#[derive(Debug)]\nstruct Pair {\n    /// One.\n    one: u8, // first\n\
             #[cfg(test)] tested: u8,\n    two: u8,\n}\n\
             #[cfg(test)]\n#[path = \"unit_tests.rs\"]\nmod unit_tests;\n\
             #[cfg(test)]\nmod tests { const EXPECTED: u8 = 1; }\nconst LAST: &str = \"// 1\";\n",
        ),
        ("extra/Cargo.toml", "[package]\nname = \"extra\"\n"),
        ("extra/src/lib.rs", "const EXTRA: u8 = 1;"),
        ("other/Cargo.toml", "[package]\nname = \"other\"\n"),
        ("other/src/lib.rs", "const OTHER: u8 = 1;"),
    ];

    /// Returns the fingerprint of `stage` after `edit`: a file, a text in it and the replacement.
    fn fingerprint(edit: Option<(&str, &str, &str)>) -> String {
        let root = tempfile::tempdir().unwrap();
        for (file, text) in FILES {
            let path = root.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            let text = match edit {
                Some((edited, from, to)) if edited == file => {
                    assert!(text.contains(from), "{file}: {from}");
                    text.replace(from, to)
                }
                _ => text.to_owned(),
            };
            fs::write(path, text).unwrap();
        }
        let mut hash = Hash::default();
        let folders = add_sources(&mut hash, root.path(), &root.path().join("stage"));
        assert_eq!(folders, ["extra", "shared", "stage"].map(|name| root.path().join(name)));
        hash.0.finalize().to_hex().to_string()
    }

    /// The fingerprint covers direct and indirect dependencies, but not unused crates, comments or
    /// tests.
    #[test]
    fn only_edits_of_used_sources_change_the_fingerprint() {
        let unedited = fingerprint(None);
        for edit in [
            ("stage/src/main.rs", "1", "2"),
            ("stage/src/main.rs", "warn", "deny"),
            ("stage/src/unit_tests.txt", "1", "2"),
            ("shared/src/lib.rs", "Debug", "Clone"),
            ("shared/src/lib.rs", "one: u8", "one: u16"),
            ("shared/src/lib.rs", "two: u8", "two: u16"),
            ("shared/src/lib.rs", "// 1", "// 2"),
            ("extra/src/lib.rs", "1", "2"),
            ("shared/Cargo.toml", "workspace = true", "workspace = true, features = []"),
            ("Cargo.lock", "checksum = \"aa\"", "checksum = \"ab\""),
            ("Cargo.lock", "checksum = \"bb\"", "checksum = \"bc\""),
            ("Cargo.lock", "checksum = \"dd\"", "checksum = \"de\""),
            ("Cargo.toml", "lto = true", "lto = false"),
        ] {
            assert_ne!(fingerprint(Some(edit)), unedited, "{edit:?}");
        }
        for edit in [
            ("other/src/lib.rs", "1", "2"),
            ("other/Cargo.toml", "other", "another"),
            ("stage/tests/it.rs", "1", "2"),
            ("stage/src/unit_tests.rs", "1", "2"),
            ("stage/src/main.rs", "A stage", "The stage"),
            ("stage/src/main.rs", "{ work(1); }", "{\n    work(1); // works\n}"),
            ("shared/src/lib.rs", "Numbers", "Two numbers"),
            ("shared/src/lib.rs", "One.", "The first."),
            ("shared/src/lib.rs", "first", "the first"),
            ("shared/src/lib.rs", "tested: u8", "tested: u16"),
            ("shared/src/lib.rs", "EXPECTED: u8 = 1", "EXPECTED: u8 = 2"),
            ("Cargo.lock", "checksum = \"cc\"", "checksum = \"cd\""),
        ] {
            assert_eq!(fingerprint(Some(edit)), unedited, "{edit:?}");
        }
    }

    /// Returns whether each declaration of a module file in a source's text is under
    /// `#[cfg(test)]`.
    fn declarations(text: &str, file: &Path) -> Vec<bool> {
        let [name, stem] =
            [file.file_name(), file.file_stem()].map(|n| n.unwrap().to_str().unwrap());
        let (module, path) = (format!("mod {stem};"), format!("#[path = \"{name}\"]"));
        let lines: Vec<&str> = text.lines().map(str::trim).collect();
        let mut found = Vec::new();
        for (i, line) in lines.iter().enumerate().filter(|(_, line)| line.ends_with(';')) {
            let above = lines[..i].iter().rev().take_while(|line| line.starts_with("#["));
            let attributes: Vec<&str> = above.copied().collect();
            let has_path = attributes.iter().any(|attribute| attribute.starts_with("#[path"));
            let is_named = line.ends_with(&module) && !has_path;
            if is_named || attributes.contains(&path.as_str()) {
                found.push(attributes.contains(&"#[cfg(test)]"));
            }
        }
        found
    }

    /// No file that fingerprints exclude is compiled into a program.
    #[test]
    fn files_of_unit_tests_are_modules_for_tests_only() {
        let stages = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(3).unwrap();
        let sources =
            walkdir::WalkDir::new(stages).into_iter().map(|entry| entry.unwrap().into_path());
        let is_source = |path: &PathBuf| path.iter().any(|part| part == "src");
        let sources: Vec<PathBuf> =
            sources.filter(|path| is_source(path) && is_rust(path)).collect();
        let tests: Vec<&PathBuf> = sources.iter().filter(|path| is_unit_test(path)).collect();
        assert!(tests.len() > 10, "{tests:?}");
        for file in tests {
            let folder = file.parent().unwrap();
            let module = folder.with_extension("rs");
            let mut found = Vec::new();
            for path in &sources {
                if path.parent() == Some(folder) || *path == module {
                    found.extend(declarations(&fs::read_to_string(path).unwrap(), file));
                }
            }
            assert!(!found.is_empty() && !found.contains(&false), "{}: {found:?}", file.display());
        }
        for (text, expected) in [
            ("#[cfg(test)]\npub mod unit_tests;\nmod tests;", [true]),
            ("#[cfg(test)]\n#[path = \"unit_tests.rs\"]\nmod tests;", [true]),
            ("#[cfg(test)]\nmod tests;\nmod unit_tests;", [false]),
            ("#[path = \"unit_tests.rs\"]\nmod more;", [false]),
        ] {
            assert_eq!(declarations(text, Path::new("unit_tests.rs")), expected, "{text}");
        }
    }

    fn hash_of(parts: &[(&str, &str)]) -> blake3::Hash {
        let mut hash = Hash::default();
        parts.iter().for_each(|(name, bytes)| hash.part(name, bytes.as_bytes()));
        hash.0.finalize()
    }

    #[test]
    fn boundaries_between_parts_are_hashed() {
        assert_ne!(hash_of(&[("a", "bc")]), hash_of(&[("ab", "c")]));
        assert_ne!(hash_of(&[("a", "b"), ("c", "")]), hash_of(&[("a", ""), ("b", "c")]));
    }
}
