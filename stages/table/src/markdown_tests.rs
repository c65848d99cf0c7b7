//! Rows to Markdown.

use super::*;
use serde_json::json;
use std::collections::BTreeMap;

fn rows() -> Vec<Row> {
    let row = |scene: &str, variant: &str, protocol: &str, psnr: f64, lpips: Option<f64>, train_s: f64| {
        let mut row = json!({"scene": scene, "variant": variant, "protocol": protocol, "method": "eval", "psnr": psnr, "train_s": train_s,
            "commit": "abc1234", "machine": "2 cores"});
        lpips.iter().for_each(|value| row["lpips"] = json!(value));
        row.as_object().cloned().unwrap()
    };
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

| variant | PSNR | LPIPS | training | against the first | commit | machine |
| --- | --- | --- | --- | --- | --- | --- |
| as it is | **31.00** | **0.0450** | **2.0 min** | +0.00 | abc1234 | 2 cores |
| no warm-up | 30.88 | – | 3.3 min | -0.12 | abc1234 | 2 cores |
";
    assert_eq!(markdown(&params, &rows(), &[]).unwrap(), expected);
}

#[test]
fn columns_hold_all_values_of_a_key() {
    let params = Params {
        rows: vec!["variant".to_owned()],
        columns: vec!["scene".to_owned()],
        values: vec!["psnr".to_owned(), "lpips".to_owned()],
        ..Params::default()
    };
    let failed = [FailedPoint { stage: "eval".to_owned(), point: "scene=ship".to_owned(), ..FailedPoint::default() }];
    let expected = "\
# Results

| variant | lego (PSNR / LPIPS) | chair (PSNR / LPIPS) | commit | machine |
| --- | --- | --- | --- | --- |
| as it is | **30.00** / **0.0500** | 32.00 / **0.0400** | abc1234 | 2 cores |
| no warm-up | 29.50 / – | **32.25** / – | abc1234 | 2 cores |

Failed, or waiting for what failed:

* eval [scene=ship]
";
    assert_eq!(markdown(&params, &rows(), &failed).unwrap(), expected);
}

#[test]
fn keys_that_no_result_has_are_refused() {
    for (rows_by, relative_to, words) in [
        (
            vec!["varant"],
            vec![],
            "parameter rows: no result has a key \"varant\"; did you mean variant? known: method, protocol, scene, variant",
        ),
        (vec![], vec![("variant", "nothing")], "parameter relative_to: no result has {\"variant\": \"nothing\"}"),
    ] {
        let params = Params {
            rows: rows_by.into_iter().map(str::to_owned).collect(),
            relative_to: relative_to.into_iter().map(|(k, v)| (k.to_owned(), v.to_owned())).collect(),
            ..Params::default()
        };
        assert_eq!(markdown(&params, &rows(), &[]).unwrap_err(), words);
    }
    let spread = Params { spread: vec!["psnr".to_owned()], ..Params::default() };
    let text = markdown(&spread, &rows(), &[]).unwrap();
    assert!(text.ends_with("\nPSNR over 4 results: 30.94 ± 1.39, from 29.50 to 32.25\n"), "{text}");
    let nothing =
        markdown(&Params::default(), &[], &[FailedPoint { stage: "eval".to_owned(), ..FailedPoint::default() }]).unwrap();
    assert!(nothing.contains("* eval\n"), "{nothing}");
}
