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

/// Formats a value like [`write_json`].
pub fn json_text(value: &impl Serialize) -> io::Result<String> {
    Ok(serde_json::to_string_pretty(value)? + "\n")
}

/// Makes renames in `folder` durable.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Formats a value as canonical JSON, the only form that is hashed: sorted keys, no white space,
/// numbers as `serde_json` prints them.
///
/// # Panics
/// If the value can't be JSON (a map whose keys aren't strings), which is a programming error.
pub fn canonical_json(value: &impl Serialize) -> String {
    let mut value = serde_json::to_value(value).expect("hashed types serialise to JSON");
    // `serde_json` keeps insertion order if any crate enables its `preserve_order`.
    value.sort_all_objects();
    value.to_string()
}

/// Hashes the [`canonical_json`] of a value: blake3, in hexadecimal.
pub fn hash_json(value: &impl Serialize) -> String {
    blake3::hash(canonical_json(value).as_bytes()).to_hex().to_string()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::Value;

    use super::*;

    #[test]
    fn permissions_are_left_to_the_umask() {
        let dir = tempfile::tempdir().unwrap();
        let path_of = |name: &str| dir.path().join(name);
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        fs::write(path_of("plain"), "").unwrap();
        write_atomically(&path_of("atomic"), b"").unwrap();
        assert_eq!(mode(&path_of("atomic")), mode(&path_of("plain")));
        fs::create_dir(path_of("folder")).unwrap();
        let temporary = temporary(0o777).tempdir_in(dir.path()).unwrap();
        assert_eq!(mode(temporary.path()), mode(&path_of("folder")));
    }

    fn any_json() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::from),
            any::<i64>().prop_map(Value::from),
            any::<f64>().prop_filter("finite", |x| x.is_finite()).prop_map(Value::from),
            ".*".prop_map(Value::from),
        ];
        leaf.prop_recursive(4, 32, 6, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..6).prop_map(Value::from),
                prop::collection::vec((".*", inner), 0..6)
                    .prop_map(|v| Value::Object(v.into_iter().collect())),
            ]
        })
    }

    proptest! {
        #[test]
        fn canonical_form_parses_back_and_is_stable(value in any_json()) {
            let text = canonical_json(&value);
            let parsed: Value = serde_json::from_str(&text).unwrap();
            prop_assert_eq!(&parsed, &value);
            prop_assert_eq!(canonical_json(&parsed), text);
        }

        #[test]
        fn key_order_does_not_matter(mut entries in prop::collection::btree_map(".*", any::<i32>(),
            0..8)) {
            let forward: serde_json::Map<_, _> = entries.iter().map(|(k, v)| (k.clone(),
                (*v).into())).collect();
            let mut backward = serde_json::Map::new();
            while let Some((k, v)) = entries.pop_last() {
                backward.insert(k, v.into());
            }
            prop_assert_eq!(hash_json(&forward), hash_json(&backward));
        }
    }
}
