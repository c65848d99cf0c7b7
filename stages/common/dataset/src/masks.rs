//! Masks that lie next to images, and the log of all masks.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use artifact::{WARNING, counted};

use crate::dataset::Dataset;
use crate::error::DatasetError;
use crate::format::Format;
use crate::frame::Frame;
use crate::lookup::{Listings, LookupError};
use crate::mask_file::{MaskFile, MaskKind};
use crate::misplaced::shown;
use crate::photograph::{IMAGE_EXTENSIONS, has_shape_of, look};
use crate::turn::Turn;
use crate::unused_masks::unused_masks;

/// Folder of masks next to the images' folder.
const MASKS: &str = "masks";
/// Start of instant-ngp's names for masks.
const DYNAMIC_MASK: &str = "dynamic_mask_";

/// Finds the masks of frames that name none, and notes which masks are used.
pub(crate) fn add_masks(folder: &Path, set: &mut Dataset) -> Result<(), DatasetError> {
    let mut listings = Listings::new(folder);
    let has_masks_folder = matches!(set.format, Format::Llff | Format::Colmap);
    for frame in set.frames.iter_mut().filter(|frame| frame.mask.is_none()) {
        let Ok(image) = frame.image.strip_prefix(folder) else { continue };
        let found = mask_beside(&mut listings, image, has_masks_folder);
        let found = found.map_err(|reason| DatasetError::format(&frame.image, reason))?;
        frame.mask = found.map(|(path, kind)| MaskFile { path: folder.join(path), kind });
    }
    set.notes.extend(usage(&set.frames));
    set.notes.extend(sizes(folder, &set.frames)?);
    set.notes.extend(unused_masks(&mut listings, set.format, &set.frames));
    Ok(())
}

/// Finds the mask next to an image: `masks/NAME.png` or `masks/NAME.EXT.png`, or else instant-ngp's
/// `dynamic_mask_NAME.png`.
fn mask_beside(
    listings: &mut Listings,
    image: &Path,
    has_masks_folder: bool,
) -> Result<Option<(PathBuf, MaskKind)>, LookupError> {
    let (Some(stem), Some(parent)) = (image.file_stem().and_then(|s| s.to_str()), image.parent())
    else {
        return Ok(None);
    };
    let named = format!("{stem}.png");
    if has_masks_folder {
        let mut names = vec![(named.clone(), MaskKind::Named)];
        let long = IMAGE_EXTENSIONS.map(|extension| format!("{stem}{extension}.png"));
        names.extend(long.map(|name| (name, MaskKind::NamedWithExtension)));
        let inside = inside_images(parent);
        for masks in listings.alike(Path::new(""), MASKS) {
            if let Some(found) = only_file(listings, &Path::new(&masks).join(&inside), &names)? {
                return Ok(Some(found));
            }
        }
    }
    only_file(listings, parent, &[(format!("{DYNAMIC_MASK}{named}"), MaskKind::Dynamic)])
}

/// Returns the folder of an image inside the images' folder.
fn inside_images(parent: &Path) -> PathBuf {
    let mut parts = parent.iter();
    let first = parts.next().and_then(|part| part.to_str()).unwrap_or_default();
    let is_images = first.eq_ignore_ascii_case("images") || first.starts_with("images_");
    if is_images { parts.collect() } else { parent.to_path_buf() }
}

/// Returns the one file of a folder that has one of the names, in either case.
fn only_file(
    listings: &mut Listings,
    folder: &Path,
    names: &[(String, MaskKind)],
) -> Result<Option<(PathBuf, MaskKind)>, LookupError> {
    let mut found: Vec<(PathBuf, MaskKind)> = Vec::new();
    for (name, kind) in names {
        let files = listings.alike(folder, name).into_iter().map(|same| folder.join(same));
        let files: Vec<PathBuf> = files.filter(|file| listings.is_file(file)).collect();
        found.extend(files.into_iter().map(|file| (file, *kind)));
    }
    found.sort();
    match &found[..] {
        [] => Ok(None),
        [only] => Ok(Some(only.clone())),
        [(first, _), (second, _), ..] => Err(LookupError::Ambiguous {
            name: shown(&folder.join(&names[0].0)),
            first: first.clone(),
            second: second.clone(),
        }),
    }
}

/// Returns the line on how many views have masks of which kind.
fn usage(frames: &[Frame]) -> Option<String> {
    let mut kinds: BTreeMap<MaskKind, usize> = BTreeMap::new();
    for mask in frames.iter().filter_map(|frame| frame.mask.as_ref()) {
        *kinds.entry(mask.kind).or_default() += 1;
    }
    let masked: usize = kinds.values().sum();
    let whole = frames.len() - masked;
    if masked == 0 {
        return None;
    }
    let each: Vec<String> = kinds
        .iter()
        .map(|(kind, count)| {
            let colour = if kind.is_inverted() { "white" } else { "black" };
            format!("{} for {count}: {colour} is left out", kind.title())
        })
        .collect();
    let have = if masked == 1 { "has a mask" } else { "have masks" };
    let rest = match whole {
        0 => String::new(),
        1 => "; 1 is used whole".to_owned(),
        count => format!("; {count} are used whole"),
    };
    let views = counted(frames.len(), "view");
    Some(format!("{masked} of {views} {have}{rest} ({})", each.join(", ")))
}

/// Returns a line on masks of another size than their photographs', and one on masks of another
/// shape.
fn sizes(folder: &Path, frames: &[Frame]) -> Result<Vec<String>, DatasetError> {
    let (mut smaller, mut misshapen) = (Vec::new(), Vec::new());
    for frame in frames {
        let Some(mask) = &frame.mask else { continue };
        let stored = look(&mask.path)?;
        let (mut width, mut height) = stored.size;
        if frame.turn == Turn::Upright && stored.is_sideways() {
            (width, height) = (height, width);
        }
        let k = frame.taken_with;
        if (width, height) != (k.width, k.height) {
            let path = shown(mask.path.strip_prefix(folder).unwrap_or(&mask.path));
            let sizes = format!("{path}: {width}×{height} for {}×{}", k.width, k.height);
            let is_copy = has_shape_of(&k, width, height);
            if is_copy { &mut smaller } else { &mut misshapen }.push(sizes);
        }
    }
    let line = |warning: &str, what: &str, masks: &[String]| {
        let first = masks.first()?;
        let count = counted(masks.len(), "mask");
        let verb = if masks.len() == 1 { "has" } else { "have" };
        Some(format!(
            "{warning}{count} {verb} another {what} than the photograph; resampled by nearest \
            neighbour ({first})"
        ))
    };
    Ok([line("", "size", &smaller), line(WARNING, "shape", &misshapen)]
        .into_iter()
        .flatten()
        .collect())
}

/// Returns a folder's images without instant-ngp's masks of these images.
pub(crate) fn without_dynamic_masks(images: Vec<PathBuf>) -> Vec<PathBuf> {
    let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().to_lowercase();
    let stems: BTreeSet<String> = images.iter().map(|path| stem(path)).collect();
    let is_mask = |path: &Path| {
        stem(path).strip_prefix(DYNAMIC_MASK).is_some_and(|masked| stems.contains(masked))
    };
    images.into_iter().filter(|path| !is_mask(path)).collect()
}
