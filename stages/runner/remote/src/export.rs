//! Export of an artifact with its history as an archive, which `import` reads.
//!
//! An archive is a tar of `export.json`, `objects/HASH/…` and `actions/KEY.json`, in this order. It
//! contains exactly the objects and records listed in `export.json`, sorted: each object's manifest
//! with its files in the manifest's order, then the records. Equal histories have equal bytes.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{
    Failure, MANIFEST_FILE, Manifest, bail_bad_input, file_kind, format_count, format_size,
    json_text, print_line, report_line, sync_folder, temporary,
};
use serde::{Deserialize, Serialize};
use store::{Record, Store};
use tempfile::NamedTempFile;

use crate::folder::{Affixes, remove_leftovers};
use crate::intake::{protect, unprotect};
use crate::selection::{find_unique, keys_of_artifact, records_by_key, with_history};
use crate::transfer::{ContentCheck, Progress, STORE_REMEDY};

/// Name of the first entry.
pub(crate) const INDEX_FILE: &str = "export.json";
/// Version of the archive's format.
pub(crate) const EXPORT_FORMAT: u32 = 1;

/// `export.json`: list of an archive's objects and records.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Index {
    /// Version of the archive's format.
    pub(crate) export: u32,
    /// Format of the store that manifests and records come from.
    pub(crate) store: u32,
    /// Identity of the exported artifact.
    pub(crate) artifact: String,
    /// Identities of the archive's objects, sorted.
    pub(crate) objects: Vec<String>,
    /// Keys of the archive's records, sorted.
    pub(crate) actions: Vec<String>,
}

/// Returns the path of an object's file in the archive.
pub(crate) fn object_entry(identity: &str, file: &str) -> String {
    format!("objects/{identity}/{file}")
}

/// Returns the path of a record in the archive.
pub(crate) fn action_entry(key: &str) -> String {
    format!("actions/{key}.json")
}

/// Writes one artifact with its history as one file.
pub(crate) fn export(
    store: &Store,
    start: &str,
    destination: Destination<'_>,
    records_only: bool,
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<()> {
    destination.check()?;
    let history = History::find(store, start, records_only)?;
    let run = protect(store, history.records.values(), stop)?;
    let written = history.write(store, destination, stop);
    let ended = unprotect(store, run);
    written?;
    Ok(ended?)
}

/// Artifact with the records of its history and their stored objects.
struct History {
    artifact: String,
    records: BTreeMap<String, Record>,
    objects: BTreeSet<String>,
}

impl History {
    /// Finds the history of the artifact or action whose hash or key begins with `start`.
    fn find(store: &Store, start: &str, records_only: bool) -> anyhow::Result<Self> {
        let mut records = records_by_key(store)?;
        let location = store.root().display().to_string();
        let names = records.keys().chain(records.values().map(|record| &record.output));
        let name = find_unique(start, names, "artifact or action", &location)?;
        let (artifact, keys) = match records.get(&name) {
            Some(record) => (record.output.clone(), BTreeSet::from([name])),
            None => (name.clone(), keys_of_artifact(&records, &name)),
        };
        if !store.is_complete(&artifact)? {
            let object = store.object(&artifact);
            let problem = "the artifact is incomplete; run again, or pull it";
            bail_bad_input!("{}: {problem}", object.display());
        }
        let history = with_history(&records, keys);
        records.retain(|key, _| history.contains(key));
        let mut objects = BTreeSet::from([artifact.clone()]);
        let mut incomplete = BTreeSet::new();
        for record in records.values().filter(|_| !records_only) {
            let is_complete = store.is_complete(&record.output)?;
            let group = if is_complete { &mut objects } else { &mut incomplete };
            group.insert(record.output.clone());
        }
        if !incomplete.is_empty() {
            report_line!(
                "this store lacks all or part of {} of the history; only the record of each is \
                written",
                format_count(incomplete.len(), "artifact")
            );
        }
        Ok(Self { artifact, records, objects })
    }

    fn write(
        &self,
        store: &Store,
        destination: Destination<'_>,
        stop: &Arc<AtomicBool>,
    ) -> anyhow::Result<()> {
        let mut manifests = Vec::new();
        for identity in &self.objects {
            manifests.push((identity, store.manifest(identity)?));
        }
        let total = manifests.iter().map(|(_, manifest)| manifest.size()).sum();
        let file = destination.file;
        let temporary = destination.begin()?;
        let mut writer = Writer {
            tar: tar::Builder::new(BufWriter::with_capacity(1 << 20, temporary)),
            name: file.display().to_string(),
            progress: Progress::new("export", total, stop),
        };
        let index = Index {
            export: EXPORT_FORMAT,
            store: store::FORMAT,
            artifact: self.artifact.clone(),
            objects: self.objects.iter().cloned().collect(),
            actions: self.records.keys().cloned().collect(),
        };
        writer.write_json(INDEX_FILE, &index)?;
        for (identity, manifest) in manifests {
            writer.write_object(&store.object(identity), identity, &manifest)?;
        }
        for (key, record) in &self.records {
            writer.write_json(&action_entry(key), record)?;
        }
        let temporary = writer
            .tar
            .into_inner()
            .and_then(|buffer| buffer.into_inner().map_err(io::IntoInnerError::into_error));
        destination.finish(temporary.with_context(|| file.display().to_string())?)?;
        drop(writer.progress);
        print_line!(
            "{}: {} with {} and {}, {}",
            file.display(),
            &self.artifact[..10],
            format_count(self.records.len(), "record"),
            format_count(self.objects.len(), "artifact"),
            format_size(total)
        );
        Ok(())
    }
}

/// Writer of an archive.
struct Writer {
    tar: tar::Builder<BufWriter<NamedTempFile>>,
    /// Name of the archive in messages.
    name: String,
    progress: Progress,
}

impl Writer {
    fn write_json(&mut self, path: &str, value: &impl Serialize) -> anyhow::Result<()> {
        let text = json_text(value)?;
        append(&mut self.tar, path, text.len() as u64, text.as_bytes())
            .with_context(|| self.name.clone())
    }

    fn write_object(
        &mut self,
        folder: &Path,
        identity: &str,
        manifest: &Manifest,
    ) -> anyhow::Result<()> {
        self.write_json(&object_entry(identity, MANIFEST_FILE), manifest)?;
        for entry in &manifest.files {
            let path = folder.join(&entry.path);
            let name = path.display().to_string();
            let mut reader = CheckedReader {
                file: File::open(&path).with_context(|| name.clone())?,
                check: ContentCheck::new(entry, STORE_REMEDY),
                progress: &self.progress,
                name: &name,
                problem: None,
            };
            let archived = object_entry(identity, &entry.path);
            let written = append(&mut self.tar, &archived, entry.size, &mut reader);
            if let Some(problem) = reader.problem.take() {
                return Err(problem);
            }
            reader.check.finish(&name)?;
            written.with_context(|| self.name.clone())?;
        }
        Ok(())
    }
}

/// Appends an entry without owner and time, so that archives of different machines are equal.
fn append(
    tar: &mut tar::Builder<impl Write>,
    path: &str,
    size: u64,
    content: impl Read,
) -> io::Result<()> {
    let mut header = tar::Header::new_gnu();
    header.set_size(size);
    header.set_mode(0o644);
    header.set_mtime(0);
    header.set_uid(0);
    header.set_gid(0);
    header.set_entry_type(tar::EntryType::Regular);
    tar.append_data(&mut header, path, content)
}

/// Reader of an object's file that compares the content with the manifest.
struct CheckedReader<'a> {
    file: File,
    check: ContentCheck<'a>,
    progress: &'a Progress,
    name: &'a str,
    /// Difference from the manifest, or interruption; an `io::Error` would hide which of the two.
    problem: Option<anyhow::Error>,
}

impl Read for CheckedReader<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read(buffer)?;
        if let Err(problem) = self.check.add(&buffer[..count], self.progress, &self.name) {
            self.problem = Some(problem.into());
            return Err(io::Error::other("stopped"));
        }
        Ok(count)
    }
}

/// Prefix and suffix of an unfinished archive's name.
const TEMPORARY_AFFIXES: Affixes = (".nerf-sr-export-", ".partial");

/// Path of an archive to be written.
#[derive(Clone, Copy)]
pub(crate) struct Destination<'a> {
    pub(crate) file: &'a Path,
    /// True if an existing regular file is replaced.
    pub(crate) force: bool,
}

impl Destination<'_> {
    fn name(&self) -> String {
        self.file.display().to_string()
    }

    fn folder(&self) -> &Path {
        self.file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }

    /// Fails if the path exists and may not be replaced. Only regular files may be replaced, since
    /// replacing a device or a link may have effects outside the folder.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let name = self.name();
        let problem = match self.file.symlink_metadata() {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(error).context(name),
            Ok(found) if !found.is_file() => format!(
                "{name} is {}; an archive replaces regular files only, choose another name",
                file_kind(found.file_type())
            ),
            Ok(_) if self.force => return Ok(()),
            Ok(_) => format!(
                "{name}: the file exists; choose another name, or replace the file with --force"
            ),
        };
        Err(Failure::Usage(problem).into())
    }

    /// Creates the temporary file that becomes the archive.
    pub(crate) fn begin(&self) -> anyhow::Result<NamedTempFile> {
        let folder = self.folder();
        remove_leftovers(folder, TEMPORARY_AFFIXES);
        let file = temporary(0o666)
            .prefix(TEMPORARY_AFFIXES.0)
            .suffix(TEMPORARY_AFFIXES.1)
            .tempfile_in(folder);
        file.with_context(|| folder.display().to_string())
    }

    /// Renames the finished archive to its destination. Without `force`, a file created there
    /// meanwhile is kept.
    pub(crate) fn finish(&self, archive: NamedTempFile) -> anyhow::Result<()> {
        archive.as_file().sync_all().with_context(|| self.name())?;
        self.check()?;
        let renamed = if self.force {
            archive.persist(self.file)
        } else {
            archive.persist_noclobber(self.file)
        };
        if let Err(problem) = renamed {
            if problem.error.kind() == io::ErrorKind::AlreadyExists {
                // The error with the remedy.
                self.check()?;
            }
            return Err(problem.error).with_context(|| self.name());
        }
        sync_folder(self.folder()).with_context(|| self.name())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// A file that is created while the archive is written is replaced only with `force`.
    #[test]
    fn a_file_created_meanwhile_is_kept_without_force() {
        for force in [false, true] {
            let dir = tempfile::tempdir().unwrap();
            let file = dir.path().join("export.tar");
            let destination = Destination { file: &file, force };
            destination.check().unwrap();
            let mut archive = destination.begin().unwrap();
            archive.write_all(b"archive").unwrap();
            fs::write(&file, "precious").unwrap();
            let finished = destination.finish(archive);
            assert_eq!(finished.is_ok(), force);
            let expected = if force { "archive" } else { "precious" };
            assert_eq!(fs::read_to_string(&file).unwrap(), expected);
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        }
    }
}
