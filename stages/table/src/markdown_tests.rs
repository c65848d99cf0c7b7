//! Tests of the conversion of rows to Markdown.

use super::*;
use crate::params::{Gain, Group};
use metrics::AnyMetrics;
use serde_json::{Value, json};
use std::collections::BTreeMap;

fn markdown(
    params: &Params,
    rows: &[Row],
    figures: &Figures,
    failed: &[FailedPoint],
) -> Result<String, Failure> {
    document(params, rows, figures, failed).map(|document| document.text)
}

/// Creates a figure as `metrics.json` describes it.
fn figure(path: &str, label: &str, digits: usize, higher_is_better: bool) -> Value {
    json!({
        "path": path,
        "label": label,
        "digits": digits,
        "higher_is_better": higher_is_better,
    })
}

fn figures() -> Figures {
    let mut figures = Figures::default();
    figures.add(&AnyMetrics::from(json!({"figures": [
        figure("psnr", "PSNR", 2, true),
        figure("ssim", "SSIM", 4, true),
        figure("lpips", "LPIPS", 4, false),
    ]})));
    figures
}

fn row(
    scene: &str,
    variant: &str,
    protocol: &str,
    psnr: f64,
    lpips: Option<f64>,
    train_s: f64,
) -> Row {
    let mut row = json!({"scene": scene, "variant": variant, "protocol": protocol,
        "method": "eval", "psnr": psnr, "train_s": train_s,
        "commit": "abc1234", "machine": "2 cores"});
    lpips.iter().for_each(|value| row["lpips"] = json!(value));
    row.as_object().cloned().unwrap()
}

fn rows() -> Vec<Row> {
    vec![
        row("lego", "as it is", "100x2", 30.0, Some(0.05), 100.0),
        row("chair", "as it is", "100x2", 32.0, Some(0.04), 140.0),
        row("lego", "no warm-up", "100x2", 29.5, None, 90.0),
        row("chair", "no warm-up", "100x2", 32.25, None, 310.0),
    ]
}

#[test]
fn results_of_one_row_are_averaged_and_the_best_is_marked() {
    let relative_to = BTreeMap::from([("variant".to_owned(), "as it is".to_owned())]);
    let params = Params { title: "Ablation".to_owned(), relative_to, ..Params::default() };
    let expected = "\
# Ablation

| variant | PSNR | LPIPS | training | against as it is | commit | machine |
| --- | --- | --- | --- | --- | --- | --- |
| as it is | **31.00** | **0.0450** | **2.0 min** | +0.00 | abc1234 | 2 cores |
| no warm-up | 30.88 | – | 3.3 min | -0.12 | abc1234 | 2 cores |
";
    assert_eq!(markdown(&params, &rows(), &figures(), &[]).unwrap(), expected);
}

#[test]
fn numbers_of_views_have_no_best() {
    let mut rows = rows();
    for (row, views) in rows.iter_mut().zip([9, 9, 12, 12]) {
        row.insert("near_views".to_owned(), json!(views));
    }
    let params = Params { values: vec!["near_views".to_owned()], ..Params::default() };
    let text = markdown(&params, &rows, &figures(), &[]).unwrap();
    assert!(text.contains("| no warm-up | 12 | abc1234 |"), "{text}");
}

#[test]
fn columns_are_the_values_of_a_key() {
    let params = Params {
        rows: vec!["variant".to_owned()],
        columns: vec!["scene".to_owned()],
        values: vec!["psnr".to_owned(), "lpips".to_owned()],
        ..Params::default()
    };
    let failed = [FailedPoint {
        stage: "eval".to_owned(),
        point: "scene=ship".to_owned(),
        ..FailedPoint::default()
    }];
    let expected = "\
# Results

| variant | lego (PSNR / LPIPS) | chair (PSNR / LPIPS) | commit | machine |
| --- | --- | --- | --- | --- |
| as it is | **30.00** / **0.0500** | 32.00 / **0.0400** | abc1234 | 2 cores |
| no warm-up | 29.50 / – | **32.25** / – | abc1234 | 2 cores |

Failed, or waiting for a failed stage:

* eval [scene=ship]
";
    assert_eq!(markdown(&params, &rows(), &figures(), &failed).unwrap(), expected);
}

#[test]
fn keys_that_no_result_has_are_refused() {
    let expected = "parameter rows: no result has a key \"varant\"; did you mean variant? known: \
        method, protocol, scene, variant";
    let params = Params { rows: vec!["varant".to_owned()], ..Params::default() };
    let problem = markdown(&params, &rows(), &figures(), &[]).unwrap_err();
    assert!(matches!(&problem, Failure::Usage(message) if message == expected), "{problem}");
    let without_results = markdown(
        &Params::default(),
        &[],
        &figures(),
        &[FailedPoint { stage: "eval".to_owned(), ..FailedPoint::default() }],
    )
    .unwrap();
    assert!(without_results.contains("* eval\n"), "{without_results}");
}

/// The spread is that of the seeds' means over scenes, not of the scenes. A seed that lacks a scene
/// isn't compared.
#[test]
fn seeds_have_a_spread() {
    let of = |scene: &str, seed: &str, psnr: f64| {
        let mut row = row(scene, seed, "100x2", psnr, None, 1.0);
        let seed = row.remove("variant").unwrap();
        row.insert("seed".to_owned(), seed);
        row
    };
    let mut rows = vec![of("lego", "0", 30.0), of("lego", "1", 32.0)];
    let spread = |rows: &[Row]| {
        let text = markdown(&Params::default(), rows, &figures(), &[]).unwrap();
        text.lines().last().unwrap().to_owned()
    };
    assert_eq!(spread(&rows), "PSNR over 2 results: 31.00 ± 1.41, from 30.00 to 32.00");
    rows.extend([of("chair", "0", 20.0), of("chair", "1", 22.0), of("chair", "2", 9.0)]);
    assert_eq!(spread(&rows), "PSNR over 2 results: 26.00 ± 1.41, from 25.00 to 27.00");
}

/// A row without all scenes says so, and is neither the best nor on the front. Differences are
/// those of common scenes.
#[test]
fn means_over_different_scenes_are_not_compared() {
    let mut rows = rows();
    rows.truncate(3);
    for row in &mut rows {
        let method = format!("ours, {}", row["variant"].as_str().unwrap());
        row.insert("method".to_owned(), json!(method));
    }
    rows[2].insert("psnr".to_owned(), json!(33.0));
    let params = params(json!({
        "rows": ["variant"], "values": ["psnr"], "front": "train_s",
        "relative_to": {"variant": "as it is"}, "methods": {"eval": "ours, {variant}"},
        "extra_rows": [{"method": "theirs", "scene": "lego", "psnr": 29}],
        "gains": [{"name": "ours", "of": "eval", "over": "theirs"}],
    }));
    let expected = "\
# Results

| variant | PSNR | against as it is | front | commit | machine |
| --- | --- | --- | --- | --- | --- |
| as it is | **31.00** | +0.00 | ● | abc1234 | 2 cores |
| no warm-up | 33.00 (1 of 2 scenes) | +3.00 |  | abc1234 | 2 cores |

## Gain, PSNR in dB

| gain | all |
| --- | --- |
| ours | +2.50 |
";
    assert_eq!(markdown(&params, &rows, &figures(), &[]).unwrap(), expected);
}

/// Lines are compared with the reference of the same protocol, over the seeds that both have.
#[test]
fn results_are_compared_with_their_counterparts() {
    let mut rows = Vec::new();
    for (protocol, variant, seed, psnr) in [
        ("24x2", "as it is", "0", Some(22.0)),
        ("24x2", "as it is", "1", Some(23.0)),
        ("24x2", "averaged", "0", Some(21.0)),
        ("24x2", "averaged", "1", None),
        ("12x4", "as it is", "0", Some(19.0)),
        ("12x4", "averaged", "0", Some(19.5)),
        ("48x2", "averaged", "0", Some(25.0)),
    ] {
        let mut row = row("lego", variant, protocol, 0.0, None, 1.0);
        row.remove("psnr");
        row.insert("seed".to_owned(), json!(seed));
        psnr.iter().for_each(|psnr| _ = row.insert("psnr".to_owned(), json!(psnr)));
        rows.push(row);
    }
    let mut params = params(json!({
        "rows": ["protocol", "variant"], "values": ["psnr"], "relative_to": {"variant": "as it is"},
    }));
    let text = markdown(&params, &rows, &figures(), &[]).unwrap();
    for line in [
        "| 24x2 | as it is | 22.50 | +0.00 |",
        "| 24x2 | averaged | 21.00 | -1.00 |",
        "| 12x4 | as it is | 19.00 | +0.00 |",
        "| 12x4 | averaged | 19.50 | +0.50 |",
        "| 48x2 | averaged | **25.00** | – |",
    ] {
        assert!(text.contains(line), "{line}\n{text}");
    }
    params.relative_to.insert("variant".to_owned(), "nothing".to_owned());
    let text = markdown(&params, &rows, &figures(), &[]).unwrap();
    assert!(
        text.contains("\nNo result has variant = nothing, so nothing is compared.\n"),
        "{text}"
    );
    assert!(text.contains("| 24x2 | as it is | 22.50 | – |"), "{text}");
}

fn params(value: serde_json::Value) -> Params {
    serde_json::from_value(value).unwrap()
}

fn method_row(method: &str, group: &str, scene: &str, protocol: &str, psnr: f64) -> Value {
    let origin = json!({"commit": "abc1234", "machine": "vm"});
    let mut row = json!({"method": method, "has seen": group, "scene": scene,
        "protocol": protocol, "psnr": psnr});
    row.as_object_mut().unwrap().extend(origin.as_object().cloned().unwrap());
    row
}

/// Returns rows of four methods in two groups at two protocols, as `rows` creates them.
fn methods() -> Vec<Row> {
    let missing = json!({"method": "liif", "has seen": "HR", "scene": "lego", "protocol": "100x2",
        "missing": "no liif"});
    let rows = [
        method_row("nerf", "LR", "lego", "100x2", 30.0),
        method_row("nerf", "LR", "chair", "100x2", 32.0),
        method_row("nerf", "LR", "lego", "100x4", 28.0),
        method_row("ss", "LR", "lego", "100x2", 31.0),
        method_row("ss", "LR", "chair", "100x2", 33.5),
        method_row("ss", "LR", "lego", "100x4", 27.0),
        missing,
        method_row("hr", "HR", "lego", "100x2", 35.0),
    ];
    rows.map(|row| row.as_object().cloned().unwrap()).into()
}

/// An extra row belongs to results whose keys it shares, also without a given list of keys.
#[test]
fn extra_rows_match_default_keys() {
    let extra = json!([{"method": "paper: SS", "variant": "no warm-up", "psnr": 27.5}]);
    let params = params(json!({"values": ["psnr"], "extra_rows": extra}));
    let text = markdown(&params, &rows(), &figures(), &[]).unwrap();
    assert!(text.contains("| 27.50 |"), "{text}");
}

/// The best row of each group is marked. Extra rows are in no group.
#[test]
fn groups_extra_rows_and_gains_are_rendered() {
    let params = Params {
        groups: vec![Group {
            name: "LR".to_owned(),
            methods: vec!["nerf".to_owned(), "ss".to_owned()],
        }],
        gains: vec![
            Gain { name: "ours".to_owned(), of: "ss".to_owned(), over: "nerf".to_owned() },
            Gain {
                name: "theirs".to_owned(),
                of: "paper: SS".to_owned(),
                over: "paper: NeRF".to_owned(),
            },
            Gain { name: "unknown".to_owned(), of: "ss".to_owned(), over: "liif".to_owned() },
        ],
        ..params(json!({
            "rows": ["method"], "columns": ["protocol"], "values": ["psnr"],
            "extra_rows": [
                {"method": "paper: NeRF", "protocol": "100x2", "psnr": 27.5},
                {"method": "paper: SS", "protocol": "100x2", "psnr": 29.75},
                {"method": "paper: SS", "protocol": "200x2", "psnr": 40},
                {"method": "paper: SS, this \
                    scene", "scene": "chair", "protocol": "100x2", "psnr": 40},
            ],
        }))
    };
    let expected = "\
# Results

Means over lego, chair:

| method | has seen | 100x2 (PSNR) | 100x4 (PSNR) | commit | machine |
| --- | --- | --- | --- | --- | --- |
| nerf | LR | 31.00 | **28.00** | abc1234 | vm |
| ss | LR | **32.25** | 27.00 | abc1234 | vm |
| liif | HR | no liif | – | – | – |
| hr | HR | 35.00 (1 of 2 scenes) | – | abc1234 | vm |
| paper: NeRF |  | 27.50 | – | – | – |
| paper: SS |  | 29.75 | – | – | – |

## lego

| method | has seen | 100x2 (PSNR) | 100x4 (PSNR) | commit | machine |
| --- | --- | --- | --- | --- | --- |
| nerf | LR | 30.00 | **28.00** | abc1234 | vm |
| ss | LR | **31.00** | 27.00 | abc1234 | vm |
| liif | HR | no liif | – | – | – |
| hr | HR | 35.00 | – | abc1234 | vm |

## chair

| method | has seen | 100x2 (PSNR) | commit | machine |
| --- | --- | --- | --- | --- |
| nerf | LR | 32.00 | abc1234 | vm |
| ss | LR | **33.50** | abc1234 | vm |
| paper: SS, this scene |  | 40.00 | – | – |

## Gain, PSNR in dB

| gain | 100x2 | 100x4 |
| --- | --- | --- |
| ours | +1.25 | -1.00 |
| theirs | +2.25 | – |
";
    assert_eq!(markdown(&params, &methods(), &figures(), &[]).unwrap(), expected);
}

fn node(stage: &str) -> Value {
    json!({"stage": stage, "point": "", "values": {"protocol": "100x2"}, "is_shown": true,
        "kind": "other", "key": "",
        "output": "", "folder": "", "parameters": {}, "inputs": {}, "started_unix": 0,
        "seconds": 1.0, "threads": 1, "host": "vm"})
}

/// Methods are in the order of their groups, also methods that were left out.
#[test]
fn rows_follow_the_groups() {
    let left_out = json!({"stage": "eval-liif", "point": "", "values": {"protocol": "100x2"},
        "reason": "no liif"});
    let failed = json!({"stage": "eval-nerf", "point": ""});
    let nodes = ["eval", "eval-hr", "eval-ss"].map(node);
    let run = json!({"nodes": nodes, "failed": [failed, left_out]});
    let params = params(json!({"methods": {"eval-ss": "ours, {protocol}"},
        "groups": [{"name": "LR", "methods": ["eval-ss", "eval-liif"]},
        {"name": "HR", "methods": ["eval-hr"]}]}));
    let run = serde_json::from_value(run).unwrap();
    let silent = stage::Progress::silent();
    let rows = crate::rows::rows(&run, &params, &mut Figures::default(), &silent).unwrap();
    let cells: Vec<[&str; 3]> = rows
        .iter()
        .map(|row| {
            ["method", "has seen", "missing"]
                .map(|key| row.get(key).map_or("", |v| v.as_str().unwrap()))
        })
        .collect();
    assert_eq!(
        cells,
        [
            ["ours, 100x2", "LR", ""],
            ["eval-liif", "LR", "no liif"],
            ["eval-hr", "HR", ""],
            ["eval", "", ""]
        ]
    );
}

/// Rows on the front are marked, by their means over scenes and in each scene's table.
#[test]
fn the_front_is_marked_and_drawn() {
    let params = Params {
        rows: vec!["variant".to_owned()],
        values: vec!["psnr".to_owned()],
        front: Some("train_s".to_owned()),
        ..Params::default()
    };
    let rendered = document(&params, &rows(), &figures(), &[]).unwrap();
    let expected = "\
| variant | PSNR | front | commit | machine |
| --- | --- | --- | --- | --- |
| as it is | **31.00** | ● | abc1234 | 2 cores |
| no warm-up | 30.88 |  | abc1234 | 2 cores |

![The results by cost and score](front.svg)
";
    assert!(rendered.text.contains(expected), "{}", rendered.text);
    let lego = "## lego

| variant | PSNR | front | commit | machine |
| --- | --- | --- | --- | --- |
| as it is | **30.00** | ● | abc1234 | 2 cores |
| no warm-up | 29.50 | ● | abc1234 | 2 cores |
";
    assert!(rendered.text.contains(lego), "{}", rendered.text);
    assert!(rendered.picture.unwrap().contains(">no warm-up</text>"));

    let unknown = Params { front: Some("train_seconds".to_owned()), ..params };
    let problem = document(&unknown, &rows(), &figures(), &[]).err().unwrap().to_string();
    assert!(problem.contains("front: no result has a value \"train_seconds\""), "{problem}");
}
