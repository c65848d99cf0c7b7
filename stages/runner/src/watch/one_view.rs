use std::io;
use std::path::Path;

use artifact::MANIFEST_FILE;
use serde_json::Value;

use super::chain::Chain;

/// The file that lists a folder's views.
const VIEWS_FILE: &str = "views.json";

/// The view that is watched.
pub(super) struct OneView {
    pub(super) name: String,
    /// Pixels of the view's camera.
    pub(super) pixels: u64,
}

impl OneView {
    /// Finds a view by name, or the chain's first view if the name is empty.
    pub(super) fn find(chain: &Chain, name: &str) -> anyhow::Result<Self> {
        let folders: Vec<&Path> =
            chain.render.inputs.iter().map(|(_, folder)| folder.as_path()).collect();
        let lists = folders.iter().filter_map(|folder| list(folder).ok());
        let views: Vec<Value> = lists.flat_map(|list| views(&list).to_vec()).collect();
        let found = views.iter().find(|view| name.is_empty() || name_of(view) == Some(name));
        let Some(view) = found else {
            let known: Vec<&str> = views.iter().filter_map(name_of).collect();
            anyhow::bail!("view {name}: no such view; {}", artifact::known_names(name, known));
        };
        let side = |side| view["camera"]["intrinsics"][side].as_u64().unwrap_or(0);
        let name = name_of(view).unwrap_or_default().to_owned();
        Ok(Self { name, pixels: side("width") * side("height") })
    }

    /// Makes `into`, a copy of `folder` by links, whose `views.json` lists this view alone. A
    /// folder without `views.json` becomes one link.
    pub(super) fn of(&self, folder: &Path, into: &Path) -> io::Result<()> {
        let Ok(mut list) = list(folder) else {
            return std::os::unix::fs::symlink(folder, into);
        };
        std::fs::create_dir_all(into)?;
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            // The manifest describes the uncut folder.
            if ![VIEWS_FILE, MANIFEST_FILE].iter().any(|name| entry.file_name() == *name) {
                std::os::unix::fs::symlink(entry.path(), into.join(entry.file_name()))?;
            }
        }
        if let Some(views) = list.get_mut("views").and_then(Value::as_array_mut) {
            views.retain(|view| name_of(view) == Some(&self.name));
        }
        artifact::write_json(&into.join(VIEWS_FILE), &list)
    }
}

fn list(folder: &Path) -> io::Result<Value> {
    Ok(serde_json::from_slice(&std::fs::read(folder.join(VIEWS_FILE))?)?)
}

fn views(list: &Value) -> &[Value] {
    list["views"].as_array().map_or(&[], Vec::as_slice)
}

fn name_of(view: &Value) -> Option<&str> {
    view["camera"]["name"].as_str()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn other_views_are_left_out_and_the_rest_is_linked() {
        let folder = tempfile::tempdir().unwrap();
        let (whole, one) = (folder.path().join("whole"), folder.path().join("one"));
        std::fs::create_dir_all(whole.join("images")).unwrap();
        std::fs::write(whole.join("images/b.png"), "b").unwrap();
        std::fs::write(whole.join(MANIFEST_FILE), "{}").unwrap();
        let view = |name| json!({"camera": {"name": name}, "image": "images/b.png"});
        let list_of = |views: &[Value]| json!({"background": "white", "views": views});
        artifact::write_json(&whole.join(VIEWS_FILE), &list_of(&[view("a"), view("b")])).unwrap();
        OneView { name: "b".to_owned(), pixels: 1 }.of(&whole, &one).unwrap();
        assert_eq!(list(&one).unwrap(), list_of(&[view("b")]));
        assert_eq!(std::fs::read_to_string(one.join("images/b.png")).unwrap(), "b");
        assert!(!one.join(MANIFEST_FILE).exists());
    }
}
