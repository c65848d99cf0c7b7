use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::Context as _;
use artifact::{FileEntry, MANIFEST_FILE, Manifest, counted, print_line, report_line, sized};
use store::{Record, Store};

use crate::intake::entered;
use crate::progress::Progress;
use crate::remote::{Access, Remote};
use crate::selection::Selection;
use crate::transfer::{Transfer, all};

/// Copies finished actions and their artifacts to a remote that lacks them.
pub(crate) async fn push(
    store: &Store,
    remote: &Remote,
    selection: &Selection,
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<()> {
    remote.check_format(Access::Write).await?;
    let place = store.root().display().to_string();
    let records: BTreeMap<String, Record> =
        store.records()?.into_iter().map(|record| (record.key(), record)).collect();
    let selected = selection.of(&records, &place)?;
    let run = store.begin_run(&entered(store, stop)?, std::env::args().collect())?;
    let id = run.id().to_owned();
    let there: BTreeSet<String> = remote.records().await?.keys.into_iter().collect();
    let missing: Vec<&Record> =
        selected.iter().filter(|key| !there.contains(*key)).map(|key| &records[key]).collect();
    {
        // From here on garbage collection leaves alone what is about to be read.
        let entered = entered(store, stop)?;
        for record in &missing {
            run.record_action(&entered, &record.stage, &record.key())?;
        }
    }
    let pushed = push_records(store, remote, &missing, stop).await;
    // Reading is no use that keeps an artifact longer.
    run.end()?;
    store.remove_run(&id).ok();
    let (actions, bytes) = pushed?;
    let known = selected.len() - missing.len();
    print_line!(
        "{}: {} pushed ({}), {known} there already",
        remote.name(""),
        counted(actions, "action"),
        sized(bytes)
    );
    Ok(())
}

/// How many records went, and bytes of their artifacts.
async fn push_records(
    store: &Store,
    remote: &Remote,
    records: &[&Record],
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<(usize, u64)> {
    let mut by_output: BTreeMap<String, Vec<Record>> = BTreeMap::new();
    let mut sizes = BTreeMap::new();
    let mut without = 0;
    for &record in records {
        if !store.is_whole(&record.output)? {
            without += 1;
            continue;
        }
        sizes.insert(record.output.clone(), store.manifest(&record.output)?.size());
        by_output.entry(record.output.clone()).or_default().push(record.clone());
    }
    if without > 0 {
        report_line!("{} left out: their artifacts are not whole here", counted(without, "action"));
    }
    let actions = by_output.values().map(Vec::len).sum();
    let total = sizes.values().sum();
    let transfer = Transfer::new(remote, Progress::new("push", total, stop));
    all(by_output.into_iter().map(|(output, records)| {
        push_object(store.clone(), Arc::clone(&transfer), output, records)
    }))
    .await?;
    Ok((actions, total))
}

/// Files first, then the manifest, then the records: whoever starts from a record finds all.
async fn push_object(
    store: Store,
    transfer: Arc<Transfer>,
    output: String,
    records: Vec<Record>,
) -> anyhow::Result<()> {
    let folder = store.object(&output);
    let manifest = Manifest::read(&folder)?;
    let object = format!("objects/{output}");
    let there = transfer.remote.has_files(&object, &manifest.files).await?;
    let mut missing = Vec::new();
    for (entry, is_there) in manifest.files.into_iter().zip(there) {
        if is_there {
            transfer.progress.add(entry.size)?;
        } else {
            missing.push((folder.join(&entry.path), format!("{object}/{}", entry.path), entry));
        }
    }
    all(missing
        .into_iter()
        .map(|(from, to, entry)| upload(Arc::clone(&transfer), from, to, entry)))
    .await?;
    let path = folder.join(MANIFEST_FILE);
    let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
    transfer.remote.write(&format!("{object}/{MANIFEST_FILE}"), bytes).await?;
    for record in records {
        transfer.progress.add(0)?;
        let mut bytes = serde_json::to_vec_pretty(&record)?;
        bytes.push(b'\n');
        transfer.remote.write(&format!("actions/{}.json", record.key()), bytes).await?;
    }
    Ok(())
}

async fn upload(
    transfer: Arc<Transfer>,
    from: std::path::PathBuf,
    to: String,
    entry: FileEntry,
) -> anyhow::Result<()> {
    transfer.upload(&from, &to, &entry).await
}
