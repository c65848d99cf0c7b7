use std::ffi::OsStr;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

/// True if a file in a user's folder is neither hashed nor read: a link to nothing, or a file by
/// which [`has_passed_over_name`] knows an editor or a system.
pub(crate) fn is_passed_over(path: &Path) -> bool {
    path.file_name().is_some_and(has_passed_over_name) || is_dangling(path)
}

/// True if a name is that of an editor's lock or swap file (`.#x` of Emacs, `.~lock.x#` of
/// LibreOffice, `.x.swp` of Vim), or of what macOS leaves (`.DS_Store`, `._x`). Such files come and
/// go with the program, and are no part of a data set.
pub fn has_passed_over_name(name: &OsStr) -> bool {
    let name = name.as_encoded_bytes();
    let (is_lock, is_swap) = (name.starts_with(b".~lock."), name.ends_with(b".swp"));
    name == b".DS_Store"
        || name.starts_with(b".#")
        || name.starts_with(b"._")
        || (is_lock && name.ends_with(b"#"))
        || (is_swap && name.starts_with(b"."))
}

/// True for a link whose target isn't there. A target that can't be reached for another reason is
/// no such target.
fn is_dangling(path: &Path) -> bool {
    let is_link = fs::symlink_metadata(path).is_ok_and(|link| link.is_symlink());
    is_link && fs::metadata(path).is_err_and(|error| error.kind() == ErrorKind::NotFound)
}
