//! `schemas/` and `docs/reference/` match the types and the built stages' descriptions, and the
//! notebook matches the guide. `make reference` generates these files.

#![allow(missing_docs, reason = "a test")]

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::sync::LazyLock;
use std::time::SystemTime;

use schemars::{JsonSchema, schema_for};
use serde_json::{Value, json};
use stage::Description;

fn schema_of<T: JsonSchema>() -> Value {
    schema_for!(T).to_value()
}

/// Returns the descriptions of all stages.
fn descriptions() -> &'static [Description] {
    static DESCRIPTIONS: LazyLock<Vec<Description>> =
        LazyLock::new(|| common::stage_names().iter().map(|name| description(name)).collect());
    &DESCRIPTIONS
}

/// Returns a built stage's description, without parts that differ between builds.
fn description(name: &str) -> Description {
    let program = common::bin(name);
    assert_up_to_date(&program);
    let output = Command::new(program).arg("describe").output().unwrap();
    assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
    let description: Description = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(description.name, name, "folder, crate and program have one name");
    Description { version: String::new(), code: String::new(), ..description }
}

/// Returns whether files are rewritten instead of compared.
fn is_update() -> bool {
    std::env::var_os("UPDATE").is_some()
}

/// Fails if files are rewritten from a program that is older than its sources.
fn assert_up_to_date(program: &Path) {
    if !is_update() {
        return;
    }
    // Cargo lists a program's sources in a file next to the program.
    let list = std::fs::read_to_string(program.with_extension("d")).unwrap();
    let sources = list.split_whitespace().skip(1).map(Path::new).filter(|path| path.is_file());
    for source in sources {
        assert!(
            modified(source) <= modified(program),
            "{} is older than {}; run `make build` first",
            program.display(),
            source.display()
        );
    }
}

fn modified(file: &Path) -> SystemTime {
    file.metadata().unwrap().modified().unwrap()
}

/// Returns the schemas of all files, by their paths in `schemas/`.
fn schemas() -> BTreeMap<String, Value> {
    let files = [
        ("pipeline", schema_of::<planning::PipelineFile>()),
        ("describe", schema_of::<stage::Description>()),
        ("artifact", schema_of::<artifact::Manifest>()),
        ("action", schema_of::<store::Record>()),
        ("run", schema_of::<artifact::RunRecord>()),
        ("views", schema_of::<scene::Views>()),
        ("scene", schema_of::<prep::SceneSummary>()),
        ("field", schema_of::<fields::FieldFile>()),
        ("training", schema_of::<radiance::TrainingLog>()),
        ("refiner", schema_of::<refinement::RefinerFile>()),
        ("metrics", schema_of::<metrics::Metrics>()),
        ("results", schema_of::<Vec<report::ResultRow>>()),
        ("export", schema_of::<export::ExportSummary>()),
        ("offset", schema_of::<export::ExportOffset>()),
        ("degradation", schema_of::<pixels::Degradation>()),
    ];
    let parameters = descriptions()
        .iter()
        .map(|d| (format!("parameters/{}.json", d.name), d.parameters.clone()));
    files
        .into_iter()
        .map(|(name, schema)| (format!("{name}.json"), schema))
        .chain(parameters)
        .collect()
}

/// Compares a file with its expected content, or rewrites the file.
fn check_file(file: &str, expected: &str) {
    let path = common::root().join(file);
    if is_update() {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, expected).unwrap();
    } else {
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(found == expected, "{file} is out of date; run `make reference` (CONTRIBUTING.md)");
    }
}

/// Compares a folder with its expected files, or rewrites the files.
fn check_folder(folder: &str, expected: &BTreeMap<String, String>) {
    let root = common::root().join(folder);
    for (name, text) in expected {
        check_file(&format!("{folder}/{name}"), text);
    }
    let files = walkdir::WalkDir::new(&root)
        .into_iter()
        .filter(|e| e.as_ref().unwrap().file_type().is_file())
        .count();
    assert_eq!(files, expected.len(), "{folder} has a file that isn't generated");
}

#[test]
fn schemas_are_current() {
    let text = |schema: &Value| serde_json::to_string_pretty(schema).unwrap() + "\n";
    check_folder(
        "schemas",
        &schemas().iter().map(|(name, schema)| (name.clone(), text(schema))).collect(),
    );
}

#[test]
fn reference_pages_are_current() {
    let mut pages: BTreeMap<String, String> = descriptions()
        .iter()
        .map(|d| (format!("{}.md", d.name), reference::stage_page(d)))
        .collect();
    pages.insert("files.md".to_owned(), reference::files_page(&schemas()));
    assert_up_to_date(&common::bin("nerf-sr"));
    let project = common::Project::tiny();
    let help = |arguments: &[&str]| project.run(arguments).stdout;
    pages.insert("command-line.md".to_owned(), reference::command_page(help));
    let list = |d: &Description| format!("* [{0}]({0}.md): {1}\n", d.name, d.summary);
    let stages: String = descriptions().iter().map(list).collect();
    let further = "\nBesides: [file formats](files.md), [command line](command-line.md).\n";
    let index = reference::heading("Reference", "Inputs, output and parameters of every stage.")
        + "\n"
        + &stages
        + further;
    pages.insert("README.md".to_owned(), index);
    check_folder("docs/reference", &pages);
}

/// The notebook has the Python guide's text and programs, in the guide's order.
#[test]
fn the_notebook_is_current() {
    let guide = std::fs::read_to_string(common::root().join("docs/guide/python.md")).unwrap();
    let mut cells = Vec::new();
    for (index, part) in guide.split("```").enumerate() {
        let (kind, text) = match part.strip_prefix("python\n") {
            Some(program) => ("code", program),
            None => ("markdown", part),
        };
        let lines: Vec<&str> = text.trim().split_inclusive('\n').collect();
        if lines.is_empty() {
            continue;
        }
        let mut cell = json!({"cell_type": kind, "id": format!("part-{index}"), "metadata": {},
            "source": lines});
        if kind == "code" {
            cell["execution_count"] = Value::Null;
            cell["outputs"] = json!([]);
        }
        cells.push(cell);
    }
    let kernel = json!({"display_name": "Python 3", "language": "python", "name": "python3"});
    let notebook = json!({"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4,
        "nbformat_minor": 5});
    let text = serde_json::to_string_pretty(&notebook).unwrap() + "\n";
    check_file("docs/guide/python.ipynb", &text);
}

/// A stage's help names its reference page, and every parameter has a known group or none.
#[test]
fn help_leads_to_the_reference() {
    for description in descriptions()
        .iter()
        .filter(|d| d.parameter_sections().iter().any(|section| !section.parameters.is_empty()))
    {
        let help = Command::new(common::bin(&description.name)).arg("--help").output().unwrap();
        let help = String::from_utf8(help.stdout).unwrap();
        let page = format!("docs/reference/{}.md", description.name);
        assert!(help.contains(&page) && common::root().join(&page).exists(), "{page}");
        assert!(!help.contains("null"), "{help}");
        for parameter in
            description.parameter_sections().iter().flat_map(|section| &section.parameters)
        {
            let is_known_group = parameter.group.is_empty()
                || stage::PARAMETER_GROUPS.contains(&parameter.group.as_str());
            assert!(
                is_known_group && help.contains(&format!("  {}", parameter.name)),
                "{parameter:?}"
            );
            let is_choice = parameter.choices.iter().any(|(word, _)| *word == parameter.default);
            assert!(
                parameter.text.ends_with('.') && (parameter.default != "none" || is_choice),
                "{parameter:?}"
            );
        }
    }
}

/// Parameters of each variant of a stage have different names.
#[test]
fn parameter_names_are_unique() {
    for description in descriptions() {
        let sections = description.parameter_sections();
        let (common, variants): (Vec<_>, Vec<_>) =
            sections.iter().partition(|section| section.variant.is_none());
        for variant in &variants {
            let parameters = common.iter().chain([variant]).flat_map(|section| &section.parameters);
            let mut names: Vec<&str> =
                parameters.map(|parameter| parameter.name.as_str()).collect();
            let count = names.len();
            names.sort_unstable();
            names.dedup();
            assert_eq!(names.len(), count, "{}: {:?}", description.name, variant.variant);
        }
    }
}

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn assert_matches_schema(schema: &str, file: &Path) {
    let folder = common::root().join("schemas");
    let validator = jsonschema::validator_for(&read_json(&folder.join(schema))).unwrap();
    let errors: Vec<String> =
        validator.iter_errors(&read_json(file)).map(|e| e.to_string()).collect();
    assert!(errors.is_empty(), "{}: {errors:?}", file.display());
}

/// The stages' files match the schemas.
#[test]
fn artifacts_match_their_schemas() {
    let project = common::Project::tiny();
    project.ok(&["run"]);
    let object = |stage: &str| project.artifact(stage, &[]);
    let (scene, field, views, metrics) =
        (object("prep"), object("train-ss"), object("render-depth"), object("eval"));
    for folder in [&scene, &field, &views, &metrics] {
        assert_matches_schema("artifact.json", &folder.join("artifact.json"));
    }
    assert_matches_schema("scene.json", &scene.join("scene.json"));
    for views in [
        scene.join("train"),
        scene.join("truth"),
        scene.join("cameras"),
        scene.join("references"),
        views,
    ] {
        assert_matches_schema("views.json", &views.join("views.json"));
    }
    assert_matches_schema("field.json", &field.join("field.json"));
    assert_matches_schema("training.json", &field.join("training.json"));
    assert_matches_schema("metrics.json", &metrics.join("metrics.json"));
    for action in std::fs::read_dir(project.path(".nerf-sr/actions")).unwrap() {
        let path = action.unwrap().path();
        if path.extension().is_some_and(|e| e == "json") {
            assert_matches_schema("action.json", &path);
        }
    }
}

#[path = "reference.rs"]
mod reference;

mod common;
