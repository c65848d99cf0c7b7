use std::collections::BTreeMap;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use artifact::{Failure, FileEntry, bail_bad_input, bail_usage, one_line};
use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::aws::AmazonS3Builder;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{
    ClientOptions, GetResult, ObjectStore, ObjectStoreExt as _, PutPayload, RetryConfig,
};
use store::FORMAT;

use crate::folder::{ACTIONS, Folder, Listing};

/// Maximum time without data from a server. Chosen by hand.
const READ_TIMEOUT: Duration = Duration::from_secs(60);
/// Maximum total time of retries after transient errors. Chosen by hand.
const MAX_RETRY_TIME: Duration = Duration::from_secs(60);
/// Maximum number of retries after transient errors. Chosen by hand.
const MAX_RETRIES: usize = 6;
/// Maximum size of the file `format`, in bytes.
const MAX_FORMAT_BYTES: u64 = 100;

/// Remote with the layout of a store: a folder, or a prefix in an S3 bucket.
#[derive(Clone, Debug)]
pub(crate) struct Remote {
    pub(crate) files: Arc<dyn ObjectStore>,
    /// Folder of the remote; `None` for a server.
    folder: Option<Folder>,
    prefix: Path,
    name: String,
    /// Likely cause of failed requests, for messages.
    hint: &'static str,
}

/// Environment variables with credentials, one of which is usually set.
const CREDENTIAL_VARIABLES: [&str; 5] = [
    "AWS_ACCESS_KEY_ID",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    "AWS_SKIP_SIGNATURE",
];
/// Hint of a failed request if no credentials are set.
const NO_CREDENTIALS_HINT: &str =
    " (AWS_ACCESS_KEY_ID is not set, so the machine's role was requested)";

/// Kind of access to a remote.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Access {
    Read,
    Write,
}

impl Remote {
    /// Opens a remote. For writing, a missing folder is created.
    pub(crate) fn open(location: &str, access: Access) -> anyhow::Result<Self> {
        let name = location.trim_end_matches('/').to_owned();
        match location.split_once("://") {
            Some(("s3", rest)) => Self::open_s3(rest.trim_end_matches('/'), name),
            Some((scheme, _)) => {
                let message = format!(
                    "{location}: unknown scheme {scheme}://; a remote is a folder or \
                    s3://bucket/prefix"
                );
                Err(Failure::Usage(message).into())
            }
            None => Self::open_folder(FilePath::new(location), name, access),
        }
    }

    fn open_folder(folder: &FilePath, name: String, access: Access) -> anyhow::Result<Self> {
        if access == Access::Write {
            if folder.join("locks").exists() {
                bail_usage!(
                    "{name}: the folder is a store, which only nerf-sr may write; choose another \
                    folder"
                );
            }
            std::fs::create_dir_all(folder).with_context(|| name.clone())?;
        } else if !folder.is_dir() {
            bail_bad_input!("{name}: no such folder");
        }
        // Without fsync, a record could survive a power failure, but not its artifact.
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

    /// Opens a prefix of an S3 bucket; credentials, region and endpoint come from `AWS_…`
    /// variables.
    fn open_s3(rest: &str, name: String) -> anyhow::Result<Self> {
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        if bucket.is_empty() {
            bail_usage!("{name}: bucket missing; a remote is a folder or s3://bucket/prefix");
        }
        // An error means that another provider is installed, which works, too.
        rustls::crypto::ring::default_provider().install_default().ok();
        let endpoint = ["AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"]
            .into_iter()
            .find_map(|v| std::env::var(v).ok());
        // A timeout for complete requests would stop large files on slow connections.
        let client = ClientOptions::new().with_timeout_disabled().with_read_timeout(READ_TIMEOUT);
        let is_http = endpoint.is_some_and(|endpoint| endpoint.starts_with("http://"));
        let retry = RetryConfig {
            max_retries: MAX_RETRIES,
            retry_timeout: MAX_RETRY_TIME,
            ..RetryConfig::default()
        };
        let builder = AmazonS3Builder::from_env()
            .with_bucket_name(bucket)
            .with_client_options(client)
            .with_allow_http(is_http);
        let files = builder.with_retry(retry).build().with_context(|| name.clone())?;
        let prefix = Path::parse(prefix).with_context(|| name.clone())?;
        let has_credentials =
            CREDENTIAL_VARIABLES.iter().any(|name| std::env::var_os(name).is_some());
        let hint = if has_credentials { "" } else { NO_CREDENTIALS_HINT };
        Ok(Self { files: Arc::new(files), folder: None, prefix, name, hint })
    }

    /// Returns the path of a file. A path with characters that a server or a file system may not
    /// support is percent-encoded.
    pub(crate) fn path(&self, file: &str) -> Path {
        let needs_encoding =
            file.contains(|c: char| c.is_control() || "%#\\?*:<>|\"{}[]^`~".contains(c));
        let path = if needs_encoding { None } else { Path::parse(file).ok() };
        let path = path.unwrap_or_else(|| Path::from(file));
        self.prefix.parts().chain(path.parts()).collect()
    }

    /// Returns the name of a file in messages; of the remote if `file` is empty.
    pub(crate) fn name(&self, file: &str) -> String {
        if file.is_empty() { self.name.clone() } else { format!("{}/{file}", self.name) }
    }

    /// Returns the name of a file whose request failed, with a hint about the cause.
    pub(crate) fn name_with_hint(&self, file: &str) -> String {
        format!("{}{}", self.name(file), self.hint)
    }

    /// Converts the error of reading a file. In a folder, the error concerns only this file and is
    /// bad input; a server that fails after all retries would fail for all files.
    pub(crate) fn read_error(&self, file: &str, error: object_store::Error) -> anyhow::Error {
        match self.folder {
            Some(_) => {
                let problem = format!("{}: {}", self.name(file), one_line(&error.into()));
                Failure::BadInput(problem).into()
            }
            None => anyhow::Error::new(error).context(self.name_with_hint(file)),
        }
    }

    /// Opens a file; `None` if it is not found.
    pub(crate) async fn get(&self, file: &str) -> anyhow::Result<Option<GetResult>> {
        let path = self.path(file);
        if let Some(folder) = &self.folder
            && !folder.has_file(&path, &self.name(file))?
        {
            return Ok(None);
        }
        match self.files.get(&path).await {
            Ok(found) => Ok(Some(found)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.read_error(file, error)),
        }
    }

    /// Reads a file of at most `max_bytes`; a larger one is damaged or hostile.
    pub(crate) async fn read(&self, file: &str, max_bytes: u64) -> anyhow::Result<Option<Vec<u8>>> {
        let Some(found) = self.get(file).await? else { return Ok(None) };
        let mut bytes = Vec::new();
        let mut stream = found.into_stream();
        while let Some(piece) = stream.next().await {
            bytes.extend_from_slice(&piece.map_err(|e| self.read_error(file, e))?);
            if bytes.len() as u64 > max_bytes {
                bail_bad_input!("{}: more than {max_bytes} bytes", self.name(file));
            }
        }
        Ok(Some(bytes))
    }

    /// Writes a file atomically.
    pub(crate) async fn write(&self, file: &str, bytes: Vec<u8>) -> anyhow::Result<()> {
        let staged = self.staged_path(file);
        let written = self.files.put(&staged, PutPayload::from(bytes)).await;
        written.with_context(|| self.name_with_hint(file))?;
        self.publish(&staged, file).await
    }

    /// Returns the path of a file until [`Remote::publish`] moves the file to its final path.
    pub(crate) fn staged_path(&self, file: &str) -> Path {
        self.folder.as_ref().and_then(Folder::staged_path).unwrap_or_else(|| self.path(file))
    }

    /// Moves a complete file to its final path, which a server has done already.
    pub(crate) async fn publish(&self, staged: &Path, file: &str) -> anyhow::Result<()> {
        if self.folder.is_none() {
            return Ok(());
        }
        let renamed = self.files.rename(staged, &self.path(file)).await;
        renamed.with_context(|| self.name_with_hint(file))
    }

    /// Lists the files below a folder of a server, with sizes in bytes.
    async fn list(&self, folder: &str) -> anyhow::Result<BTreeMap<Path, u64>> {
        let entries =
            self.files.list(Some(&self.path(folder))).map_ok(|meta| (meta.location, meta.size));
        entries.try_collect().await.with_context(|| self.name_with_hint(folder))
    }

    /// Takes those files out of the list that the remote has in the folder `object` with the same
    /// size, and returns them.
    pub(crate) async fn take_existing(
        &self,
        object: &str,
        files: &mut Vec<FileEntry>,
    ) -> anyhow::Result<Vec<FileEntry>> {
        let sizes = match &self.folder {
            Some(_) => BTreeMap::new(),
            None => self.list(object).await?,
        };
        let existing = files.extract_if(.., |file| {
            let path = self.path(&format!("{object}/{}", file.path));
            match &self.folder {
                Some(folder) => folder.has_file_of_size(&path, file.size),
                None => sizes.get(&path) == Some(&file.size),
            }
        });
        Ok(existing.collect())
    }

    /// Lists the records.
    pub(crate) async fn records(&self) -> anyhow::Result<Listing> {
        let mut listing = match &self.folder {
            Some(folder) => folder.records()?,
            None => self.list_server_records().await?,
        };
        listing.sort();
        Ok(listing)
    }

    async fn list_server_records(&self) -> anyhow::Result<Listing> {
        let actions = self.path(ACTIONS);
        let mut listing = Listing::default();
        for path in self.list(ACTIONS).await?.into_keys() {
            let relative: Vec<_> = path.prefix_match(&actions).into_iter().flatten().collect();
            match &relative[..] {
                // Some programs store an empty object for a folder.
                [] => {}
                [name] => listing.add(name.as_ref()),
                _ => listing.invalid.push(path.to_string()),
            }
        }
        Ok(listing)
    }

    /// Checks the remote's format. Fails for a newer one, and when reading for a missing one. When
    /// writing, marks a remote of an older or without a format.
    pub(crate) async fn check_format(&self, access: Access) -> anyhow::Result<()> {
        let bytes = match self.read("format", MAX_FORMAT_BYTES).await? {
            Some(bytes) => bytes,
            None if access == Access::Write => return self.mark().await,
            None => {
                bail_bad_input!("{}: nothing was pushed here: file `format` not found", self.name);
            }
        };
        let text = String::from_utf8_lossy(&bytes);
        match text.trim().parse::<u32>() {
            Ok(found) if found < FORMAT && access == Access::Write => self.mark().await,
            Ok(found) if found <= FORMAT => Ok(()),
            _ => Err(Failure::BadInput(format!(
                "{}: the remote has format {}, this nerf-sr-remote supports format {FORMAT}; \
                use the newer nerf-sr-remote, or another remote",
                self.name,
                text.trim()
            ))
            .into()),
        }
    }

    /// Marks the remote with this program's format.
    async fn mark(&self) -> anyhow::Result<()> {
        self.write("format", format!("{FORMAT}\n").into_bytes()).await
    }
}
