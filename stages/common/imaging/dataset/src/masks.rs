//! Finds masks next to images, and logs which masks are used.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use artifact::{WARNING, format_count};

use crate::dataset::Dataset;
use crate::file_status::path_text;
use crate::frame::{Frame, Turn};
use crate::lookup::{Listings, LookupError};
use crate::photograph::{IMAGE_EXTENSIONS, has_aspect_of, read_header};
use crate::text::counted_with_verb;
use crate::unused_masks::unused_mask_warnings;

/// Mask of a photograph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskFile {
    /// Path of the mask's image.
    pub path: PathBuf,
    /// Convention by which the mask was found.
    pub kind: MaskKind,
}

/// Convention for masks of photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum MaskKind {
    /// `mask_path` of a frame (nerfstudio). Black is excluded.
    Listed,
    /// `masks/NAME.png` next to the images' folder. Black is excluded.
    Named,
    /// `masks/NAME.EXT.png` next to the images' folder (COLMAP). Black is excluded.
    NamedWithExtension,
    /// `dynamic_mask_NAME.png` next to the image (instant-ngp). White is excluded.
    Dynamic,
}

impl MaskKind {
    /// True if white, not black, is excluded.
    pub fn is_inverted(self) -> bool {
        self == Self::Dynamic
    }

    /// Returns the convention's name for the log.
    fn title(self) -> &'static str {
        match self {
            Self::Listed => "mask_path",
            Self::Named => "masks/NAME.png",
            Self::NamedWithExtension => "masks/NAME.EXT.png",
            Self::Dynamic => "dynamic_mask_NAME.png",
        }
    }
}

/// Folder of masks next to the images' folder.
const MASKS: &str = "masks";
/// Prefix of instant-ngp's mask names.
const DYNAMIC_PREFIX: &str = "dynamic_mask_";

/// Finds the masks of frames that don't name one, and adds notes on all masks.
pub(crate) fn add_masks(folder: &Path, set: &mut Dataset) -> anyhow::Result<()> {
    let mut listings = Listings::new(folder);
    let may_have_masks_folder = set.format.has_masks_folder();
    for frame in set.frames.iter_mut().filter(|frame| frame.mask.is_none()) {
        let Ok(image) = frame.image.strip_prefix(folder) else { continue };
        let found = find_mask(&mut listings, image, may_have_masks_folder)
            .with_context(|| path_text(&frame.image))?;
        frame.mask = found.map(|(path, kind)| MaskFile { path: folder.join(path), kind });
    }
    set.notes.extend(usage_note(&set.frames));
    set.notes.extend(size_notes(folder, &set.frames)?);
    set.notes.extend(unused_mask_warnings(&mut listings, set.format, &set.frames));
    Ok(())
}

/// Finds the mask of an image: `masks/NAME.png` or `masks/NAME.EXT.png`, otherwise instant-ngp's
/// `dynamic_mask_NAME.png`.
fn find_mask(
    listings: &mut Listings,
    image: &Path,
    may_have_masks_folder: bool,
) -> Result<Option<(PathBuf, MaskKind)>, LookupError> {
    let (Some(stem), Some(parent)) = (image.file_stem().and_then(|s| s.to_str()), image.parent())
    else {
        return Ok(None);
    };
    if may_have_masks_folder {
        let mut names = vec![(format!("{stem}.png"), MaskKind::Named)];
        for extension in IMAGE_EXTENSIONS {
            names.push((format!("{stem}{extension}.png"), MaskKind::NamedWithExtension));
        }
        let sub_folder = without_images_folder(parent);
        for masks in listings.variants(Path::new(""), MASKS) {
            let folder = Path::new(&masks).join(&sub_folder);
            if let Some(found) = find_single_file(listings, &folder, &names)? {
                return Ok(Some(found));
            }
        }
    }
    let name = format!("{DYNAMIC_PREFIX}{stem}.png");
    find_single_file(listings, parent, &[(name, MaskKind::Dynamic)])
}

/// Returns an image's folder relative to the images' folder.
fn without_images_folder(parent: &Path) -> PathBuf {
    let mut parts = parent.iter();
    let first = parts.next().and_then(|part| part.to_str()).unwrap_or_default();
    let lower_case = first.to_ascii_lowercase();
    let is_images = lower_case == "images" || lower_case.starts_with("images_");
    if is_images { parts.collect() } else { parent.to_path_buf() }
}

/// Finds the single file of a folder with one of the names, in any case and Unicode normal form;
/// fails if there are several.
fn find_single_file(
    listings: &mut Listings,
    folder: &Path,
    names: &[(String, MaskKind)],
) -> Result<Option<(PathBuf, MaskKind)>, LookupError> {
    let mut found: Vec<(PathBuf, MaskKind)> = Vec::new();
    for (name, kind) in names {
        for variant in listings.variants(folder, name) {
            let file = folder.join(variant);
            if listings.is_file(&file) {
                found.push((file, *kind));
            }
        }
    }
    found.sort();
    match &found[..] {
        [] => Ok(None),
        [only] => Ok(Some(only.clone())),
        [(first, _), (second, _), ..] => Err(LookupError::Ambiguous {
            name: path_text(&folder.join(&names[0].0)),
            first: first.clone(),
            second: second.clone(),
        }),
    }
}

/// Returns the note on the number of views with masks of each kind, if any.
fn usage_note(frames: &[Frame]) -> Option<String> {
    let mut kinds: BTreeMap<MaskKind, usize> = BTreeMap::new();
    for mask in frames.iter().filter_map(|frame| frame.mask.as_ref()) {
        *kinds.entry(mask.kind).or_default() += 1;
    }
    let masked: usize = kinds.values().sum();
    if masked == 0 {
        return None;
    }
    let mut parts = Vec::new();
    for (kind, count) in kinds {
        let colour = if kind.is_inverted() { "white" } else { "black" };
        parts.push(format!("{count} by {}, where {colour} is excluded", kind.title()));
    }
    let have = if masked == 1 { "has a mask" } else { "have masks" };
    let views = format_count(frames.len(), "view");
    Some(format!("{masked} of {views} {have} ({})", parts.join("; ")))
}

/// Returns a note on masks that differ from their photographs in size, and a warning about those
/// that differ in aspect ratio.
fn size_notes(folder: &Path, frames: &[Frame]) -> anyhow::Result<Vec<String>> {
    let (mut resized, mut distorted) = (Vec::new(), Vec::new());
    for frame in frames {
        let Some(mask) = &frame.mask else { continue };
        let stored = read_header(&mask.path)?;
        let (mut width, mut height) = stored.size;
        if frame.turn == Turn::Upright && stored.is_sideways() {
            (width, height) = (height, width);
        }
        let k = frame.lens_intrinsics;
        if (width, height) != (k.width, k.height) {
            let path = path_text(mask.path.strip_prefix(folder).unwrap_or(&mask.path));
            let sizes = format!("{path}: {width}×{height} for {}×{}", k.width, k.height);
            let has_same_aspect = has_aspect_of(&k, width, height);
            if has_same_aspect { &mut resized } else { &mut distorted }.push(sizes);
        }
    }
    let mut notes = Vec::new();
    for (prefix, property, masks) in [("", "size", resized), (WARNING, "aspect ratio", distorted)] {
        if let Some(first) = masks.first() {
            let subject = counted_with_verb(masks.len(), "mask", ["differs", "differ"]);
            notes.push(format!(
                "{prefix}{subject} from the photograph in {property}; resampled by nearest \
                neighbour (first: {first})"
            ));
        }
    }
    Ok(notes)
}

/// Returns a folder's images without instant-ngp's masks of these images.
pub(crate) fn without_dynamic_masks(mut images: Vec<PathBuf>) -> Vec<PathBuf> {
    let stems: BTreeSet<String> = images.iter().map(|path| lowercase_stem(path)).collect();
    images.retain(|path| {
        let stem = lowercase_stem(path);
        !stem.strip_prefix(DYNAMIC_PREFIX).is_some_and(|masked| stems.contains(masked))
    });
    images
}

fn lowercase_stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().to_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_images_folder_is_removed_in_any_case() {
        for (parent, expected) in
            [("images/a", "a"), ("Images_4/a", "a"), ("IMAGES", ""), ("other/a", "other/a")]
        {
            assert_eq!(without_images_folder(Path::new(parent)), Path::new(expected), "{parent}");
        }
    }
}
