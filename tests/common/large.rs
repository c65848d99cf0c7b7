//! Stage inputs that are generated in seconds, including large ones on which stages run for long.

use std::path::{Path, PathBuf};

use pixels::Rgba8;
use scene::{View, Views};
use serde_json::{Value, json};

use super::{Project, stage};

/// Project with a small scene, field, LR views and refiner, all written by the stages.
pub struct Small {
    pub project: Project,
}

const FIELD_PARAMETERS: &str = r#"{"rays": 60000, "n_levels": 4, "cells_per_pixel": 1.28, "log2_hashmap_size": 12, "hidden_dim": 16, "march_steps": 128, "max_rays_per_step": 2048, "samples_per_step": 16384}"#;

impl Small {
    /// Runs the stages up to a field, its LR views and a refiner.
    pub fn new() -> Self {
        let small = Self { project: Project::tiny() };
        let demo = r#"{"size": 48, "train": 4, "test": 1, "samples_per_axis": 1}"#;
        small.make("demo-scene", demo, &[], "data");
        small.make("prep", r#"{"lr_width": 24}"#, &[("dataset", "data")], "scene");
        small.make("train-ss", FIELD_PARAMETERS, &[("scene", "scene/train")], "field");
        let cameras = [("field", "field"), ("cameras", "scene/train")];
        small.make("render-depth", r#"{"samples_per_axis": 1}"#, &cameras, "views");
        let refiner =
            r#"{"steps": 1, "batch_size": 1, "patch_size": 8, "features": 64, "blocks": 16}"#;
        small.make("train-refine", refiner, &[("views", "views"), ("truth", "scene/train")], "net");
        small
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.project.path(name)
    }

    /// Runs a stage; inputs and output are paths in the project's folder.
    pub fn make(&self, name: &str, params: &str, inputs: &[(&str, &str)], output: &str) {
        let folders: Vec<PathBuf> = inputs.iter().map(|(_, folder)| self.path(folder)).collect();
        let mut given: Vec<(&str, &Path)> = Vec::new();
        for ((name, _), folder) in inputs.iter().zip(&folders) {
            given.push((name, folder));
        }
        let finished = stage(name, params, &given, &self.path(output), &[]);
        assert_eq!(finished.code, 0, "{name}: {}", finished.stderr);
    }

    /// Writes cameras of the training views, resized to the given widths.
    pub fn cameras(&self, output: &str, widths: &[u32]) {
        let given = Views::read_folder(&self.path("scene/train-cameras")).unwrap();
        let mut views = Vec::new();
        for (view, &width) in given.views.iter().zip(widths) {
            views.push(View::camera_only(view.camera.resized(width, width)));
        }
        let folder = self.path(output);
        std::fs::create_dir(&folder).unwrap();
        let views = Views::new(given.background, given.bounds, views);
        artifact::write_json(&folder.join(scene::VIEWS_FILE), &views).unwrap();
        publish(&folder, "cameras");
    }

    /// Writes a copy of the demo scene's data set in which all images are one large photograph.
    pub fn large_photographs(&self, output: &str, width: usize) {
        let (from, to) = (self.path("data"), self.path(output));
        let image = Rgba8::new(width, width, vec![200; 4 * width * width]);
        std::fs::create_dir(&to).unwrap();
        pixels::write_png(&to.join("large.png"), &image).unwrap();
        for entry in walkdir::WalkDir::new(&from).min_depth(1) {
            let entry = entry.unwrap();
            let path = to.join(entry.path().strip_prefix(&from).unwrap());
            match entry.path().extension().and_then(|e| e.to_str()) {
                None => std::fs::create_dir(&path).unwrap(),
                Some("png") => std::fs::hard_link(to.join("large.png"), &path).unwrap(),
                Some(_) if entry.file_name() == artifact::MANIFEST_FILE => {}
                Some(_) => _ = std::fs::copy(entry.path(), &path).unwrap(),
            }
        }
    }

    /// Writes a run's record with the given nodes, as the input of a sink.
    pub fn record(&self, output: &str, nodes: &[Value]) {
        let record = json!({"home": self.path("out"), "nodes": nodes}).to_string();
        self.project.write(&format!("{output}/run.json"), &record);
    }

    /// Returns a node of a run's record; the node's artifact is a folder of the project.
    pub fn node(&self, stage: &str, kind: &str, folder: &str, inputs: &Value) -> Value {
        json!({"stage": stage, "point": "", "is_shown": true, "kind": kind, "key": "k",
            "output": "o", "folder": self.path(folder), "parameters": {}, "inputs": inputs,
            "started_unix": 0, "seconds": 1.0, "threads": 1})
    }
}

/// Writes the manifest of a folder.
fn publish(folder: &Path, kind: &str) {
    let manifest = artifact::Manifest::of_folder(kind, folder).unwrap();
    artifact::write_json(&folder.join(artifact::MANIFEST_FILE), &manifest).unwrap();
}
