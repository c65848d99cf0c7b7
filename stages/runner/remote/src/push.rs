use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{
    MANIFEST_FILE, Manifest, format_count, format_size, json_text, print_line, report_line,
};
use store::{Record, Store};

use crate::export::action_entry;
use crate::intake::{protect, unprotect};
use crate::remote::{Access, Remote};
use crate::selection::{Selection, records_by_key};
use crate::transfer::{Progress, Transfer, run_all};

/// Copies finished actions and their artifacts to a remote, unless it has them.
pub(crate) async fn push(
    store: &Store,
    remote: &Remote,
    selection: &Selection,
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<()> {
    remote.check_format(Access::Write).await?;
    let records = records_by_key(store)?;
    let selected = selection.keys_among(&records, &store.root().display().to_string())?;
    let existing: BTreeSet<String> = remote.records().await?.keys.into_iter().collect();
    let missing: Vec<&Record> = selected.difference(&existing).map(|key| &records[key]).collect();
    let run = protect(store, missing.iter().copied(), stop)?;
    let pushed = push_records(store, remote, &missing, stop).await;
    let ended = unprotect(store, run);
    let (actions, bytes) = pushed?;
    ended?;
    print_line!(
        "{}: {} pushed ({}), {} already present",
        remote.name(""),
        format_count(actions, "action"),
        format_size(bytes),
        selected.len() - missing.len()
    );
    Ok(())
}

/// Pushes records with their artifacts. Returns the number of pushed records and the size of their
/// artifacts in bytes.
async fn push_records(
    store: &Store,
    remote: &Remote,
    records: &[&Record],
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<(usize, u64)> {
    let mut by_output: BTreeMap<String, Vec<Record>> = BTreeMap::new();
    let mut sizes = BTreeMap::new();
    let mut skipped = 0;
    for &record in records {
        if !store.is_complete(&record.output)? {
            skipped += 1;
            continue;
        }
        sizes.insert(record.output.clone(), store.manifest(&record.output)?.size());
        by_output.entry(record.output.clone()).or_default().push(record.clone());
    }
    if skipped > 0 {
        let actions = format_count(skipped, "action");
        report_line!(
            "{actions} skipped because artifacts are incomplete in this store; \
            remove them by `nerf-sr verify --remove`, then run again"
        );
    }
    let actions = by_output.values().map(Vec::len).sum();
    let total = sizes.values().sum();
    let transfer = Transfer::new(remote, Progress::new("push", total, stop));
    run_all(by_output.into_iter().map(|(output, records)| {
        push_object(store.clone(), Arc::clone(&transfer), output, records)
    }))
    .await?;
    Ok((actions, total))
}

/// Pushes an artifact's files, then its manifest, then its records, so that a remote's records
/// refer to complete artifacts.
async fn push_object(
    store: Store,
    transfer: Arc<Transfer>,
    output: String,
    records: Vec<Record>,
) -> anyhow::Result<()> {
    let folder = store.object(&output);
    let object = format!("objects/{output}");
    let mut files = Manifest::read(&folder)?.files;
    for existing in transfer.remote.take_existing(&object, &mut files).await? {
        transfer.progress.add(existing.size)?;
    }
    run_all(files.into_iter().map(|entry| {
        let transfer = Arc::clone(&transfer);
        let source = folder.join(&entry.path);
        let target = format!("{object}/{}", entry.path);
        async move { transfer.upload(&source, &target, &entry).await }
    }))
    .await?;
    let path = folder.join(MANIFEST_FILE);
    let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
    transfer.remote.write(&format!("{object}/{MANIFEST_FILE}"), bytes).await?;
    for record in records {
        // Fails after a signal.
        transfer.progress.add(0)?;
        let text = json_text(&record)?;
        transfer.remote.write(&action_entry(&record.key()), text.into_bytes()).await?;
    }
    Ok(())
}
