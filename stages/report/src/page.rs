use artifact::{RunRecord, format_count, format_utc};
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::commands::{commands, file_name};
use crate::comparison::{comparison, plots};
use crate::data::Data;
use crate::gather::Report;
use crate::heading::facts;
use crate::pipeline::pipeline;
use crate::results::warnings_by_node;
use crate::tables::{conventions, scores, summary, view_figures};

const STYLE: &str = include_str!("page.css");
/// Scripts in the order of their dependencies.
const SCRIPTS: [&str; 4] = [
    include_str!("chart.js"),
    include_str!("comparison.js"),
    include_str!("plots.js"),
    include_str!("page.js"),
];
/// Content security policy: pictures come from the page and from files next to it, and nothing else
/// is fetched.
const POLICY: &str = "default-src 'none'; img-src data: 'self' file:; style-src 'unsafe-inline'; \
    script-src 'unsafe-inline'; base-uri 'none'; form-action 'none'";

/// Renders the page; without `data`, all of the page but the pictures.
pub(crate) fn page(report: &Report<'_>, data: Option<&Data>) -> anyhow::Result<Markup> {
    let json = data.map(Data::to_json).transpose()?.unwrap_or_default();
    let has_pictures = data.is_some_and(|data| !data.pictures.is_empty());
    let title = title(report);
    Ok(html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta http-equiv="Content-Security-Policy" content=(POLICY);
                meta name="color-scheme" content="light dark";
                title { (title) " · nerf-sr report" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                a class="skip" href="#content" { "Skip to the content" }
                (header(report, &title, has_pictures))
                main id="content" {
                    (notices(report))
                    (summary(report))
                    @if has_pictures { (comparison(data)) }
                    (scores(report))
                    (plots(report))
                    (view_figures(report))
                    (conventions(report))
                    @if has_pipeline(report.run) { (pipeline(report.run)) }
                    (commands(report.run))
                }
                footer { p { "Written by nerf-sr. This page needs no network." } }
                script type="application/json" id="data" { (PreEscaped(json)) }
                @for script in SCRIPTS { script { (PreEscaped(script)) } }
            }
        }
    })
}

/// Maximum number of data sets in the title and in the list; chosen by hand.
const MAX_NAMES: usize = 4;

/// Lists the data sets' short names.
fn title(report: &Report<'_>) -> String {
    let sets = data_sets(report);
    let names: Vec<String> =
        sets.iter().take(MAX_NAMES).map(|set| file_name(set.as_ref())).collect();
    match sets.len() {
        0 => "A run".to_owned(),
        1..=MAX_NAMES => names.join(", "),
        more => format!("{} and {} more", names.join(", "), more - MAX_NAMES),
    }
}

fn data_sets(report: &Report<'_>) -> Vec<String> {
    if !report.run.data_sets.is_empty() {
        return report.run.data_sets.clone();
    }
    report.scenes.iter().map(|scene| scene.data_set.clone()).collect()
}

fn has_pipeline(run: &RunRecord) -> bool {
    !run.nodes.is_empty() || !run.unfinished.is_empty()
}

fn header(report: &Report<'_>, title: &str, has_pictures: bool) -> Markup {
    let run = report.run;
    let views: usize = report.scenes.iter().map(|scene| scene.views.len()).sum();
    let has_pipeline = has_pipeline(run);
    let ends = run.nodes.iter().map(|node| node.started_unix + node.seconds.max(0.0) as u64);
    let sets = data_sets(report);
    let links = [
        ("compare", "Compare", has_pictures),
        ("scores", "Scores", !report.rows.is_empty()),
        ("plots", "Plots", !report.rows.is_empty()),
        ("pipeline", "Pipeline", has_pipeline),
        ("commands", "Commands", true),
    ];
    html! {
        header class="top" {
            h1 { (title) }
            dl class="about" {
                @for (name, text) in facts(run) { div { dt { (name) } dd { (text) } } }
                div {
                    dt { "Data set" }
                    dd {
                        @for set in sets.iter().take(MAX_NAMES) { code { (set) } " " }
                        @if sets.len() > MAX_NAMES { "and " (sets.len() - MAX_NAMES) " more" }
                    }
                }
                @if let Some(ended) = ends.max() {
                    div { dt { "Date" } dd { time { (format_utc(ended)) } } }
                }
                @if let Some(commit) = run.commit() {
                    div { dt { "Commit" } dd { code { (commit) } } }
                }
                div {
                    dt { "Shows" }
                    dd {
                        (format_count(report.rows.len(), "result")) " · "
                        (format_count(views, "view"))
                    }
                }
            }
            nav aria-label="Sections" {
                @for (id, name, _) in links.iter().filter(|link| link.2) {
                    a href={ "#" (id) } { (name) }
                }
            }
        }
    }
}

/// Sections with failures and warnings, at the top of the page.
fn notices(report: &Report<'_>) -> Markup {
    let run = report.run;
    let warnings = warnings_by_node(run);
    let left_out: Vec<_> =
        run.failed.iter().filter_map(|point| Some((point, point.reason.as_ref()?))).collect();
    let failures = run.unfinished.iter().filter_map(|node| Some((node, node.message.as_ref()?)));
    let is_partial = run.failed.iter().any(|point| point.reason.is_none());
    html! {
        @if is_partial {
            section class="notice bad" id="failures" aria-labelledby="failures-heading" {
                h2 id="failures-heading" { "This run failed" }
                p { "The page has the results that were finished." }
                ul {
                    @for (node, message) in failures {
                        li { b { (artifact::label(&node.stage, &node.point)) } ": " (message) }
                    }
                }
            }
        }
        @if !report.unreadable.is_empty() {
            section class="notice bad" aria-labelledby="unread-heading" {
                h2 id="unread-heading" { "Scores that can't be read" }
                ul { @for problem in &report.unreadable { li { (problem) } } }
            }
        }
        @if !warnings.is_empty() {
            section class="notice" id="warnings" aria-labelledby="warnings-heading" {
                h2 id="warnings-heading" { "Warnings" }
                ul { @for (node, warning) in &warnings { li { b { (node) } ": " (warning) } } }
            }
        }
        @if !left_out.is_empty() {
            section class="notice" aria-labelledby="left-out-heading" {
                h2 id="left-out-heading" { "Left out" }
                ul {
                    @for (point, reason) in left_out {
                        li { b { (artifact::label(&point.stage, &point.point)) } ": " (reason) }
                    }
                }
            }
        }
    }
}
