//! The shipped experiments at small budgets, over a tiny pipeline: their tables, selections,
//! failures, and a second run that does nothing.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::{Project, data};
use serde_json::Value;

/// The tiny pipeline with the shipped pipelines and experiments, and its scene once more as a data
/// set, `data/other`.
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

/// The values of a key, row by row.
fn column(rows: &[Value], key: &str) -> Vec<String> {
    rows.iter().map(|row| row[key].as_str().unwrap_or_default().to_owned()).collect()
}

/// Two data sets in one run, a product of scenes and supervision, rows with all figures; a second
/// run starts nothing.
#[test]
fn quality_runs_scenes_and_sweeps() {
    let project = project();
    let quality = [&["run", "quality", "--scene", "demo,other"][..], &SMALL].concat();
    project.ok(&quality);
    let text = table(&project, "quality");
    assert!(text.contains("| 24x2 | rendered | kernel | other |"), "{text}");
    let made = rows(&project, "quality");
    assert_eq!(column(&made, "scene"), ["demo", "demo", "other", "other"]);
    assert_eq!(column(&made, "supervision"), ["average", "kernel", "average", "kernel"]);
    for row in &made {
        for name in
            ["psnr", "ssim", "train_s", "render_s", "rays_per_s", "samples_per_ray", "views"]
        {
            assert!(row[name].as_f64().is_some_and(|v| v > 0.0), "{name}: {row}");
        }
        assert!(
            ["protocol", "machine"]
                .iter()
                .all(|name| row[name].as_str().is_some_and(|word| !word.is_empty())),
            "{row}"
        );
    }
    // Both are one scene under two names: the results are equal.
    assert_eq!((&made[0]["psnr"], &made[1]["psnr"]), (&made[2]["psnr"], &made[3]["psnr"]));
    let csv = std::fs::read_to_string(project.path("out/quality/rows.csv")).unwrap();
    assert_eq!(csv.lines().count(), 5);
    assert!(table(&project, "quality").starts_with(
        "# Quality by protocol\n\n| protocol | method | supervision | scene | PSNR |"
    ));
    let again = project.ok(&quality);
    assert!(again.contains("nothing to run") && again.contains("quality (up to date)"), "{again}");
    assert_eq!(rows(&project, "quality"), made);
    project
        .run(&["run", "quality", "--scene", "nowhere", "--data", "data"])
        .fails(2, &["no scene nowhere in data; set the folder"]);
}

/// Variants form no product, and each is compared with the first.
#[test]
fn variants_stand_beside_the_first() {
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
    // Without a number on the command line, rays follow from each quality.
    let plan = ["tradeoff", "--scene", "other", "--protocol", "100x2", "--first-variants", "4"];
    let plan = project.nodes(&[&plan[..], &["--data", "data"]].concat());
    let trainings = plan.iter().filter(|node| node["stage"] == "train-ss");
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

/// A point that fails is named; what else there is stands in the table.
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

/// Rendered and refined views, without references and with some, are scored on the same views, with
/// figures that need both.
#[test]
fn refinement_stands_beside_rendering() {
    let project = project();
    let short = [
        "downscaled-field.rays=30000",
        "finetuned-field.rays=30000",
        "train-refine.steps=20",
        "train-refine.features=8",
    ];
    let short: Vec<&str> = short.into_iter().flat_map(|word| ["-p", word]).collect();
    let numbers =
        ["--scene", "other", "--variant", "1", "--variant", "2", "-p", "prep.hr_references=2"];
    project.ok(&[&["run", "refine-table"][..], &numbers, &SMALL, &short].concat());
    let made = rows(&project, "refine-table");
    assert_eq!(
        column(&made, "method"),
        ["ss", "refine", "refine, references: 1", "refine, references: 2"]
    );
    for row in &made {
        assert!(
            ["near_psnr", "seconds_per_view"]
                .iter()
                .all(|name| row[*name].as_f64().is_some_and(|v| v > 0.0)),
            "{row}"
        );
        assert_eq!(row["least_gain"].is_null(), row["method"] == "ss", "{row}");
    }
    project.ok(&[
        &["run", "quality-refined", "--scene", "other", "-p", "supervision=kernel"][..],
        &SMALL,
        &short,
    ]
    .concat());
    assert_eq!(column(&rows(&project, "quality-refined"), "method"), ["rendered", "refined"]);
    let parts = [
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
    project
        .ok(&[&["run", "refine-ablation", "-p", "downscaled-field.rays=30000"][..], &parts]
            .concat());
    let made = rows(&project, "refine-ablation");
    let gains: Vec<f64> = made.iter().map(|row| row["gain"].as_f64().unwrap()).collect();
    assert!(
        gains.len() == 4
            && gains[0] != gains[1]
            && gains[0] != gains[3]
            && gains.iter().all(|g| g.is_finite()),
        "{gains:?}"
    );
}
