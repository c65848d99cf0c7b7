//! The report page in a real browser: of runs, of one result and of many, with and without
//! pictures' originals, and of a run that failed.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use common::browser::run_in_browser;
use common::{Project, stage};
use serde_json::{Value, json};

/// Maximum size of a page with 50 views of 800 pixels.
const PAGE_BYTES: u64 = 15_000_000;

/// Returns the browser's reports on a dark phone, a light desktop, a light phone and a dark
/// desktop, or on the first `count` of these; fails on any problem.
#[track_caller]
fn look(page: &Path, count: usize) -> Option<Vec<Value>> {
    let found = run_in_browser("page.mjs", [page.as_os_str(), count.to_string().as_ref()])?;
    let looks = found.as_array().unwrap().clone();
    assert_eq!(looks.len(), count);
    for look in &looks {
        assert_eq!(look["problems"], json!([]), "{}: {}", page.display(), look["size"]);
    }
    Some(looks)
}

fn scored_figure(view: &Value, figure: &Value) -> Option<(String, String)> {
    let place = format!("/scores/{}", figure["path"].as_str().unwrap());
    let value = view.pointer(&place)?.as_f64()?;
    let digits = figure["digits"].as_u64().unwrap() as usize;
    Some((figure["label"].as_str().unwrap().to_owned(), format!("{value:.digits$}")))
}

fn scored_figures(view: &Value, figures: &[Value]) -> (String, BTreeMap<String, String>) {
    (
        view["name"].as_str().unwrap().to_owned(),
        figures.iter().filter_map(|figure| scored_figure(view, figure)).collect(),
    )
}

/// `metrics.json` as the page should show it: by view and label of a figure, rounded.
fn shown(metrics: &Value) -> BTreeMap<String, BTreeMap<String, String>> {
    let figures = metrics["figures"].as_array().unwrap();
    metrics["views"].as_array().unwrap().iter().map(|view| scored_figures(view, figures)).collect()
}

/// Paths of a score's numbers.
fn paths((name, score): (&String, &Value)) -> Vec<String> {
    match score.as_object() {
        None => vec![name.clone()],
        Some(parts) => parts.keys().map(|part| format!("{name}/{part}")).collect(),
    }
}

/// Every number has a figure, without which no page would show it.
#[track_caller]
fn figures_name_all_numbers(metrics: &Value) {
    let figures = metrics["figures"].as_array().unwrap();
    for path in metrics["mean"].as_object().unwrap().iter().flat_map(paths) {
        assert!(
            figures.iter().any(|figure| figure["path"] == path.as_str()),
            "no figure of {path}"
        );
    }
}

#[track_caller]
fn says(look: &Value, result: &str, metrics: &Value) {
    for (view, figures) in shown(metrics) {
        assert!(!figures.is_empty(), "{view} has no figure");
        let found = &look["numbers"][&view][result];
        for (label, number) in figures {
            assert_eq!(found[&label], json!(number), "{view}, {result}, {label}: {}", look["size"]);
        }
    }
}

fn metrics_of(project: &Project, output: &str) -> Value {
    let file = project.object(output).join("metrics.json");
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

#[test]
fn a_page_shows_a_sweep_as_eval_scored_it() {
    let project = Project::fast();
    let sweep = ["-p", "supersample=1,2"];
    let said = project.ok(&[&["run"], &sweep[..]].concat());
    assert!(said.contains("out/report/index.html"), "{said}");
    let page = project.path("out/report/index.html");
    let text = std::fs::read_to_string(&page).unwrap();
    for words in [
        "run -p supersample=1,2",
        "weights not given",
        " UTC",
        "<h1>demo-scene</h1>",
        "LR 16×16 → HR 32×32",
        " per LR pixel",
        "href=\"#definition-psnr\" title=\"",
    ] {
        assert!(text.contains(words), "the page lacks {words:?}");
    }
    // Originals lie beside it, and what the page says of each stage is the run's.
    let folders = std::fs::read_dir(project.path("out/report/views")).unwrap().count();
    assert_eq!(folders, 2, "one a view");
    for stage in ["prep", "train-ss", "eval"] {
        let output = project.output_of(stage, &sweep).remove(0);
        assert!(text.contains(&output[..10]), "{stage}: no {output}");
    }
    let metrics: Vec<Value> = project
        .output_of("eval", &sweep)
        .iter()
        .map(|output| metrics_of(&project, output))
        .collect();
    metrics.iter().for_each(figures_name_all_numbers);
    let Some(looks) = look(&page, 4) else { return };
    for (metrics, result) in metrics.iter().zip(["supersample=1", "supersample=2"]) {
        assert!(metrics["mean"]["psnr"].is_number());
        looks.iter().for_each(|look| says(look, result, metrics));
    }
    // Without the originals the page works.
    let alone = project.path("alone.html");
    std::fs::copy(&page, &alone).unwrap();
    look(&alone, 1);
}

fn record_node(project: &Project, stage: &str, kind: &str, point: &str, inputs: &Value) -> Value {
    let folder = project.artifact(stage, &[]);
    json!({"stage": stage, "program": stage, "point": point, "kind": kind, "key": "k",
        "values": if point.is_empty() { json!({}) } else { json!({"rays": point[5..9]}) },
        "is_cached": point.is_empty(), "peak_memory": 100_000_000,
        "output": folder.file_name().unwrap().to_str().unwrap(), "folder": folder,
        "parameters": {"rays": 4000, "seed": null}, "inputs": inputs,
        "started_unix": 1_790_000_000, "seconds": 3.5, "threads": 2})
}

/// A run's record, as the runner writes it, with the same result many times. `constant` ends the
/// points' names.
fn record(project: &Project, results: usize, constant: &str) -> Value {
    let mut nodes = vec![
        record_node(project, "demo-scene", "dataset", "", &json!({})),
        record_node(project, "prep", "scene", "", &json!({"dataset": {"node": 0}})),
    ];
    for result in 0..results {
        let point =
            if results == 1 { String::new() } else { format!("rays={}{constant}", 1000 + result) };
        let first = nodes.len();
        let prep = |folder: &str| json!({"node": 1, "subtree": folder});
        let inputs = json!({"scene": prep("train")});
        nodes.push(record_node(project, "train-ss", "field", &point, &inputs));
        let inputs = json!({"field": {"node": first}, "cameras": prep("cameras")});
        nodes.push(record_node(project, "render-depth", "views", &point, &inputs));
        let inputs = json!({"views": {"node": first + 1}, "truth": prep("truth")});
        nodes.push(record_node(project, "eval", "metrics", &point, &inputs));
    }
    json!({"home": project.path("out"), "command": ["nerf-sr", "run"], "data_sets": ["demo-scene"],
        "nodes": nodes})
}

/// The page of a record.
#[track_caller]
fn page_of(folder: &Path, record: &Value) -> PathBuf {
    let (run, page) = (folder.join("run"), folder.join("page"));
    std::fs::create_dir_all(&run).unwrap();
    std::fs::write(run.join("run.json"), record.to_string()).unwrap();
    let finished = stage("report", "{}", &[("run", &run)], &page, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    page.join("index.html")
}

/// Labels of a page's layers of one kind.
fn layers(page: &str, kind: &str) -> Vec<String> {
    let data = page.split_once("id=\"data\">").unwrap().1.split_once("</script>").unwrap().0;
    let data: Value = serde_json::from_str(data).unwrap();
    let layers = data["layers"].as_array().unwrap().iter().filter(|layer| layer["kind"] == kind);
    layers.map(|layer| layer["label"].as_str().unwrap().to_owned()).collect()
}

/// Scores fail, but the views are rendered: the page shows them and their ground truth.
#[test]
fn a_failed_run_shows_the_renders_that_it_finished() {
    let project = Project::fast();
    project.ok(&["run"]);
    let mut record = record(&project, 1, "");
    record["nodes"].as_array_mut().unwrap().pop();
    record["failed"] = json!([{"stage": "eval", "point": ""}]);
    record["unfinished"] = json!([{"stage": "eval", "point": "", "kind": "metrics",
        "parameters": {}, "needs": [3, 1], "message": "out of memory"}]);
    let folder = tempfile::tempdir().unwrap();
    let page = page_of(folder.path(), &record);
    let text = std::fs::read_to_string(&page).unwrap();
    assert!(text.contains("This run failed") && text.contains("There are no scores"));
    assert_eq!(layers(&text, "render"), ["rendered, not scored"]);
    assert_eq!(layers(&text, "ground-truth"), ["Ground truth"]);
    assert_eq!(std::fs::read_dir(folder.path().join("page/views")).unwrap().count(), 2);
    look(&page, 1);
}

/// Names of photographs may be long: plots and tables have room for them, or shorten them.
#[test]
fn long_view_names_have_room() {
    let dir = tempfile::tempdir().unwrap();
    let metrics = photographs(dir.path(), 12, 64, "photograph_of_the_garden_behind_the_house_");
    let page = page_of(dir.path(), &photographs_record(dir.path(), &metrics));
    look(&page, 2);
}

#[test]
fn one_result_and_a_hundred_have_readable_pages() {
    let project = Project::fast();
    project.ok(&["run"]);
    let metrics = project.json("eval", "metrics.json", &[]);
    let long = ", experiment=photographs of the garden behind the house";
    for (results, constant, last, sizes) in [
        (1, "", "rendered".to_owned(), 1),
        (12, "", "rays=1011".to_owned(), 1),
        (100, long, format!("rays=1099{long}"), 2),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let page = page_of(folder.path(), &record(&project, results, constant));
        let text = std::fs::read_to_string(&page).unwrap();
        assert_eq!(text.matches("★</span>").count() > 0, results > 1, "{results}");
        assert!(text.len() as u64 <= PAGE_BYTES, "{} bytes", text.len());
        // All results have equal pictures, which the page lists once.
        let renders: Vec<String> = layers(&text, "render");
        assert_eq!(renders.len(), 1, "{renders:?}");
        assert_eq!(renders[0].ends_with(&format!("and {} more", results - 1)), results > 1);
        let Some(looks) = look(&page, sizes) else { return };
        looks.iter().for_each(|look| says(look, &last, &metrics));
    }
}

/// A result has the name of its method, not of the block that scored it.
#[test]
fn a_result_is_named_by_its_method() {
    let project = Project::fast();
    project.ok(&["run"]);
    for (program, name) in [("render-depth", "rendered"), ("refine", "refined")] {
        let mut record = record(&project, 1, "");
        record["nodes"][3]["program"] = json!(program);
        let folder = tempfile::tempdir().unwrap();
        let text = std::fs::read_to_string(page_of(folder.path(), &record)).unwrap();
        assert!(text.contains(&format!("<th scope=\"row\">{name}<wbr></th>")), "{name}");
    }
}

fn camera(name: &str, side: usize) -> Value {
    json!({"name": name, "intrinsics": {"width": side, "height": side, "fx": side, "fy": side,
            "cx": side / 2, "cy": side / 2},
        "camera_to_world": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]]})
}

fn write_image(folder: &Path, file: &str, image: &pixels::Rgba8) {
    let path = folder.join(file);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    pixels::write_png(&path, image).unwrap();
}

/// Views of photographs, which no filter shrinks to nothing: detail at every size, and noise.
fn photographs(folder: &Path, count: usize, side: usize, prefix: &str) -> Value {
    let (mut truths, mut renders, mut scores) = (vec![], vec![], vec![]);
    for number in 0..count {
        let name = format!("{prefix}{number}");
        let sharp = texture(side, number as u64, 1.0);
        write_image(folder, &format!("truth/images/{name}.png"), &sharp);
        write_image(
            folder,
            &format!("views/images/{name}.png"),
            &texture(side, number as u64, 0.5),
        );
        let small = pixels::resize_pillow(&sharp, side / 2, side / 2, pixels::Filter::Lanczos);
        write_image(folder, &format!("truth/low/{name}.png"), &small);
        write_image(
            folder,
            &format!("metrics/errors/{name}.png"),
            &texture(side, 1000 + number as u64, 1.0),
        );
        let view = json!({"camera": camera(&name, side), "image": format!("images/{name}.png")});
        let mut truth = view.clone();
        truth["low_resolution"] = json!(format!("low/{name}.png"));
        truths.push(truth);
        renders.push(view);
        scores.push(json!({"name": name, "scores": {"psnr": 20.0 + number as f64 / 10.0},
            "error_map": format!("errors/{name}.png")}));
    }
    let conventions = serde_json::to_value(scene::Conventions::default()).unwrap();
    let bounds =
        json!({"min": [-1.0, -1.0, -1.0], "max": [1.0, 1.0, 1.0], "near": 1.0, "far": 9.0});
    for (place, views) in [("truth", truths), ("views", renders)] {
        let file = json!({"conventions": conventions, "background": "white", "bounds": bounds,
            "views": views});
        std::fs::write(folder.join(place).join("views.json"), file.to_string()).unwrap();
    }
    let figure =
        json!({"path": "psnr", "label": "PSNR ↑ dB", "digits": 2, "higher_is_better": true});
    json!({"conventions": {}, "figures": [figure], "mean": {"psnr": 22.45}, "views": scores})
}

fn noise(number: u64, x: usize, y: usize, c: usize) -> f64 {
    let mut bits = (x as u64) << 40 | (y as u64) << 16 | number << 4 | c as u64;
    for factor in [0xff51_afd7_ed55_8ccd_u64, 0xc4ce_b9fe_1a85_ec53] {
        bits = (bits ^ (bits >> 33)).wrapping_mul(factor);
    }
    (bits >> 56) as f64 / 255.0 - 0.5
}

fn waves(number: u64, x: usize, y: usize) -> f64 {
    let phase = number as f64;
    (1..7)
        .map(|octave| {
            let length = f64::from(1 << octave) * 0.012;
            let (u, v) = (x as f64 * length, y as f64 * length);
            ((u + phase).sin() * (v * 1.3 - phase).cos()) / f64::from(octave)
        })
        .sum::<f64>()
}

fn texture_pixel(number: u64, detail: f64, x: usize, y: usize) -> [u8; 4] {
    let level = 0.5 + 0.2 * waves(number, x, y);
    let [r, g, b] = [0, 1, 2].map(|c| {
        let value = level + 0.12 * detail * noise(number, x, y, c) + 0.05 * c as f64;
        (value.clamp(0.0, 1.0) * 255.0) as u8
    });
    [r, g, b, 255]
}

/// Waves of every length with phases that depend on the number, and noise.
fn texture(side: usize, number: u64, detail: f64) -> pixels::Rgba8 {
    let pixel = |i: usize| texture_pixel(number, detail, i % side, i / side);
    pixels::Rgba8::new(side, side, (0..side * side).flat_map(pixel).collect())
}

fn folder_node(dir: &Path, stage: &str, kind: &str, folder: &str, inputs: &Value) -> Value {
    json!({"stage": stage, "point": "", "kind": kind, "key": "", "output": "",
        "folder": dir.join(folder), "parameters": {}, "inputs": inputs,
        "started_unix": 1, "seconds": 1.0, "threads": 1})
}

/// The record of scored [`photographs`].
fn photographs_record(dir: &Path, metrics: &Value) -> Value {
    std::fs::write(dir.join("metrics/metrics.json"), metrics.to_string()).unwrap();
    let inputs = json!({"views": {"node": 1}, "truth": {"node": 0}});
    let nodes = [
        folder_node(dir, "truth", "views", "truth", &json!({})),
        folder_node(dir, "views", "views", "views", &json!({})),
        folder_node(dir, "eval", "metrics", "metrics", &inputs),
    ];
    json!({"nodes": nodes})
}

#[test]
fn fifty_views_of_800_pixels_have_room() {
    let dir = tempfile::tempdir().unwrap();
    let metrics = photographs(dir.path(), 50, 800, "r_");
    let page = page_of(dir.path(), &photographs_record(dir.path(), &metrics));
    let bytes = page.metadata().unwrap().len();
    println!("{bytes} bytes");
    assert!(bytes <= PAGE_BYTES, "{bytes} bytes");
    // All views are there, with their originals.
    let views = std::fs::read_dir(dir.path().join("page/views")).unwrap();
    assert_eq!(views.count(), 50);
    let original = pixels::read_png(&dir.path().join("page/views/r_7/ground-truth.png")).unwrap();
    let truth = pixels::read_png(&dir.path().join("truth/images/r_7.png")).unwrap();
    assert!(original == truth, "an original isn't what it was");
    let text = std::fs::read_to_string(&page).unwrap();
    assert_eq!(text.matches("\"uri\":\"data:image/").count(), 50 * 4);
}

/// The second stage fails: the page shows the first, and says what happened.
#[test]
fn a_run_that_failed_has_a_page() {
    let project = Project::fast();
    project.ok(&["run"]);
    let whole = std::fs::read(project.path("out/report/index.html")).unwrap();
    let failed = project.run(&["run", "-p", "train-ss.rays=1"]);
    assert_ne!(failed.code, 0);
    assert!(failed.stdout.contains("moved the earlier page to"), "{}", failed.stdout);
    assert_eq!(std::fs::read(project.path("out/report-demo-scene/index.html")).unwrap(), whole);
    let page = project.path("out/report/index.html");
    let text = std::fs::read_to_string(&page).unwrap();
    for words in
        ["This run failed", "<b>train-ss</b>: ", "✕ failed", "– not run", "There are no scores"]
    {
        assert!(text.contains(words), "the page lacks {words:?}");
    }
    look(&page, 2);
    // Results that are there are shown beside those that aren't.
    let sweep = ["run", "--keep-going", "-p", "train-ss.rays=1,4000"];
    assert_ne!(project.run(&sweep).code, 0);
    let text = std::fs::read_to_string(&page).unwrap();
    assert!(text.contains("This run failed") && text.contains("<b>train-ss [rays=1]</b>"));
    let Some(looks) = look(&page, 1) else { return };
    let metrics = project.json("eval", "metrics.json", &[]);
    looks.iter().for_each(|look| says(look, "rays=4000", &metrics));
}

#[test]
fn a_page_without_scores_to_read_says_so() {
    let project = Project::fast();
    project.ok(&["run"]);
    let mut record = record(&project, 2, "");
    let empty = tempfile::tempdir().unwrap();
    record["nodes"][4]["folder"] = json!(empty.path());
    // Metrics of somebody's own, without views or figures.
    let own = tempfile::tempdir().unwrap();
    std::fs::write(own.path().join("metrics.json"), r#"{"mean": {"mse": 0.25}, "views": {}}"#)
        .unwrap();
    record["nodes"][7]["folder"] = json!(own.path());
    let folder = tempfile::tempdir().unwrap();
    let page = page_of(folder.path(), &record);
    let text = std::fs::read_to_string(&page).unwrap();
    assert!(text.contains("Scores that can't be read") && text.contains("0.2500"), "no such page");
    let looks = look(&page, 1);
    let summary = json!(["0.2500"]);
    looks.into_iter().flatten().for_each(|look| assert_eq!(look["summary"][0], summary[0]));
}

fn heading(project: &Project, folder: &str) -> String {
    let text = std::fs::read_to_string(project.path(folder).join("index.html")).unwrap();
    text.split_once("<h1>").unwrap().1.split_once("</h1>").unwrap().0.to_owned()
}

#[test]
fn another_data_set_has_its_own_page() {
    let project = Project::fast();
    project.demo_data("first");
    project.demo_data("second");
    for data_set in ["first", "second"] {
        let path = project.path("data").join(data_set).canonicalize().unwrap();
        let copy = project.path("sets").join(data_set);
        std::fs::create_dir_all(&copy).unwrap();
        let all = [path.join("."), copy.clone()];
        assert!(std::process::Command::new("cp").arg("-r").args(all).status().unwrap().success());
    }
    let run = |data_set: &str| project.ok(&["run", "-i", &format!("dataset=./sets/{data_set}")]);
    assert!(!run("first").contains("before"));
    let said = run("second");
    assert!(said.contains("out/report-first/index.html"), "{said}");
    assert_eq!(heading(&project, "out/report"), "second");
    assert_eq!(heading(&project, "out/report-first"), "first");
    assert!(run("second").contains("up to date"));
}
