//! Explains why a folder is no data set, and finds data sets near it.

use std::path::{Path, PathBuf};

use artifact::nearest;

use crate::file_status::{path_text, visible_entries};
use crate::find_format;
use crate::format::Format;

/// Maximum number of folders two levels below that are searched: a home folder may have many.
/// Chosen by hand.
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
        return Some(format!("expected a folder, found a file; give its folder {parent}"));
    }
    find_export(folder)
        .or_else(|| find_misnamed(folder))
        .or_else(|| find_below(folder))
        .or_else(|| find_above(folder))
}

/// Describes an export of an application, identified by the file or folder `sign`; `remedy`
/// converts the export.
fn export_text(application: &str, sign: &Path, remedy: &str) -> String {
    let sign = path_text(sign);
    format!("found a {application} export ({sign}), which is not supported; {remedy}")
}

/// Describes data sets in other folders; `None` if there are none.
fn sets_text(sets: &[(PathBuf, Format)]) -> Option<String> {
    let listed = sets.iter().take(MAX_LISTED);
    let listed: Vec<String> = listed
        .map(|(folder, format)| format!("{} in {}", format.title(), path_text(folder)))
        .collect();
    let more = sets.len().saturating_sub(MAX_LISTED);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let choice = if sets.len() == 1 { "that folder" } else { "one of these folders" };
    (!sets.is_empty()).then(|| format!("found {}{more}; give {choice}", listed.join(", ")))
}

fn parent_folder(path: &Path) -> PathBuf {
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    parent.unwrap_or(Path::new(".")).to_path_buf()
}

fn sub_folders(folder: &Path) -> Vec<PathBuf> {
    visible_entries(folder).into_iter().filter(|path| path.is_dir()).collect()
}

fn name_text(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension))
}

/// Recognises exports of Polycam and Record3D, also in a folder's only sub-folder, as in an
/// archive.
fn find_export(folder: &Path) -> Option<String> {
    let mut candidates = vec![folder.to_path_buf()];
    if let [only] = &sub_folders(folder)[..] {
        candidates.push(only.clone());
    }
    candidates.iter().find_map(|folder| find_polycam(folder).or_else(|| find_record3d(folder)))
}

fn find_polycam(folder: &Path) -> Option<String> {
    let (data, keyframes) = if name_text(folder) == "keyframes" {
        (parent_folder(folder), folder.to_path_buf())
    } else {
        (folder.to_path_buf(), folder.join("keyframes"))
    };
    let mut cameras = ["corrected_cameras", "cameras"].map(|name| keyframes.join(name)).into_iter();
    let sign =
        cameras.find(|path| visible_entries(path).iter().any(|e| has_extension(e, "json")))?;
    Some(export_text("Polycam", &sign, &conversion("polycam", &data)))
}

fn find_record3d(folder: &Path) -> Option<String> {
    let [has_exr, has_rgbd, has_rgb, has_depth, has_metadata, has_json] =
        ["EXR_RGBD", "rgbd", "rgb", "depth", "metadata", "metadata.json"]
            .map(|name| folder.join(name).exists());
    let sign = if has_exr {
        folder.join("EXR_RGBD")
    } else if has_rgbd && has_metadata {
        folder.join("rgbd")
    } else if has_rgb && has_depth && (has_json || has_metadata) {
        folder.join("rgb")
    } else {
        visible_entries(folder).into_iter().find(|path| has_extension(path, "r3d"))?
    };
    let data = if has_exr { sign.clone() } else { folder.to_path_buf() };
    let command = conversion("record3d", &data);
    let is_video = has_extension(&sign, "r3d") || name_text(&sign) == "rgbd";
    let remedy = if is_video {
        format!("export it from Record3D as EXR + JPG sequence, then {command}")
    } else {
        command
    };
    Some(export_text("Record3D", &sign, &remedy))
}

/// Returns nerfstudio's command that converts an application's export to a data set.
fn conversion(application: &str, data: &Path) -> String {
    let mut output = data.as_os_str().to_owned();
    output.push("-nerfstudio");
    format!(
        "convert: ns-process-data {application} --data {} --output-dir {}",
        shell_quoted(data),
        shell_quoted(Path::new(&output))
    )
}

fn shell_quoted(path: &Path) -> String {
    format!("'{}'", path_text(path).replace('\'', r"'\''"))
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

/// True if a folder or a sub-folder has COLMAP's list of images.
fn has_model(folder: &Path) -> bool {
    has_image_list(folder) || sub_folders(folder).iter().any(|path| has_image_list(path))
}

fn has_image_list(folder: &Path) -> bool {
    ["images.bin", "images.txt"].iter().any(|name| folder.join(name).is_file())
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

fn sets_of(folders: &[PathBuf]) -> Vec<(PathBuf, Format)> {
    let mut sets = Vec::new();
    for folder in folders {
        // Folders that can't be read are not suggested.
        if let Ok(Some(format)) = find_format(folder) {
            sets.push((folder.clone(), format));
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
