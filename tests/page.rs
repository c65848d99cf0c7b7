//! Report pages in a real browser: of one and of many results, with and without the images'
//! originals, and of failed runs.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use common::browser::run_in_browser;
use common::{Project, stage};
use serde_json::{Value, json};

/// Maximum bytes of a page with 50 views of 800 pixels.
const MAX_PAGE_BYTES: u64 = 15_000_000;

/// Operates a page on a dark phone, a light desktop, a light phone and a dark desktop, or on the
/// first `count` of these, and returns the page's content on each; `None` without a browser.
/// Fails on any problem.
#[track_caller]
fn operate_page(page: &Path, count: usize) -> Option<Vec<Value>> {
    let found = run_in_browser("page.mjs", [page.as_os_str(), count.to_string().as_ref()])?;
    let contents = found.as_array().unwrap().clone();
    assert_eq!(contents.len(), count);
    for content in &contents {
        assert_eq!(content["problems"], json!([]), "{}: {}", page.display(), content["size"]);
    }
    Some(contents)
}

/// Returns a figure's label and its rounded value in a view's scores.
fn rounded_score(view: &Value, figure: &Value) -> Option<(String, String)> {
    let pointer = format!("/scores/{}", figure["path"].as_str().unwrap());
    let value = view.pointer(&pointer)?.as_f64()?;
    let digits = figure["digits"].as_u64().unwrap() as usize;
    Some((figure["label"].as_str().unwrap().to_owned(), format!("{value:.digits$}")))
}

fn rounded_scores(view: &Value, figures: &[Value]) -> (String, BTreeMap<String, String>) {
    (
        view["name"].as_str().unwrap().to_owned(),
        figures.iter().filter_map(|figure| rounded_score(view, figure)).collect(),
    )
}

/// Returns the numbers that a page should show for `metrics.json`, by view and figure label.
fn expected_numbers(metrics: &Value) -> BTreeMap<String, BTreeMap<String, String>> {
    let figures = metrics["figures"].as_array().unwrap();
    metrics["views"].as_array().unwrap().iter().map(|view| rounded_scores(view, figures)).collect()
}

/// Returns the paths of a score's numbers.
fn number_paths((name, score): (&String, &Value)) -> Vec<String> {
    match score.as_object() {
        None => vec![name.clone()],
        Some(parts) => parts.keys().map(|part| format!("{name}/{part}")).collect(),
    }
}

/// Fails if a number of the scores has no figure, without which no page shows the number.
#[track_caller]
fn assert_all_numbers_have_figures(metrics: &Value) {
    let figures = metrics["figures"].as_array().unwrap();
    for path in metrics["mean"].as_object().unwrap().iter().flat_map(number_paths) {
        assert!(
            figures.iter().any(|figure| figure["path"] == path.as_str()),
            "no figure for {path}"
        );
    }
}

#[track_caller]
fn assert_shows_scores(content: &Value, result: &str, metrics: &Value) {
    for (view, figures) in expected_numbers(metrics) {
        assert!(!figures.is_empty(), "{view} has no figure");
        let found = &content["numbers"][&view][result];
        for (label, number) in figures {
            assert_eq!(
                found[&label],
                json!(number),
                "{view}, {result}, {label}: {}",
                content["size"]
            );
        }
    }
}

fn read_metrics(project: &Project, output: &str) -> Value {
    let file = project.object(output).join("metrics.json");
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

#[test]
fn a_page_shows_the_scores_of_a_sweep() {
    let project = Project::fast();
    let sweep = ["-p", "supersample=1,2"];
    let stdout = project.ok(&[&["run"], &sweep[..]].concat());
    assert!(stdout.contains("out/report/index.html"), "{stdout}");
    let page = project.path("out/report/index.html");
    let text = std::fs::read_to_string(&page).unwrap();
    for expected in [
        "run -p supersample=1,2",
        "weights not given",
        " UTC",
        "<h1>demo-scene</h1>",
        "LR 16×16 → HR 32×32",
        " per LR pixel",
        "href=\"#definition-psnr\" title=\"",
    ] {
        assert!(text.contains(expected), "the page lacks {expected:?}");
    }
    // The images' originals are next to the page, which names the run's artifacts.
    let folders = std::fs::read_dir(project.path("out/report/views")).unwrap().count();
    assert_eq!(folders, 2, "one folder per view");
    for stage in ["prep", "train-ss", "eval"] {
        let output = project.output_of(stage, &sweep).remove(0);
        assert!(text.contains(&output[..10]), "{stage}: no {output}");
    }
    let metrics: Vec<Value> = project
        .output_of("eval", &sweep)
        .iter()
        .map(|output| read_metrics(&project, output))
        .collect();
    metrics.iter().for_each(assert_all_numbers_have_figures);
    let Some(contents) = operate_page(&page, 4) else { return };
    for (metrics, result) in metrics.iter().zip(["supersample=1", "supersample=2"]) {
        assert!(metrics["mean"]["psnr"].is_number());
        contents.iter().for_each(|content| assert_shows_scores(content, result, metrics));
    }
    // The page works without the originals.
    let copy = project.path("alone.html");
    std::fs::copy(&page, &copy).unwrap();
    operate_page(&copy, 1);
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

/// Returns the record of a run with `results` results, which are equal except for their points'
/// names. `suffix` ends the names.
fn record(project: &Project, results: usize, suffix: &str) -> Value {
    let mut nodes = vec![
        record_node(project, "demo-scene", "dataset", "", &json!({})),
        record_node(project, "prep", "scene", "", &json!({"dataset": {"node": 0}})),
    ];
    for result in 0..results {
        let point =
            if results == 1 { String::new() } else { format!("rays={}{suffix}", 1000 + result) };
        let first = nodes.len();
        let prep_subtree = |folder: &str| json!({"node": 1, "subtree": folder});
        let inputs = json!({"scene": prep_subtree("train")});
        nodes.push(record_node(project, "train-ss", "field", &point, &inputs));
        let inputs = json!({"field": {"node": first}, "cameras": prep_subtree("cameras")});
        nodes.push(record_node(project, "render-depth", "views", &point, &inputs));
        let inputs = json!({"views": {"node": first + 1}, "truth": prep_subtree("truth")});
        nodes.push(record_node(project, "eval", "metrics", &point, &inputs));
    }
    json!({"home": project.path("out"), "command": ["nerf-sr", "run"], "data_sets": ["demo-scene"],
        "nodes": nodes})
}

/// Runs `report` on a run's record and returns the page's path.
#[track_caller]
fn page_of(folder: &Path, record: &Value) -> PathBuf {
    let (run, page) = (folder.join("run"), folder.join("page"));
    std::fs::create_dir_all(&run).unwrap();
    std::fs::write(run.join("run.json"), record.to_string()).unwrap();
    let finished = stage("report", "{}", &[("run", &run)], &page, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    page.join("index.html")
}

/// Returns the labels of a page's layers of one kind.
fn layers(page: &str, kind: &str) -> Vec<String> {
    let data = page.split_once("id=\"data\">").unwrap().1.split_once("</script>").unwrap().0;
    let data: Value = serde_json::from_str(data).unwrap();
    let layers = data["layers"].as_array().unwrap().iter().filter(|layer| layer["kind"] == kind);
    layers.map(|layer| layer["label"].as_str().unwrap().to_owned()).collect()
}

/// If only `eval` fails, the page shows the rendered views and their ground truth.
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
    operate_page(&page, 1);
}

/// Plots and tables have room for long names of photographs, or shorten the names.
#[test]
fn long_view_names_fit_the_page() {
    let dir = tempfile::tempdir().unwrap();
    let metrics =
        write_scored_views(dir.path(), 12, 64, "photograph_of_the_garden_behind_the_house_");
    let page = page_of(dir.path(), &scored_views_record(dir.path(), &metrics));
    operate_page(&page, 2);
}

#[test]
fn one_result_and_a_hundred_have_readable_pages() {
    let project = Project::fast();
    project.ok(&["run"]);
    let metrics = project.json("eval", "metrics.json", &[]);
    let long_suffix = ", experiment=photographs of the garden behind the house";
    for (results, suffix, last, sizes) in [
        (1, "", "rendered".to_owned(), 1),
        (12, "", "rays=1011".to_owned(), 1),
        (100, long_suffix, format!("rays=1099{long_suffix}"), 2),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let page = page_of(folder.path(), &record(&project, results, suffix));
        let text = std::fs::read_to_string(&page).unwrap();
        assert_eq!(text.matches("★</span>").count() > 0, results > 1, "{results}");
        assert!(text.len() as u64 <= MAX_PAGE_BYTES, "{} bytes", text.len());
        // All results have equal images, which the page lists once.
        let renders: Vec<String> = layers(&text, "render");
        assert_eq!(renders.len(), 1, "{renders:?}");
        assert_eq!(renders[0].ends_with(&format!("and {} more", results - 1)), results > 1);
        let Some(contents) = operate_page(&page, sizes) else { return };
        contents.iter().for_each(|content| assert_shows_scores(content, &last, &metrics));
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

/// Writes `count` views, their ground truth and error maps, and returns their metrics. Like
/// photographs, the images have detail at every size and noise, which limits PNG's compression.
fn write_scored_views(folder: &Path, count: usize, side: usize, prefix: &str) -> Value {
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
    for (subfolder, views) in [("truth", truths), ("views", renders)] {
        let file = json!({"conventions": conventions, "background": "white", "bounds": bounds,
            "views": views});
        std::fs::write(folder.join(subfolder).join("views.json"), file.to_string()).unwrap();
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

/// Returns an image of noise and of waves of every length, whose phases depend on `number`.
fn texture(side: usize, number: u64, detail: f64) -> pixels::Rgba8 {
    let pixel = |i: usize| texture_pixel(number, detail, i % side, i / side);
    pixels::Rgba8::new(side, side, (0..side * side).flat_map(pixel).collect())
}

fn folder_node(dir: &Path, stage: &str, kind: &str, folder: &str, inputs: &Value) -> Value {
    json!({"stage": stage, "point": "", "kind": kind, "key": "", "output": "",
        "folder": dir.join(folder), "parameters": {}, "inputs": inputs,
        "started_unix": 1, "seconds": 1.0, "threads": 1})
}

/// Writes `metrics.json`, and returns the record of a run with [`write_scored_views`]'s views.
fn scored_views_record(dir: &Path, metrics: &Value) -> Value {
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
fn fifty_views_of_800_pixels_fit_the_size_limit() {
    let dir = tempfile::tempdir().unwrap();
    let metrics = write_scored_views(dir.path(), 50, 800, "r_");
    let page = page_of(dir.path(), &scored_views_record(dir.path(), &metrics));
    let bytes = page.metadata().unwrap().len();
    println!("{bytes} bytes");
    assert!(bytes <= MAX_PAGE_BYTES, "{bytes} bytes");
    // The page has all views, with their originals.
    let views = std::fs::read_dir(dir.path().join("page/views")).unwrap();
    assert_eq!(views.count(), 50);
    let original = pixels::read_png(&dir.path().join("page/views/r_7/ground-truth.png")).unwrap();
    let truth = pixels::read_png(&dir.path().join("truth/images/r_7.png")).unwrap();
    assert!(original == truth, "the original differs from the ground truth");
    let text = std::fs::read_to_string(&page).unwrap();
    assert_eq!(text.matches("\"uri\":\"data:image/").count(), 50 * 4);
}

/// If training fails, the page shows the failure, and the earlier page is moved away.
#[test]
fn a_run_that_failed_has_a_page() {
    let project = Project::fast();
    project.ok(&["run"]);
    let earlier_page = std::fs::read(project.path("out/report/index.html")).unwrap();
    let failed = project.run(&["run", "-p", "train-ss.rays=1"]);
    assert_ne!(failed.code, 0);
    assert!(failed.stdout.contains("moved the earlier page to"), "{}", failed.stdout);
    assert_eq!(
        std::fs::read(project.path("out/report-demo-scene/index.html")).unwrap(),
        earlier_page
    );
    let page = project.path("out/report/index.html");
    let text = std::fs::read_to_string(&page).unwrap();
    for expected in
        ["This run failed", "<b>train-ss</b>: ", "✕ failed", "– not run", "There are no scores"]
    {
        assert!(text.contains(expected), "the page lacks {expected:?}");
    }
    operate_page(&page, 2);
    // The finished result of a sweep is shown next to the failed one.
    let sweep = ["run", "--keep-going", "-p", "train-ss.rays=1,4000"];
    assert_ne!(project.run(&sweep).code, 0);
    let text = std::fs::read_to_string(&page).unwrap();
    assert!(text.contains("This run failed") && text.contains("<b>train-ss [rays=1]</b>"));
    let Some(contents) = operate_page(&page, 1) else { return };
    let metrics = project.json("eval", "metrics.json", &[]);
    contents.iter().for_each(|content| assert_shows_scores(content, "rays=4000", &metrics));
}

#[test]
fn a_page_reports_unreadable_scores() {
    let project = Project::fast();
    project.ok(&["run"]);
    let mut record = record(&project, 2, "");
    let empty = tempfile::tempdir().unwrap();
    record["nodes"][4]["folder"] = json!(empty.path());
    // Metrics of a user's own program, without views or figures.
    let custom = tempfile::tempdir().unwrap();
    std::fs::write(custom.path().join("metrics.json"), r#"{"mean": {"mse": 0.25}, "views": {}}"#)
        .unwrap();
    record["nodes"][7]["folder"] = json!(custom.path());
    let folder = tempfile::tempdir().unwrap();
    let page = page_of(folder.path(), &record);
    let text = std::fs::read_to_string(&page).unwrap();
    assert!(
        text.contains("Scores that can't be read") && text.contains("0.2500"),
        "the page lacks the notice or the score"
    );
    let contents = operate_page(&page, 1);
    let summary = json!(["0.2500"]);
    contents
        .into_iter()
        .flatten()
        .for_each(|content| assert_eq!(content["summary"][0], summary[0]));
    // A square without pixels is refused.
    let (run, output) = (folder.path().join("run"), folder.path().join("none"));
    let finished = stage("report", r#"{"crop": [0, 0, 0]}"#, &[("run", &run)], &output, &[]);
    assert_eq!(finished.code, 2);
    assert!(finished.stderr.contains("a side of at least 1 pixel"), "{}", finished.stderr);
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
        let arguments = [path.join("."), copy.clone()];
        assert!(
            std::process::Command::new("cp").arg("-r").args(arguments).status().unwrap().success()
        );
    }
    let run = |data_set: &str| project.ok(&["run", "-i", &format!("dataset=./sets/{data_set}")]);
    assert!(!run("first").contains("before"));
    let stdout = run("second");
    assert!(stdout.contains("out/report-first/index.html"), "{stdout}");
    assert_eq!(heading(&project, "out/report"), "second");
    assert_eq!(heading(&project, "out/report-first"), "first");
    assert!(run("second").contains("up to date"));
}
