//! Explains why a folder is no data set, and finds data sets near it.

use std::path::{Path, PathBuf};

use artifact::nearest;

use crate::colmap;
use crate::conversion::{find_export, find_packed, packed_text};
use crate::file_status::{name_text, parent_folder, path_text, sub_folders, visible_entries};
use crate::find_format;
use crate::format::Format;
use crate::photograph::is_image_name;

/// Maximum number of folders that are searched on the second level below a folder, and on the
/// third: a home folder may have many. Chosen by hand.
const MAX_FOLDERS: usize = 1000;
/// Maximum number of data sets that a message lists.
const MAX_LISTED: usize = 3;
/// Files of the Blender format that don't identify it.
const PARTS: [&str; 2] = ["transforms_test.json", "transforms_val.json"];

/// Searches in and around a folder for a data set, or for something that may become one. Returns
/// what was found, with the remedy.
pub(crate) fn find_nearby(folder: &Path) -> Option<String> {
    if folder.is_file() {
        let parent = parent_folder(folder);
        let parent = path_text(&parent);
        return packed_text(folder).or_else(|| {
            Some(format!("expected a folder, found a file; give its folder {parent}"))
        });
    }
    find_export(folder)
        .or_else(|| find_misnamed(folder))
        .or_else(|| find_below(folder))
        .or_else(|| find_above(folder))
        .or_else(|| find_model(folder))
        .or_else(|| find_packed(folder))
}

/// Lists data sets, with the remedy; `None` if there are none.
fn sets_text(sets: &[String]) -> Option<String> {
    let listed = &sets[..sets.len().min(MAX_LISTED)];
    let more = sets.len() - listed.len();
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let choice = if sets.len() == 1 { "that folder" } else { "one of these folders" };
    (!sets.is_empty()).then(|| format!("found {}{more}; give {choice}", listed.join(", ")))
}

/// Recognises files and folders whose name is similar to a name that a data set uses.
fn find_misnamed(folder: &Path) -> Option<String> {
    if let Some(found) = PARTS.into_iter().find(|part| folder.join(part).is_file()) {
        return Some(format!(
            "found {found}, but no transforms_train.json with the training views"
        ));
    }
    for path in &visible_entries(folder) {
        let name = name_text(path);
        let meant = if path.is_dir() {
            nearest(name, ["sparse"]).filter(|_| has_model(path))
        } else {
            nearest(name, Format::ALL.into_iter().filter_map(Format::file))
        };
        if let Some(meant) = meant {
            return Some(format!("found {name}; did you mean {meant}?"));
        }
    }
    None
}

/// True if a folder or a sub-folder has a COLMAP model.
fn has_model(folder: &Path) -> bool {
    colmap::is_model(folder) || sub_folders(folder).iter().any(|path| colmap::is_model(path))
}

/// Finds a COLMAP model outside `sparse`, at most three levels below a folder, and the folder's
/// images. 3D Gaussian Splatting has `distorted/sparse/0` next to `input`.
fn find_model(folder: &Path) -> Option<String> {
    let near = sub_folders(folder);
    let mut level = near.clone();
    let mut model = None;
    for _ in 0..3 {
        model = model.or_else(|| level.iter().find(|path| colmap::is_model(path)).cloned());
        level = level.iter().flat_map(|path| sub_folders(path)).take(MAX_FOLDERS).collect();
    }
    let relative = |path: &Path| path_text(path.strip_prefix(folder).unwrap_or(path));
    let found = format!("found a COLMAP model in {}", relative(&model?));
    let has_images = |path: &&PathBuf| visible_entries(path).iter().any(|f| is_image_name(f));
    let own = [folder.join("images"), folder.to_path_buf()];
    if own.iter().find(has_images).is_some() {
        return Some(format!("{found}; move it to sparse/0"));
    }
    Some(match near.iter().find(has_images) {
        Some(images) => format!(
            "{found} and images in {}; rename these folders to sparse/0 and images",
            relative(images)
        ),
        None => format!("{found}, but no images; put the model in sparse/0 next to images"),
    })
}

/// Finds data sets one level below a folder, otherwise two levels below.
fn find_below(folder: &Path) -> Option<String> {
    let near = sub_folders(folder);
    sets_text(&sets_of(&near)).or_else(|| {
        let far: Vec<PathBuf> =
            near.iter().flat_map(|path| sub_folders(path)).take(MAX_FOLDERS).collect();
        sets_text(&sets_of(&far))
    })
}

/// Finds the data set that contains a folder such as `images` or `sparse/0`.
fn find_above(folder: &Path) -> Option<String> {
    let folder = folder.canonicalize().ok()?;
    let above: Vec<PathBuf> = folder.ancestors().skip(1).take(2).map(Path::to_path_buf).collect();
    let mut sets = sets_of(&above);
    sets.truncate(1);
    sets_text(&sets)
}

/// Describes the folders that are data sets.
fn sets_of(folders: &[PathBuf]) -> Vec<String> {
    let mut sets = Vec::new();
    for folder in folders {
        // Folders that can't be read, and models without their images, are not suggested.
        if let Ok(Some(format)) = find_format(folder)
            && (format != Format::Colmap || colmap::has_photographs(folder))
        {
            sets.push(format!("{} in {}", format.title(), path_text(folder)));
        }
    }
    sets
}

/// Finds a file with almost the name `transforms_test.json`.
pub(crate) fn find_misspelt_test_file(folder: &Path) -> Option<String> {
    let known = ["transforms_train.json", "transforms_val.json", "transforms.json", PARTS[0]];
    let names = visible_entries(folder);
    let mut names = names.iter().map(|path| name_text(path)).filter(|name| !known.contains(name));
    names.find(|name| nearest(name, known) == Some(PARTS[0])).map(str::to_owned)
}
