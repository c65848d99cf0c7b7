//! Frames of a `camera-path` stage, before it has run.

use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use super::scene::SceneImages;
use super::work::Images;

/// Name of a recorded path's file.
const PATH_FILE: &str = "camera_path.json";

/// Part of a recorded path.
#[derive(Deserialize)]
struct PathFile {
    render_width: f64,
    render_height: f64,
    camera_path: Vec<Value>,
}

/// Returns the frames of a path that `camera-path` computes: as large as the scene's HR images,
/// unless parameter `size` gives the frames' width.
pub(super) fn computed(parameters: &Value, scene: &SceneImages) -> Option<Images> {
    let count = parameters["frames"].as_u64()?;
    Some(frames(count, scene.images("train-cameras")?.largest_size, parameters))
}

/// Returns the frames of a recorded path; `None` if its file can't be read.
pub(super) fn recorded(parameters: &Value, folder: &Path) -> Option<Images> {
    let bytes = std::fs::read(folder.join(PATH_FILE)).ok()?;
    let path: PathFile = serde_json::from_slice(&bytes).ok()?;
    let size = (path.render_width as u64, path.render_height as u64);
    Some(frames(path.camera_path.len() as u64, size, parameters))
}

fn frames(count: u64, largest_size: (u64, u64), parameters: &Value) -> Images {
    let pixels = largest_size.0.saturating_mul(largest_size.1).saturating_mul(count);
    Images { count, pixels, largest_size }.with_size(parameters)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn frames_follow_from_parameters_or_a_recorded_path() {
        let demo = json!({"size": 200, "aspect": 2.0, "train": 8, "test": 2, "backdrop": false});
        let scene = SceneImages::of_demo(&demo, &json!({"scale": 2})).unwrap();
        let images = |count, largest_size: (u64, u64)| {
            Some(Images { count, pixels: count * largest_size.0 * largest_size.1, largest_size })
        };
        let parameters = json!({"frames": 120});
        assert_eq!(computed(&parameters, &scene), images(120, (200, 100)));
        let parameters = json!({"frames": 3, "size": 50});
        assert_eq!(computed(&parameters, &scene), images(3, (50, 25)));

        let folder = tempfile::tempdir().unwrap();
        assert_eq!(recorded(&parameters, folder.path()), None);
        let file = json!({"render_width": 40, "render_height": 30.0, "camera_path": [{}, {}]});
        std::fs::write(folder.path().join(PATH_FILE), file.to_string()).unwrap();
        assert_eq!(recorded(&json!({"size": null}), folder.path()), images(2, (40, 30)));
        assert_eq!(recorded(&json!({"size": 80}), folder.path()), images(2, (80, 60)));
    }
}
