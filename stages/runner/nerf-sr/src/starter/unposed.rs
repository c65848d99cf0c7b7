//! Images in a folder that has no cameras.

use std::path::{Path, PathBuf};

use artifact::format_count;
use dataset::{is_image_name, is_unsupported_name, unsupported_summary};

/// Names of folders for images; COLMAP's format expects them in the first. The empty name is that
/// of the data set's folder itself.
const FOLDERS: [&str; 6] = ["images", "", "image", "input", "photos", "rgb"];

/// Images of a folder, or of a subfolder for images.
pub(crate) struct UnposedImages {
    /// Paths, sorted.
    pub(crate) files: Vec<PathBuf>,
    /// Name of the subfolder, one of [`FOLDERS`].
    subfolder: &'static str,
}

impl UnposedImages {
    /// Finds the images of a folder; `None` if there are none.
    pub(crate) fn find(folder: &Path) -> Option<Self> {
        FOLDERS
            .iter()
            .map(|subfolder| Self { files: list_images(&folder.join(subfolder)), subfolder })
            .find(|images| !images.files.is_empty())
    }

    /// Returns the number of images as text, with the command that converts images of unsupported
    /// formats.
    pub(crate) fn summary(&self) -> String {
        let images = format_count(self.files.len(), "image");
        match unsupported_summary(&self.files) {
            Some(unsupported) => format!("{images} ({unsupported})"),
            None => images,
        }
    }

    /// Returns the instructions for estimating cameras with COLMAP.
    pub(crate) fn colmap_instructions(&self, folder: &Path) -> String {
        let folder = folder.display().to_string().replace('\'', r"'\''");
        let moved = match self.subfolder {
            "images" => String::new(),
            "" => format!("move them to '{folder}/images', then "),
            other => format!("rename '{folder}/{other}' '{folder}/images', then "),
        };
        format!(
            "{moved}`colmap automatic_reconstructor --workspace_path '{folder}' --image_path \
            '{folder}/images' --dense 0`"
        )
    }
}

/// Returns a folder's images, sorted by name, including images of unsupported formats.
fn list_images(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> =
        entries.map(|entry| entry.path()).filter(|path| is_image(path)).collect();
    files.sort();
    files
}

fn is_image(path: &Path) -> bool {
    let is_hidden = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
    !is_hidden && (is_image_name(path) || is_unsupported_name(path))
}
