use std::io;
use std::path::Path;

use artifact::MANIFEST_FILE;
use scene::VIEWS_FILE;
use serde_json::Value;

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
        let mut views: Vec<Value> = Vec::new();
        for (_, folder) in &chain.render.inputs {
            if let Ok(mut list) = read_list(folder) {
                views.append(views_of(&mut list).unwrap_or(&mut Vec::new()));
            }
        }
        let found = views.iter().find(|view| name.is_empty() || name_of(view) == Some(name));
        let Some(view) = found else {
            if name.is_empty() {
                anyhow::bail!("no view to watch: the inputs list none");
            }
            let known: Vec<&str> = views.iter().filter_map(name_of).collect();
            anyhow::bail!("no view {name}; {}", artifact::known_names(name, known));
        };
        let [width, height] = ["width", "height"]
            .map(|side| view["camera"]["intrinsics"][side].as_u64().unwrap_or(0));
        Ok(Self { name: name_of(view).unwrap_or_default().to_owned(), pixels: width * height })
    }

    /// Creates `cut`, a copy of `folder` by links whose `views.json` lists this view alone. A
    /// folder without `views.json` becomes one link.
    pub(super) fn copy_cut(&self, folder: &Path, cut: &Path) -> io::Result<()> {
        let Ok(mut list) = read_list(folder) else {
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
        if let Some(views) = views_of(&mut list) {
            views.retain(|view| name_of(view) == Some(&self.name));
        }
        artifact::write_json(&cut.join(VIEWS_FILE), &list)
    }
}

fn read_list(folder: &Path) -> io::Result<Value> {
    Ok(serde_json::from_slice(&std::fs::read(folder.join(VIEWS_FILE))?)?)
}

fn views_of(list: &mut Value) -> Option<&mut Vec<Value>> {
    list.get_mut("views")?.as_array_mut()
}

fn name_of(view: &Value) -> Option<&str> {
    view["camera"]["name"].as_str()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn other_views_are_left_out_and_other_files_are_linked() {
        let folder = tempfile::tempdir().unwrap();
        let (source, copy) = (folder.path().join("source"), folder.path().join("copy"));
        std::fs::create_dir_all(source.join("images")).unwrap();
        std::fs::write(source.join("images/b.png"), "b").unwrap();
        std::fs::write(source.join(MANIFEST_FILE), "{}").unwrap();
        let view = |name| json!({"camera": {"name": name}, "image": "images/b.png"});
        let list = |views: &[Value]| json!({"background": "white", "views": views});
        artifact::write_json(&source.join(VIEWS_FILE), &list(&[view("a"), view("b")])).unwrap();
        WatchedView { name: "b".to_owned(), pixels: 1 }.copy_cut(&source, &copy).unwrap();
        assert_eq!(read_list(&copy).unwrap(), list(&[view("b")]));
        assert_eq!(std::fs::read_to_string(copy.join("images/b.png")).unwrap(), "b");
        assert!(!copy.join(MANIFEST_FILE).exists());
    }
}
