use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::failure::permission_advice;
use crate::fsio::hash_json;
use crate::listing::{list_files, relative_path};

/// Name of the manifest inside an artifact.
pub const MANIFEST_FILE: &str = "artifact.json";

/// Version of the manifest's format.
const SCHEMA: u32 = 1;

/// `artifact.json`: list of an artifact's files. Origin and time are not part of it, so that two
/// actions may create the same object.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Kind of the artifact: `dataset`, `scene`, `field`, `views`, `metrics`, …
    pub kind: String,
    /// Version of the manifest's format.
    pub schema: u32,
    /// Files except the manifest, sorted by path.
    pub files: Vec<FileEntry>,
}

/// File of an artifact.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FileEntry {
    /// Path inside the artifact, separated by `/`.
    pub path: String,
    /// Size in bytes.
    pub size: u64,
    /// blake3 of the content, hexadecimal.
    pub blake3: String,
}

/// Difference between an artifact's files and its manifest.
#[derive(Debug, thiserror::Error)]
pub enum Damage {
    /// The file is missing.
    #[error(
        "{path}: not found; the artifact is damaged; remove it by `nerf-sr verify --remove`, \
        then run again"
    )]
    Missing {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file can't be read; the artifact may be undamaged.
    #[error("cannot read {path}: {source}{}", permission_advice(.path, .source))]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Error of the file operation.
        source: io::Error,
    },
    /// The size differs.
    #[error(
        "{path}: {found} bytes, but {expected} in the manifest; the artifact is damaged; \
        remove it by `nerf-sr verify --remove`, then run again"
    )]
    Size {
        /// Path of the file.
        path: PathBuf,
        /// Size in the manifest, in bytes.
        expected: u64,
        /// Size on disk, in bytes.
        found: u64,
    },
    /// The content differs.
    #[error(
        "{path}: the content has changed (blake3 differs); the artifact is damaged; \
        remove it by `nerf-sr verify --remove`, then run again"
    )]
    Content {
        /// Path of the file.
        path: PathBuf,
    },
    /// The manifest itself can't be used.
    #[error("{path}: not a manifest: {reason}")]
    Manifest {
        /// Path of the manifest.
        path: PathBuf,
        /// Reason, as a sentence fragment.
        reason: String,
    },
}

impl Damage {
    /// Converts the error of a file operation. A path through a file instead of a folder means that
    /// the folder's files are missing.
    fn of_file(path: PathBuf, source: io::Error) -> Self {
        match source.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => Self::Missing { path },
            _ => Self::Unreadable { path, source },
        }
    }
}

impl Manifest {
    /// Hashes all files below `folder`, except its manifest.
    pub fn of_folder(kind: &str, folder: &Path) -> io::Result<Self> {
        let mut named = Vec::new();
        for (relative, file) in list_files(folder)? {
            if relative != Path::new(MANIFEST_FILE) {
                named.push((manifest_path(&relative)?, file));
            }
        }
        let entries = named.into_par_iter().map(|(path, file)| {
            Ok(FileEntry { path, size: fs::metadata(&file)?.len(), blake3: hash_file(&file)? })
        });
        let mut files = entries.collect::<io::Result<Vec<_>>>()?;
        files.sort();
        Ok(Self { kind: kind.to_owned(), schema: SCHEMA, files })
    }

    /// Reads `folder/artifact.json`. Fails if a path leaves the folder.
    pub fn read(folder: &Path) -> Result<Self, Damage> {
        let path = folder.join(MANIFEST_FILE);
        let bytes = fs::read(&path).map_err(|source| Damage::of_file(path.clone(), source))?;
        Self::parse(&bytes).map_err(|reason| Damage::Manifest { path, reason })
    }

    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let manifest: Self = serde_json::from_slice(bytes).map_err(|e| e.to_string())?;
        if manifest.schema != SCHEMA {
            return Err(format!("schema {}, expected {SCHEMA}", manifest.schema));
        }
        for file in &manifest.files {
            relative_path(&file.path).map_err(|e| e.to_string())?;
        }
        if !manifest.files.is_sorted_by(|a, b| a.path < b.path) {
            return Err("files are not sorted by path".to_owned());
        }
        Ok(manifest)
    }

    /// Returns the artifact's identity: the blake3 of the manifest's canonical JSON.
    pub fn identity(&self) -> String {
        hash_json(self)
    }

    /// Returns the manifest of a folder inside the artifact, of kind `KIND/FOLDER`.
    pub fn subtree(&self, folder: &str) -> Self {
        let prefix = format!("{folder}/");
        let mut files = Vec::new();
        for file in &self.files {
            if let Some(path) = file.path.strip_prefix(&prefix) {
                files.push(FileEntry { path: path.to_owned(), ..file.clone() });
            }
        }
        Self { kind: format!("{}/{folder}", self.kind), schema: self.schema, files }
    }

    /// Returns the total size of all files in bytes.
    pub fn size(&self) -> u64 {
        self.files.iter().map(|f| f.size).sum()
    }

    /// Checks that all files exist with the right size, without reading them.
    pub fn check_sizes(&self, folder: &Path) -> Result<(), Damage> {
        for file in &self.files {
            let path = folder.join(&file.path);
            match fs::metadata(&path) {
                Ok(meta) if meta.len() == file.size => {}
                Ok(meta) => {
                    return Err(Damage::Size { path, expected: file.size, found: meta.len() });
                }
                Err(source) => return Err(Damage::of_file(path, source)),
            }
        }
        Ok(())
    }

    /// Checks the size and content of all files; returns the first difference.
    pub fn check_contents(&self, folder: &Path) -> Result<(), Damage> {
        self.check_sizes(folder)?;
        let checks: Vec<Result<(), Damage>> = self
            .files
            .par_iter()
            .map(|file| {
                let path = folder.join(&file.path);
                match hash_file(&path) {
                    Ok(hash) if hash == file.blake3 => Ok(()),
                    Ok(_) => Err(Damage::Content { path }),
                    Err(source) => Err(Damage::of_file(path, source)),
                }
            })
            .collect();
        checks.into_iter().collect()
    }
}

/// Converts a path inside an artifact to its form in the manifest: UTF-8, separated by `/`.
fn manifest_path(relative: &Path) -> io::Result<String> {
    let parts: Option<Vec<&str>> =
        relative.components().map(|part| part.as_os_str().to_str()).collect();
    parts
        .map(|parts| parts.join("/"))
        .ok_or_else(|| io::Error::other(format!("{relative:?}: the file name isn't UTF-8")))
}

/// Returns the blake3 hash of a file, in hexadecimal.
pub fn hash_file(path: &Path) -> io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(File::open(path)?)?;
    Ok(hasher.finalize().to_hex().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example() -> (tempfile::TempDir, Manifest) {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("train")).unwrap();
        fs::write(dir.path().join("train/a.txt"), "alpha").unwrap();
        fs::write(dir.path().join("b.txt"), "beta").unwrap();
        let manifest = Manifest::of_folder("scene", dir.path()).unwrap();
        (dir, manifest)
    }

    #[test]
    fn files_are_sorted_and_hashed() {
        let (_dir, manifest) = example();
        let paths: Vec<_> = manifest.files.iter().map(|f| f.path.as_str()).collect();
        assert_eq!(paths, ["b.txt", "train/a.txt"]);
        assert_eq!(manifest.files[0].blake3, blake3::hash(b"beta").to_hex().as_str());
    }

    #[test]
    fn a_subtree_depends_on_nothing_outside_it() {
        let (dir, before) = example();
        fs::write(dir.path().join("b.txt"), "changed").unwrap();
        let after = Manifest::of_folder("scene", dir.path()).unwrap();
        assert_ne!(before.identity(), after.identity());
        assert_eq!(before.subtree("train").identity(), after.subtree("train").identity());
        assert_eq!(after.subtree("train").files[0].path, "a.txt");
    }

    #[test]
    fn a_flipped_byte_is_found_and_named() {
        let (dir, manifest) = example();
        manifest.check_contents(dir.path()).unwrap();
        fs::write(dir.path().join("train/a.txt"), "alphb").unwrap();
        manifest.check_sizes(dir.path()).unwrap();
        let damage = manifest.check_contents(dir.path()).unwrap_err();
        assert!(
            matches!(&damage, Damage::Content { path } if path.ends_with("train/a.txt")),
            "{damage}"
        );
    }

    /// A missing file is damage; an unreadable one may be undamaged.
    #[test]
    fn missing_and_unreadable_files_differ() {
        let (dir, manifest) = example();
        let (folder, file) = (dir.path().join("train"), dir.path().join("train/a.txt"));
        let problem = || manifest.check_contents(dir.path()).unwrap_err();
        fs::remove_file(&file).unwrap();
        assert!(matches!(problem(), Damage::Missing { path } if path == file));
        std::os::unix::fs::symlink("a.txt", &file).unwrap();
        assert!(matches!(problem(), Damage::Unreadable { path, .. } if path == file));
        let message = problem().to_string();
        assert!(message.starts_with("cannot read ") && !message.contains("--remove"), "{message}");
        fs::remove_dir_all(&folder).unwrap();
        fs::write(&folder, "").unwrap();
        assert!(matches!(problem(), Damage::Missing { path } if path == file));
    }

    #[test]
    fn names_that_are_not_utf8_are_refused() {
        use std::os::unix::ffi::OsStrExt as _;
        let (dir, _) = example();
        let name = std::ffi::OsStr::from_bytes(b"r_\xff\x1b.png");
        fs::write(dir.path().join(name), "").unwrap();
        let message = Manifest::of_folder("scene", dir.path()).unwrap_err().to_string();
        assert!(
            message.contains(r"r_\xFF\u{1b}.png") && message.contains("isn't UTF-8"),
            "{message}"
        );
    }
}
