//! Folders near a data set: what they contain instead, and what to do.

use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};

use artifact::nearest;

use crate::format::Format;
use crate::found::is_hidden;
use crate::misplaced::shown;
use crate::present_format;

/// Maximum number of folders two levels below that are searched: a home folder may have many.
const MAX_FOLDERS: usize = 1000;
/// Data sets that a message lists.
const MAX_LISTED: usize = 3;
/// Files by which formats are recognised.
const SIGNS: [&str; 3] = ["transforms_train.json", "transforms.json", "poses_bounds.npy"];
/// Files of Blender's form that are no sign of it by themselves.
const PARTS: [&str; 2] = ["transforms_test.json", "transforms_val.json"];

/// Content of a folder that is no data set.
#[derive(Debug)]
pub enum Nearby {
    /// A file was given.
    File {
        /// Folder of the file.
        folder: PathBuf,
    },
    /// An application's own export.
    Export {
        /// Name of the application.
        application: &'static str,
        /// File or folder that tells.
        sign: PathBuf,
        /// Command or steps that make a data set of the export.
        remedy: String,
    },
    /// A file that is named almost as a data set's.
    Misspelt {
        /// Name of the file.
        found: String,
        /// Name of the data set's file.
        meant: &'static str,
    },
    /// Test views without training views.
    Incomplete {
        /// Name of the file of views.
        found: &'static str,
    },
    /// Data sets in folders below or above.
    Elsewhere {
        /// The folders, and their formats.
        sets: Vec<(PathBuf, Format)>,
    },
}

impl Display for Nearby {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { folder } => {
                write!(f, "a file was given; give its folder {}", shown(folder))
            }
            Self::Export { application, sign, remedy } => {
                write!(
                    f,
                    "found {application}'s own export ({}), which is not read; {remedy}",
                    shown(sign)
                )
            }
            Self::Misspelt { found, meant } => write!(f, "found {found}; did you mean {meant}?"),
            Self::Incomplete { found } => {
                write!(f, "found {found}, but no transforms_train.json with the training views")
            }
            Self::Elsewhere { sets } => {
                let listed = sets.iter().take(MAX_LISTED);
                let listed: Vec<String> = listed
                    .map(|(folder, format)| format!("{} in {}", format.title(), shown(folder)))
                    .collect();
                let more = sets.len().saturating_sub(MAX_LISTED);
                let more = if more > 0 { format!(" and {more} more") } else { String::new() };
                write!(f, "found {}{more}; give ", listed.join(", "))?;
                f.write_str(if sets.len() == 1 { "that folder" } else { "one of these folders" })
            }
        }
    }
}

impl Nearby {
    /// Looks for a data set, or for what may become one, in and around a folder.
    pub(crate) fn of(folder: &Path) -> Option<Self> {
        if folder.is_file() {
            return Some(Self::File { folder: folder_above(folder) });
        }
        export(folder)
            .or_else(|| misnamed(folder))
            .or_else(|| below(folder))
            .or_else(|| above(folder))
    }
}

/// Returns a folder's entries without those that begin with a dot, by name.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> =
        entries.map(|entry| entry.path()).filter(|path| !is_hidden(path)).collect();
    paths.sort();
    paths
}

fn folder_above(path: &Path) -> PathBuf {
    let above = path.parent().filter(|above| !above.as_os_str().is_empty());
    above.unwrap_or(Path::new(".")).to_path_buf()
}

fn folders(folder: &Path) -> Vec<PathBuf> {
    entries(folder).into_iter().filter(|path| path.is_dir()).collect()
}

fn text_of_name(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension))
}

/// Recognises Polycam's and Record3D's own exports, also in the one sub-folder of an archive.
fn export(folder: &Path) -> Option<Nearby> {
    let below = folders(folder);
    let inner = if below.len() == 1 { below } else { Vec::new() };
    [folder.to_path_buf()]
        .iter()
        .chain(&inner)
        .find_map(|place| polycam(place).or_else(|| record3d(place)))
}

fn polycam(folder: &Path) -> Option<Nearby> {
    let is_inside = text_of_name(folder) == "keyframes";
    let data = if is_inside { folder_above(folder) } else { folder.to_path_buf() };
    let keyframes = if is_inside { folder.to_path_buf() } else { folder.join("keyframes") };
    let mut cameras = ["corrected_cameras", "cameras"].map(|name| keyframes.join(name)).into_iter();
    let sign = cameras.find(|path| entries(path).iter().any(|e| has_extension(e, "json")))?;
    let remedy = converted("polycam", &data);
    Some(Nearby::Export { application: "Polycam", sign, remedy })
}

fn record3d(folder: &Path) -> Option<Nearby> {
    let has = |name: &str| folder.join(name).exists();
    let sign = if has("EXR_RGBD") {
        folder.join("EXR_RGBD")
    } else if has("rgbd") && has("metadata") {
        folder.join("rgbd")
    } else if has("rgb") && has("depth") && (has("metadata.json") || has("metadata")) {
        folder.join("rgb")
    } else {
        entries(folder).into_iter().find(|path| has_extension(path, "r3d"))?
    };
    let data = if text_of_name(&sign) == "EXR_RGBD" { sign.clone() } else { folder.to_path_buf() };
    let command = converted("record3d", &data);
    let is_video = has_extension(&sign, "r3d") || text_of_name(&sign) == "rgbd";
    let remedy = if is_video {
        format!("export it from Record3D as EXR + JPG sequence, then {command}")
    } else {
        command
    };
    Some(Nearby::Export { application: "Record3D", sign, remedy })
}

/// Returns nerfstudio's command that makes a data set of an application's export.
fn converted(application: &str, data: &Path) -> String {
    let quoted = |path: &Path| format!("'{}'", shown(path).replace('\'', r"'\''"));
    let mut output = data.as_os_str().to_owned();
    output.push("-nerfstudio");
    format!(
        "convert: ns-process-data {application} --data {} --output-dir {}",
        quoted(data),
        quoted(Path::new(&output))
    )
}

/// Recognises names that are almost a data set's.
fn misnamed(folder: &Path) -> Option<Nearby> {
    let entries = entries(folder);
    if let Some(found) = PARTS.into_iter().find(|part| folder.join(part).is_file()) {
        return Some(Nearby::Incomplete { found });
    }
    for path in &entries {
        let name = text_of_name(path);
        let meant = if path.is_dir() {
            nearest(name, ["sparse"]).filter(|_| has_model(path))
        } else {
            nearest(name, SIGNS)
        };
        if let Some(meant) = meant {
            return Some(Nearby::Misspelt { found: name.to_owned(), meant });
        }
    }
    None
}

/// True if a folder, or one in it, has COLMAP's list of images.
fn has_model(folder: &Path) -> bool {
    let has_list = |path: &Path| {
        ["bin", "txt"].iter().any(|e| path.join("images").with_extension(e).is_file())
    };
    has_list(folder) || folders(folder).iter().any(|path| has_list(path))
}

/// Finds data sets one level below a folder, or else two.
fn below(folder: &Path) -> Option<Nearby> {
    let near = folders(folder);
    let sets = sets_of(&near);
    if !sets.is_empty() {
        return Some(Nearby::Elsewhere { sets });
    }
    let far: Vec<PathBuf> = near.iter().flat_map(|path| folders(path)).take(MAX_FOLDERS).collect();
    let sets = sets_of(&far);
    (!sets.is_empty()).then_some(Nearby::Elsewhere { sets })
}

/// Finds the data set that a folder such as `images` or `sparse/0` belongs to.
fn above(folder: &Path) -> Option<Nearby> {
    let folder = folder.canonicalize().ok()?;
    let above: Vec<PathBuf> = folder.ancestors().skip(1).take(2).map(Path::to_path_buf).collect();
    let mut sets = sets_of(&above);
    sets.truncate(1);
    (!sets.is_empty()).then_some(Nearby::Elsewhere { sets })
}

fn sets_of(folders: &[PathBuf]) -> Vec<(PathBuf, Format)> {
    let mut sets = Vec::new();
    for folder in folders {
        // What can't be looked at is no data set to suggest.
        if let Ok(Some(format)) = present_format(folder) {
            sets.push((folder.clone(), format));
        }
    }
    sets
}

/// Returns the file that is almost named `transforms_test.json`.
pub(crate) fn misspelt_test_file(folder: &Path) -> Option<String> {
    let known = ["transforms_train.json", "transforms_val.json", "transforms.json", PARTS[0]];
    let names = entries(folder);
    let mut names =
        names.iter().map(|path| text_of_name(path)).filter(|name| !known.contains(name));
    names.find(|name| nearest(name, known) == Some(PARTS[0])).map(str::to_owned)
}
