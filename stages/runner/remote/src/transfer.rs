use std::fs::File;
use std::future::Future;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use artifact::{Failure, FileEntry, bail_bad_input};
use futures_util::StreamExt as _;
use object_store::{ObjectStoreExt as _, WriteMultipart};
use stage::ProgressMode;
use tokio::sync::Semaphore;

use crate::intake::create_file;
use crate::remote::Remote;

/// Maximum number of concurrent transfers, and number of threads. Chosen by hand.
pub(crate) const MAX_CONCURRENT_FILES: usize = 8;
/// Maximum size in bytes of a file that is uploaded in one piece, and minimum size of a part of a
/// larger file. At most three parts of a file are in memory. S3 requires at least 5 MiB.
const MIN_PART_BYTES: u64 = 6 << 20;
/// Maximum number of parts of a file; S3 supports 10,000.
const MAX_PARTS: u64 = 9_000;

/// Progress in bytes. [`Progress::add`] also checks for signals, because it is called after each
/// piece of data.
pub(crate) struct Progress {
    bytes: stage::Progress,
    stop: Arc<AtomicBool>,
}

impl Progress {
    /// Creates progress of `total` bytes. With a total of 0, nothing is displayed, and only signals
    /// are checked.
    pub(crate) fn new(label: &str, total: u64, stop: &Arc<AtomicBool>) -> Self {
        let mode = if total > 0 { ProgressMode::Plain } else { ProgressMode::None };
        Self { bytes: stage::Progress::of_bytes(label, total, mode), stop: Arc::clone(stop) }
    }

    /// Counts transferred bytes. Fails if a signal has interrupted the program.
    pub(crate) fn add(&self, bytes: u64) -> Result<(), Failure> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(Failure::Interrupted);
        }
        self.bytes.add(bytes);
        Ok(())
    }

    /// Logs a line on stderr without disturbing the bar.
    pub(crate) fn log(&self, line: &str) {
        self.bytes.log_line(line);
    }
}

/// State shared by all transfers.
pub(crate) struct Transfer {
    pub(crate) remote: Remote,
    pub(crate) progress: Progress,
    slots: Semaphore,
}

impl Transfer {
    pub(crate) fn new(remote: &Remote, progress: Progress) -> Arc<Self> {
        Arc::new(Self {
            remote: remote.clone(),
            progress,
            slots: Semaphore::new(MAX_CONCURRENT_FILES),
        })
    }

    /// Uploads a file of an artifact, which appears on the remote only if it matches the manifest.
    pub(crate) async fn upload(
        &self,
        source: &Path,
        target: &str,
        entry: &FileEntry,
    ) -> anyhow::Result<()> {
        let _slot = self.slots.acquire().await?;
        let name = source.display();
        let file = File::open(source).with_context(|| name.to_string())?;
        let mut check = ContentCheck::new(entry, STORE_REMEDY);
        if entry.size <= MIN_PART_BYTES {
            let mut bytes = Vec::new();
            let read = file.take(entry.size + 1).read_to_end(&mut bytes);
            read.with_context(|| name.to_string())?;
            check.add(&bytes, &self.progress, &name)?;
            check.finish(&name)?;
            return self.remote.write(target, bytes).await;
        }
        let part_bytes = MIN_PART_BYTES.max(entry.size.div_ceil(MAX_PARTS));
        let staged = self.remote.staged_path(target);
        let upload = self.remote.files.put_multipart(&staged).await;
        let upload = upload.with_context(|| self.remote.name_with_hint(target))?;
        let mut upload = WriteMultipart::new_with_chunk_size(upload, part_bytes as usize);
        match self.write_parts(&mut upload, &file, part_bytes, check, source).await {
            Ok(()) => {
                let finished = upload.finish().await;
                finished.with_context(|| self.remote.name_with_hint(target))?;
                self.remote.publish(&staged, target).await
            }
            Err(error) => {
                // The first error is reported, even if the clean-up fails.
                upload.abort().await.ok();
                Err(error)
            }
        }
    }

    async fn write_parts(
        &self,
        upload: &mut WriteMultipart,
        file: &File,
        part_bytes: u64,
        mut check: ContentCheck<'_>,
        source: &Path,
    ) -> anyhow::Result<()> {
        let name = source.display();
        loop {
            let mut bytes = Vec::with_capacity(part_bytes as usize);
            let read = file.take(part_bytes).read_to_end(&mut bytes);
            read.with_context(|| name.to_string())?;
            if bytes.is_empty() {
                return check.finish(&name);
            }
            check.add(&bytes, &self.progress, &name)?;
            upload.wait_for_capacity(2).await?;
            upload.put(bytes.into());
        }
    }

    /// Downloads a file of an artifact into a scratch folder. Fails if it differs from the
    /// manifest.
    pub(crate) async fn download(
        &self,
        source: &str,
        target: &Path,
        entry: &FileEntry,
    ) -> anyhow::Result<()> {
        let _slot = self.slots.acquire().await?;
        let name = self.remote.name(source);
        let Some(found) = self.remote.get(source).await? else {
            bail_bad_input!("{name}: not found; {REMOTE_REMEDY}");
        };
        let mut file = create_file(target)?;
        let mut check = ContentCheck::new(entry, REMOTE_REMEDY);
        let mut stream = found.into_stream();
        while let Some(piece) = stream.next().await {
            let piece = piece.map_err(|error| self.remote.read_error(source, error))?;
            check.add(&piece, &self.progress, &name)?;
            file.write_all(&piece).with_context(|| target.display().to_string())?;
        }
        check.finish(&name)
    }
}

/// Remedy for a damaged artifact of the store.
pub(crate) const STORE_REMEDY: &str =
    "the artifact is damaged; remove it by `nerf-sr verify --remove`, then run again";
/// Remedy for a missing or damaged file on the remote. A push skips actions whose record exists.
pub(crate) const REMOTE_REMEDY: &str = "the artifact was not pulled; on the remote, delete the \
    action's record, and this file if it exists; then push again from a store with the artifact";

/// Comparison of a file's content with its manifest, piece by piece.
pub(crate) struct ContentCheck<'a> {
    entry: &'a FileEntry,
    /// Remedy in the messages about differences.
    remedy: &'a str,
    size: u64,
    hasher: blake3::Hasher,
}

impl<'a> ContentCheck<'a> {
    pub(crate) fn new(entry: &'a FileEntry, remedy: &'a str) -> Self {
        Self { entry, remedy, size: 0, hasher: blake3::Hasher::new() }
    }

    /// Adds the next piece. Fails if the content is too long.
    pub(crate) fn add(
        &mut self,
        piece: &[u8],
        progress: &Progress,
        name: &dyn std::fmt::Display,
    ) -> Result<(), Failure> {
        self.size += piece.len() as u64;
        let expected = self.entry.size;
        if self.size > expected {
            let remedy = self.remedy;
            bail_bad_input!("{name}: more than the {expected} bytes in the manifest; {remedy}");
        }
        self.hasher.update(piece);
        progress.add(piece.len() as u64)
    }

    /// Fails if the complete content differs from the manifest.
    pub(crate) fn finish(self, name: &dyn std::fmt::Display) -> anyhow::Result<()> {
        let problem = if self.size != self.entry.size {
            format!("{} bytes, but {} in the manifest", self.size, self.entry.size)
        } else if self.hasher.finalize().to_hex().as_str() != self.entry.blake3 {
            "the content differs from the manifest (blake3)".to_owned()
        } else {
            return Ok(());
        };
        Err(Failure::BadInput(format!("{name}: {problem}; {}", self.remedy)).into())
    }
}

/// Runs tasks concurrently and returns their results in order of completion. If one fails, the
/// others are cancelled.
pub(crate) async fn run_all<T: Send + 'static>(
    tasks: impl Iterator<Item = impl Future<Output = anyhow::Result<T>> + Send + 'static>,
) -> anyhow::Result<Vec<T>> {
    let mut results = Vec::new();
    let mut running = tokio::task::JoinSet::new();
    for task in tasks {
        if running.len() >= MAX_CONCURRENT_FILES {
            results.extend(next_result(&mut running).await?);
        }
        running.spawn(task);
    }
    while let Some(result) = next_result(&mut running).await? {
        results.push(result);
    }
    Ok(results)
}

async fn next_result<T: 'static>(
    running: &mut tokio::task::JoinSet<anyhow::Result<T>>,
) -> anyhow::Result<Option<T>> {
    running.join_next().await.transpose()?.transpose()
}
