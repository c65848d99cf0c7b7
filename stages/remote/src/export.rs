use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{Failure, MANIFEST_FILE, Manifest, counted, print_line, report_line, sized};
use serde::Serialize;
use store::{Record, Store};

use crate::archive::{EXPORT, INDEX, Index, action_entry, object_entry};
use crate::destination::Destination;
use crate::intake::entered;
use crate::progress::Progress;
use crate::selection::{one, with_history};
use crate::transfer::Checked;

/// Writes one artifact with its history as one file.
pub(crate) fn export(
    store: &Store,
    what: &str,
    destination: Destination<'_>,
    records_only: bool,
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<()> {
    destination.check()?;
    let run = store.begin_run(&entered(store, stop)?, std::env::args().collect())?;
    let id = run.id().to_owned();
    let written = (|| {
        let history = History::of(store, what, records_only)?;
        let entered = entered(store, stop)?;
        for (key, record) in &history.records {
            run.record_action(&entered, &record.stage, key)?;
        }
        drop(entered);
        history.write(store, destination, stop)
    })();
    // Reading is no use that keeps an artifact longer.
    run.end()?;
    store.remove_run(&id).ok();
    written
}

/// An artifact, the actions that it came of, and the artifacts of these.
struct History {
    artifact: String,
    records: BTreeMap<String, Record>,
    objects: BTreeSet<String>,
}

impl History {
    fn of(store: &Store, what: &str, records_only: bool) -> anyhow::Result<Self> {
        let mut records: BTreeMap<String, Record> =
            store.records()?.into_iter().map(|record| (record.key(), record)).collect();
        let place = store.root().display().to_string();
        let names = records.keys().chain(records.values().map(|record| &record.output));
        let name = one(what, names, "artifact or action", &place)?;
        let keys: BTreeSet<String> = match records.get(&name) {
            Some(_) => BTreeSet::from([name.clone()]),
            None => records
                .iter()
                .filter(|(_, record)| record.output == name)
                .map(|(key, _)| key.clone())
                .collect(),
        };
        let artifact = records.get(&name).map_or(name, |record| record.output.clone());
        if !store.is_whole(&artifact)? {
            let object = store.object(&artifact);
            return Err(Failure::BadInput(format!(
                "{}: the artifact is not whole; run again, or pull it",
                object.display()
            ))
            .into());
        }
        let history = with_history(&records, keys);
        records.retain(|key, _| history.contains(key));
        let mut objects = BTreeSet::from([artifact.clone()]);
        for record in records.values().filter(|_| !records_only) {
            if store.is_whole(&record.output)? {
                objects.insert(record.output.clone());
            }
        }
        let missing: BTreeSet<&String> = records
            .values()
            .map(|record| &record.output)
            .filter(|o| !objects.contains(*o))
            .collect();
        if !records_only && !missing.is_empty() {
            report_line!(
                "{} of the history not whole here: only the records are written",
                counted(missing.len(), "artifact")
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
        let mut out = Writer {
            tar: tar::Builder::new(BufWriter::with_capacity(1 << 20, temporary)),
            name: file.display().to_string(),
            progress: Progress::new("export", total, stop),
        };
        self.write_index(&mut out)?;
        for (identity, manifest) in manifests {
            out.object(&store.object(identity), identity, &manifest)?;
        }
        for (key, record) in &self.records {
            out.json(&action_entry(key), record)?;
        }
        let temporary = out
            .tar
            .into_inner()
            .and_then(|buffer| buffer.into_inner().map_err(io::IntoInnerError::into_error));
        destination.finish(temporary.with_context(|| file.display().to_string())?)?;
        drop(out.progress);
        let (records, objects) =
            (counted(self.records.len(), "record"), counted(self.objects.len(), "artifact"));
        print_line!(
            "{}: {} with {records} and {objects}, {}",
            file.display(),
            &self.artifact[..10],
            sized(total)
        );
        Ok(())
    }

    fn write_index(&self, out: &mut Writer) -> anyhow::Result<()> {
        let index = Index {
            export: EXPORT,
            store: store::FORMAT,
            artifact: self.artifact.clone(),
            objects: self.objects.iter().cloned().collect(),
            actions: self.records.keys().cloned().collect(),
        };
        out.json(INDEX, &index)
    }
}

struct Writer {
    tar: tar::Builder<BufWriter<tempfile::NamedTempFile>>,
    name: String,
    progress: Progress,
}

impl Writer {
    fn json(&mut self, path: &str, value: &impl Serialize) -> anyhow::Result<()> {
        let mut bytes = serde_json::to_vec_pretty(value)?;
        bytes.push(b'\n');
        self.entry(path, bytes.len() as u64, bytes.as_slice()).with_context(|| self.name.clone())
    }

    fn object(&mut self, folder: &Path, identity: &str, manifest: &Manifest) -> anyhow::Result<()> {
        self.json(&object_entry(identity, MANIFEST_FILE), manifest)?;
        for entry in &manifest.files {
            let path = folder.join(&entry.path);
            let name = path.display().to_string();
            let file = File::open(&path).with_context(|| name.clone())?;
            let mut reading = Reading {
                file,
                checked: Checked::new(entry),
                progress: &self.progress,
                name: &name,
                problem: None,
            };
            let written = append(
                &mut self.tar,
                &object_entry(identity, &entry.path),
                entry.size,
                &mut reading,
            );
            if let Some(problem) = reading.problem.take() {
                return Err(problem);
            }
            reading.checked.finish(
                &name,
                "the artifact is damaged: `nerf-sr verify --remove`, then run again",
            )?;
            written.with_context(|| self.name.clone())?;
        }
        Ok(())
    }

    fn entry(&mut self, path: &str, size: u64, from: impl Read) -> io::Result<()> {
        append(&mut self.tar, path, size, from)
    }
}

/// Nothing of the machine is in an entry: neither owner nor time.
fn append(
    tar: &mut tar::Builder<impl Write>,
    path: &str,
    size: u64,
    from: impl Read,
) -> io::Result<()> {
    let mut header = tar::Header::new_gnu();
    header.set_size(size);
    header.set_mode(0o644);
    header.set_mtime(0);
    header.set_uid(0);
    header.set_gid(0);
    header.set_entry_type(tar::EntryType::Regular);
    tar.append_data(&mut header, path, from)
}

/// A file on its way into the archive, compared with the manifest.
struct Reading<'a> {
    file: File,
    checked: Checked<'a>,
    progress: &'a Progress,
    name: &'a str,
    problem: Option<anyhow::Error>,
}

impl Read for Reading<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read(buffer)?;
        if let Err(problem) = self.checked.take(&buffer[..count], self.progress, &self.name) {
            self.problem = Some(problem);
            return Err(io::Error::other("stopped"));
        }
        Ok(count)
    }
}
