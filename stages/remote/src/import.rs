use std::fmt;
use std::fs::File;
use std::io::{self, BufReader, Read, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{Failure, FileEntry, MANIFEST_FILE, counted, file_kind, sized};
use store::{Arrival, Record, Store, is_hash};

use crate::archive::{EXPORT, INDEX, Index, action_entry, object_entry};
use crate::intake::{Intake, MANIFEST_LIMIT, RECORD_LIMIT, create, read_manifest, read_record};
use crate::progress::Progress;
use crate::transfer::Checked;

/// A longer path is no path.
const PATH_LIMIT: u64 = 8 << 10;
const PIECE_BYTES: usize = 1 << 18;
const REMEDY: &str = "nothing is taken in; export it again from a whole store";

/// Content of an archive that was read.
#[derive(Debug)]
pub struct Imported {
    records: usize,
    objects: usize,
    /// Size of the archive.
    bytes: u64,
    /// Number of records that the store didn't have.
    new: usize,
}

impl fmt::Display for Imported {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (records, objects) =
            (counted(self.records, "record"), counted(self.objects, "artifact"));
        let (size, new) = (sized(self.bytes), self.new);
        write!(f, "{records} and {objects} read ({size}), {new} records new")
    }
}

/// Reads what `export` wrote. Nothing is taken in before all is verified.
pub fn import(store: &Store, file: &Path, stop: &Arc<AtomicBool>) -> anyhow::Result<Imported> {
    let name = file.display().to_string();
    let (total, open) = open(file)?;
    let mut archive = tar::Archive::new(BufReader::with_capacity(1 << 20, open));
    let entries = archive.entries().with_context(|| name.clone())?.raw(true);
    let intake = Intake::begin(store, stop)?;
    let mut reader =
        Reader { entries, intake: &intake, name, progress: Progress::new("import", total, stop) };
    let index = reader.index()?;
    let mut arrivals = Vec::new();
    for identity in &index.objects {
        arrivals.push((identity, reader.object(identity)?));
    }
    let mut records = Vec::new();
    for key in &index.actions {
        let entry = action_entry(key);
        let bytes = reader.small(&entry, RECORD_LIMIT)?;
        records.push(read_record(&bytes, key, &reader.name_of(&entry))?);
    }
    reader.end(&index, &records)?;
    drop(reader);
    let new = take_in(&intake, &arrivals, records)?;
    intake.end()?;
    Ok(Imported { records: index.actions.len(), objects: index.objects.len(), bytes: total, new })
}

/// Opens an archive; returns its size, too. A named pipe would be waited for, and a device has no
/// end.
fn open(file: &Path) -> anyhow::Result<(u64, File)> {
    let unreadable =
        |problem: io::Error| Failure::BadInput(format!("{}: {problem}", file.display()));
    let found = file.metadata().map_err(unreadable)?;
    if !found.is_file() {
        let (name, kind) = (file.display(), file_kind(found.file_type()));
        let problem = format!("{name} is {kind}, not a regular file; save the archive as a file");
        return Err(Failure::BadInput(problem).into());
    }
    Ok((found.len(), File::open(file).map_err(unreadable)?))
}

/// Objects first, each with its records, and then records that stand alone. How many records are
/// new.
fn take_in(
    intake: &Intake,
    arrivals: &[(&String, Option<Arrival>)],
    mut records: Vec<Record>,
) -> anyhow::Result<usize> {
    let mut new = 0;
    for (identity, arrival) in arrivals {
        let (own, others) =
            records.into_iter().partition::<Vec<_>, _>(|record| record.output == **identity);
        new += intake.take_in(arrival.as_ref(), &own)?;
        records = others;
    }
    Ok(new + intake.take_in(None, &records)?)
}

/// Reads entry after entry; any that isn't the next one is refused, so none decides where it is
/// written.
struct Reader<'a, R: Read> {
    entries: tar::Entries<'a, R>,
    intake: &'a Intake,
    name: String,
    progress: Progress,
}

impl<'a, R: Read> Reader<'a, R> {
    fn name_of(&self, entry: &str) -> String {
        format!("{}: {entry}", self.name)
    }

    fn refuse(&self, reason: impl std::fmt::Display) -> anyhow::Error {
        Failure::BadInput(format!("{}: {reason}; {REMEDY}", self.name)).into()
    }

    /// The next entry, if it is the expected one.
    fn next(&mut self, expected: &str) -> anyhow::Result<tar::Entry<'a, R>> {
        let mut long = None;
        loop {
            let entry = match self.entries.next() {
                Some(Ok(entry)) => entry,
                Some(Err(error)) => {
                    return Err(self
                        .refuse(format!("no tar file where {expected:?} should follow: {error}")));
                }
                None => return Err(self.refuse(format!("it ends before {expected:?}"))),
            };
            let kind = entry.header().entry_type();
            if kind.is_gnu_longname() && long.is_none() {
                let mut path = Vec::new();
                let read = entry.take(PATH_LIMIT).read_to_end(&mut path);
                read.map_err(|e| self.refuse(format!("{expected:?}: {e}")))?;
                path.pop_if(|last| *last == 0);
                long = Some(path);
                continue;
            }
            let path = long.unwrap_or_else(|| entry.header().path_bytes().into_owned());
            let found: String = String::from_utf8_lossy(&path).chars().take(200).collect();
            if kind != tar::EntryType::Regular {
                return Err(self.refuse(format!("{found:?} is no plain file ({kind:?})")));
            }
            if path != expected.as_bytes() {
                return Err(self.refuse(format!("{found:?} where {expected:?} should follow")));
            }
            return Ok(entry);
        }
    }

    /// The content of an entry that is small unless somebody means harm.
    fn small(&mut self, expected: &str, limit: u64) -> anyhow::Result<Vec<u8>> {
        let entry = self.next(expected)?;
        let size = entry.size();
        if size > limit {
            return Err(self.refuse(format!("{expected:?} has {size} bytes, more than {limit}")));
        }
        let mut bytes = Vec::new();
        let read = entry.take(limit).read_to_end(&mut bytes);
        read.map_err(|e| self.refuse(format!("{expected:?}: {e}")))?;
        if bytes.len() as u64 != size {
            return Err(self.refuse(format!("it ends within {expected:?}")));
        }
        self.progress.add(size)?;
        Ok(bytes)
    }

    fn index(&mut self) -> anyhow::Result<Index> {
        let bytes = self.small(INDEX, MANIFEST_LIMIT)?;
        let value: serde_json::Value =
            serde_json::from_slice(&bytes).map_err(|e| self.refuse(format!("{INDEX}: {e}")))?;
        for (field, known) in [("export", EXPORT), ("store", store::FORMAT)] {
            if value
                .get(field)
                .and_then(serde_json::Value::as_u64)
                .is_none_or(|found| found > u64::from(known))
            {
                let found = value.get(field).cloned().unwrap_or_default();
                return Err(self.refuse(format!(
                    "{field} format {found}, this nerf-sr-remote knows {known}; use the newer one"
                )));
            }
        }
        let index: Index =
            serde_json::from_value(value).map_err(|e| self.refuse(format!("{INDEX}: {e}")))?;
        for names in [&index.objects, &index.actions] {
            if !names.iter().all(|name| is_hash(name)) || !names.is_sorted_by(|a, b| a < b) {
                return Err(self.refuse(format!("{INDEX}: names that are no sorted hashes")));
            }
        }
        Ok(index)
    }

    /// An object, put together in the scratch folder and found whole; none where the store has it.
    fn object(&mut self, identity: &str) -> anyhow::Result<Option<Arrival>> {
        let is_here = self.intake.store.is_whole(identity)?;
        let folder = self.intake.scratch(identity);
        let first = object_entry(identity, MANIFEST_FILE);
        let bytes = self.small(&first, MANIFEST_LIMIT)?;
        let path = folder.join(MANIFEST_FILE);
        let written = std::fs::create_dir_all(&folder).and_then(|()| std::fs::write(&path, bytes));
        written.with_context(|| path.display().to_string())?;
        let manifest = read_manifest(&folder, identity, &self.name_of(&first))?;
        for file in &manifest.files {
            self.file(identity, file, (!is_here).then(|| folder.join(&file.path)).as_deref())?;
        }
        if is_here {
            Ok(None)
        } else {
            Ok(Some(self.intake.store.check_arrival(&folder, identity)?))
        }
    }

    /// A file of an object, written where it isn't here yet.
    fn file(&mut self, identity: &str, file: &FileEntry, to: Option<&Path>) -> anyhow::Result<()> {
        let path = object_entry(identity, &file.path);
        let mut entry = self.next(&path)?;
        if entry.size() != file.size {
            let sizes = format!("{} bytes where the manifest says {}", entry.size(), file.size);
            return Err(self.refuse(format!("{path:?} has {sizes}")));
        }
        let mut out = to.map(create).transpose()?;
        let name = self.name_of(&path);
        let mut checked = Checked::new(file);
        let mut piece = vec![0; PIECE_BYTES];
        loop {
            let count =
                entry.read(&mut piece).map_err(|e| self.refuse(format!("{path:?}: {e}")))?;
            if count == 0 {
                return checked.finish(&name, REMEDY);
            }
            checked.take(&piece[..count], &self.progress, &name)?;
            if let Some(out) = &mut out {
                out.write_all(&piece[..count]).with_context(|| path.clone())?;
            }
        }
    }

    /// Nothing may follow, and every object must have a record.
    fn end(&mut self, index: &Index, records: &[Record]) -> anyhow::Result<()> {
        if let Some(entry) = self.entries.next() {
            let name = entry.map_or_else(
                |e| e.to_string(),
                |e| String::from_utf8_lossy(&e.header().path_bytes()).into_owned(),
            );
            return Err(self.refuse(format!("{name:?} where the end should be")));
        }
        let has_record =
            |identity: &String| records.iter().any(|record| record.output == *identity);
        match index.objects.iter().chain([&index.artifact]).find(|identity| !has_record(identity)) {
            Some(identity) => Err(self.refuse(format!("no record says what made {identity:?}"))),
            None => Ok(()),
        }
    }
}
