//! The shipped experiments with few rays on a tiny pipeline: tables, selections, failures, and a
//! second run with nothing to do.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::{Project, data};
use serde_json::Value;

/// Creates a project with the shipped experiments, its demo scene as the data set `data/other`, and
/// weights if available.
fn project() -> Project {
    let project = Project::experiments();
    project.demo_data("other");
    if let Some(data) = data() {
        std::os::unix::fs::symlink(data.join("weights"), project.path("data/weights")).unwrap();
    }
    project
}

const SMALL: [&str; 6] = ["--data", "data", "--protocol", "24x2", "-p", "train-ss.rays=60000"];

fn rows(project: &Project, name: &str) -> Vec<Value> {
    let text = std::fs::read(project.path(&format!("out/{name}/rows.json"))).unwrap();
    serde_json::from_slice(&text).unwrap()
}

fn table(project: &Project, name: &str) -> String {
    std::fs::read_to_string(project.path(&format!("out/{name}/table.md"))).unwrap()
}

/// Returns the text values of a column, one per row.
fn column(rows: &[Value], key: &str) -> Vec<String> {
    rows.iter().map(|row| row[key].as_str().unwrap_or_default().to_owned()).collect()
}

/// A run covers every scene, with all metrics; a second run starts nothing.
#[test]
fn quality_runs_each_scene() {
    let project = project();
    let quality = [&["run", "quality", "--scene", "demo,other"][..], &SMALL].concat();
    project.ok(&quality);
    let text = table(&project, "quality");
    assert!(text.contains("| 24x2 | rendered | other |"), "{text}");
    let results = rows(&project, "quality");
    assert_eq!(column(&results, "scene"), ["demo", "other"]);
    for row in &results {
        for name in
            ["psnr", "ssim", "train_s", "render_s", "rays_per_s", "samples_per_ray", "views"]
        {
            assert!(row[name].as_f64().is_some_and(|v| v > 0.0), "{name}: {row}");
        }
        assert!(
            ["protocol", "machine"]
                .iter()
                .all(|name| row[name].as_str().is_some_and(|value| !value.is_empty())),
            "{row}"
        );
    }
    // Both names refer to one scene, so results are equal.
    assert_eq!(results[0]["psnr"], results[1]["psnr"]);
    let csv = std::fs::read_to_string(project.path("out/quality/rows.csv")).unwrap();
    assert_eq!(csv.lines().count(), 3);
    assert!(
        table(&project, "quality")
            .starts_with("# Quality by protocol\n\n| protocol | method | scene | PSNR |")
    );
    let again = project.ok(&quality);
    assert!(again.contains("nothing to run") && again.contains("quality (up to date)"), "{again}");
    assert_eq!(rows(&project, "quality"), results);
    project
        .run(&["run", "quality", "--scene", "nowhere", "--data", "data"])
        .fails(2, &["no scene nowhere in data; set the folder"]);
}

/// Variants are not combined with each other; each is compared with the first.
#[test]
fn variants_are_compared_with_the_first() {
    let project = project();
    let first = ["--scene", "other", "--first-variants", "3"];
    project.ok(&[&["run", "ablation"][..], &first, &SMALL].concat());
    assert_eq!(
        column(&rows(&project, "ablation"), "variant"),
        ["as it is", "supervision: average", "all pixels drawn alike"]
    );
    let text = table(&project, "ablation");
    assert!(text.contains("against as it is") && text.contains("| +0.00 |"), "{text}");
    project.ok(&[
        "run",
        "tradeoff",
        "--scene",
        "other",
        "--data",
        "data",
        "--protocol",
        "24x2",
        "--first-variants",
        "3",
        "-p",
        "train-ss.rays=20000",
    ]);
    assert_eq!(column(&rows(&project, "tradeoff"), "variant"), ["draft", "fast", "balanced"]);
    // Without `train-ss.rays`, each quality determines the number of rays.
    let arguments =
        ["tradeoff", "--scene", "other", "--protocol", "100x2", "--first-variants", "4"];
    let nodes = project.nodes(&[&arguments[..], &["--data", "data"]].concat());
    let trainings = nodes.iter().filter(|node| node["stage"] == "train-ss");
    let rays: Vec<f64> = trainings
        .map(|node| {
            assert!(node["parameters"]["rays"].is_null(), "{node}");
            node["parameters"]["rays_per_pixel"].as_f64().unwrap()
        })
        .collect();
    assert!(rays.len() == 4 && rays.is_sorted_by(|a, b| 2.0 * a < *b), "{rays:?}");
    let text = table(&project, "tradeoff");
    assert!(text.contains(" | front | ") && text.contains(" | ● | "), "{text}");
    assert!(text.contains("](front.svg)"), "{text}");
    assert!(project.path("out/tradeoff/front.svg").exists());
    project.ok(&["run", "seeds", "-p", "train-ss.rays=30000", "-p", "train-ss.seed=3,4"]);
    assert!(
        table(&project, "seeds").contains("\nPSNR over 2 results: "),
        "{}",
        table(&project, "seeds")
    );
}

/// A failed point is named, and the table contains the other points.
#[test]
fn a_failed_point_is_named() {
    let project = project();
    let text = "extends: [../experiments/common.yaml, ../pipelines/reference-refine.yaml]
default: [trial]
experiment:
  scenes: [demo]
  variants:
    - {name: as it is}
    - {name: too few rays, parameters: {train-ss.rays: 1}}
stages:
  trial:
    run: table
    inputs: {run: eval}
    parameters: {rows: [variant]}
";
    project.write("experiments/trial.yaml", text);
    let finished = project.run(&["run", "trial", "--keep-going"]);
    assert_eq!(finished.code, 2, "{}{}", finished.stdout, finished.stderr);
    let text = table(&project, "trial");
    assert!(text.contains("\n| as it is |"), "{text}");
    assert!(text.contains("\n* eval [variant=too few rays]\n"), "{text}");
    assert_eq!(rows(&project, "trial").len(), 1);
}

/// Rendered and refined views, with and without references, are scored on the same views, with
/// metrics that compare both.
#[test]
fn refined_views_are_compared_with_rendered_ones() {
    let project = project();
    let budgets = [
        "downscaled-field.rays=30000",
        "finetuned-field.rays=30000",
        "train-refine.steps=20",
        "train-refine.features=8",
    ];
    let budgets: Vec<&str> = budgets.into_iter().flat_map(|budget| ["-p", budget]).collect();
    let selection =
        ["--scene", "other", "--variant", "1", "--variant", "2", "-p", "prep.hr_references=2"];
    project.ok(&[&["run", "refine-table"][..], &selection, &SMALL, &budgets].concat());
    let results = rows(&project, "refine-table");
    // With a fixed number of references, both variants share the methods without references; each
    // has a row of its own.
    assert_eq!(
        column(&results, "method"),
        ["ss", "ss", "refine", "refine", "refine, references: 1", "refine, references: 2"]
    );
    assert_eq!(column(&results, "variant"), ["1", "2", "1", "2", "1", "2"]);
    for row in &results {
        assert!(
            ["near_psnr", "seconds_per_view"]
                .iter()
                .all(|name| row[*name].as_f64().is_some_and(|v| v > 0.0)),
            "{row}"
        );
        assert_eq!(row["least_gain"].is_null(), row["method"] == "ss", "{row}");
    }
    project.ok(&[&["run", "quality-refined", "--scene", "other"][..], &SMALL, &budgets].concat());
    assert_eq!(column(&rows(&project, "quality-refined"), "method"), ["rendered", "refined"]);
    let arguments = [
        "--scene",
        "other",
        "--first-variants",
        "4",
        "--data",
        "data",
        "--protocol",
        "24x2",
        "-p",
        "train-refine.steps=20",
    ];
    project.ok(&[&["run", "refine-ablation", "-p", "downscaled-field.rays=30000"][..], &arguments]
        .concat());
    let results = rows(&project, "refine-ablation");
    let gains: Vec<f64> = results.iter().map(|row| row["gain"].as_f64().unwrap()).collect();
    assert!(
        gains.len() == 4
            && gains[0] != gains[1]
            && gains[0] != gains[3]
            && gains.iter().all(|g| g.is_finite()),
        "{gains:?}"
    );
}
