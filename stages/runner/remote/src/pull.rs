use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use artifact::{
    Failure, MANIFEST_FILE, bail_bad_input, format_count, format_size, one_line, print_line,
};
use store::{Record, Store, StoreError};

use crate::export::{action_entry, object_entry};
use crate::folder::{ACTIONS, Listing};
use crate::intake::{Intake, MAX_MANIFEST_BYTES, MAX_RECORD_BYTES, parse_record, read_manifest};
use crate::remote::{Access, Remote};
use crate::selection::Selection;
use crate::transfer::{Progress, REMOTE_REMEDY, Transfer, run_all};

/// Copies finished actions and their artifacts from a remote, unless the store has them.
pub(crate) async fn pull(
    store: &Store,
    remote: &Remote,
    selection: &Selection,
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<()> {
    remote.check_format(Access::Read).await?;
    // Metadata is small, so only signals are checked while it is fetched.
    let signals = Arc::new(Progress::new("pull", 0, stop));
    let mut refused = Vec::new();
    let (missing, existing) =
        fetch_missing_records(store, remote, selection, &signals, &mut refused).await?;
    let intake = Arc::new(Intake::begin(store, stop)?);
    let objects = fetch_manifests(&intake, remote, missing, &signals, &mut refused).await?;
    let sizes = objects.iter().filter_map(|object| object.bytes);
    let total = sizes.fold(0, u64::saturating_add);
    drop(signals);
    let transfer = Transfer::new(remote, Progress::new("pull", total, stop));
    let tasks = objects
        .into_iter()
        .map(|object| fetch_object(Arc::clone(&intake), Arc::clone(&transfer), object));
    let mut actions = 0;
    let mut bytes = 0;
    for (new, size) in run_accepted(tasks, &mut refused).await? {
        actions += new;
        bytes += size;
    }
    let mut refused: Vec<String> = refused.iter().map(one_line).collect();
    refused.sort_unstable();
    for problem in &refused {
        transfer.progress.log(problem);
    }
    print_line!(
        "{}: {} pulled ({}), {existing} already present",
        remote.name(""),
        format_count(actions, "action"),
        format_size(bytes)
    );
    Arc::into_inner(intake).map_or(Ok(()), Intake::end)?;
    match refused.len() {
        0 => Ok(()),
        count => Err(Failure::BadInput(format!(
            "refused {count} of the records and artifacts, listed above; the rest was pulled"
        ))
        .into()),
    }
}

/// Fetches records. Returns those of selected actions that the store lacks, and the number of
/// selected actions that the store has.
async fn fetch_missing_records(
    store: &Store,
    remote: &Remote,
    selection: &Selection,
    progress: &Arc<Progress>,
    refused: &mut Vec<anyhow::Error>,
) -> anyhow::Result<(Vec<Record>, usize)> {
    let Listing { mut keys, invalid } = remote.records().await?;
    for name in invalid {
        let file = remote.name(&format!("{ACTIONS}/{name}"));
        refused.push(Failure::BadInput(format!("{file}: not a record; remove the file")).into());
    }
    let count = keys.len();
    if selection.is_all() {
        keys = missing_keys(store, keys)?;
    } else if selection.artifacts.is_empty() && !selection.history {
        keys.retain(|key| selection.keys.iter().any(|start| key.starts_with(start)));
    }
    let existing = count - keys.len();
    let tasks = keys.into_iter().map(|key| fetch_record(remote.clone(), Arc::clone(progress), key));
    // A record is `None` if another process has removed it meanwhile.
    let fetched = run_accepted(tasks, refused).await?;
    let mut records: BTreeMap<String, Record> = fetched.into_iter().flatten().collect();
    let selected = selection.keys_among(&records, &remote.name(""))?;
    let count = selected.len();
    let missing: Vec<Record> =
        missing_keys(store, selected)?.iter().filter_map(|key| records.remove(key)).collect();
    let existing = if selection.is_all() { existing } else { count - missing.len() };
    Ok((missing, existing))
}

/// Returns the keys of the actions that the store lacks.
fn missing_keys(
    store: &Store,
    keys: impl IntoIterator<Item = String>,
) -> Result<Vec<String>, StoreError> {
    let mut missing = Vec::new();
    for key in keys {
        if store.hit(&key)?.is_none() {
            missing.push(key);
        }
    }
    Ok(missing)
}

/// Fetches a record; `None` if it is not found.
async fn fetch_record(
    remote: Remote,
    progress: Arc<Progress>,
    key: String,
) -> anyhow::Result<Option<(String, Record)>> {
    progress.add(0)?;
    let file = action_entry(&key);
    let Some(bytes) = remote.read(&file, MAX_RECORD_BYTES).await? else { return Ok(None) };
    let record = parse_record(&bytes, &key, &remote.name(&file))?;
    Ok(Some((key, record)))
}

/// Artifact to pull.
struct Object {
    identity: String,
    records: Vec<Record>,
    /// Size of the files to fetch, whose manifest is in the scratch folder; `None` if the store has
    /// the artifact.
    bytes: Option<u64>,
}

/// Fetches the manifests of the artifacts that the store lacks.
async fn fetch_manifests(
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
        let (intake, remote) = (Arc::clone(intake), remote.clone());
        fetch_manifest(intake, remote, Arc::clone(progress), identity, records)
    });
    let mut objects = run_accepted(tasks, refused).await?;
    objects.sort_by(|a, b| a.identity.cmp(&b.identity));
    Ok(objects)
}

async fn fetch_manifest(
    intake: Arc<Intake>,
    remote: Remote,
    progress: Arc<Progress>,
    identity: String,
    records: Vec<Record>,
) -> anyhow::Result<Object> {
    progress.add(0)?;
    if intake.store.is_complete(&identity)? {
        return Ok(Object { identity, records, bytes: None });
    }
    let file = object_entry(&identity, MANIFEST_FILE);
    let Some(bytes) = remote.read(&file, MAX_MANIFEST_BYTES).await? else {
        bail_bad_input!("{}: not found; {REMOTE_REMEDY}", remote.name(&file));
    };
    let manifest = intake.add_manifest(&identity, &bytes, &remote.name(&file))?;
    Ok(Object { identity, records, bytes: Some(manifest.size()) })
}

/// Fetches an artifact, checks it, and imports it with its records. Returns the number of new
/// records and the size of the fetched files in bytes.
async fn fetch_object(
    intake: Arc<Intake>,
    transfer: Arc<Transfer>,
    object: Object,
) -> anyhow::Result<(usize, u64)> {
    let Object { identity, records, bytes } = object;
    let Some(bytes) = bytes else { return Ok((intake.import(None, &records)?, 0)) };
    let folder = intake.scratch(&identity);
    // Manifests of all artifacts at once may exceed the memory.
    let manifest = read_manifest(&folder, &identity, &identity)?;
    run_all(manifest.files.into_iter().map(|entry| {
        let transfer = Arc::clone(&transfer);
        let source = object_entry(&identity, &entry.path);
        let target = folder.join(&entry.path);
        async move { transfer.download(&source, &target, &entry).await }
    }))
    .await?;
    let arrival = intake.store.check_arrival(&folder, &identity)?;
    Ok((intake.import(Some(&arrival), &records)?, bytes))
}

/// Runs tasks concurrently and returns their values. Bad input doesn't affect other artifacts, and
/// is added to `refused`; any other error ends all tasks.
async fn run_accepted<T: Send + 'static>(
    tasks: impl Iterator<Item = impl Future<Output = anyhow::Result<T>> + Send + 'static>,
    refused: &mut Vec<anyhow::Error>,
) -> anyhow::Result<Vec<T>> {
    let tasks = tasks.map(|task| async {
        match task.await {
            Err(error) if !matches!(error.downcast_ref(), Some(Failure::BadInput(_))) => Err(error),
            result => Ok(result),
        }
    });
    let mut values = Vec::new();
    for result in run_all(tasks).await? {
        match result {
            Ok(value) => values.push(value),
            Err(error) => refused.push(error),
        }
    }
    Ok(values)
}
