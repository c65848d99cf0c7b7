//! Warns about files that look like masks but that no view uses.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use artifact::{WARNING, format_count};

use crate::file_status::path_text;
use crate::format::Format;
use crate::frame::Frame;
use crate::lookup::Listings;
use crate::photograph::is_image_name;

/// Maximum depth of sub-folders to search in a folder of masks; chosen by hand.
const MAX_DEPTH: usize = 4;

/// Returns a warning for each folder with images that look like masks but aren't used: folders such
/// as `masks` next to the images' folders, and files such as `a_mask.png` next to images.
pub(crate) fn unused_mask_warnings(
    listings: &mut Listings,
    format: Format,
    frames: &[Frame],
) -> Vec<String> {
    let root = listings.root().to_path_buf();
    let (mut images, mut used): (BTreeSet<PathBuf>, BTreeSet<PathBuf>) = Default::default();
    for frame in frames {
        images.insert(relative(&root, &frame.image));
        used.extend(frame.mask.as_ref().map(|mask| relative(&root, &mask.path)));
    }
    let parents: BTreeSet<&Path> = images.iter().filter_map(|image| image.parent()).collect();
    let mut above: BTreeSet<&Path> = parents.iter().filter_map(|parent| parent.parent()).collect();
    above.insert(Path::new(""));
    let mut candidates: Vec<(PathBuf, Vec<PathBuf>)> = Vec::new();
    for folder in above {
        for name in listings.names(folder) {
            let path = folder.join(&name);
            let is_copy = !used.is_empty() && is_reduced_copy(&name);
            if looks_like_mask(&name) && !is_copy && listings.is_folder(&path) {
                candidates.push((path.clone(), images_in(listings, &path, MAX_DEPTH)));
            }
        }
    }
    for folder in parents {
        let mut files = images_in(listings, folder, 0);
        files.retain(|file| {
            file.file_stem().is_some_and(|stem| looks_like_mask(&stem.to_string_lossy()))
        });
        candidates.push((folder.to_path_buf(), files));
    }
    let mut warnings = Vec::new();
    for (folder, mut files) in candidates {
        files.retain(|file| !used.contains(file) && !images.contains(file));
        warnings.extend(warning(format, &folder, &files));
    }
    warnings
}

fn relative(root: &Path, path: &Path) -> PathBuf {
    path.strip_prefix(root).unwrap_or(path).to_path_buf()
}

fn warning(format: Format, folder: &Path, files: &[PathBuf]) -> Option<String> {
    let first = files.first()?;
    let count = format_count(files.len(), "unused file");
    let look_like = if files.len() == 1 { "looks like a mask" } else { "look like masks" };
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let remedy = if format.has_masks_folder() {
        "the mask of a photograph NAME.EXT must be called masks/NAME.png or masks/NAME.EXT.png"
    } else {
        "list masks as mask_path of their frames"
    };
    Some(format!(
        "{WARNING}{count} in {} {look_like} (first: {}); {remedy}",
        path_text(folder),
        path_text(first)
    ))
}

/// True if one of a name's words means a mask.
fn looks_like_mask(name: &str) -> bool {
    let lower = name.to_lowercase();
    let mut words = lower.split(|c: char| !c.is_alphabetic());
    words.any(|word| matches!(word, "mask" | "masks" | "segmentation" | "segmentations"))
}

/// True for nerfstudio's reduced copies of `masks`: `masks_2`, `masks_4` and so on.
fn is_reduced_copy(name: &str) -> bool {
    name.strip_prefix("masks_").is_some_and(|factor| factor.parse::<u32>().is_ok())
}

/// Returns the images in a folder and, down to a depth, in its sub-folders.
fn images_in(listings: &mut Listings, folder: &Path, depth: usize) -> Vec<PathBuf> {
    let names = listings.names(folder).into_iter();
    let (mut found, others): (Vec<PathBuf>, Vec<PathBuf>) =
        names.map(|name| folder.join(name)).partition(|path| is_image_name(path));
    for path in others {
        if depth > 0 && listings.is_folder(&path) {
            found.extend(images_in(listings, &path, depth - 1));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_masks_are_recognised() {
        for name in ["masks", "Mask", "a_mask", "a.mask", "mask001", "dynamic_mask_a", "masks_4"] {
            assert!(looks_like_mask(name), "{name}");
        }
        for name in ["unmasked", "masked_ball", "images", "a", "damask"] {
            assert!(!looks_like_mask(name), "{name}");
        }
    }
}
