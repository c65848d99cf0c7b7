//! `schemas/` is made from the types; this test keeps it current. `UPDATE=1 cargo test --test schemas` writes it anew.

#![allow(missing_docs, reason = "a test")]

use std::collections::BTreeMap;
use std::path::Path;

use artifact::{Description, Named, RENAMES, Rename, Schema, Stage};
use schemars::{JsonSchema, schema_for};

fn of<T: JsonSchema>() -> serde_json::Value {
    schema_for!(T).to_value()
}

/// What all stages say of themselves.
fn descriptions() -> Vec<Description> {
    vec![
        demo_scene::DemoScene::describe("", ""),
        prep::Prep::describe("", ""),
        train_ss::TrainSs::describe("", ""),
        render_depth::RenderDepth::describe("", ""),
        eval::Eval::describe("", ""),
        report::Report::describe("", ""),
        camera_path::CameraPath::describe("", ""),
        video::Video::describe("", ""),
        register::Register::describe("", ""),
        train_refine::TrainRefine::describe("", ""),
        refine::Refine::describe("", ""),
        upsample::Upsample::describe("", ""),
    ]
}

#[test]
fn schemas_are_current() {
    let mut all = BTreeMap::new();
    for description in descriptions() {
        all.insert(format!("parameters/{}.json", description.name), description.parameters);
    }
    for (name, schema) in [
        ("pipeline", of::<runner::PipelineFile>()),
        ("describe", of::<artifact::Description>()),
        ("artifact", of::<artifact::Manifest>()),
        ("action", of::<artifact::Record>()),
        ("run", of::<artifact::RunRecord>()),
        ("views", of::<scene::Views>()),
        ("scene", of::<prep::SceneSummary>()),
        ("field", of::<radiance::FieldFile>()),
        ("training", of::<train_ss::TrainingLog>()),
        ("refiner", of::<refinement::RefinerFile>()),
        ("metrics", of::<eval::Metrics>()),
        ("results", of::<Vec<report::ResultRow>>()),
        ("degradation", of::<pixels::Degradation>()),
    ] {
        all.insert(format!("{name}.json"), schema);
    }
    let folder = common::root().join("schemas");
    let update = std::env::var_os("UPDATE").is_some();
    for (name, schema) in &all {
        let path = folder.join(name);
        let text = serde_json::to_string_pretty(schema).unwrap() + "\n";
        if update {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, text).unwrap();
        } else {
            let found = std::fs::read_to_string(&path).unwrap_or_default();
            assert!(found == text, "schemas/{name} is out of date: UPDATE=1 cargo test --test schemas");
        }
    }
    let files = walkdir::WalkDir::new(&folder).into_iter().filter(|e| e.as_ref().unwrap().file_type().is_file()).count();
    assert_eq!(files, all.len(), "schemas/ has a file that no type makes");
}

/// Every old name is gone, and every new one is there.
#[test]
fn renames_lead_to_names_that_are_there() {
    let descriptions = descriptions();
    for Rename { program, kind, old, new, .. } in RENAMES {
        let description = descriptions.iter().find(|d| d.name == *program).expect(program);
        let schema = Schema::new(program, &description.parameters).unwrap();
        let names: Vec<&str> = match kind {
            Named::Parameter => schema.names(),
            Named::Input => description.inputs.keys().map(String::as_str).collect(),
        };
        assert!(names.contains(new) && !names.contains(old), "{program}: {old} → {new}");
    }
}

/// What the stages write is what the schemas say.
#[test]
fn artifacts_fit_their_schemas() {
    let project = common::Project::tiny();
    project.ok(&["run"]);
    let folder = common::root().join("schemas");
    let check = |schema: &str, file: &Path| {
        let read = |path: &Path| -> serde_json::Value { serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap() };
        let validator = jsonschema::validator_for(&read(&folder.join(schema))).unwrap();
        let errors: Vec<String> = validator.iter_errors(&read(file)).map(|e| e.to_string()).collect();
        assert!(errors.is_empty(), "{}: {errors:?}", file.display());
    };
    let object = |stage: &str| project.artifact(stage, &[]);
    let (scene, field, views, metrics) = (object("prep"), object("train-ss"), object("render-depth"), object("eval"));
    for folder in [&scene, &field, &views, &metrics] {
        check("artifact.json", &folder.join("artifact.json"));
    }
    check("scene.json", &scene.join("scene.json"));
    for views in [scene.join("train"), scene.join("truth"), scene.join("cameras"), scene.join("references"), views] {
        check("views.json", &views.join("views.json"));
    }
    check("field.json", &field.join("field.json"));
    check("training.json", &field.join("training.json"));
    check("metrics.json", &metrics.join("metrics.json"));
    for action in std::fs::read_dir(project.path(".nerf-sr/actions")).unwrap() {
        let path = action.unwrap().path();
        if path.extension().is_some_and(|e| e == "json") {
            check("action.json", &path);
        }
    }
}

mod common;
