use std::path::{Path, PathBuf};

use crate::lookup::listings::Listings;
use crate::photograph::{IMAGE_EXTENSIONS, is_image_name};
use crate::unread::is_unread_name;

/// Differences between a written name and a file's name that a step of the lookup tolerates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Tolerance {
    /// A missing, doubled or converted extension.
    pub(super) extension: bool,
    /// Upper case for lower case, also in folders.
    pub(super) case: bool,
}

impl Tolerance {
    pub(super) const NONE: Self = Self { extension: false, case: false };
    /// In the order in which they are tried.
    pub(super) const STEPS: [Self; 4] = [
        Self::NONE,
        Self { extension: true, case: false },
        Self { extension: false, case: true },
        Self { extension: true, case: true },
    ];
}

/// Extensions that a file may have instead of the written one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extensions {
    /// One more or one less, or that of a converted image.
    Slips,
    /// Any image's: reduced copies are often stored in another format.
    Any,
}

/// File name that stands for a written one: a stem that has to match, and an extension that may be
/// in either case.
struct Variant {
    stem: String,
    extension: &'static str,
}

/// Returns the files that a path may mean, sorted.
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
    for folder in folders(listings, parent, tolerance.case) {
        for Variant { stem, extension } in &variants {
            for same in listings.alike(&folder, &format!("{stem}{extension}")) {
                let file = folder.join(&same);
                if (tolerance.case || same.starts_with(stem.as_str())) && listings.is_file(&file) {
                    found.push(file);
                }
            }
        }
    }
    found.sort();
    found.dedup();
    found
}

/// Returns the folders that a path may mean.
fn folders(listings: &mut Listings, path: &Path, any_case: bool) -> Vec<PathBuf> {
    if !any_case {
        return vec![path.to_path_buf()];
    }
    let mut found = vec![PathBuf::new()];
    for part in path.iter().filter_map(|part| part.to_str()) {
        let mut below = Vec::new();
        for folder in &found {
            below.extend(listings.alike(folder, part).iter().map(|same| folder.join(same)));
        }
        found = below;
    }
    found
}

fn variants(name: &str, extensions: Extensions) -> Vec<Variant> {
    let with_each =
        |stem: &str| IMAGE_EXTENSIONS.map(|extension| Variant { stem: stem.to_owned(), extension });
    let path = Path::new(name);
    let stem = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or(name);
    if extensions == Extensions::Any && is_image_name(path) || is_unread_name(path) {
        return with_each(stem).into();
    }
    let mut found: Vec<Variant> = with_each(name).into();
    // `a.png.png` for `a.png`: the file lacks what the name has twice.
    if is_image_name(path) && is_image_name(Path::new(stem)) {
        found.push(Variant { stem: stem.to_owned(), extension: "" });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names_of(name: &str, extensions: Extensions) -> Vec<String> {
        let of = |v: Variant| format!("{}{}", v.stem, v.extension);
        variants(name, extensions).into_iter().map(of).collect()
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
            assert_eq!(names_of(name, Extensions::Slips), expected);
        }
        let any = ["a.png", "a.jpg", "a.jpeg", "a.exr"];
        assert_eq!(names_of("a.JPG", Extensions::Any), any);
        assert_eq!(names_of("a", Extensions::Any), any);
    }
}
