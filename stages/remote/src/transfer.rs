use std::fs::File;
use std::future::Future;
use std::io::{Read as _, Write as _};
use std::path::Path;
use std::sync::Arc;

use anyhow::Context as _;
use artifact::{Failure, FileEntry};
use futures_util::StreamExt as _;
use object_store::{ObjectStoreExt as _, WriteMultipart};
use tokio::sync::Semaphore;

use crate::intake::create;
use crate::progress::Progress;
use crate::remote::Remote;

/// Files that are on their way at once, and threads.
pub(crate) const FILES_AT_ONCE: usize = 8;
/// A larger file goes up in parts of this size. Each file holds three of them at most, which bounds
/// the memory.
const LEAST_PART_BYTES: u64 = 6 << 20;
/// S3 takes 10,000 parts a file.
const MOST_PARTS: u64 = 9_000;

/// What all transfers share.
pub(crate) struct Transfer {
    pub(crate) remote: Remote,
    pub(crate) progress: Progress,
    places: Semaphore,
}

impl Transfer {
    pub(crate) fn new(remote: &Remote, progress: Progress) -> Arc<Self> {
        Arc::new(Self { remote: remote.clone(), progress, places: Semaphore::new(FILES_AT_ONCE) })
    }

    /// Uploads a file of an artifact. A file that isn't what the manifest says never appears on the
    /// remote.
    pub(crate) async fn upload(
        &self,
        from: &Path,
        to: &str,
        entry: &FileEntry,
    ) -> anyhow::Result<()> {
        let _place = self.places.acquire().await?;
        let file = File::open(from).with_context(|| from.display().to_string())?;
        let mut checked = Checked::new(entry);
        if entry.size <= LEAST_PART_BYTES {
            let mut bytes = Vec::new();
            file.take(entry.size + 1)
                .read_to_end(&mut bytes)
                .with_context(|| from.display().to_string())?;
            checked.take(&bytes, &self.progress, &from.display())?;
            checked.finish(&from.display(), LOCAL_REMEDY)?;
            return self.remote.write(to, bytes).await;
        }
        let part = LEAST_PART_BYTES.max(entry.size.div_ceil(MOST_PARTS));
        let staged = self.remote.staged(to);
        let upload = self
            .remote
            .files
            .put_multipart(&staged)
            .await
            .with_context(|| self.remote.failed(to))?;
        let mut upload = WriteMultipart::new_with_chunk_size(upload, part as usize);
        match self.write_parts(&mut upload, file, part, checked, from).await {
            Ok(()) => {
                upload.finish().await.with_context(|| self.remote.failed(to))?;
                self.remote.place(&staged, to).await
            }
            Err(error) => {
                // The first error counts, whatever became of the clean-up.
                upload.abort().await.ok();
                Err(error)
            }
        }
    }

    async fn write_parts(
        &self,
        upload: &mut WriteMultipart,
        file: File,
        part: u64,
        mut checked: Checked<'_>,
        from: &Path,
    ) -> anyhow::Result<()> {
        loop {
            let mut bytes = Vec::with_capacity(part as usize);
            (&file)
                .take(part)
                .read_to_end(&mut bytes)
                .with_context(|| from.display().to_string())?;
            if bytes.is_empty() {
                return checked.finish(&from.display(), LOCAL_REMEDY);
            }
            checked.take(&bytes, &self.progress, &from.display())?;
            upload.wait_for_capacity(2).await?;
            upload.put(bytes.into());
        }
    }

    /// Fetches a file of an artifact into a scratch folder; one that isn't what the manifest says
    /// is refused.
    pub(crate) async fn download(
        &self,
        from: &str,
        to: &Path,
        entry: &FileEntry,
    ) -> anyhow::Result<()> {
        let _place = self.places.acquire().await?;
        let name = self.remote.name(from);
        let Some(found) = self.remote.get(from).await? else {
            return Err(
                Failure::BadInput(format!("{name}: it is not there; {REMOTE_REMEDY}")).into()
            );
        };
        let mut file = create(to)?;
        let mut checked = Checked::new(entry);
        let mut stream = found.into_stream();
        while let Some(piece) = stream.next().await {
            let piece = piece.map_err(|error| self.remote.unreadable(from, error))?;
            checked.take(&piece, &self.progress, &name)?;
            file.write_all(&piece).with_context(|| to.display().to_string())?;
        }
        checked.finish(&name, REMOTE_REMEDY)
    }
}

const LOCAL_REMEDY: &str = "the artifact is damaged: `nerf-sr verify --remove`, then run again";
const REMOTE_REMEDY: &str = "nothing of its artifact is taken in; delete this file and the \
    action's record there, and push from a whole store";

/// Compares a stream with what a manifest says of it.
pub(crate) struct Checked<'a> {
    entry: &'a FileEntry,
    size: u64,
    hasher: blake3::Hasher,
}

impl<'a> Checked<'a> {
    pub(crate) fn new(entry: &'a FileEntry) -> Self {
        Self { entry, size: 0, hasher: blake3::Hasher::new() }
    }

    /// The next piece; an error as soon as there is too much.
    pub(crate) fn take(
        &mut self,
        piece: &[u8],
        progress: &Progress,
        name: &dyn std::fmt::Display,
    ) -> anyhow::Result<()> {
        self.size += piece.len() as u64;
        if self.size > self.entry.size {
            let expected = self.entry.size;
            return Err(Failure::BadInput(format!(
                "{name}: more than the {expected} bytes that the manifest says"
            ))
            .into());
        }
        self.hasher.update(piece);
        Ok(progress.add(piece.len() as u64)?)
    }

    pub(crate) fn finish(self, name: &dyn std::fmt::Display, remedy: &str) -> anyhow::Result<()> {
        let problem = if self.size != self.entry.size {
            format!("{} bytes where the manifest says {}", self.size, self.entry.size)
        } else if self.hasher.finalize().to_hex().as_str() != self.entry.blake3 {
            "the content is not what was written (blake3 differs)".to_owned()
        } else {
            return Ok(());
        };
        Err(Failure::BadInput(format!("{name}: {problem}; {remedy}")).into())
    }
}

/// Carries out tasks, some at once, until one fails; what the others began is dropped.
pub(crate) async fn all<T: Send + 'static>(
    tasks: impl Iterator<Item = impl Future<Output = anyhow::Result<T>> + Send + 'static>,
) -> anyhow::Result<Vec<T>> {
    let mut results = Vec::new();
    let mut running = tokio::task::JoinSet::new();
    for task in tasks {
        if running.len() >= FILES_AT_ONCE {
            results.extend(next(&mut running).await?);
        }
        running.spawn(task);
    }
    while let Some(result) = next(&mut running).await? {
        results.push(result);
    }
    Ok(results)
}

async fn next<T: 'static>(
    running: &mut tokio::task::JoinSet<anyhow::Result<T>>,
) -> anyhow::Result<Option<T>> {
    running.join_next().await.transpose()?.transpose()
}
