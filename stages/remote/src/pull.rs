use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{Failure, FileEntry, MANIFEST_FILE, counted, one_line, print_line, sized};
use store::{Record, Store, StoreError};

use crate::intake::{Intake, MANIFEST_LIMIT, RECORD_LIMIT, read_manifest, read_record};
use crate::listing::{ACTIONS, Listing};
use crate::progress::Progress;
use crate::remote::{Access, Remote};
use crate::selection::Selection;
use crate::transfer::{Transfer, all};

/// Copies finished actions and their artifacts from a remote to a store that lacks them.
pub(crate) async fn pull(
    store: &Store,
    remote: &Remote,
    selection: &Selection,
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<()> {
    remote.check_format(Access::Read).await?;
    let looking = Arc::new(Progress::new("pull", 0, stop));
    let mut refused = Vec::new();
    let (missing, known) =
        missing_records(store, remote, selection, &looking, &mut refused).await?;
    let intake = Arc::new(Intake::begin(store, stop)?);
    let objects = look(&intake, remote, missing, &looking, &mut refused).await?;
    let total = objects.iter().fold(0, |sum: u64, object| sum.saturating_add(object.bytes));
    drop(looking);
    let transfer = Transfer::new(remote, Progress::new("pull", total, stop));
    let tasks = objects
        .into_iter()
        .map(|object| refusable(fetch(Arc::clone(&intake), Arc::clone(&transfer), object)));
    let (mut actions, mut bytes) = (0, 0);
    for result in all(tasks).await? {
        match result {
            Ok((new, size)) => (actions, bytes) = (actions + new, bytes + size),
            Err(error) => refused.push(error),
        }
    }
    let mut refused: Vec<String> = refused.iter().map(one_line).collect();
    refused.sort_unstable();
    refused.iter().for_each(|reason| transfer.progress.say(reason));
    print_line!(
        "{}: {} pulled ({}), {known} here already",
        remote.name(""),
        counted(actions, "action"),
        sized(bytes)
    );
    Arc::into_inner(intake).map_or(Ok(()), Intake::end)?;
    match refused.len() {
        0 => Ok(()),
        count => {
            Err(Failure::BadInput(format!("{} refused; the rest is here", counted(count, "file")))
                .into())
        }
    }
}

/// Records of the actions that the store lacks, and how many of those that are meant it has.
async fn missing_records(
    store: &Store,
    remote: &Remote,
    selection: &Selection,
    progress: &Arc<Progress>,
    refused: &mut Vec<anyhow::Error>,
) -> anyhow::Result<(Vec<Record>, usize)> {
    let Listing { mut keys, odd } = remote.records().await?;
    for name in odd {
        let file = remote.name(&format!("{ACTIONS}/{name}"));
        refused.push(Failure::BadInput(format!("{file}: not a record; remove the file")).into());
    }
    let all_are_meant = selection.keys.is_empty() && selection.artifacts.is_empty();
    let count = keys.len();
    if all_are_meant {
        keys = lacking(store, keys)?;
    } else if selection.artifacts.is_empty() && !selection.history {
        keys.retain(|key| selection.keys.iter().any(|start| key.starts_with(start)));
    }
    let known = count - keys.len();
    let tasks =
        keys.into_iter().map(|key| refusable(record(remote.clone(), Arc::clone(progress), key)));
    let mut records = BTreeMap::new();
    for result in all(tasks).await? {
        match result {
            Ok(Some((key, record))) => drop(records.insert(key, record)),
            // Somebody has removed it meanwhile.
            Ok(None) => {}
            Err(error) => refused.push(error),
        }
    }
    let selected = selection.of(&records, &remote.name(""))?;
    let count = selected.len();
    let missing: Vec<Record> =
        lacking(store, selected)?.iter().filter_map(|key| records.remove(key)).collect();
    let known = if all_are_meant { known } else { count - missing.len() };
    Ok((missing, known))
}

/// Keys of the actions that the store lacks.
fn lacking(
    store: &Store,
    keys: impl IntoIterator<Item = String>,
) -> Result<Vec<String>, StoreError> {
    let mut lacking = Vec::new();
    for key in keys {
        if store.hit(&key)?.is_none() {
            lacking.push(key);
        }
    }
    Ok(lacking)
}

async fn record(
    remote: Remote,
    progress: Arc<Progress>,
    key: String,
) -> anyhow::Result<Option<(String, Record)>> {
    progress.add(0)?;
    let file = format!("actions/{key}.json");
    let Some(bytes) = remote.read(&file, RECORD_LIMIT).await? else { return Ok(None) };
    let record = read_record(&bytes, &key, &remote.name(&file))?;
    Ok(Some((key, record)))
}

/// An artifact that is to come, its manifest in the scratch folder already; `bytes` is 0 where the
/// store has it.
struct Object {
    identity: String,
    records: Vec<Record>,
    bytes: u64,
    is_here: bool,
}

/// Fetches the manifests of all artifacts that the store lacks.
async fn look(
    intake: &Arc<Intake>,
    remote: &Remote,
    records: Vec<Record>,
    progress: &Arc<Progress>,
    refused: &mut Vec<anyhow::Error>,
) -> anyhow::Result<Vec<Object>> {
    let mut by_output: BTreeMap<String, Vec<Record>> = BTreeMap::new();
    for record in records {
        by_output.entry(record.output.clone()).or_default().push(record);
    }
    let tasks = by_output.into_iter().map(|(identity, records)| {
        refusable(manifest(
            Arc::clone(intake),
            remote.clone(),
            Arc::clone(progress),
            identity,
            records,
        ))
    });
    let mut objects = Vec::new();
    for result in all(tasks).await? {
        match result {
            Ok(object) => objects.push(object),
            Err(error) => refused.push(error),
        }
    }
    objects.sort_by(|a, b| a.identity.cmp(&b.identity));
    Ok(objects)
}

async fn manifest(
    intake: Arc<Intake>,
    remote: Remote,
    progress: Arc<Progress>,
    identity: String,
    records: Vec<Record>,
) -> anyhow::Result<Object> {
    progress.add(0)?;
    if intake.store.is_whole(&identity)? {
        return Ok(Object { identity, records, bytes: 0, is_here: true });
    }
    let file = format!("objects/{identity}/{MANIFEST_FILE}");
    let Some(bytes) = remote.read(&file, MANIFEST_LIMIT).await? else {
        let message =
            format!("{}: it is not there; push again from a whole store", remote.name(&file));
        return Err(Failure::BadInput(message).into());
    };
    let folder = intake.scratch(&identity);
    let path = folder.join(MANIFEST_FILE);
    std::fs::create_dir_all(&folder)
        .and_then(|()| std::fs::write(&path, bytes))
        .with_context(|| path.display().to_string())?;
    let manifest = read_manifest(&folder, &identity, &remote.name(&file))?;
    Ok(Object { identity, records, bytes: manifest.size(), is_here: false })
}

/// Fetches an artifact, looks at it as a whole, and takes it in with its records. How many of these
/// are new, and its bytes.
async fn fetch(
    intake: Arc<Intake>,
    transfer: Arc<Transfer>,
    object: Object,
) -> anyhow::Result<(usize, u64)> {
    let Object { identity, records, bytes, is_here } = object;
    if is_here {
        return Ok((intake.take_in(None, &records)?, 0));
    }
    let folder = intake.scratch(&identity);
    let manifest = read_manifest(&folder, &identity, &identity)?;
    let files = manifest.files.into_iter().map(|entry| {
        download(
            Arc::clone(&transfer),
            format!("objects/{identity}/{}", entry.path),
            folder.join(&entry.path),
            entry,
        )
    });
    all(files).await?;
    let arrival = intake.store.check_arrival(&folder, &identity)?;
    Ok((intake.take_in(Some(&arrival), &records)?, bytes))
}

async fn download(
    transfer: Arc<Transfer>,
    from: String,
    to: PathBuf,
    entry: FileEntry,
) -> anyhow::Result<()> {
    transfer.download(&from, &to, &entry).await
}

/// What is wrong with one artifact stops no other: it is the inner error, and any other error the
/// outer one.
async fn refusable<T>(
    task: impl Future<Output = anyhow::Result<T>>,
) -> anyhow::Result<anyhow::Result<T>> {
    match task.await {
        Ok(value) => Ok(Ok(value)),
        Err(error) if matches!(error.downcast_ref(), Some(Failure::BadInput(_))) => Ok(Err(error)),
        Err(error) => Err(error),
    }
}
