use std::collections::BTreeMap;

use artifact::format_duration;
use maud::{Markup, html};
use metrics::ScoreFormat;

use crate::gather::{Report, Row, has_values, is_best};

/// Number of figures in the summary; chosen by hand.
const SUMMARY_FIGURES: usize = 4;
/// Maximum number of cells in the table of all views' figures; a page omits a larger table. Chosen
/// by hand.
const MAX_CELLS: usize = 12_000;

/// Section with the most important figures of the best result. Results of different data sets have
/// no best one.
pub(crate) fn summary(report: &Report<'_>) -> Markup {
    if report.scenes.len() > 1 {
        return html! {};
    }
    let Some(best) = report.best_row().map(|best| &report.rows[best]) else {
        return html! { p class="note" { "There are no scores." } };
    };
    let known = report.figures.iter().filter_map(|figure| Some((figure, best.mean(figure)?)));
    html! {
        section class="summary" aria-label="Summary" {
            @if let Some(figure) = report.main_figure() && report.rows.len() > 1 {
                p { "Best by " (without_arrow(&figure.label)) " of " (report.rows.len())
                    " results: " b { (best.label) } }
            }
            dl {
                @for (figure, mean) in known.take(SUMMARY_FIGURES) {
                    div { dt { (figure.label) } dd { (figure.format_value(mean)) } }
                }
                @if best.training > 0.0 {
                    div { dt { "Training" } dd { (format_duration(best.training)) } }
                }
            }
        }
    }
}

/// Removes from a label the arrow that tells whether higher or lower values are better.
fn without_arrow(label: &str) -> String {
    label.replace(['↑', '↓'], "").split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Table of means, one row per result, with the best value of each column marked.
pub(crate) fn scores(report: &Report<'_>) -> Markup {
    let rows = &report.rows;
    if rows.is_empty() {
        return html! {};
    }
    let known = report.known_figures();
    let with_data_sets = report.scenes.len() > 1;
    html! {
        section id="scores" aria-labelledby="scores-heading" {
            h2 id="scores-heading" { "Scores" }
            p class="note" {
                "Means over the test views. ↑ higher is better, ↓ lower is better."
                @if rows.len() > 1 { " ★ marks the best of each column." }
            }
            div class="wide tall" tabindex="0" role="region" aria-labelledby="scores-heading" {
                table {
                    thead {
                        tr {
                            th scope="col" { "Result" }
                            @if with_data_sets { th scope="col" { "Data set" } }
                            @for figure in &known { (figure_head(report, figure)) }
                            th scope="col" class="n" { "Views" }
                            th scope="col" class="n" { "Training time" }
                            th scope="col" class="n" { "Rendering time" }
                        }
                    }
                    tbody {
                        @for row in rows {
                            tr {
                                th scope="row" { (breakable(&row.label)) }
                                @if with_data_sets { td { (report.scenes[row.scene].data_set) } }
                                @for figure in &known { (mean_cell(figure, row, rows)) }
                                td class="n" { (row.view_count()) }
                                td class="n" { (format_duration(row.training)) }
                                td class="n" { (format_duration(row.rendering)) }
                            }
                        }
                    }
                }
            }
            (missing_note(report))
        }
    }
}

/// Head of a figure's column, with the definition of the figure if the metrics state one.
fn figure_head(report: &Report<'_>, figure: &ScoreFormat) -> Markup {
    let Some((name, definition)) = definition(report, figure) else {
        return html! { th scope="col" class="n" { (figure.label) } };
    };
    html! {
        th scope="col" class="n" {
            a class="term" href={ "#definition-" (name) } title=(definition) { (figure.label) }
        }
    }
}

/// Returns the name of a figure's metric and its definition; `None` if no result has the figure.
pub(crate) fn definition<'a>(
    report: &'a Report<'_>,
    figure: &ScoreFormat,
) -> Option<(&'a str, &'a str)> {
    let metric = figure.path.split('/').next().unwrap_or_default();
    // A result without this figure may state why it isn't measured.
    let row = report.rows.iter().find(|row| row.mean(figure).is_some())?;
    let conventions = row.metrics.conventions().as_object()?;
    // Networks of LPIPS, such as `lpips_vgg`, share a definition.
    let (name, text) = conventions.iter().find(|(name, _)| {
        let rest = metric.strip_prefix(name.as_str());
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('_'))
    })?;
    Some((name, text.as_str()?))
}

/// Text that may be broken after punctuation, so that no word is cut.
pub(crate) fn breakable(text: &str) -> Markup {
    html! {
        @for part in text.split_inclusive(['_', '-', '=', ',', '/', '.']) { (part) wbr; }
    }
}

/// Cell of the table of means.
fn mean_cell(figure: &ScoreFormat, row: &Row<'_>, rows: &[Row<'_>]) -> Markup {
    let Some(value) = row.mean(figure) else {
        // Without HR truth, LPIPS can't be computed: the cell doesn't ask for weights.
        let has_truth = row.metrics.has_hr_truth();
        let missing = figure.missing.as_deref().filter(|_| has_truth);
        return html! { td class="n" { (missing.unwrap_or("–")) } };
    };
    html! {
        @if is_best(figure, row, rows) {
            td class="n best" {
                span class="star" aria-label="best" role="img" { "★" } " " (figure.format_value(value))
            }
        } @else {
            td class="n" { (figure.format_value(value)) }
        }
    }
}

/// Note on figures that no result has, with the reasons.
fn missing_note(report: &Report<'_>) -> Markup {
    let has_truth = report.rows.iter().any(|row| row.metrics.has_hr_truth());
    let unknown = report.figures.iter().filter(|figure| !has_values(figure, &report.rows));
    let unknown: Vec<_> = unknown.filter_map(|f| Some((f, f.missing.as_ref()?))).collect();
    html! {
        @if has_truth && !unknown.is_empty() {
            p class="note" {
                "Not measured: "
                @for (i, (figure, why)) in unknown.iter().enumerate() {
                    @if i > 0 { "; " }
                    (without_arrow(&figure.label)) " (" (why) ")"
                }
                "."
            }
        }
    }
}

/// Table of every view's figures, readable without mouse and JavaScript, unlike the plots.
pub(crate) fn view_figures(report: &Report<'_>) -> Markup {
    let known = report.known_figures();
    let views: usize = report.rows.iter().map(Row::view_count).sum();
    if views == 0 || views * known.len() > MAX_CELLS {
        return html! {};
    }
    html! {
        details class="more" {
            summary { "Numbers of every view" }
            div class="wide tall" tabindex="0" role="region" aria-label="Numbers of every view" {
                table {
                    thead {
                        tr {
                            th scope="col" { "View" }
                            @if report.rows.len() > 1 { th scope="col" { "Result" } }
                            @for figure in &known { (figure_head(report, figure)) }
                        }
                    }
                    tbody {
                        @for row in &report.rows {
                            @for view in row.metrics.views() {
                                tr {
                                    th scope="row" {
                                        (breakable(view["name"].as_str().unwrap_or_default()))
                                    }
                                    @if report.rows.len() > 1 { td { (breakable(&row.label)) } }
                                    @for figure in &known {
                                        @let value = figure.value_in(&view["scores"]);
                                        @let text = value.map(|value| figure.format_value(value));
                                        td class="n" { (text.as_deref().unwrap_or("–")) }
                                    }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Definitions of the figures, as stated by the metrics.
pub(crate) fn conventions(report: &Report<'_>) -> Markup {
    let definitions = definitions(report);
    html! {
        @if !definitions.is_empty() {
            details class="more" {
                summary { "Definitions of the figures" }
                dl class="facts" {
                    @for (name, text) in &definitions {
                        dt id={ "definition-" (name) } { (name.replace('_', " ")) }
                        dd { (text) }
                    }
                }
            }
        }
    }
}

/// Returns the definitions by name: of measured figures as [`definition`], of others as stated by
/// the first result.
fn definitions<'a>(report: &'a Report<'_>) -> BTreeMap<&'a str, &'a str> {
    let mut all = BTreeMap::new();
    let stated = report.rows.iter().filter_map(|row| row.metrics.conventions().as_object());
    for (name, text) in stated.flatten() {
        all.entry(name.as_str()).or_insert(text.as_str().unwrap_or_default());
    }
    all.extend(report.figures.iter().filter_map(|figure| definition(report, figure)));
    all
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use artifact::RunRecord;
    use serde_json::json;

    use super::*;

    fn run(folder: &Path, data_sets: [&str; 2], metrics: [serde_json::Value; 2]) -> RunRecord {
        let mut nodes = Vec::new();
        for (i, (data_set, metrics)) in data_sets.into_iter().zip(metrics).enumerate() {
            let output = folder.join(i.to_string());
            std::fs::create_dir_all(&output).unwrap();
            std::fs::write(output.join("metrics.json"), metrics.to_string()).unwrap();
            let node = |kind: &str, inputs: serde_json::Value| {
                json!({"stage": kind, "point": format!("point={i}"), "kind": kind, "key": "",
                    "output": "", "folder": output, "parameters": {}, "inputs": inputs,
                    "started_unix": 0, "seconds": 0.0, "threads": 1})
            };
            nodes.push(node("scene", json!({"dataset": {"folder": data_set}})));
            nodes.push(node("metrics", json!({"truth": {"node": 2 * i}})));
        }
        serde_json::from_value(json!({"nodes": nodes})).unwrap()
    }

    /// Returns the metrics of one view.
    fn metrics(mean: &serde_json::Value) -> serde_json::Value {
        json!({"mean": mean, "views": [{"name": "a", "scores": {}}]})
    }

    #[test]
    fn the_best_result_is_one_of_a_single_data_set() {
        let folder = tempfile::tempdir().unwrap();
        for (data_sets, has_best) in [(["lego", "lego"], true), (["lego", "chair"], false)] {
            let scores = [20, 21].map(|psnr| metrics(&json!({"psnr": psnr})));
            let run = run(folder.path(), data_sets, scores);
            let text = summary(&Report::new(&run)).into_string();
            assert_eq!(text.contains("of 2 results: <b>point=1</b>"), has_best, "{text}");
        }
    }

    /// Photographs without HR truth have neither PSNR nor LPIPS.
    #[test]
    fn a_figure_without_values_decides_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let figures = json!([
            {"path": "lpips", "label": "LPIPS ↓", "digits": 4, "higher_is_better": false,
                "missing": "weights not given"},
            {"path": "low", "label": "PSNR at LR ↑ dB", "digits": 2, "higher_is_better": true},
        ]);
        let scores = [27.3, 27.4].map(|psnr| {
            let mut metrics = metrics(&json!({"low": psnr}));
            metrics["figures"] = figures.clone();
            metrics
        });
        let text = summary(&Report::new(&run(folder.path(), ["a"; 2], scores))).into_string();
        assert!(text.contains("Best by PSNR at LR dB of 2 results: <b>point=1</b>"), "{text}");
        let none = [(); 2].map(|()| metrics(&json!({})));
        let text = summary(&Report::new(&run(folder.path(), ["a"; 2], none))).into_string();
        assert!(!text.contains("Best by"), "{text}");
    }
}
