//! Images in a folder that has no cameras.

use std::path::Path;

const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "exr", "tif", "tiff"];

/// Images of a folder, or of `images` in it.
pub(crate) struct Pictures {
    pub(crate) count: usize,
    /// Whether they are in `images`, where COLMAP's form has them.
    in_place: bool,
}

impl Pictures {
    pub(crate) fn of(folder: &Path) -> Self {
        let beside = count(&folder.join("images"));
        if beside > 0 {
            return Self { count: beside, in_place: true };
        }
        Self { count: count(folder), in_place: false }
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

fn count(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter(|entry| is_image(&entry.path())).count()
}

fn is_image(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    EXTENSIONS.contains(&extension.to_ascii_lowercase().as_str())
}
