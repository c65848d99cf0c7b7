//! Tests of the table of qualities, and of the expansion of qualities to parameters.

use std::path::Path;

use serde_json::json;
use stage::{Description, Schema};

use super::*;
use crate::key::key_parts;
use crate::{Node, Pipeline, Plan, PlanError, Request};

const PIPELINE: &str = "default: [render-depth]
stages:
  prep: {}
  train-ss:
    inputs: {scene: prep}
  render-depth:
    inputs: {field: train-ss}
";

/// Schemas of the parameters of the stages that qualities affect.
const SCHEMAS: [(&str, &str); 4] = [
    ("train-ss", include_str!("../../../../schemas/parameters/train-ss.json")),
    ("render-depth", include_str!("../../../../schemas/parameters/render-depth.json")),
    ("train-refine", include_str!("../../../../schemas/parameters/train-refine.json")),
    ("refine", include_str!("../../../../schemas/parameters/refine.json")),
];

fn descriptions() -> BTreeMap<String, Description> {
    let mut descriptions = BTreeMap::new();
    let prep = [("prep", r#"{"properties": {"lr_width": {"type": "integer", "default": 100}}}"#)];
    for (name, parameters) in SCHEMAS.into_iter().chain(prep) {
        let parameters: Value = serde_json::from_str(parameters).unwrap();
        let description = json!({"name": name, "version": "", "code": "", "summary": "",
        "parameters": parameters, "output": {"kind": name},
        "inputs": {
            "scene": {"kinds": ["prep"], "summary": "", "optional": true},
            "field": {"kinds": ["train-ss"], "summary": "", "optional": true},
        }});
        descriptions.insert(name.to_owned(), serde_json::from_value(description).unwrap());
    }
    descriptions
}

fn plan_of(text: &str, arguments: &[&str]) -> Result<Plan, PlanError> {
    let parameters = arguments.iter().map(|argument| (*argument).to_owned()).collect();
    let pipeline = Pipeline::parse(text.as_bytes(), Path::new("dir/pipeline.yaml"))?;
    let request = Request { parameters, ..Request::default() };
    Plan::from_descriptions(&pipeline, &descriptions(), &request)
}

fn problem(text: &str, arguments: &[&str]) -> String {
    plan_of(text, arguments).err().expect("a refused plan").to_string()
}

/// Returns the only node of a stage.
fn node(text: &str, arguments: &[&str], stage: &str) -> Node {
    let plan = plan_of(text, arguments).unwrap();
    let mut nodes = plan.nodes.into_iter().filter(|node| node.stage == stage);
    let node = nodes.next().unwrap();
    assert!(nodes.next().is_none());
    node
}

/// Returns a parameter of a quality's row.
fn parameter_of(quality: Quality, program: &str, name: &str) -> Value {
    ROWS[&quality][program][name].clone()
}

#[test]
fn every_quality_sets_the_same_valid_parameters() {
    for (program, schema) in SCHEMAS {
        let schema = Schema::new(&serde_json::from_str(schema).unwrap()).unwrap();
        for quality in Quality::ALL {
            let row = &ROWS[&quality][program];
            let problems = schema.resolve(row).err();
            assert_eq!(problems, None, "{quality:?} {program}");
            assert!(row.keys().eq(ROWS[&Quality::Best][program].keys()), "{quality:?} {program}");
        }
    }
    assert_eq!(ROWS.len(), 4);
    assert!(ROWS.values().all(|row| row.len() == SCHEMAS.len()));
}

/// A stage that runs without a runner therefore has the quality `best`.
#[test]
fn best_has_the_defaults_of_the_stages() {
    for (program, schema) in SCHEMAS {
        let schema = Schema::new(&serde_json::from_str(schema).unwrap()).unwrap();
        let best = schema.resolve(&ROWS[&Quality::Best][program]);
        assert_eq!(best, schema.resolve(&Map::new()), "{program}");
    }
}

#[test]
fn a_better_quality_casts_more_rays() {
    for name in ["rays_per_pixel", "min_rays", "max_rays"] {
        let values =
            Quality::ALL.map(|quality| parameter_of(quality, "train-ss", name).as_f64().unwrap());
        assert!(values.is_sorted_by(|a, b| a < b), "{name}: {values:?}");
    }
}

/// Keys contain a quality's parameters, but never its name.
#[test]
fn a_quality_equals_its_parameters() {
    for (stage, program) in [("train-ss", "train-ss"), ("render-depth", "render-depth")] {
        let explicit: Vec<String> = ROWS[&Quality::Fast][program]
            .iter()
            .map(|(name, value)| format!("{stage}.{name}={value}"))
            .collect();
        let explicit: Vec<&str> = explicit.iter().map(String::as_str).collect();
        let parts = |arguments: &[&str]| {
            let parts = key_parts(&node(PIPELINE, arguments, stage), &[], "cpu");
            assert!(!parts.contains_key("parameter quality"));
            parts
        };
        assert_eq!(parts(&["quality=fast"]), parts(&explicit));
        assert_eq!(parts(&["quality=balanced"]), parts(&[]));
        assert_ne!(parts(&["quality=fast"]), parts(&[]));
        let in_file = PIPELINE.replace("default:", "quality: fast\ndefault:");
        assert_eq!(key_parts(&node(&in_file, &[], stage), &[], "cpu"), parts(&explicit));
    }
}

/// A program of another name has no quality, which a note says if the program has the parameters.
#[test]
fn a_renamed_program_has_no_quality() {
    let mut descriptions = descriptions();
    let (pipeline, request) = (PIPELINE.as_bytes(), Request::default());
    let pipeline = Pipeline::parse(pipeline, Path::new("dir/pipeline.yaml")).unwrap();
    let notes = |descriptions: &BTreeMap<String, Description>| {
        Plan::from_descriptions(&pipeline, descriptions, &request).unwrap().notes
    };
    assert_eq!(notes(&descriptions), [""; 0]);
    descriptions.get_mut("train-ss").unwrap().name = "mine".to_owned();
    assert_eq!(
        notes(&descriptions),
        ["train-ss: qualities set no parameters of mine; to use them, name it train-ss in its \
            description"]
    );
    descriptions.get_mut("train-ss").unwrap().parameters = json!({"properties": {}});
    assert_eq!(notes(&descriptions), [""; 0]);
}

/// A block's parameter and one on the command line override every quality; the quality on the
/// command line overrides the file's.
#[test]
fn given_parameters_override_a_quality() {
    let file = PIPELINE
        .replace("default:", "quality: fast\ndefault:")
        .replace("{scene: prep}\n", "{scene: prep}\n    parameters: {rays: 7, min_rays: 5}\n");
    for (arguments, stage, expected) in [
        (
            &[][..],
            "train-ss",
            [json!(7), json!(5), parameter_of(Quality::Fast, "train-ss", "rays_per_pixel")],
        ),
        (
            &["quality=best", "min_rays=6"],
            "train-ss",
            [json!(7), json!(6), parameter_of(Quality::Best, "train-ss", "rays_per_pixel")],
        ),
        (
            &["rays_per_pixel=0.5", "quality=draft", "rays="],
            "train-ss",
            [Value::Null, json!(5), json!(0.5)],
        ),
    ] {
        let node = node(&file, arguments, stage);
        let found = ["rays", "min_rays", "rays_per_pixel"].map(|name| &node.parameters[name]);
        let numbers = found.map(Value::as_f64);
        assert_eq!(numbers, expected.each_ref().map(Value::as_f64), "{arguments:?}");
    }
}

#[test]
fn a_block_that_extends_another_has_the_quality() {
    let text = PIPELINE.replace(
        "{scene: prep}\n",
        "{scene: prep}\n  small:\n    extends: train-ss\n    inputs: {scene: prep}\n",
    );
    let text = text.replace("[render-depth]", "[small]");
    let node = node(&text, &["quality=draft"], "small");
    assert_eq!(node.parameters["min_rays"], parameter_of(Quality::Draft, "train-ss", "min_rays"));
}

#[test]
fn qualities_are_swept() {
    let plan = plan_of(PIPELINE, &["quality=draft,fast,draft"]).unwrap();
    let points: Vec<(&str, &str)> =
        plan.nodes.iter().map(|node| (node.stage.as_str(), node.point.as_str())).collect();
    let (draft, fast) = ("quality=draft", "quality=fast");
    assert_eq!(
        points,
        [
            ("prep", ""),
            ("train-ss", draft),
            ("train-ss", fast),
            ("render-depth", draft),
            ("render-depth", fast)
        ]
    );
    assert_eq!(plan.notes, ["-p quality=draft,fast,draft: draft equals draft; it is used once"]);
    let experiment = format!("{PIPELINE}experiment:\n  sweeps: {{quality: [draft, best]}}\n");
    let plan = plan_of(&experiment, &[]).unwrap();
    assert_eq!(plan.nodes[2].values["quality"], "best");
}

/// The paper's field and network have parameters of the same names, which no quality sets.
#[test]
fn other_variants_have_no_quality() {
    let mlp = ["field=mlp", "quality=draft"];
    assert_eq!(
        node(PIPELINE, &mlp, "train-ss").parameters,
        node(PIPELINE, &mlp[..1], "train-ss").parameters
    );
    let refiner = "default: [train-refine]\nstages:\n  train-refine: {}\n";
    assert_eq!(
        node(refiner, &["quality=draft"], "train-refine").parameters["steps"],
        parameter_of(Quality::Draft, "train-refine", "steps")
    );
    assert_eq!(
        node(refiner, &["net=paper", "quality=draft"], "train-refine").parameters["steps"],
        46_875
    );
}

#[test]
fn an_unknown_quality_is_refused_with_the_known_ones() {
    let known = "choose draft, fast, balanced or best";
    for name in ["good", "2", "", "Best"] {
        let problem = problem(PIPELINE, &[&format!("quality={name}")]);
        assert!(problem.starts_with(&format!("-p quality={name}: no quality")), "{problem}");
        assert!(problem.ends_with(known) && !problem.contains('\n'), "{problem}");
    }
    let file = PIPELINE.replace("stages:", "quality: good\nstages:");
    let problem_in_file = problem(&file, &[]);
    assert!(problem_in_file.starts_with("dir/pipeline.yaml:2: "), "{problem_in_file}");
    for quality in Quality::ALL {
        assert!(problem_in_file.contains(quality.name()), "{problem_in_file}");
    }
    let experiment = format!("{PIPELINE}experiment:\n  sweeps: {{quality: [good]}}\n");
    assert!(problem(&experiment, &[]).ends_with(known));
    let stage_problem = problem(PIPELINE, &["train-ss.quality=best"]);
    assert!(stage_problem.contains("train-ss has no such parameter"), "{stage_problem}");
}

/// A file's own quality overrides those of the files that it extends, of which the first wins.
#[test]
fn a_file_inherits_its_quality() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    write("fast.yaml", &format!("quality: fast\n{PIPELINE}"));
    write("best.yaml", "quality: best\ndefault: []\nstages: {}\n");
    write("none.yaml", "default: []\nstages: {}\n");
    for (head, expected) in [
        ("extends: [none.yaml, best.yaml, fast.yaml]", Some(Quality::Best)),
        ("extends: [fast.yaml, best.yaml]\nquality: draft", Some(Quality::Draft)),
        ("extends: none.yaml", None),
    ] {
        let path = write("top.yaml", &format!("{head}\nstages: {{}}\n"));
        assert_eq!(Pipeline::read(&path).unwrap().quality, expected, "{head}");
    }
}
