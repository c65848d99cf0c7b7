//! Run of the pipeline's programs on a data set, and the run's outcome.

use std::path::{Path, PathBuf};

use fields::FieldFile;
use radiance::PointField as _;
use safetensors::{Dtype, SafeTensors};
use serde_json::{Value, json};

use crate::capture::Capture;
use crate::common::{Project, stage};

/// Data set and parameters of a run.
pub(crate) struct Setup {
    pub(crate) capture: Capture,
    pub(crate) prep: Value,
    pub(crate) train: Value,
    pub(crate) render: Value,
    /// True if the field is rounded to half precision before it is rendered.
    pub(crate) half: bool,
    /// True if the field is also exported.
    pub(crate) export: bool,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            capture: Capture::default(),
            prep: json!({"lr_width": 24}),
            train: json!({"rays": 100_000, "n_levels": 3, "cells_per_pixel": 1.28,
                "log2_hashmap_size": 12, "hidden_dim": 16,
                "march_steps": 64, "max_rays_per_step": 1024, "samples_per_step": 8192}),
            render: json!({"samples_per_axis": 1}),
            half: false,
            export: false,
        }
    }
}

/// Outcome of a run.
#[derive(Clone, Debug)]
pub(crate) enum Outcome {
    /// Success of all programs, with finite artifacts.
    Done(Figures),
    /// Refusal by a program, in one line.
    Refused { code: i32, message: String },
    /// Crash of a program, an error of several lines, or a number that isn't finite.
    Broken(String),
}

/// Measured values of a run.
#[derive(Clone, Debug, Default)]
pub(crate) struct Figures {
    /// Mean PSNR of the test views; `None` without ground truth.
    pub(crate) psnr: Option<f64>,
    /// Largest absolute parameter of the field.
    pub(crate) parameter: f32,
    /// Natural logarithm of the largest density, per side of the unit cube.
    pub(crate) density: f32,
    /// Warnings of `prep` and `train-ss`.
    pub(crate) warnings: Vec<String>,
}

/// Copies the entries of one JSON object into another.
pub(crate) fn merge(into: &mut Value, from: &Value) {
    for (key, value) in from.as_object().unwrap() {
        into[key] = value.clone();
    }
}

/// Runs the programs; the first that fails ends the run.
pub(crate) fn run(setup: &Setup) -> Outcome {
    let project = Project::tiny();
    setup.capture.write(&project.path("data"));
    match run_stages(&project, setup) {
        Ok(figures) => Outcome::Done(figures),
        Err(outcome) => outcome,
    }
}

fn run_stages(project: &Project, setup: &Setup) -> Result<Figures, Outcome> {
    let run = |name: &str, params: &Value, inputs: &[(&str, &str)], output: &str| {
        run_stage(project, name, params, inputs, output)
    };
    run("prep", &setup.prep, &[("dataset", "data")], "scene")?;
    run("train-ss", &setup.train, &[("scene", "scene/train")], "field")?;
    if setup.half {
        round_to_half(&project.path("field"));
    }
    let inputs = [("field", "field"), ("cameras", "scene/cameras")];
    run("render-depth", &setup.render, &inputs, "views")?;
    if setup.export {
        let inputs = [("field", "field"), ("cameras", "scene/train-cameras")];
        match run("export", &json!({"resolution": 32}), &inputs, "export") {
            // A field without a surface has nothing to export.
            Ok(()) | Err(Outcome::Refused { code: 3, .. }) => {}
            Err(broken) => return Err(broken),
        }
    }
    let mut figures = Figures { warnings: warnings(project), ..measure_field(project) };
    if read_json(&project.path("scene/scene.json"))["has_truth"] == true {
        run("eval", &json!({}), &[("views", "views"), ("truth", "scene/truth")], "scores")?;
        figures.psnr = read_json(&project.path("scores/metrics.json"))["mean"]["psnr"].as_f64();
    }
    Ok(figures)
}

fn run_stage(
    project: &Project,
    name: &str,
    params: &Value,
    inputs: &[(&str, &str)],
    output: &str,
) -> Result<(), Outcome> {
    let folders: Vec<PathBuf> = inputs.iter().map(|(_, folder)| project.path(folder)).collect();
    let mut named_folders: Vec<(&str, &Path)> = Vec::new();
    for ((name, _), folder) in inputs.iter().zip(&folders) {
        named_folders.push((name, folder));
    }
    let output = project.path(output);
    let finished = stage(name, &params.to_string(), &named_folders, &output, &[]);
    let root = format!("{}/", project.path("").display());
    let text = finished.stderr.replace(&root, "").replace(root.trim_end_matches('/'), "");
    let text = text.trim();
    if finished.code == 0 {
        return match find_non_finite(&output) {
            None => Ok(()),
            Some(found) => Err(Outcome::Broken(format!("{name}: {found}"))),
        };
    }
    let is_refusal = [2, 3, 4].contains(&finished.code) && text.lines().count() == 1;
    Err(if is_refusal {
        Outcome::Refused { code: finished.code, message: text.to_owned() }
    } else {
        Outcome::Broken(format!("{name}, exit code {}: {text}", finished.code))
    })
}

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Returns the warnings of `prep`, from its notes, and of `train-ss`.
fn warnings(project: &Project) -> Vec<String> {
    let notes = read_json(&project.path("scene/scene.json"))["notes"].clone();
    let log = read_json(&project.path("field/training.json"))["warnings"].clone();
    let texts = |list: &Value| -> Vec<String> {
        let entries = list.as_array().into_iter().flatten();
        entries.map(|entry| entry.as_str().unwrap().to_owned()).collect()
    };
    let notes = texts(&notes);
    let prep_warnings = notes.iter().filter_map(|note| note.strip_prefix("warning: "));
    prep_warnings.map(str::to_owned).chain(texts(&log)).collect()
}

/// Returns a field's largest parameter and, for a grid, the largest density at 64³ points.
fn measure_field(project: &Project) -> Figures {
    let file: FieldFile =
        serde_json::from_value(read_json(&project.path("field").join(fields::FIELD_FILE))).unwrap();
    let path = project.path("field").join(FieldFile::member_file(0));
    let parameter = floats(&path).into_iter().fold(0.0, |largest: f32, x| largest.max(x.abs()));
    let fields::FieldModel::Grid(architecture) = file.field else {
        return Figures { parameter, ..Figures::default() };
    };
    let field = radiance::Field::read(&path, architecture, file.bounds).unwrap();
    let centre = |k: usize| (k as f32 + 0.5) / 64.0;
    let points: Vec<[f32; 3]> = (0..64usize.pow(3))
        .map(|i| [centre(i % 64), centre(i / 64 % 64), centre(i / 4096)])
        .collect();
    let density = field.densities(&points).unwrap().into_iter().fold(0.0, f32::max);
    Figures { parameter, density: density.ln(), ..Figures::default() }
}

/// Returns all 32-bit floats of a safetensors file.
fn floats(path: &Path) -> Vec<f32> {
    let bytes = std::fs::read(path).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let float_tensors = tensors.iter().filter(|(_, tensor)| tensor.dtype() == Dtype::F32);
    let bytes = float_tensors.flat_map(|(_, tensor)| tensor.data().as_chunks::<4>().0.to_vec());
    bytes.map(f32::from_le_bytes).collect()
}

/// Rounds all floats of a field to half precision.
fn round_to_half(field: &Path) {
    let path = field.join(FieldFile::member_file(0));
    let mut bytes = std::fs::read(&path).unwrap();
    let mut ranges = Vec::new();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    for (_, tensor) in tensors.iter().filter(|(_, tensor)| tensor.dtype() == Dtype::F32) {
        let start = tensor.data().as_ptr().addr() - bytes.as_ptr().addr();
        ranges.push(start..start + tensor.data().len());
    }
    for range in ranges {
        for word in bytes[range].as_chunks_mut::<4>().0 {
            *word = exr::prelude::f16::from_f32(f32::from_le_bytes(*word)).to_f32().to_le_bytes();
        }
    }
    std::fs::write(&path, bytes).unwrap();
    std::fs::remove_file(field.join(artifact::MANIFEST_FILE)).unwrap();
    let manifest = artifact::Manifest::of_folder("field", field).unwrap();
    artifact::write_json(&field.join(artifact::MANIFEST_FILE), &manifest).unwrap();
}

/// Returns a message about the artifact's first JSON, EXR, PLY or safetensors file with a number
/// that isn't finite. Rust writes such numbers to JSON as `null`.
fn find_non_finite(folder: &Path) -> Option<String> {
    for entry in walkdir::WalkDir::new(folder).sort_by_file_name() {
        let path = entry.unwrap().into_path();
        let is_finite = match path.extension().and_then(|end| end.to_str()) {
            Some("json") => !has_null(&read_json(&path)),
            Some("exr") => {
                let image = pixels::read_exr(&path).unwrap();
                image.channels.iter().all(|(_, samples)| samples.iter().all(|x| x.is_finite()))
            }
            Some("safetensors") => floats(&path).iter().all(|x| x.is_finite()),
            Some("ply") => {
                let table = crate::common::splats::read_ply(&path);
                table.values().flatten().all(|x| x.is_finite())
            }
            _ => true,
        };
        if !is_finite {
            let path = path.strip_prefix(folder).unwrap();
            return Some(format!("{} has a number that isn't finite", path.display()));
        }
    }
    None
}

fn has_null(value: &Value) -> bool {
    match value {
        Value::Null => true,
        Value::Array(entries) => entries.iter().any(has_null),
        Value::Object(entries) => entries.values().any(has_null),
        _ => false,
    }
}
