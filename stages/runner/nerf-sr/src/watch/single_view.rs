use std::io;
use std::path::Path;

use artifact::MANIFEST_FILE;
use scene::{Camera, VIEWS_FILE, View, Views};

use super::chain::Chain;

/// The watched view.
pub(super) struct WatchedView {
    pub(super) name: String,
    /// Number of pixels of the view's camera.
    pub(super) pixels: u64,
}

impl WatchedView {
    /// Finds a view by name, or the chain's first view if the name is empty.
    pub(super) fn find(chain: &Chain<'_>, name: &str) -> anyhow::Result<Self> {
        let folders = chain.render.inputs.iter().map(|(_, folder)| folder);
        let lists = folders.filter_map(|folder| Views::read_folder(folder).ok());
        let views: Vec<View> = lists.flat_map(|list| list.views).collect();
        let found = views.iter().find(|view| name.is_empty() || view.camera.name == name);
        let Some(view) = found else {
            if name.is_empty() {
                anyhow::bail!("no view to watch: the inputs list none");
            }
            let known = views.iter().map(|view| view.camera.name.as_str());
            anyhow::bail!("no view {name}; {}", artifact::known_names(name, known));
        };
        let Camera { name, intrinsics, .. } = &view.camera;
        let pixels = u64::from(intrinsics.width) * u64::from(intrinsics.height);
        Ok(Self { name: name.clone(), pixels })
    }

    /// Creates `cut`, a copy of `folder` by links whose `views.json` lists this view alone. A
    /// folder without `views.json` becomes one link.
    pub(super) fn copy_cut(&self, folder: &Path, cut: &Path) -> io::Result<()> {
        let Ok(mut list) = Views::read_folder(folder) else {
            return std::os::unix::fs::symlink(folder, cut);
        };
        std::fs::create_dir_all(cut)?;
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            // The manifest describes the uncut folder.
            if ![VIEWS_FILE, MANIFEST_FILE].iter().any(|name| entry.file_name() == *name) {
                std::os::unix::fs::symlink(entry.path(), cut.join(entry.file_name()))?;
            }
        }
        list.views.retain(|view| view.camera.name == self.name);
        artifact::write_json(&cut.join(VIEWS_FILE), &list)
    }
}

#[cfg(test)]
mod tests {
    use scene::{Background, Bounds, Intrinsics};

    use super::*;

    #[test]
    fn other_views_are_left_out_and_other_files_are_linked() {
        let folder = tempfile::tempdir().unwrap();
        let (source, copy) = (folder.path().join("source"), folder.path().join("copy"));
        std::fs::create_dir_all(source.join("images")).unwrap();
        std::fs::write(source.join("images/b.png"), "b").unwrap();
        std::fs::write(source.join(MANIFEST_FILE), "{}").unwrap();
        let view = |name: &str| {
            let camera = Camera {
                name: name.to_owned(),
                intrinsics: Intrinsics::from_angle_x(30, 20, 0.7),
                camera_to_world: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]],
            };
            View { image: Some("images/b.png".to_owned()), ..View::camera_only(camera) }
        };
        let list = |views| Views::new(Background::White, Bounds::cube(1.0, 2.0, 6.0), views);
        artifact::write_json(&source.join(VIEWS_FILE), &list(vec![view("a"), view("b")])).unwrap();
        WatchedView { name: "b".to_owned(), pixels: 1 }.copy_cut(&source, &copy).unwrap();
        assert_eq!(Views::read_folder(&copy).unwrap(), list(vec![view("b")]));
        assert_eq!(std::fs::read_to_string(copy.join("images/b.png")).unwrap(), "b");
        assert!(!copy.join(MANIFEST_FILE).exists());
    }
}
