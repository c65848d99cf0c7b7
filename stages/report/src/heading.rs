//! Facts in the page's heading: image sizes, rays and machine.

use std::collections::BTreeSet;

use artifact::{RunNode, RunRecord, format_amount};
use radiance::{TRAINING_FILE, TrainingLog};
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// Maximum number of different values of a fact that are listed; chosen by hand.
const MAX_VALUES: usize = 3;

/// Name of a scene's summary.
const SCENE_FILE: &str = "scene.json";

/// Part of [`SCENE_FILE`].
#[derive(Deserialize)]
struct SceneFile {
    lr: [u32; 2],
    hr: [u32; 2],
    /// Number of training views.
    train: u64,
}

/// Returns name and text of the facts that are known.
pub(crate) fn facts(run: &RunRecord) -> Vec<(&'static str, String)> {
    let scenes = run.nodes.iter().filter(|node| node.kind == "scene");
    let sizes = scenes
        .filter_map(|node| read_json(node, SCENE_FILE))
        .map(|SceneFile { lr, hr, .. }| format!("LR {}×{} → HR {}×{}", lr[0], lr[1], hr[0], hr[1]));
    let fields = (0..run.nodes.len()).filter(|&index| run.nodes[index].kind == "field");
    let rays = fields.filter_map(|index| rays_of_field(run, index));
    let machines = run.nodes.iter().map(|node| node.host.clone()).filter(|host| !host.is_empty());
    let facts = [
        ("Sizes", joined(sizes.collect())),
        ("Rays", joined(rays.collect())),
        ("Machine", joined(machines.collect())),
    ];
    facts.into_iter().filter(|(_, text)| !text.is_empty()).collect()
}

/// Lists different values.
fn joined(values: BTreeSet<String>) -> String {
    let count = values.len();
    let shown: Vec<String> = values.into_iter().take(MAX_VALUES).collect();
    let shown = shown.join("; ");
    if count > MAX_VALUES { format!("{shown}; {} more", count - MAX_VALUES) } else { shown }
}

/// Returns the number of rays of a training, also per LR pixel of its training views.
fn rays_of_field(run: &RunRecord, index: usize) -> Option<String> {
    let node = &run.nodes[index];
    let log: TrainingLog = read_json(node, TRAINING_FILE)?;
    // Only fields trained on `train` are listed: a field of `downscaled` has other LR pixels.
    let scene = node.inputs.get("scene").filter(|input| input.subtree.as_deref() == Some("train"));
    let scene: SceneFile = read_json(&run.nodes[scene?.node?], SCENE_FILE)?;
    let pixels = u64::from(scene.lr[0]) * u64::from(scene.lr[1]) * scene.train;
    let per_pixel = log.rays as f64 / pixels.max(1) as f64;
    Some(format!("{}, {per_pixel:.1} per LR pixel", format_amount(log.rays)))
}

/// Reads a JSON file of an artifact; `None` if it is missing or of another form.
pub(crate) fn read_json<T: DeserializeOwned>(node: &RunNode, file: &str) -> Option<T> {
    let bytes = std::fs::read(node.folder.join(file)).ok()?;
    serde_json::from_slice(&bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn sizes_rays_and_machine_are_in_the_heading() {
        let folder = tempfile::tempdir().unwrap();
        let node = |stage: &str, kind: &str, file: &str, content: serde_json::Value| {
            let output = folder.path().join(stage);
            std::fs::create_dir(&output).unwrap();
            std::fs::write(output.join(file), content.to_string()).unwrap();
            json!({"stage": stage, "point": "", "kind": kind, "key": "", "output": "",
                "folder": output, "parameters": {}, "inputs": {}, "started_unix": 0,
                "seconds": 0.0, "threads": 2, "host": "box"})
        };
        let scene = json!({"lr": [10, 20], "hr": [20, 40], "train": 5, "test": 1});
        let scene = node("prep", "scene", "scene.json", scene);
        let log = json!({"steps": 1, "rays": 12_000, "samples_per_ray": 1.0, "curve": []});
        let mut field = node("train-ss", "field", TRAINING_FILE, log);
        field["inputs"] = json!({"scene": {"node": 0, "subtree": "train"}});
        let run: RunRecord = serde_json::from_value(json!({"nodes": [scene, field]})).unwrap();
        assert_eq!(
            facts(&run),
            [
                ("Sizes", "LR 10×20 → HR 20×40".to_owned()),
                ("Rays", format!("{}, 12.0 per LR pixel", format_amount(12_000))),
                ("Machine", "box".to_owned()),
            ]
        );
        assert_eq!(facts(&RunRecord::default()), []);
    }
}
