//! Destination of an export.

use std::io;
use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, file_kind, sync_folder, temporary};
use tempfile::NamedTempFile;

use crate::folder::{Affixes, remove_leftovers};

/// Prefix and suffix of an unfinished archive's name.
const TEMPORARY_AFFIXES: Affixes = (".nerf-sr-export-", ".partial");

/// Path of an archive to be written.
#[derive(Clone, Copy)]
pub(crate) struct Destination<'a> {
    pub(crate) file: &'a Path,
    /// True if an existing regular file is replaced.
    pub(crate) force: bool,
}

impl Destination<'_> {
    fn name(&self) -> String {
        self.file.display().to_string()
    }

    fn folder(&self) -> &Path {
        self.file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }

    /// Fails if the path exists and may not be replaced. Only regular files may be replaced, since
    /// replacing a device or a link may have effects outside the folder.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let name = self.name();
        let problem = match self.file.symlink_metadata() {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(error).context(name),
            Ok(found) if !found.is_file() => format!(
                "{name} is {}; an archive replaces regular files only, choose another name",
                file_kind(found.file_type())
            ),
            Ok(_) if self.force => return Ok(()),
            Ok(_) => format!(
                "{name}: the file exists; choose another name, or replace the file with --force"
            ),
        };
        Err(Failure::Usage(problem).into())
    }

    /// Creates the temporary file that becomes the archive.
    pub(crate) fn begin(&self) -> anyhow::Result<NamedTempFile> {
        let folder = self.folder();
        remove_leftovers(folder, TEMPORARY_AFFIXES);
        let file = temporary(0o666)
            .prefix(TEMPORARY_AFFIXES.0)
            .suffix(TEMPORARY_AFFIXES.1)
            .tempfile_in(folder);
        file.with_context(|| folder.display().to_string())
    }

    /// Renames the finished archive to its destination. Without `force`, a file created there
    /// meanwhile is kept.
    pub(crate) fn finish(&self, archive: NamedTempFile) -> anyhow::Result<()> {
        archive.as_file().sync_all().with_context(|| self.name())?;
        self.check()?;
        let renamed = if self.force {
            archive.persist(self.file)
        } else {
            archive.persist_noclobber(self.file)
        };
        renamed.map_err(|e| e.error).with_context(|| self.name())?;
        sync_folder(self.folder()).with_context(|| self.name())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::io::Write as _;

    use super::*;

    /// A file that is created while the archive is written is replaced only with `force`.
    #[test]
    fn a_file_created_meanwhile_is_kept_without_force() {
        for force in [false, true] {
            let dir = tempfile::tempdir().unwrap();
            let file = dir.path().join("export.tar");
            let destination = Destination { file: &file, force };
            destination.check().unwrap();
            let mut archive = destination.begin().unwrap();
            archive.write_all(b"archive").unwrap();
            fs::write(&file, "precious").unwrap();
            let finished = destination.finish(archive);
            assert_eq!(finished.is_ok(), force);
            let expected = if force { "archive" } else { "precious" };
            assert_eq!(fs::read_to_string(&file).unwrap(), expected);
            assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        }
    }
}
