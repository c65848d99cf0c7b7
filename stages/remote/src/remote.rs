use std::collections::BTreeMap;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, FileEntry, one_line};
use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::aws::AmazonS3Builder;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    ClientOptions, GetResult, ObjectStore, ObjectStoreExt as _, PutPayload, RetryConfig,
};
use store::FORMAT;

use crate::folder::Folder;
use crate::listing::{ACTIONS, Listing};

/// A server that says nothing for so long is given up.
const LONGEST_SILENCE: Duration = Duration::from_secs(60);
/// For so long, and so often, a request is made again that failed for a reason that may pass.
const LONGEST_RETRYING: Duration = Duration::from_secs(60);
const MOST_RETRIES: usize = 6;
/// What `format` may hold.
const FORMAT_LIMIT: u64 = 100;

/// A place that machines share, laid out as a store: a folder, or a prefix in an S3 bucket.
#[derive(Clone, Debug)]
pub(crate) struct Remote {
    pub(crate) files: Arc<dyn ObjectStore>,
    /// The remote's folder, if the remote is one.
    folder: Option<Folder>,
    prefix: Path,
    name: String,
    /// What a request that failed may lack.
    hint: &'static str,
}

/// Variables by one of which a machine says who it is.
const IDENTITIES: [&str; 5] = [
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    "AWS_SKIP_SIGNATURE",
];
const NO_IDENTITY: &str =
    " (AWS_ACCESS_KEY_ID is not set, so the machine's own role was asked for)";

/// Whether a remote is to be written.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Access {
    Read,
    Write,
}

impl Remote {
    /// The remote that a user names. A folder that is to be written is made.
    pub(crate) fn open(place: &str, access: Access) -> anyhow::Result<Self> {
        let name = place.trim_end_matches('/').to_owned();
        match place.split_once("://") {
            Some(("s3", rest)) => Self::open_s3(rest.trim_end_matches('/'), name),
            Some((scheme, _)) => {
                let message = format!(
                    "{place}: {scheme}:// is not known; a remote is a folder or s3://bucket/prefix"
                );
                Err(Failure::Usage(message).into())
            }
            None => Self::open_folder(FilePath::new(place), name, access),
        }
    }

    fn open_folder(folder: &FilePath, name: String, access: Access) -> anyhow::Result<Self> {
        if access == Access::Write {
            if folder.join("locks").exists() {
                let message = format!(
                    "{name}: a store of nerf-sr's own, which only a run may write; name another \
                    folder"
                );
                return Err(Failure::Usage(message).into());
            }
            std::fs::create_dir_all(folder).with_context(|| name.clone())?;
        } else if !folder.is_dir() {
            return Err(Failure::BadInput(format!("{name}: there is no such folder")).into());
        }
        // A record that survives a power cut must not outlive its artifact.
        let files = LocalFileSystem::new_with_prefix(folder)?.with_fsync(true);
        let mut folder = Folder::new(folder, files.clone());
        if access == Access::Write {
            folder = folder.for_push().with_context(|| name.clone())?;
        }
        Ok(Self {
            files: Arc::new(files),
            folder: Some(folder),
            prefix: Path::default(),
            name,
            hint: "",
        })
    }

    /// Credentials, region and endpoint come from the usual `AWS_…` variables.
    fn open_s3(rest: &str, name: String) -> anyhow::Result<Self> {
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        if bucket.is_empty() {
            return Err(Failure::Usage(format!(
                "{name}: names no bucket; a remote is a folder or s3://bucket/prefix"
            ))
            .into());
        }
        // With another provider set already, that one is as good.
        rustls::crypto::ring::default_provider().install_default().ok();
        let endpoint = ["AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"]
            .into_iter()
            .find_map(|v| std::env::var(v).ok());
        // A limit on a whole request would stop large files on slow lines.
        let client =
            ClientOptions::new().with_timeout_disabled().with_read_timeout(LONGEST_SILENCE);
        let plain = endpoint.is_some_and(|endpoint| endpoint.starts_with("http://"));
        let retry = RetryConfig {
            max_retries: MOST_RETRIES,
            retry_timeout: LONGEST_RETRYING,
            ..RetryConfig::default()
        };
        let builder = AmazonS3Builder::from_env()
            .with_bucket_name(bucket)
            .with_client_options(client)
            .with_allow_http(plain);
        let files = builder.with_retry(retry).build().with_context(|| name.clone())?;
        let prefix = Path::parse(prefix).with_context(|| name.clone())?;
        let hint = if IDENTITIES.iter().any(|name| std::env::var_os(name).is_some()) {
            ""
        } else {
            NO_IDENTITY
        };
        Ok(Self { files: Arc::new(files), folder: None, prefix, name, hint })
    }

    /// Where a file of the store is kept. Names with characters that a server or a file system may
    /// not take are percent-encoded.
    pub(crate) fn path(&self, file: &str) -> Path {
        let is_plain = |c: char| !c.is_control() && !"%#\\?*:<>|\"{}[]^`~".contains(c);
        let path = if file.chars().all(is_plain) { Path::parse(file).ok() } else { None };
        let path = path.unwrap_or_else(|| Path::from(file));
        self.prefix.parts().chain(path.parts()).collect()
    }

    /// A file of the remote in words.
    pub(crate) fn name(&self, file: &str) -> String {
        if file.is_empty() { self.name.clone() } else { format!("{}/{file}", self.name) }
    }

    /// A file in words, where a request for it failed.
    pub(crate) fn failed(&self, file: &str) -> String {
        format!("{}{}", self.name(file), self.hint)
    }

    /// Returns the failure of reading a file. In a folder it concerns this file alone; a server
    /// that has failed after all retries fails for all files.
    pub(crate) fn unreadable(&self, file: &str, error: object_store::Error) -> anyhow::Error {
        match self.folder {
            Some(_) => {
                let problem = format!("{}: {}", self.name(file), one_line(&error.into()));
                Failure::BadInput(problem).into()
            }
            None => anyhow::Error::new(error).context(self.failed(file)),
        }
    }

    /// Opens a file; none where it isn't there.
    pub(crate) async fn get(&self, file: &str) -> anyhow::Result<Option<GetResult>> {
        let path = self.path(file);
        if let Some(folder) = &self.folder
            && !folder.has(&path, &self.name(file))?
        {
            return Ok(None);
        }
        match self.files.get(&path).await {
            Ok(found) => Ok(Some(found)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.unreadable(file, error)),
        }
    }

    /// Reads a file that is small unless somebody means harm.
    pub(crate) async fn read(&self, file: &str, limit: u64) -> anyhow::Result<Option<Vec<u8>>> {
        let Some(found) = self.get(file).await? else { return Ok(None) };
        let mut bytes = Vec::new();
        let mut stream = found.into_stream();
        while let Some(piece) = stream.next().await {
            bytes.extend_from_slice(&piece.map_err(|e| self.unreadable(file, e))?);
            if bytes.len() as u64 > limit {
                return Err(Failure::BadInput(format!(
                    "{}: more than {limit} bytes",
                    self.name(file)
                ))
                .into());
            }
        }
        Ok(Some(bytes))
    }

    /// Writes a file at once: a reader sees the old or the new one.
    pub(crate) async fn write(&self, file: &str, bytes: Vec<u8>) -> anyhow::Result<()> {
        let staged = self.staged(file);
        self.files
            .put(&staged, PutPayload::from(bytes))
            .await
            .with_context(|| self.failed(file))?;
        self.place(&staged, file).await
    }

    /// Returns the path to write a file to until [`Remote::place`] gives the file its own.
    pub(crate) fn staged(&self, file: &str) -> Path {
        self.folder.as_ref().and_then(Folder::staged).unwrap_or_else(|| self.path(file))
    }

    /// Moves a file that is whole to its path; on a server it is there already.
    pub(crate) async fn place(&self, staged: &Path, file: &str) -> anyhow::Result<()> {
        if self.folder.is_none() {
            return Ok(());
        }
        self.files.rename(staged, &self.path(file)).await.with_context(|| self.failed(file))
    }

    /// Lists the files below a folder of a server with their sizes.
    async fn list(&self, folder: &str) -> anyhow::Result<BTreeMap<Path, u64>> {
        let entries =
            self.files.list(Some(&self.path(folder))).map_ok(|meta| (meta.location, meta.size));
        entries.try_collect().await.with_context(|| self.failed(folder))
    }

    /// Returns for each file of an artifact whether the artifact's folder on the remote, `object`,
    /// has a file of its name and size.
    pub(crate) async fn has_files(
        &self,
        object: &str,
        files: &[FileEntry],
    ) -> anyhow::Result<Vec<bool>> {
        let paths = files.iter().map(|file| self.path(&format!("{object}/{}", file.path)));
        let paths = paths.zip(files.iter().map(|file| file.size));
        if let Some(folder) = &self.folder {
            return Ok(paths.map(|(path, size)| folder.has_size(&path, size)).collect());
        }
        let sizes = self.list(object).await?;
        Ok(paths.map(|(path, size)| sizes.get(&path) == Some(&size)).collect())
    }

    /// Lists the records.
    pub(crate) async fn records(&self) -> anyhow::Result<Listing> {
        let mut listing = match &self.folder {
            Some(folder) => folder.records()?,
            None => self.records_of_server().await?,
        };
        listing.sort();
        Ok(listing)
    }

    async fn records_of_server(&self) -> anyhow::Result<Listing> {
        let (mut listing, actions) = (Listing::default(), self.path(ACTIONS));
        for path in self.list(ACTIONS).await?.into_keys() {
            let inside: Vec<_> = path.prefix_match(&actions).into_iter().flatten().collect();
            match &inside[..] {
                // An empty object may stand for the folder.
                [] => {}
                [name] => listing.add(name.as_ref()),
                _ => listing.odd.push(path.to_string()),
            }
        }
        Ok(listing)
    }

    /// Refuses a remote of a newer form, and for reading one that isn't marked; marks it for
    /// writing, as one of an older form.
    pub(crate) async fn check_format(&self, access: Access) -> anyhow::Result<()> {
        let bytes = match self.read("format", FORMAT_LIMIT).await? {
            Some(bytes) => bytes,
            None if access == Access::Write => return self.mark().await,
            None => {
                return Err(Failure::BadInput(format!(
                    "{}: nothing was pushed here: there is no file `format`",
                    self.name
                ))
                .into());
            }
        };
        let text = String::from_utf8_lossy(&bytes);
        match text.trim().parse::<u32>() {
            Ok(found) if found < FORMAT && access == Access::Write => self.mark().await,
            Ok(found) if found <= FORMAT => Ok(()),
            _ => Err(Failure::BadInput(format!(
                "{}: the remote has format {}, this nerf-sr-remote knows format {FORMAT}; \
                use the newer nerf-sr-remote, or another remote",
                self.name,
                text.trim()
            ))
            .into()),
        }
    }

    /// Marks the remote as of this program's format.
    async fn mark(&self) -> anyhow::Result<()> {
        self.write("format", format!("{FORMAT}\n").into_bytes()).await
    }
}
