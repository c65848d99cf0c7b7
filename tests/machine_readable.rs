//! Machine-readable output: `--json` of the verbs that report, `path` and `diff`, with scenes of
//! `prep`.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::Project;
use serde_json::{Value, json};

const PIPELINE: &str = "default: [prep]
stages:
  demo-scene:
    parameters: {size: 16, train: 3, test: 1}
  prep:
    inputs: {dataset: demo-scene}
    parameters: {scale: 2}
";

fn json_output(project: &Project, arguments: &[&str]) -> Value {
    serde_json::from_str(&project.ok(arguments)).unwrap()
}

fn states(report: &Value) -> Vec<String> {
    report["nodes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|node| node["state"].as_str().unwrap().to_owned())
        .collect()
}

#[test]
fn plan_status_and_why_report_as_json() {
    let project = Project::new(PIPELINE);
    let before = json_output(&project, &["plan", "--json", "-p", "kernel=lanczos,box"]);
    assert_eq!(states(&before), ["will run", "waits", "waits"]);
    assert_eq!(before["nodes"][2]["point"], "kernel=box");
    assert_eq!(
        (&before["nodes"][1]["waits_on"], &before["nodes"][1]["key"]),
        (&json!([0]), &Value::Null)
    );
    assert_eq!(before["nodes"][1]["inputs"]["dataset"]["node"], 0);
    assert_eq!(before["nodes"][1]["parameters"]["scale"], 2.0);
    project.ok(&["run"]);
    let after = json_output(&project, &["status", "--json"]);
    assert_eq!(states(&after), ["cached", "cached"]);
    let prep = &after["nodes"][1];
    assert!(prep["bytes"].as_u64().unwrap() > 1000 && prep["seconds"].as_f64().unwrap() > 0.0);
    let folder = project.ok(&["path", "prep"]);
    assert_eq!(prep["folder"], folder.trim());
    let why = json_output(&project, &["why", "prep", "--json", "-p", "kernel=box"]);
    assert_eq!(why["nodes"].as_array().unwrap().len(), 1);
    assert_eq!(
        why["nodes"][0]["changes"],
        json!([{"name": "parameter kernel", "before": null, "now": "box"}])
    );
}

#[test]
fn path_prints_folders_within_artifacts() {
    let project = Project::new(PIPELINE);
    project.run(&["path", "prep"]).fails(3, &["prep has no artifact yet; run it first"]);
    project.ok(&["run", "-p", "kernel=lanczos,box"]);
    let paths = project.ok(&["path", "prep/train", "-p", "kernel=lanczos,box"]);
    assert_eq!(paths.lines().count(), 2);
    assert!(
        paths.lines().all(|folder| std::path::Path::new(folder).join("views.json").is_file()),
        "{paths}"
    );
    project
        .run(&["path", "prep/trian", "-p", "kernel=box"])
        .fails(2, &["prep has no such folder or file; did you mean train?"]);
    for outside in ["prep//etc/passwd", "prep/../x"] {
        project.run(&["path", outside, "-p", "kernel=box"]).fails(2, &["not a path inside"]);
    }
    project.run(&["path", "perp"]).fails(2, &["did you mean prep?"]);
}

fn hash_of(project: &Project, arguments: &[&str]) -> String {
    let folder = project.ok(&[&["path", "prep"], arguments].concat());
    folder.trim().rsplit('/').next().unwrap()[..12].to_owned()
}

/// Every kind of difference has its line, and no difference is reported twice.
#[test]
fn diff_lists_differences() {
    let project = Project::new(PIPELINE);
    project.ok(&["run", "-p", "kernel=lanczos,box"]);
    assert_eq!(
        project.ok(&["diff", "prep -p kernel=box", "prep -p kernel=box"]).trim(),
        "no differences"
    );
    let kernels = project.ok(&["diff", "prep -p kernel=lanczos", "prep -p kernel=box"]);
    let lines: Vec<&str> = kernels.lines().collect();
    assert_eq!(lines[0], "prep: parameter kernel: \"lanczos\" → \"box\"");
    assert!(
        lines[1].starts_with("prep: ") && lines[1].contains(" files differ, such as "),
        "{kernels}"
    );
    assert_eq!(lines.len(), 2, "{kernels}");
    // Artifacts may be named by hash, and the output may be JSON.
    let by_hash = project.ok(&[
        "diff",
        &hash_of(&project, &["-p", "kernel=lanczos"]),
        &hash_of(&project, &["-p", "kernel=box"]),
    ]);
    assert_eq!(by_hash, kernels);
    let report: Value =
        json_output(&project, &["diff", "--json", "prep -p kernel=lanczos", "prep -p kernel=box"]);
    assert_eq!(
        report[0]["changes"][0]["name"].as_str().map(|name| name.starts_with("file ")),
        Some(true)
    );
    // Another data set changes the scene. The input's hash changes too and isn't reported.
    project.ok(&["run", "-p", "demo-scene.seed=1", "-p", "kernel=box"]);
    let scenes =
        project.ok(&["diff", "prep -p kernel=box", "prep -p kernel=box -p demo-scene.seed=1"]);
    assert!(
        scenes.contains("demo-scene: parameter seed: 0 → 1") && !scenes.contains("input dataset"),
        "{scenes}"
    );
    // Pinned runs are compared by name.
    project.ok(&["pin", "one", "-p", "kernel=box"]);
    project.ok(&["pin", "two", "-p", "kernel=box", "-p", "demo-scene.seed=1"]);
    assert_eq!(project.ok(&["diff", "one", "two"]), scenes);
    for (arguments, code, message) in [
        (["diff", "prep", "prep -p kernel=average"], 3, "has no artifact yet; run it first"),
        (
            ["diff", "prep -p kernel=box,lanczos", "prep -p kernel=box"],
            2,
            "a sweep has several results",
        ),
        (
            ["diff", "prep --kernel box", "prep"],
            2,
            "unexpected argument '--kernel' found; quote each result",
        ),
        (["diff", "", "prep"], 2, "expected a stage, an artifact's hash, a run or a pin"),
        (["diff", "nothing", "prep"], 2, "no stage \"nothing\""),
    ] {
        project.run(&arguments).fails(code, &[message]);
    }
}

#[test]
fn gc_reports_as_json() {
    let project = Project::new(PIPELINE);
    project.ok(&["run", "-p", "kernel=lanczos,box"]);
    let report = json_output(
        &project,
        &["gc", "--json", "--dry-run", "--keep-days", "0", "-p", "kernel=lanczos"],
    );
    let items = report["items"].as_array().unwrap();
    let deleted: Vec<&Value> = items.iter().filter(|item| item["stays"].is_null()).collect();
    assert_eq!((items.len(), deleted.len()), (3, 1));
    assert_eq!(deleted[0]["stage"], "prep [kernel=box]");
    assert_eq!(deleted[0]["bytes"], report["bytes_gone"]);
    let plain = project.ok(&["gc", "--dry-run", "--keep-days", "0", "-p", "kernel=lanczos"]);
    assert!(plain.lines().last().unwrap().contains("B would be deleted"), "{plain}");
}
