//! Images in a folder that has no cameras.

use std::path::{Path, PathBuf};

use artifact::counted;
use dataset::{is_image_name, is_unread_name, unread_images};

/// Images of a folder, or of `images` in it.
pub(crate) struct Pictures {
    files: Vec<PathBuf>,
    /// True if they are in `images`, where COLMAP's form has them.
    in_place: bool,
}

impl Pictures {
    pub(crate) fn of(folder: &Path) -> Self {
        let beside = images(&folder.join("images"));
        if !beside.is_empty() {
            return Self { files: beside, in_place: true };
        }
        Self { files: images(folder), in_place: false }
    }

    /// Returns the number of images.
    pub(crate) fn count(&self) -> usize {
        self.files.len()
    }

    /// Returns the number of images, with the command that converts those that aren't read.
    pub(crate) fn found(&self) -> String {
        let images = counted(self.files.len(), "image");
        match unread_images(&self.files) {
            Some(unread) => format!("{images} ({unread})"),
            None => images,
        }
    }

    /// The commands after which the folder has cameras.
    pub(crate) fn command(&self, folder: &Path) -> String {
        let folder = folder.display().to_string().replace('\'', r"'\''");
        let moved = if self.in_place {
            String::new()
        } else {
            format!("move them to '{folder}/images', then ")
        };
        format!(
            "{moved}`colmap automatic_reconstructor --workspace_path '{folder}' --image_path \
            '{folder}/images' --dense 0`"
        )
    }
}

/// Returns a folder's images by name, in any format that is known.
fn images(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> =
        entries.map(|entry| entry.path()).filter(|path| is_image(path)).collect();
    files.sort();
    files
}

fn is_image(path: &Path) -> bool {
    let is_hidden = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
    !is_hidden && (is_image_name(path) || is_unread_name(path))
}
