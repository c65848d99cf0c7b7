//! Parameters of a stage whose `field` selects a variant, in every notation of files and command
//! lines, with train-ss as the example.

use std::path::Path;

use serde_json::{Value, json};

use super::*;

/// Part of the shipped pipeline: a training block and a block that extends it.
const PIPELINE: &str = "default: [train-ss]
stages:
  scene: {}
  train-ss:
    inputs: {scene: scene}
    parameters:
      rays: 12000000
  other:
    extends: train-ss
    inputs: {scene: scene}
    parameters:
      ensemble: 2
";

fn named_description(json: Value) -> (String, Description) {
    (json["name"].as_str().unwrap().to_owned(), serde_json::from_value(json).unwrap())
}

fn descriptions() -> BTreeMap<String, Description> {
    let parameters: Value =
        serde_json::from_str(include_str!("../../../../schemas/parameters/train-ss.json")).unwrap();
    let described = [
        json!({"name": "scene", "version": "", "code": "", "summary": "", "parameters": {},
            "inputs": {}, "output": {"kind": "scene"}}),
        json!({"name": "train-ss", "version": "", "code": "", "summary": "",
            "parameters": parameters,
               "inputs": {"scene": {"kinds": ["scene"], "summary": ""}},
               "output": {"kind": "field", "resolved": "training.json"}}),
    ];
    described.into_iter().map(named_description).collect()
}

fn plan_of(text: &str, arguments: &[&str]) -> Result<Plan, PlanError> {
    let request = Request {
        parameters: arguments.iter().map(|argument| (*argument).to_owned()).collect(),
        ..Request::default()
    };
    let pipeline = Pipeline::parse(text.as_bytes(), Path::new("dir/pipeline.yaml"))?;
    Plan::from_descriptions(&pipeline, &descriptions(), &request)
}

fn values(node: &Node, names: &[&str]) -> Vec<Value> {
    names.iter().map(|name| node.parameters.get(name).cloned().unwrap_or(json!("absent"))).collect()
}

/// Returns the point and the named parameters of each training of a plan.
fn trainings(text: &str, arguments: &[&str], names: &[&str]) -> Vec<(String, Vec<Value>)> {
    let plan = plan_of(text, arguments).unwrap();
    let nodes = plan.nodes.iter().filter(|node| node.stage == "train-ss");
    nodes.map(|node| (node.point.clone(), values(node, names))).collect()
}

fn grid(rays: Option<u64>, n_levels: u32) -> Vec<Value> {
    vec![json!("grid"), json!(rays), json!(n_levels), json!("absent"), json!(64)]
}

fn mlp(rays: Value, layers: u32) -> Vec<Value> {
    vec![json!("mlp"), rays, json!("absent"), json!(layers), json!(256)]
}

fn at_points(points: &[(&str, Vec<Value>)]) -> Vec<(String, Vec<Value>)> {
    points.iter().map(|(point, values)| ((*point).to_owned(), values.clone())).collect()
}

#[test]
fn every_notation_sets_a_variants_parameters() {
    let names = ["field", "rays", "n_levels", "layers", "hidden_dim"];
    let single = |values: Vec<Value>| vec![(String::new(), values)];
    let nested = &PIPELINE.replace("rays: 12000000", "field: {grid: {n_levels: 4}}")[..];
    let flat = &PIPELINE.replace("rays: 12000000", "rays: 12000000\n      n_levels: 4")[..];
    let with_mlp = &PIPELINE.replace("rays: 12000000", "field: mlp\n      layers: 4")[..];
    let rays = Some(12_000_000);
    for (text, arguments, expected) in [
        (PIPELINE, &[][..], single(grid(rays, 8))),
        (PIPELINE, &["n_levels=4"], single(grid(rays, 4))),
        (PIPELINE, &["train-ss.n_levels=4"], single(grid(rays, 4))),
        (PIPELINE, &["n_levels=5", "train-ss.n_levels=4"], single(grid(rays, 4))),
        (PIPELINE, &["field={\"grid\":{\"n_levels\":4}}"], single(grid(rays, 4))),
        (PIPELINE, &["field=mlp"], single(mlp(json!(rays), 8))),
        (PIPELINE, &["train-ss.field=mlp"], single(mlp(json!(rays), 8))),
        (PIPELINE, &["field=mlp", "layers=4"], single(mlp(json!(rays), 4))),
        (PIPELINE, &["layers=4", "field=mlp"], single(mlp(json!(rays), 4))),
        (PIPELINE, &["field=mlp", "rays="], single(mlp(json!(null), 8))),
        (PIPELINE, &["field={\"mlp\":{\"layers\":4}}"], single(mlp(json!(rays), 4))),
        (
            PIPELINE,
            &["n_levels=4,8"],
            at_points(&[("n_levels=4", grid(rays, 4)), ("n_levels=8", grid(rays, 8))]),
        ),
        (
            PIPELINE,
            &["field=grid,mlp"],
            at_points(&[("field=grid", grid(rays, 8)), ("field=mlp", mlp(json!(rays), 8))]),
        ),
        (
            PIPELINE,
            &["field=mlp", "layers=2,4"],
            at_points(&[("layers=2", mlp(json!(rays), 2)), ("layers=4", mlp(json!(rays), 4))]),
        ),
        (nested, &[], single(grid(None, 4))),
        (nested, &["n_levels=6"], single(grid(None, 6))),
        (flat, &[], single(grid(rays, 4))),
        // The variant has its own defaults; the file's parameters for another one don't apply.
        (nested, &["field=mlp"], single(mlp(json!(null), 8))),
        (flat, &["field=mlp"], single(mlp(json!(rays), 8))),
        (
            flat,
            &["field=grid,mlp"],
            at_points(&[("field=grid", grid(rays, 4)), ("field=mlp", mlp(json!(rays), 8))]),
        ),
        (with_mlp, &[], single(mlp(json!(null), 4))),
        (with_mlp, &["layers=6"], single(mlp(json!(null), 6))),
        (with_mlp, &["field=grid"], single(grid(None, 8))),
    ] {
        assert_eq!(trainings(text, arguments, &names), expected, "{arguments:?} over {text}");
    }
}

/// Returns a parameter of the block `other`.
fn other_parameter(text: &str, arguments: &[&str], name: &str) -> Value {
    let text = text.replace("default: [train-ss]", "default: [train-ss, other]");
    let plan = plan_of(&text, arguments).unwrap();
    let node = plan.nodes.iter().find(|node| node.stage == "other").unwrap();
    node.parameters.get(name).cloned().unwrap_or_default()
}

/// A block inherits the variant of the block that it extends, unless it selects another.
#[test]
fn an_extending_block_inherits_the_variant() {
    let own = &PIPELINE.replace("ensemble: 2", "field: {grid: {n_levels: 3}}")[..];
    for (text, arguments, name, expected) in [
        (PIPELINE, &["field=mlp"][..], "field", json!("mlp")),
        (PIPELINE, &["field=mlp", "layers=4"], "layers", json!(4)),
        (PIPELINE, &["train-ss.n_levels=4"], "n_levels", json!(4)),
        (PIPELINE, &["other.n_levels=4"], "n_levels", json!(4)),
        (own, &["train-ss.n_levels=4"], "n_levels", json!(3)),
        (own, &["train-ss.field=mlp"], "field", json!("grid")),
    ] {
        assert_eq!(other_parameter(text, arguments, name), expected, "{arguments:?}");
    }
}

#[test]
fn wrong_and_foreign_names_are_refused() {
    for (arguments, expected) in [
        (
            &["layers=4"][..],
            "stage train-ss: parameter layers: belongs to field: mlp; leave it out, or choose \
            field: mlp",
        ),
        (&["train-ss.layers=4"], "parameter layers: belongs to field: mlp"),
        (&["field=mlp", "n_levels=4"], "parameter n_levels: belongs to field: grid"),
        (&["field=grid,mlp", "n_levels=4,8"], "parameter n_levels: belongs to field: grid"),
        (&["field={\"mlp\":{\"n_levels\":4}}"], "parameter n_levels: belongs to field: grid"),
        (&["field=voxels"], "parameter field: \"voxels\" is not one of \"grid\", \"mlp\""),
        (&["field=gird"], "did you mean \"grid\"?"),
        (&["n_level=4"], "-p n_level: no stage has this parameter; did you mean n_levels?"),
        (&["train-ss.n_level=4"], "train-ss has no such parameter; did you mean n_levels?"),
        (&["grid.n_levels=4"], "no stage \"grid\""),
        (&["hidden_dim=200"], "200 is greater than the maximum of 128"),
        (&["n_levels=0"], "0 is less than the minimum of 1"),
        (&["field="], "parameter field: null is not one of"),
    ] {
        let problem = plan_of(PIPELINE, arguments).map(|plan| plan.nodes.len()).unwrap_err();
        assert!(matches!(problem, PlanError::Usage(_)), "{problem:?}");
        assert!(problem.to_string().contains(expected), "{arguments:?}: {problem}");
    }
    assert!(plan_of(PIPELINE, &["field=mlp", "hidden_dim=200"]).is_ok());
}

#[test]
fn errors_in_files_name_their_lines() {
    for (from, to, line, expected) in [
        ("rays: 12000000", "layers: 4", 7, "parameter layers: belongs to field: mlp"),
        (
            "rays: 12000000",
            "field: {grid: {layers: 4}}",
            6,
            "parameter layers: belongs to field: mlp",
        ),
        ("rays: 12000000", "levels: 4", 7, "parameter levels: unknown; did you mean n_levels?"),
        (
            "rays: 12000000",
            "field: {grid: {levels: 4}}",
            6,
            "parameter levels: unknown; did you mean n_levels?",
        ),
        ("rays: 12000000", "field: {grid: 4}", 7, "parameter field: {\"grid\":4} is not one of"),
        ("ensemble: 2", "layers: 2", 12, "stage other: parameter layers: belongs to field: mlp"),
    ] {
        let problem = plan_of(&PIPELINE.replace(from, to), &[])
            .map(|plan| plan.nodes.len())
            .unwrap_err()
            .to_string();
        assert!(
            problem.starts_with(&format!("dir/pipeline.yaml:{line}: "))
                && problem.contains(expected),
            "{to}: {problem}"
        );
    }
}

fn training_key(text: &str, arguments: &[&str]) -> String {
    let plan = plan_of(text, arguments).unwrap();
    artifact::hash_json(&key_parts(&plan.nodes[1], &[], "cpu"))
}

/// The key contains the selected variant's parameters by name, in every notation.
#[test]
fn equal_parameters_have_equal_keys() {
    let nested =
        PIPELINE.replace("rays: 12000000", "rays: 12000000\n      field: {grid: {n_levels: 4}}");
    assert_eq!(training_key(&nested, &[]), training_key(PIPELINE, &["n_levels=4"]));
    assert_eq!(training_key(PIPELINE, &["field=grid"]), training_key(PIPELINE, &[]));
    assert_ne!(training_key(PIPELINE, &["field=mlp"]), training_key(PIPELINE, &[]));
    let plan = plan_of(PIPELINE, &[]).unwrap();
    let by_scene: Vec<String> =
        plan.nodes[1].scene_defaults(Path::new("")).keys().cloned().collect();
    assert!(
        ["march_steps", "supervision"].iter().all(|name| by_scene.contains(&(*name).to_owned())),
        "{by_scene:?}"
    );
}
