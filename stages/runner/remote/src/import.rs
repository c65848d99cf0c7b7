use std::fmt::Display;
use std::fs::File;
use std::io::{BufReader, Read, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{
    Failure, FailureExt as _, FileEntry, MANIFEST_FILE, bail_bad_input, file_kind, format_count,
    format_size,
};
use serde_json::Value;
use store::{Arrival, Record, Store, is_hash};

use crate::export::{EXPORT_FORMAT, INDEX_FILE, Index, action_entry, object_entry};
use crate::intake::{Intake, MAX_MANIFEST_BYTES, MAX_RECORD_BYTES, create_file, parse_record};
use crate::transfer::{ContentCheck, Progress};

/// Maximum length of a path in an archive, in bytes; twice that of Linux.
const MAX_PATH_BYTES: u64 = 8 << 10;
/// Number of bytes that are read and hashed at a time.
const BUFFER_BYTES: usize = 1 << 18;
const REMEDY: &str = "nothing was imported; export the artifact again from a complete store";

/// Imports an archive written by `export`, after verifying all of it. Returns a summary.
pub fn import(store: &Store, file: &Path, stop: &Arc<AtomicBool>) -> anyhow::Result<String> {
    let name = file.display().to_string();
    let (file, bytes) = open(file)?;
    let mut archive = tar::Archive::new(BufReader::with_capacity(1 << 20, file));
    let entries = archive.entries().with_context(|| name.clone())?.raw(true);
    let intake = Intake::begin(store, stop)?;
    let mut reader =
        Reader { entries, intake: &intake, name, progress: Progress::new("import", bytes, stop) };
    let index = reader.read_index()?;
    let mut arrivals = Vec::new();
    for identity in &index.objects {
        arrivals.push((identity, reader.read_object(identity)?));
    }
    let mut records = Vec::new();
    for key in &index.actions {
        let entry = action_entry(key);
        let bytes = reader.read_small(&entry, MAX_RECORD_BYTES)?;
        records.push(parse_record(&bytes, key, &reader.entry_name(&entry))?);
    }
    reader.check_end(&index, &records)?;
    drop(reader);
    let new = import_all(&intake, &arrivals, records)?;
    intake.end()?;
    let records = format_count(index.actions.len(), "record");
    let objects = format_count(index.objects.len(), "artifact");
    let new = format_count(new, "new record");
    Ok(format!("{records} and {objects} read ({}), {new}", format_size(bytes)))
}

/// Opens an archive and returns its size in bytes. Only regular files are accepted, since a named
/// pipe may block and a device may be endless.
fn open(path: &Path) -> Result<(File, u64), Failure> {
    let name = path.display().to_string();
    let found = path.metadata().bad_input(&name)?;
    if !found.is_file() {
        let kind = file_kind(found.file_type());
        bail_bad_input!("{name} is {kind}, not a regular file; save the archive as a file");
    }
    Ok((File::open(path).bad_input(&name)?, found.len()))
}

/// Imports the objects, each followed by its records, then the other records. Returns the number of
/// new records.
fn import_all(
    intake: &Intake,
    arrivals: &[(&String, Option<Arrival>)],
    mut records: Vec<Record>,
) -> anyhow::Result<usize> {
    let mut new = 0;
    for (identity, arrival) in arrivals {
        let own: Vec<_> = records.extract_if(.., |record| record.output == **identity).collect();
        new += intake.import(arrival.as_ref(), &own)?;
    }
    Ok(new + intake.import(None, &records)?)
}

/// Reader of an archive's entries in the expected order. Since any other entry is refused, the
/// archive can't choose the paths that are written.
struct Reader<'a, R: Read> {
    entries: tar::Entries<'a, R>,
    intake: &'a Intake,
    name: String,
    progress: Progress,
}

impl<'a, R: Read> Reader<'a, R> {
    /// Returns the name of an entry in messages.
    fn entry_name(&self, entry: &str) -> String {
        format!("{}: {entry}", self.name)
    }

    /// Creates the error for an invalid archive.
    fn refuse(&self, problem: impl Display) -> anyhow::Error {
        Failure::BadInput(format!("{}: {problem}; {REMEDY}", self.name)).into()
    }

    /// Returns the next entry. Fails unless it is the expected one.
    fn next_entry(&mut self, expected: &str) -> anyhow::Result<tar::Entry<'a, R>> {
        let mut long_path = None;
        loop {
            let entry = match self.entries.next() {
                Some(Ok(entry)) => entry,
                Some(Err(error)) => {
                    let problem = format!("not a tar file, expected {expected:?}: {error}");
                    return Err(self.refuse(problem));
                }
                None => return Err(self.refuse(format!("the archive ends before {expected:?}"))),
            };
            let kind = entry.header().entry_type();
            if kind.is_gnu_longname() && long_path.is_none() {
                let mut path = Vec::new();
                let read = entry.take(MAX_PATH_BYTES).read_to_end(&mut path);
                read.map_err(|e| self.refuse(format!("{expected:?}: {e}")))?;
                path.pop_if(|last| *last == 0);
                long_path = Some(path);
                continue;
            }
            let path = long_path.unwrap_or_else(|| entry.header().path_bytes().into_owned());
            let found: String = String::from_utf8_lossy(&path).chars().take(200).collect();
            if kind != tar::EntryType::Regular {
                return Err(self.refuse(format!("{found:?} is not a regular file ({kind:?})")));
            }
            if path != expected.as_bytes() {
                return Err(self.refuse(format!("expected {expected:?}, found {found:?}")));
            }
            return Ok(entry);
        }
    }

    /// Reads an entry of at most `max_bytes`; a larger one is damaged or hostile.
    fn read_small(&mut self, expected: &str, max_bytes: u64) -> anyhow::Result<Vec<u8>> {
        let entry = self.next_entry(expected)?;
        let size = entry.size();
        if size > max_bytes {
            let problem = format!("{expected:?} has {size} bytes, more than {max_bytes}");
            return Err(self.refuse(problem));
        }
        let mut bytes = Vec::new();
        let read = entry.take(max_bytes).read_to_end(&mut bytes);
        read.map_err(|e| self.refuse(format!("{expected:?}: {e}")))?;
        if bytes.len() as u64 != size {
            return Err(self.refuse(format!("the archive ends within {expected:?}")));
        }
        self.progress.add(size)?;
        Ok(bytes)
    }

    fn read_index(&mut self) -> anyhow::Result<Index> {
        let bytes = self.read_small(INDEX_FILE, MAX_MANIFEST_BYTES)?;
        parse_index(&bytes).map_err(|problem| self.refuse(problem))
    }

    /// Reads an object into the scratch folder and checks it; `None` if the store has the object.
    fn read_object(&mut self, identity: &str) -> anyhow::Result<Option<Arrival>> {
        let is_stored = self.intake.store.is_complete(identity)?;
        let folder = self.intake.scratch(identity);
        let first = object_entry(identity, MANIFEST_FILE);
        let bytes = self.read_small(&first, MAX_MANIFEST_BYTES)?;
        let manifest = self.intake.add_manifest(identity, &bytes, &self.entry_name(&first))?;
        for file in &manifest.files {
            let target = (!is_stored).then(|| folder.join(&file.path));
            self.read_file(identity, file, target.as_deref())?;
        }
        if is_stored {
            return Ok(None);
        }
        Ok(Some(self.intake.store.check_arrival(&folder, identity)?))
    }

    /// Reads and checks a file of an object, and writes it to `target`, if given.
    fn read_file(
        &mut self,
        identity: &str,
        file: &FileEntry,
        target: Option<&Path>,
    ) -> anyhow::Result<()> {
        let path = object_entry(identity, &file.path);
        let mut entry = self.next_entry(&path)?;
        if entry.size() != file.size {
            let sizes = format!("{} bytes, but {} in the manifest", entry.size(), file.size);
            return Err(self.refuse(format!("{path:?} has {sizes}")));
        }
        let mut output = target.map(create_file).transpose()?;
        let name = self.entry_name(&path);
        let mut check = ContentCheck::new(file, REMEDY);
        let mut buffer = vec![0; BUFFER_BYTES];
        loop {
            let count =
                entry.read(&mut buffer).map_err(|e| self.refuse(format!("{path:?}: {e}")))?;
            if count == 0 {
                return check.finish(&name);
            }
            check.add(&buffer[..count], &self.progress, &name)?;
            if let Some(output) = &mut output {
                output.write_all(&buffer[..count]).with_context(|| path.clone())?;
            }
        }
    }

    /// Fails if the archive has further entries, or if an object or the index's artifact has no
    /// record.
    fn check_end(&mut self, index: &Index, records: &[Record]) -> anyhow::Result<()> {
        if let Some(entry) = self.entries.next() {
            let name = entry.map_or_else(
                |e| e.to_string(),
                |e| String::from_utf8_lossy(&e.header().path_bytes()).into_owned(),
            );
            return Err(self.refuse(format!("{name:?} after the last entry")));
        }
        for identity in index.objects.iter().chain([&index.artifact]) {
            if !records.iter().any(|record| record.output == *identity) {
                return Err(self.refuse(format!("no record of the artifact {identity:?}")));
            }
        }
        Ok(())
    }
}

/// Parses an archive's index; the error is the problem, as text.
fn parse_index(bytes: &[u8]) -> Result<Index, String> {
    let value: Value = serde_json::from_slice(bytes).map_err(|e| format!("{INDEX_FILE}: {e}"))?;
    for (field, known) in [("export", EXPORT_FORMAT), ("store", store::FORMAT)] {
        let Some(found) = value.get(field).and_then(Value::as_u64) else {
            return Err(format!(
                "{INDEX_FILE}: the {field} format is missing or not a whole number"
            ));
        };
        if found > u64::from(known) {
            return Err(format!(
                "{field} format {found}, this nerf-sr-remote supports {known}; update \
                nerf-sr-remote"
            ));
        }
    }
    let index: Index = serde_json::from_value(value).map_err(|e| format!("{INDEX_FILE}: {e}"))?;
    for names in [&index.objects, &index.actions] {
        if !names.iter().all(|name| is_hash(name)) || !names.is_sorted_by(|a, b| a < b) {
            return Err(format!("{INDEX_FILE}: names are not sorted hashes"));
        }
    }
    Ok(index)
}
