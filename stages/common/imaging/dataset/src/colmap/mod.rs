//! Reads COLMAP reconstructions and the images that they name.

mod bytes;
mod camera;
mod model;
mod points;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail};
use artifact::{WARNING, format_count, relative_path};
use scene::Intrinsics;

use crate::dataset::Dataset;
use crate::error::{frame_label, images_missing};
use crate::file_status::{
    FileProblem, check_link, name_text, path_text, sub_folders, visible_entries,
};
use crate::format::Format;
use crate::frame::assign_names;
use crate::lookup::{Listings, Lookup, reduced_copies};
use crate::photograph::is_image_name;
use model::{Model, find_list};

/// Finds the models in `sparse` and its sub-folders, sorted by name. If there are none, the folder
/// itself may be a model, provided that it has photographs or a folder of photographs. If it isn't
/// a model but has a folder of photographs, searches `sparse` of each sub-folder without such a
/// folder: nerfstudio writes `colmap/sparse/0`.
pub(crate) fn find_models(folder: &Path) -> Result<Vec<PathBuf>, FileProblem> {
    let found = folders_with_list(folder, "images")?;
    if !found.is_empty() {
        return Ok(found);
    }
    let has_image_folder = has_images(folder);
    if is_model(folder)
        && (has_image_folder || visible_entries(folder).iter().any(|f| is_image_name(f)))
    {
        return Ok(vec![folder.to_path_buf()]);
    }
    if !has_image_folder {
        return Ok(found);
    }
    let mut sub_folders = visible_entries(folder);
    sub_folders.retain(|path| !has_images(path));
    let mut models = Vec::new();
    for path in &sub_folders {
        models.extend(folders_with_list(path, "images")?);
    }
    Ok(models)
}

/// True if a folder has COLMAP's lists of images and cameras.
pub(crate) fn is_model(folder: &Path) -> bool {
    ["images", "cameras"].iter().all(|name| matches!(find_list(folder, name), Ok(Some(_))))
}

/// Returns whether an image of the first model exists, even in a wrong sub-folder. Also true if
/// there is no model, or if it can't be read.
pub(crate) fn has_photographs(folder: &Path) -> bool {
    let mut model = Model::default();
    let models = find_models(folder).unwrap_or_default();
    if models.first().is_none_or(|first| model.read_images(first).is_err()) {
        return true;
    }
    let names: Vec<&str> = model.images.iter().map(|image| image.name.as_str()).collect();
    let mut lookup = Lookup::in_images(folder, &names);
    names.iter().any(|name| lookup.find(name).is_ok())
        || names.first().is_some_and(|first| folder_of_image(folder, first).is_some())
}

/// True if a folder has COLMAP's usual folder of photographs, `images` or a reduced copy.
fn has_images(folder: &Path) -> bool {
    folder.join("images").is_dir() || !reduced_copies(&mut Listings::new(folder)).is_empty()
}

/// Returns the image names of the first model in `sparse`, if any.
pub(crate) fn image_names(folder: &Path) -> anyhow::Result<Vec<String>> {
    let mut model = Model::default();
    if let Some(first) = folders_with_list(folder, "images")?.first() {
        model.read_images(first)?;
    }
    Ok(model.images.into_iter().map(|image| image.name).collect())
}

/// Returns the cameras of the first model in `sparse`. The model's images aren't read.
pub(crate) fn read_cameras(folder: &Path) -> anyhow::Result<Vec<Intrinsics>> {
    let mut model = Model::default();
    if let Some(first) = folders_with_list(folder, "cameras")?.first() {
        model.read_cameras(first)?;
    }
    Ok(model.cameras.into_values().collect())
}

/// Returns `sparse` and its sub-folders that contain the list `NAME.bin` or `NAME.txt`, sorted.
fn folders_with_list(folder: &Path, name: &str) -> Result<Vec<PathBuf>, FileProblem> {
    let sparse = folder.join("sparse");
    check_link(&sparse)?;
    let mut candidates = visible_entries(&sparse);
    candidates.insert(0, sparse);
    let mut found = Vec::new();
    for path in candidates {
        if find_list(&path, name)?.is_some() {
            found.push(path);
        }
    }
    Ok(found)
}

/// Reads the model with the most images (the first one, if several have as many), and finds the
/// files of its images.
pub(crate) fn read(folder: &Path) -> anyhow::Result<Dataset> {
    let models = find_models(folder)?;
    let (path, mut model, choice) = read_largest_model(folder, &models)?;
    let far_points = model.remove_far_points();
    // COLMAP's order of registration is arbitrary.
    model.images.sort_by(|a, b| a.name.cmp(&b.name));
    let list = find_list(path, "images")?.unwrap_or_else(|| path.to_path_buf());
    check_link(&folder.join("images"))?;
    let image_names: Vec<&str> = model.images.iter().map(|image| image.name.as_str()).collect();
    let mut lookup = Lookup::in_images(folder, &image_names);
    let (mut frames, mut labels, mut missing) = (Vec::new(), Vec::new(), Vec::new());
    let mut files = Vec::new();
    for (index, image) in model.images.iter().enumerate() {
        let label = || frame_label(&list, index, &image.name);
        let file = match lookup.find(&image.name) {
            Err(error) if error.is_missing() => {
                missing.push(&image.name);
                continue;
            }
            found => found.with_context(label)?,
        };
        frames.push(model.frame(image, folder.join(&file.path)).with_context(label)?);
        labels.push(lookup.without_base(&file.label));
        files.push(file.path);
    }
    if frames.is_empty() {
        bail!(no_photographs(&lookup, &missing).context(path_text(&list)));
    }
    let name = path.strip_prefix(folder).map(path_text).unwrap_or_default();
    let name = if name.is_empty() { "the folder itself" } else { &name };
    let mut notes =
        vec![format!("COLMAP: {} from {name}", format_count(frames.len(), "photograph"))];
    notes.extend(choice.into_iter().chain(far_points));
    if let Some(first) = missing.first() {
        notes.push(format!(
            "{} of {} images have no image file and are skipped (first: {first})",
            missing.len(),
            model.images.len()
        ));
    }
    notes.extend(unregistered_note(folder, &files));
    notes.extend(lookup.notes());
    assign_names(&mut frames, &list, &labels)?;
    Ok(Dataset { format: Format::Colmap, frames, split: None, notes })
}

/// Returns the error for a model without any existing image. The error names the sub-folder that
/// contains the first image, if there is one.
fn no_photographs(lookup: &Lookup, missing: &[&String]) -> anyhow::Error {
    let Some(first) = missing.first() else {
        return anyhow!("the model has no images; at least one is required");
    };
    let reason = images_missing(missing.len(), Some(&lookup.base()), first);
    match folder_of_image(lookup.root(), first) {
        Some(found) => {
            let name = name_text(&found);
            anyhow!("{reason}; the image is in {name}: rename this folder to images")
        }
        None => reason,
    }
}

/// Finds the sub-folder that contains an image.
fn folder_of_image(folder: &Path, image: &str) -> Option<PathBuf> {
    let image = relative_path(image).ok()?;
    sub_folders(folder).into_iter().find(|path| path.join(&image).is_file())
}

/// Maximum ratio of all photographs to those without a camera at which the note is a warning.
const MAX_PHOTOGRAPHS_PER_UNREGISTERED: usize = 10;

/// Returns the note on photographs without a camera in the folders of the model's `files`, if there
/// are any. Only files with the same extension count: masks and depth images usually have another
/// one.
fn unregistered_note(folder: &Path, files: &[PathBuf]) -> Option<String> {
    let used: BTreeSet<&PathBuf> = files.iter().collect();
    let kinds: BTreeSet<_> = files.iter().map(|file| (file.parent(), file.extension())).collect();
    let folders: BTreeSet<&Path> = files.iter().filter_map(|file| file.parent()).collect();
    let mut listings = Listings::new(folder);
    let (mut count, mut unregistered) = (0, Vec::new());
    for parent in folders {
        let photographs = listings.names(parent).into_iter().map(|name| parent.join(name));
        for file in photographs.filter(|file| kinds.contains(&(file.parent(), file.extension()))) {
            count += 1;
            if !used.contains(&file) {
                unregistered.push(file);
            }
        }
    }
    let first = path_text(unregistered.first()?);
    let is_many = MAX_PHOTOGRAPHS_PER_UNREGISTERED * unregistered.len() >= count;
    let (warning, photographs) =
        (if is_many { WARNING } else { "" }, format_count(count, "photograph"));
    let have = if unregistered.len() == 1 { "has" } else { "have" };
    Some(format!(
        "{warning}{} of {photographs} {have} no camera (first: {first})",
        unregistered.len()
    ))
}

/// Reads the model with the most images (the first one, if several have as many). Returns the
/// model's folder, the model, and a note on the choice among several.
fn read_largest_model<'a>(
    folder: &Path,
    models: &'a [PathBuf],
) -> anyhow::Result<(&'a Path, Model, Option<String>)> {
    let mut largest: Option<(&Path, Model)> = None;
    let mut sizes = Vec::new();
    for path in models {
        let model = Model::read(path)?;
        let name = path.strip_prefix(folder).unwrap_or(path).display();
        sizes.push(format!("{name} has {}", model.images.len()));
        if largest.as_ref().is_none_or(|(_, best)| model.images.len() > best.images.len()) {
            largest = Some((path, model));
        }
    }
    let (path, model) = largest.context("no COLMAP model found")?;
    let choice = (models.len() > 1).then(|| {
        let (count, sizes) = (models.len(), sizes.join(", "));
        format!("{count} models; using the one with the most images ({sizes})")
    });
    Ok((path, model, choice))
}

#[cfg(test)]
mod tests;
