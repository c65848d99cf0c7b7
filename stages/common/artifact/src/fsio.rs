use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use serde::Serialize;

/// Writes a file atomically and durably (temporary file, fsync, rename, fsync of the folder):
/// readers see the old or the new content.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut temporary = temporary(0o666).suffix(".partial").tempfile_in(folder)?;
    temporary.write_all(bytes)?;
    temporary.as_file().sync_all()?;
    temporary.persist(path).map_err(|e| e.error)?;
    sync_folder(folder)
}

/// Returns a builder of hidden temporary files (mode 0o666) or folders (0o777). Their permissions
/// follow the umask, so that a group can share them; those of `tempfile` are the owner's only.
pub fn temporary(mode: u32) -> tempfile::Builder<'static, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".").permissions(fs::Permissions::from_mode(mode));
    builder
}

/// Writes a value as indented JSON with a final line feed, the form of all JSON files for users.
pub fn write_json(path: &Path, value: &impl Serialize) -> io::Result<()> {
    fs::write(path, json_text(value)?)
}

/// Writes a value like [`write_json`], but atomically ([`write_atomically`]).
pub fn write_json_atomically(path: &Path, value: &impl Serialize) -> io::Result<()> {
    write_atomically(path, json_text(value)?.as_bytes())
}

fn json_text(value: &impl Serialize) -> io::Result<String> {
    Ok(serde_json::to_string_pretty(value)? + "\n")
}

/// Makes renames in `folder` durable.
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
