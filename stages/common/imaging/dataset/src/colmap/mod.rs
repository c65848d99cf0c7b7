//! Reads COLMAP reconstructions and the images that they name.

mod bytes;
mod camera;
mod model;
mod points;

use std::path::{Path, PathBuf};

use artifact::format_count;
use scene::Intrinsics;

use crate::dataset::Dataset;
use crate::error::{DatasetError, Problem, Reason};
use crate::file_status::{check_link, is_file, visible_entries};
use crate::format::Format;
use crate::frame::assign_names;
use crate::lookup::{Listings, Located, Lookup, reduced_copies};
use model::Model;

/// Finds the models in `sparse` and its sub-folders, sorted by name. If there are none and the
/// folder has photographs, searches the `sparse` of each sub-folder without photographs: nerfstudio
/// writes `colmap/sparse/0`.
pub(crate) fn find_models(folder: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let found = folders_with_list(folder, "images")?;
    if !found.is_empty() || !has_images(folder) {
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

/// True if a folder has COLMAP's usual folder of photographs, `images` or a reduced copy.
fn has_images(folder: &Path) -> bool {
    folder.join("images").is_dir() || !reduced_copies(&mut Listings::new(folder)).is_empty()
}

/// Returns the image names of the first model in `sparse`, if any.
pub(crate) fn image_names(folder: &Path) -> Result<Vec<String>, DatasetError> {
    let mut model = Model::default();
    if let Some(first) = folders_with_list(folder, "images")?.first() {
        model.read_images(first)?;
    }
    Ok(model.images.into_iter().map(|image| image.name).collect())
}

/// Returns the cameras of the first model in `sparse`. The model's images aren't read.
pub(crate) fn read_cameras(folder: &Path) -> Result<Vec<Intrinsics>, DatasetError> {
    let mut model = Model::default();
    if let Some(first) = folders_with_list(folder, "cameras")?.first() {
        model.read_cameras(first)?;
    }
    Ok(model.cameras.into_values().collect())
}

/// Returns `sparse` and its sub-folders that contain the list `NAME.bin` or `NAME.txt`, sorted.
fn folders_with_list(folder: &Path, name: &str) -> Result<Vec<PathBuf>, DatasetError> {
    let sparse = folder.join("sparse");
    check_link(&sparse)?;
    let mut candidates = visible_entries(&sparse);
    candidates.insert(0, sparse);
    let mut found = Vec::new();
    for path in candidates {
        let list = path.join(name);
        if is_file(&list.with_extension("bin"))? || is_file(&list.with_extension("txt"))? {
            found.push(path);
        }
    }
    Ok(found)
}

/// Reads the model with the most images (the first one, if several have as many), and finds the
/// files of its images.
pub(crate) fn read(folder: &Path) -> Result<Dataset, DatasetError> {
    let models = find_models(folder)?;
    let (path, mut model, mut notes) = read_largest_model(folder, &models)?;
    notes.extend(model.remove_far_points());
    // COLMAP's order of registration is arbitrary.
    model.images.sort_by(|a, b| a.name.cmp(&b.name));
    let list =
        path.join(if path.join("images.bin").is_file() { "images.bin" } else { "images.txt" });
    check_link(&folder.join("images"))?;
    let image_names: Vec<&str> = model.images.iter().map(|image| image.name.as_str()).collect();
    let mut lookup = Lookup::in_images(folder, &image_names);
    let (mut frames, mut labels, mut missing) = (Vec::new(), Vec::new(), Vec::new());
    for (index, image) in model.images.iter().enumerate() {
        let frame_error = |reason| DatasetError::frame(&list, index, &image.name, reason);
        match lookup.find(&image.name).map_err(|e| frame_error(e.into()))? {
            Located::File(file) => {
                frames.push(model.frame(image, folder.join(&file.path)).map_err(frame_error)?);
                labels.push(lookup.without_base(&file.label));
            }
            Located::Missing(_) => missing.push(&image.name),
            Located::Unusable(problem) => {
                let remedy = "put the photograph there";
                return Err(frame_error(Reason::unusable(&problem, remedy)));
            }
        }
    }
    if frames.is_empty() {
        let reason = match missing.first() {
            Some(first) => Reason::images_missing(missing.len(), Some(&lookup.base()), first),
            None => Reason::new("the model has no images; at least one is required"),
        };
        return Err(DatasetError::format(&list, reason));
    }
    if let Some(first) = missing.first() {
        notes.push(format!(
            "{} of {} images have no image file and are skipped (first: {first})",
            missing.len(),
            model.images.len()
        ));
    }
    notes.extend(lookup.notes());
    assign_names(&mut frames, &list, &labels)?;
    Ok(Dataset { format: Format::Colmap, frames, split: None, notes })
}

/// Reads the model with the most images (the first one, if several have as many). Returns the
/// model's folder, the model, and notes on the choice.
fn read_largest_model<'a>(
    folder: &Path,
    models: &'a [PathBuf],
) -> Result<(&'a Path, Model, Vec<String>), DatasetError> {
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
    let (path, model) = largest
        .ok_or_else(|| Problem::Unrecognised { path: folder.to_path_buf(), finding: None })?;
    let photographs = format_count(model.images.len(), "photograph");
    let name = path.strip_prefix(folder).unwrap_or(path).display();
    let mut notes = vec![format!("COLMAP: {photographs} from {name}")];
    if models.len() > 1 {
        notes.push(format!(
            "{} models; using the one with the most images ({})",
            models.len(),
            sizes.join(", ")
        ));
    }
    Ok((path, model, notes))
}

#[cfg(test)]
mod tests;
