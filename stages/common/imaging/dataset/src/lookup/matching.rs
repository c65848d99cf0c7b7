use std::path::{Path, PathBuf};

use crate::lookup::listings::{Listings, composed};
use crate::photograph::{IMAGE_EXTENSIONS, is_image_name};
use crate::unsupported::is_unsupported_name;

/// Differences between a listed name and a file's name that a step of the lookup tolerates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Tolerance {
    /// True for a missing, doubled or converted extension.
    pub(super) extension: bool,
    /// True for a differing Unicode normal form, also in folders.
    pub(super) form: bool,
    /// True for differing case, also in folders.
    pub(super) case: bool,
}

impl Tolerance {
    pub(super) const NONE: Self = Self { extension: false, form: false, case: false };
    const EXTENSION: Self = Self { extension: true, ..Self::NONE };
    /// All tolerances, in the order of the attempts.
    pub(super) const STEPS: [Self; 8] = [
        Self::NONE,
        Self::EXTENSION,
        Self { form: true, ..Self::NONE },
        Self { form: true, ..Self::EXTENSION },
        Self { case: true, ..Self::NONE },
        Self { case: true, ..Self::EXTENSION },
        Self { form: true, case: true, ..Self::NONE },
        Self { form: true, case: true, ..Self::EXTENSION },
    ];

    /// Returns a name without the differences in form and case that are tolerated.
    fn folded(self, name: &str) -> String {
        let name = if self.form { composed(name) } else { name.to_owned() };
        if self.case { name.to_lowercase() } else { name }
    }
}

/// Extensions that a file may have instead of the listed one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extensions {
    /// The listed name with an image extension added, the second of two removed, or an unsupported
    /// format's replaced.
    Similar,
    /// Any image extension: reduced copies often have another format.
    Any,
}

/// File name to try for a listed name: the stem must match, the extension may be in any case.
struct Variant {
    stem: String,
    extension: &'static str,
}

/// Returns the files that match a path, sorted.
pub(super) fn candidates(
    listings: &mut Listings,
    path: &Path,
    tolerance: Tolerance,
    extensions: Extensions,
) -> Vec<PathBuf> {
    if tolerance == Tolerance::NONE {
        return if listings.is_file(path) { vec![path.to_path_buf()] } else { Vec::new() };
    }
    let (Some(name), Some(parent)) = (path.file_name().and_then(|n| n.to_str()), path.parent())
    else {
        return Vec::new();
    };
    let variants = if tolerance.extension {
        variants(name, extensions)
    } else {
        vec![Variant { stem: name.to_owned(), extension: "" }]
    };
    let mut found = Vec::new();
    for folder in matching_folders(listings, parent, tolerance) {
        for Variant { stem, extension } in &variants {
            let folded_stem = tolerance.folded(stem);
            for name in listings.variants(&folder, &format!("{stem}{extension}")) {
                let file = folder.join(&name);
                let has_stem = tolerance.folded(&name).starts_with(&folded_stem);
                if has_stem && listings.is_file(&file) {
                    found.push(file);
                }
            }
        }
    }
    found.sort();
    found.dedup();
    found
}

/// Returns the folders that match a path.
fn matching_folders(listings: &mut Listings, path: &Path, tolerance: Tolerance) -> Vec<PathBuf> {
    if !tolerance.form && !tolerance.case {
        return vec![path.to_path_buf()];
    }
    let mut found = vec![PathBuf::new()];
    for part in path.iter() {
        // Listings contain only UTF-8 names.
        let Some(part) = part.to_str() else { return Vec::new() };
        let mut below = Vec::new();
        for folder in &found {
            let mut names = listings.variants(folder, part);
            names.retain(|name| tolerance.folded(name) == tolerance.folded(part));
            below.extend(names.iter().map(|name| folder.join(name)));
        }
        found = below;
    }
    found
}

fn with_each_extension(stem: &str) -> Vec<Variant> {
    IMAGE_EXTENSIONS.map(|extension| Variant { stem: stem.to_owned(), extension }).into()
}

fn variants(name: &str, extensions: Extensions) -> Vec<Variant> {
    let path = Path::new(name);
    let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or(name);
    if extensions == Extensions::Any && is_image_name(path) || is_unsupported_name(path) {
        return with_each_extension(stem);
    }
    let mut found = with_each_extension(name);
    // Listed name `a.png.png` of the file `a.png`.
    if is_image_name(path) && is_image_name(Path::new(stem)) {
        found.push(Variant { stem: stem.to_owned(), extension: "" });
    }
    found
}

/// Splits an absolute path into folders and file name, as in `C:\Users\x\a.png` or
/// `/home/x/a.png`; `None` for a relative path.
pub(super) fn absolute_parts(text: &str) -> Option<Vec<&str>> {
    let is_absolute =
        text.starts_with(['/', '\\']) || text.split(['/', '\\']).next().is_some_and(is_drive);
    let parts = parts(text);
    (is_absolute && !parts.is_empty()).then_some(parts)
}

/// Splits a path without `..`; `None` for others.
pub(super) fn inside_parts(text: &str) -> Option<Vec<&str>> {
    let parts = parts(text);
    (!parts.is_empty() && !parts.contains(&"..")).then_some(parts)
}

/// Splits a path into folders and file name, with either kind of slash.
fn parts(text: &str) -> Vec<&str> {
    text.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".").collect()
}

fn is_drive(part: &str) -> bool {
    matches!(part.as_bytes(), [letter, b':'] if letter.is_ascii_alphabetic())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variant_names(name: &str, extensions: Extensions) -> Vec<String> {
        let file_name = |v: Variant| format!("{}{}", v.stem, v.extension);
        variants(name, extensions).into_iter().map(file_name).collect()
    }

    #[test]
    fn extensions_are_added_removed_or_replaced() {
        for (name, expected) in [
            ("r.0", vec!["r.0.png", "r.0.jpg", "r.0.jpeg", "r.0.exr"]),
            ("a.PNG", vec!["a.PNG.png", "a.PNG.jpg", "a.PNG.jpeg", "a.PNG.exr"]),
            (
                "a.jpg.png",
                vec!["a.jpg.png.png", "a.jpg.png.jpg", "a.jpg.png.jpeg", "a.jpg.png.exr", "a.jpg"],
            ),
            ("a.HEIC", vec!["a.png", "a.jpg", "a.jpeg", "a.exr"]),
        ] {
            assert_eq!(variant_names(name, Extensions::Similar), expected);
        }
        let any = ["a.png", "a.jpg", "a.jpeg", "a.exr"];
        assert_eq!(variant_names("a.JPG", Extensions::Any), any);
        assert_eq!(variant_names("a", Extensions::Any), any);
    }

    #[test]
    fn absolute_paths_of_any_system_are_split() {
        for (text, parts) in [
            (r"C:\Users\x\a.png", Some(vec!["C:", "Users", "x", "a.png"])),
            ("d:/x//a.png", Some(vec!["d:", "x", "a.png"])),
            (r"\\server\share\a.png", Some(vec!["server", "share", "a.png"])),
            ("/home/./x/a.png", Some(vec!["home", "x", "a.png"])),
            ("images/a.png", None),
            (r"images\a.png", None),
            ("CC:/a.png", None),
            ("", None),
            ("/", None),
        ] {
            assert_eq!(absolute_parts(text), parts, "{text}");
        }
    }
}
