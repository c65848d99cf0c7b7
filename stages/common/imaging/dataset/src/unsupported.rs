//! Image formats that aren't supported, and the commands that convert them.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use pixels::PixelError;

/// Image format that isn't supported.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct UnsupportedFormat {
    name: &'static str,
    extensions: &'static [&'static str],
    /// Format to convert to, with options: JPEG for phone photographs.
    target: &'static str,
}

const FORMATS: [UnsupportedFormat; 6] = [
    format("HEIC", &["heic", "heif", "hif"], "jpg -quality 98"),
    format("AVIF", &["avif"], "png"),
    format("WebP", &["webp"], "png"),
    format("TIFF", &["tif", "tiff"], "png"),
    format("BMP", &["bmp"], "png"),
    format("GIF", &["gif"], "png"),
];

const fn format(
    name: &'static str,
    extensions: &'static [&'static str],
    target: &'static str,
) -> UnsupportedFormat {
    UnsupportedFormat { name, extensions, target }
}

/// Number of bytes at a file's start that identify its format.
const SIGNATURE_BYTES: usize = 12;

impl UnsupportedFormat {
    fn from_name(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?.to_ascii_lowercase();
        FORMATS.into_iter().find(|format| format.extensions.contains(&extension.as_str()))
    }

    fn from_signature(bytes: &[u8; SIGNATURE_BYTES]) -> Option<Self> {
        let name = match bytes {
            [_, _, _, _, b'f', b't', b'y', b'p', b'a', b'v', b'i', _] => "AVIF",
            [_, _, _, _, b'f', b't', b'y', b'p', b'h' | b'm', ..] => "HEIC",
            [b'R', b'I', b'F', b'F', _, _, _, _, b'W', b'E', b'B', b'P'] => "WebP",
            [b'I', b'I', b'*', 0, ..] | [b'M', b'M', 0, b'*', ..] => "TIFF",
            [b'B', b'M', ..] => "BMP",
            [b'G', b'I', b'F', b'8', ..] => "GIF",
            _ => return None,
        };
        FORMATS.into_iter().find(|format| format.name == name)
    }

    /// Returns the command that converts all files with the folder and extension of one of `paths`.
    fn command<'a>(self, paths: impl Iterator<Item = &'a Path>) -> String {
        let patterns: BTreeSet<String> = paths.map(pattern_of).collect();
        let patterns: Vec<String> = patterns.into_iter().collect();
        format!("magick mogrify -format {} {}", self.target, patterns.join(" "))
    }
}

/// Returns the shell pattern of the files with the same folder and extension as `path`.
fn pattern_of(path: &Path) -> String {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new(".")).display().to_string().replace('\'', r"'\''");
    match path.extension().and_then(|extension| extension.to_str()) {
        Some(extension) => format!("'{folder}'/*.{extension}"),
        None => format!("'{folder}'/*"),
    }
}

/// True if a file's name is that of an image in an unsupported format.
pub fn is_unsupported_name(path: &Path) -> bool {
    UnsupportedFormat::from_name(path).is_some()
}

/// Returns the error for an image in an unsupported format, recognised by content, otherwise by
/// name.
pub(crate) fn unsupported_error(path: &Path) -> Option<PixelError> {
    let mut bytes = [0; SIGNATURE_BYTES];
    let is_read = File::open(path).and_then(|mut file| file.read_exact(&mut bytes)).is_ok();
    let format = UnsupportedFormat::from_signature(&bytes).filter(|_| is_read);
    let format = format.or_else(|| UnsupportedFormat::from_name(path))?;
    let article = if format.name.starts_with('A') { "an" } else { "a" };
    Some(PixelError::Unsupported(format!(
        "{} is {article} {} image, which is not supported; convert: {}",
        path.display(),
        format.name,
        format.command([path].into_iter())
    )))
}

/// Returns the format of the first unsupported image among files, the number of images in that
/// format, and the command that converts them; `None` if there are none.
pub fn unsupported_summary(files: &[PathBuf]) -> Option<String> {
    let first = files.iter().find(|path| is_unsupported_name(path))?;
    let format = UnsupportedFormat::from_name(first)?;
    let is_same = |path: &&PathBuf| {
        UnsupportedFormat::from_name(path).is_some_and(|other| other.name == format.name)
    };
    let images: Vec<&PathBuf> = files.iter().filter(is_same).collect();
    Some(format!(
        "{} in {}, which is not supported; convert: {}",
        images.len(),
        format.name,
        format.command(images.iter().map(|path| path.as_path()))
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_recognised_by_content_and_by_name() {
        let dir = tempfile::tempdir().unwrap();
        for (name, bytes, format) in [
            ("a.png", &b"RIFF\x10\0\0\0WEBPVP8 "[..], "WebP"),
            ("a.heic", b"\0\0\0\x18ftypheic\0\0\0\0", "HEIC"),
            ("b", b"\0\0\0\x18ftypmif1\0\0\0\0", "HEIC"),
            ("c.avif", b"\0\0\0\x18ftypavif\0\0\0\0", "AVIF"),
            ("a.tif", b"II*\0\x08\0\0\0\0\0\0\0", "TIFF"),
            ("b.tiff", b"MM\0*\0\0\0\x08\0\0\0\0", "TIFF"),
            ("a.bmp", b"BM\x46\0\0\0\0\0\0\0\x36\0", "BMP"),
            ("a.gif", b"GIF89a\0\0\0\0\0\0", "GIF"),
            ("short.WEBP", b"", "WebP"),
        ] {
            let path = dir.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let message = unsupported_error(&path).unwrap().to_string();
            let article = if format == "AVIF" { "an" } else { "a" };
            assert!(message.contains(&format!("{name} is {article} {format} image")), "{message}");
        }
        let png = dir.path().join("d.png");
        std::fs::write(&png, b"\x89PNG\r\n\x1a\n\0\0\0\0").unwrap();
        assert!(unsupported_error(&png).is_none());
        assert!(unsupported_error(&dir.path().join("gone.png")).is_none());
    }

    #[test]
    fn paths_in_commands_are_quoted() {
        assert_eq!(
            FORMATS[0].command([Path::new("/data/Tom's set/IMG 1.HEIC")].into_iter()),
            r"magick mogrify -format jpg -quality 98 '/data/Tom'\''s set'/*.HEIC"
        );
        let files = ["a.HEIC", "b.heic", "c.HEIC"].map(PathBuf::from);
        assert_eq!(
            unsupported_summary(&files).unwrap(),
            "3 in HEIC, which is not supported; convert: magick mogrify -format jpg -quality 98 \
            './'*.HEIC './'*.heic"
                .replace("'./'", "'.'/")
        );
    }
}
