use std::fs::{self, File};
use std::io;
use std::path::{Component, Path, PathBuf};

use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::advice::advice;
use crate::canonical::hash_json;
use crate::passed_over::is_passed_over;
use crate::printable::shortened;

/// The manifest's name inside an artifact.
pub const MANIFEST_FILE: &str = "artifact.json";

/// Version of the manifest's own form.
const SCHEMA: u32 = 1;

/// `artifact.json`: what an artifact is made of. Who made it, when and from what is not here: two
/// actions may end in one object.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Kind of artifact: `dataset`, `scene`, `field`, `views`, `metrics`, …
    pub kind: String,
    /// Version of the manifest's form.
    pub schema: u32,
    /// Every file but the manifest, sorted by path.
    pub files: Vec<FileEntry>,
}

/// A file of an artifact.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FileEntry {
    /// Path inside the artifact, `/` between the parts.
    pub path: String,
    /// Size in bytes.
    pub size: u64,
    /// blake3 of the content, hexadecimal.
    pub blake3: String,
}

/// A file that isn't what the manifest says.
#[derive(Debug, thiserror::Error)]
pub enum Damage {
    /// The file is missing.
    #[error(
        "{path}: not found; the artifact is damaged: `nerf-sr verify --remove`, then run again"
    )]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// The file can't be read; the artifact may be whole.
    #[error("cannot read {path}: {source}{}", advice(.path, .source))]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The size differs.
    #[error(
        "{path}: {found} bytes where the manifest says {expected}; the artifact is damaged: \
        `nerf-sr verify --remove`, then run again"
    )]
    Size {
        /// The file.
        path: PathBuf,
        /// Size by the manifest.
        expected: u64,
        /// Size on disk.
        found: u64,
    },
    /// The content differs.
    #[error(
        "{path}: the content is not what was written (blake3 differs); the artifact is damaged: \
        `nerf-sr verify --remove`, then run again"
    )]
    Content {
        /// The file.
        path: PathBuf,
    },
    /// The manifest itself can't be used.
    #[error("{path}: not a manifest: {reason}")]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

impl Damage {
    /// Returns the damage behind a failed file operation. A file in a folder's place leaves no doubt
    /// that the files of the folder are missing.
    fn of_file(path: PathBuf, source: io::Error) -> Self {
        match source.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => Self::Missing { path },
            _ => Self::Unreadable { path, source },
        }
    }
}

impl Manifest {
    /// Hashes every file below `folder` (but its manifest).
    pub fn of_folder(kind: &str, folder: &Path) -> io::Result<Self> {
        let files = list_files(folder)?
            .into_iter()
            .filter(|(relative, _)| relative != Path::new(MANIFEST_FILE));
        let named = files
            .map(|(relative, file)| Ok((manifest_path(&relative)?, file)))
            .collect::<io::Result<_>>()?;
        let files = hash_files(named)?;
        Ok(Self { kind: kind.to_owned(), schema: SCHEMA, files })
    }

    /// Reads `folder/artifact.json`, refusing paths that would leave the folder.
    pub fn read(folder: &Path) -> Result<Self, Damage> {
        let path = folder.join(MANIFEST_FILE);
        let bytes = fs::read(&path).map_err(|source| Damage::of_file(path.clone(), source))?;
        let invalid = |reason: String| Damage::Manifest { path: path.clone(), reason };
        let manifest: Self = serde_json::from_slice(&bytes).map_err(|e| invalid(e.to_string()))?;
        if manifest.schema != SCHEMA {
            return Err(invalid(format!("schema {} where {SCHEMA} is known", manifest.schema)));
        }
        for file in &manifest.files {
            relative_path(&file.path).map_err(|e| invalid(e.to_string()))?;
        }
        if !manifest.files.is_sorted_by(|a, b| a.path < b.path) {
            return Err(invalid("files are not sorted by path".to_owned()));
        }
        Ok(manifest)
    }

    /// The artifact's identity: blake3 of the manifest's canonical JSON.
    pub fn identity(&self) -> String {
        hash_json(self)
    }

    /// The manifest of a folder inside the artifact, its kind `KIND/FOLDER`.
    pub fn subtree(&self, folder: &str) -> Self {
        let prefix = format!("{folder}/");
        let files = self.files.iter().filter_map(|file| {
            let path = file.path.strip_prefix(&prefix)?.to_owned();
            Some(FileEntry { path, ..file.clone() })
        });
        Self {
            kind: format!("{}/{folder}", self.kind),
            schema: self.schema,
            files: files.collect(),
        }
    }

    /// Bytes of all files.
    pub fn size(&self) -> u64 {
        self.files.iter().map(|f| f.size).sum()
    }

    /// Checks that every file is there with its size. Cheap: no content is read.
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

    /// Checks every file's size and content; names the first that differs.
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

/// Every file below a folder with its path inside it, in the order of names. Symbolic links are
/// followed; one that leads back up is an error that names it, and so is a FIFO, socket or device:
/// who reads one may wait for ever.
pub fn list_files(folder: &Path) -> io::Result<ListedFiles> {
    list(folder, |_| false)
}

/// Files of a folder: each path inside the folder, and the file.
pub type ListedFiles = Vec<(PathBuf, PathBuf)>;

/// Lists files like [`list_files`], in a folder that a user keeps: what [`is_passed_over`] is left
/// out, and returned second, by its path inside the folder.
pub fn list_source_files(folder: &Path) -> io::Result<(ListedFiles, Vec<PathBuf>)> {
    let mut passed_over = Vec::new();
    let files = list(folder, |path| {
        let is_left_out = is_passed_over(path);
        if is_left_out {
            passed_over.push(path.strip_prefix(folder).unwrap_or(path).to_path_buf());
        }
        is_left_out
    })?;
    Ok((files, passed_over))
}

/// Lists the files below a folder, but those that are left out.
fn list(folder: &Path, mut is_left_out: impl FnMut(&Path) -> bool) -> io::Result<ListedFiles> {
    let mut found = Vec::new();
    for entry in walkdir::WalkDir::new(folder).follow_links(true).sort_by_file_name() {
        let path = match &entry {
            Ok(entry) if entry.file_type().is_dir() => None,
            Ok(entry) => Some(entry.path()),
            Err(error) => error.path(),
        };
        if path.is_some_and(&mut is_left_out) {
            continue;
        }
        let entry = entry.map_err(|error| match (error.path(), error.loop_ancestor()) {
            (Some(link), Some(up)) => io::Error::other(format!(
                "{link:?} is a link that leads back to {up:?}; remove the link"
            )),
            _ => io::Error::from(error),
        })?;
        if entry.file_type().is_file() {
            let relative =
                entry.path().strip_prefix(folder).map_err(io::Error::other)?.to_path_buf();
            found.push((relative, entry.into_path()));
        } else if !entry.file_type().is_dir() {
            let path = entry.path();
            return Err(io::Error::other(format!(
                "{path:?} is a FIFO, socket or device, which nobody can hash; remove it"
            )));
        }
    }
    Ok(found)
}

/// Path, size and blake3 of files, sorted by path.
fn hash_files(files: Vec<(String, PathBuf)>) -> io::Result<Vec<FileEntry>> {
    let mut entries: Vec<FileEntry> =
        files.into_par_iter().map(|(path, file)| entry(path, &file)).collect::<io::Result<_>>()?;
    entries.sort();
    Ok(entries)
}

fn entry(path: String, file: &Path) -> io::Result<FileEntry> {
    Ok(FileEntry { path, size: fs::metadata(file)?.len(), blake3: hash_file(file)? })
}

/// A path inside an artifact as its manifest has it: parts with `/` between them, all UTF-8.
fn manifest_path(relative: &Path) -> io::Result<String> {
    let parts: Option<Vec<&str>> =
        relative.components().map(|part| part.as_os_str().to_str()).collect();
    parts
        .map(|parts| parts.join("/"))
        .ok_or_else(|| io::Error::other(format!("{relative:?}: a file name that isn't UTF-8")))
}

fn hash_file(path: &Path) -> io::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(File::open(path)?)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// A path that leaves its folder, or names nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{:?} is not a path inside the folder", shortened(.0))]
pub struct PathError(String);

/// A path from a file that may be hostile: relative, `/`-separated, never upwards.
pub fn relative_path(text: &str) -> Result<PathBuf, PathError> {
    let path = Path::new(text);
    let plain =
        path.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    if text.is_empty() || !plain || text.contains('\0') {
        // A hostile path may be as long as its file.
        return Err(PathError(text.chars().take(200).collect()));
    }
    Ok(path.components().filter(|part| matches!(part, Component::Normal(_))).collect())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

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
    fn a_flipped_byte_is_noticed_and_named() {
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

    /// A missing file is damage; a file that can't be read may be whole.
    #[test]
    fn missing_and_unreadable_files_differ() {
        let (dir, manifest) = example();
        let (folder, file) = (dir.path().join("train"), dir.path().join("train/a.txt"));
        let problem = || manifest.check_contents(dir.path()).unwrap_err();
        fs::remove_file(&file).unwrap();
        assert!(matches!(problem(), Damage::Missing { path } if path == file));
        std::os::unix::fs::symlink("a.txt", &file).unwrap();
        assert!(matches!(problem(), Damage::Unreadable { path, .. } if path == file));
        let said = problem().to_string();
        assert!(said.starts_with("cannot read ") && !said.contains("--remove"), "{said}");
        fs::remove_dir_all(&folder).unwrap();
        fs::write(&folder, "").unwrap();
        assert!(matches!(problem(), Damage::Missing { path } if path == file));
    }

    #[test]
    fn names_that_no_manifest_can_have_are_refused() {
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

    #[test]
    fn a_link_that_leads_back_is_named() {
        let (dir, _) = example();
        std::os::unix::fs::symlink(dir.path(), dir.path().join("train/loop")).unwrap();
        let message = list_files(dir.path()).unwrap_err().to_string();
        assert!(message.contains("train/loop") && message.contains("leads back"), "{message}");
    }

    /// Links to nothing and editors' files are passed over in a user's folder; in an artifact
    /// nothing is.
    #[test]
    fn a_user_s_folder_has_files_that_are_passed_over() {
        use std::os::unix::fs::symlink;
        let (dir, _) = example();
        let at = |name: &str| dir.path().join(name);
        let passed_over = [".#b.txt", ".DS_Store", ".b.txt.swp", ".~lock.b.txt#", "._b.txt"];
        for name in passed_over {
            fs::write(at(name), "").unwrap();
        }
        symlink("nowhere", at("train/gone")).unwrap();
        symlink("b.txt", at("c.txt")).unwrap();
        let names = |files: Vec<(PathBuf, PathBuf)>| {
            files.into_iter().map(|(relative, _)| relative.display().to_string()).collect()
        };
        let (files, left_out) = list_source_files(dir.path()).unwrap();
        let files: Vec<String> = names(files);
        assert_eq!(files, ["b.txt", "c.txt", "train/a.txt"]);
        let left_out: BTreeSet<String> = left_out.iter().map(|p| p.display().to_string()).collect();
        let expected = passed_over.iter().chain(&["train/gone"]).map(|name| (*name).to_owned());
        assert_eq!(left_out, expected.collect());
        assert!(list_files(dir.path()).unwrap_err().to_string().contains("train/gone"));
        fs::remove_file(at("train/gone")).unwrap();
        assert_eq!(list_files(dir.path()).unwrap().len(), files.len() + passed_over.len());
        // A link that leads round, or into what may not be read, isn't one to nothing.
        symlink("round", at("round")).unwrap();
        assert!(list_source_files(dir.path()).unwrap_err().to_string().contains("round"));
    }

    #[test]
    fn what_is_neither_file_nor_folder_is_named() {
        let (dir, _) = example();
        let _socket = std::os::unix::net::UnixListener::bind(dir.path().join("train/s")).unwrap();
        let message = list_files(dir.path()).unwrap_err().to_string();
        assert!(message.contains("train/s") && message.contains("remove it"), "{message}");
    }

    #[test]
    fn a_manifest_can_not_point_outside() {
        for path in ["../x", "/etc/passwd", "a/../../x", "", "a\0b"] {
            assert!(relative_path(path).is_err(), "{path:?}");
        }
        assert_eq!(relative_path("./train/r_0").unwrap(), Path::new("train/r_0"));
    }
}
