use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use serde::Serialize;

/// Writes a file so that a reader sees the old or the new content, never a part: temporary file,
/// fsync, rename, fsync of the folder.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut temporary = temporary(0o666).suffix(".partial").tempfile_in(folder)?;
    temporary.write_all(bytes)?;
    temporary.as_file().sync_all()?;
    temporary.persist(path).map_err(|e| e.error)?;
    sync_folder(folder)
}

/// What makes a hidden temporary file (mode 0o666) or folder (0o777) whose permissions are left to
/// the umask, so that a group can share what becomes of it; tempfile's own are the owner's alone.
pub fn temporary(mode: u32) -> tempfile::Builder<'static, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".").permissions(fs::Permissions::from_mode(mode));
    builder
}

/// Writes a value as indented JSON that ends in a line feed: the form of every JSON file people may
/// open.
pub fn write_json(path: &Path, value: &impl Serialize) -> io::Result<()> {
    fs::write(path, json_text(value)?)
}

/// Writes a value as [`write_json`] does, whole or not at all ([`write_atomically`]).
pub fn write_json_atomically(path: &Path, value: &impl Serialize) -> io::Result<()> {
    write_atomically(path, json_text(value)?.as_bytes())
}

fn json_text(value: &impl Serialize) -> io::Result<String> {
    Ok(serde_json::to_string_pretty(value)? + "\n")
}

/// Makes a rename in `folder` durable.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn permissions_are_left_to_the_umask() {
        let dir = tempfile::tempdir().unwrap();
        let place = |name: &str| dir.path().join(name);
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        fs::write(place("plain"), "").unwrap();
        write_atomically(&place("atomic"), b"").unwrap();
        assert_eq!(mode(&place("atomic")), mode(&place("plain")));
        fs::create_dir(place("folder")).unwrap();
        let temporary = temporary(0o777).tempdir_in(dir.path()).unwrap();
        assert_eq!(mode(temporary.path()), mode(&place("folder")));
    }
}
