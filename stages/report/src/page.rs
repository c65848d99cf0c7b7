use std::path::Path;

use artifact::{RunInput, RunNode, RunRecord};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use pixels::read_png;
use scene::Views;
use serde_json::Value;

use crate::Params;
use crate::compare::compare;
use crate::figures::{Figure, figures};
use crate::images::{colour, depth, depths_of, shown_in_gallery};
use crate::results::{metrics, scored, warnings_by_node};

const STYLE: &str = "
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1240px; padding: 0 1rem; color: #222; background: #fff }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2.2rem }
table { border-collapse: collapse; margin: .6rem 0 } th, td \
{ padding: .3rem .7rem; text-align: left; border-bottom: 1px solid #ddd }
td.n { text-align: right; font-variant-numeric: tabular-nums } th { font-weight: 600 } .best \
{ font-weight: 700 }
.row { display: flex; gap: 6px; flex-wrap: wrap; margin: .4rem 0 1.2rem } figure \
{ margin: 0; flex: 1 1 180px; max-width: 300px }
figure img { width: 100%; border: 1px solid #ddd; display: block } img.lr, img.px \
{ image-rendering: pixelated }
/* One column a method, the same in both rows. */
.compare figure { flex: 1 1 0; min-width: 110px }
#warnings { border: 2px solid #b3261e; background: #fdecea; padding: 0 1rem .2rem; margin: 1rem 0 } #warnings h2 { margin: .6rem 0 }
figcaption { font-size: .82rem; color: #555 } code { font-size: .85em } details \
{ margin: .3rem 0 } small { color: #666 }
";

/// What a metrics node was scored on.
pub(crate) struct Point<'a> {
    pub(crate) node: &'a RunNode,
    pub(crate) metrics: Value,
    index: usize,
}

pub(crate) fn page(run: &RunRecord, params: &Params) -> anyhow::Result<Markup> {
    let mut points = Vec::new();
    for (index, node) in scored(run) {
        points.push(Point { node, metrics: metrics(node)?, index });
    }
    let galleries = points
        .iter()
        .map(|p| gallery(run, p, params.views as usize))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let compared = compare(run, &points, params)?;
    Ok(html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { "nerf-sr report" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { "nerf-sr report" }
                (warnings(run))
                (scores(run, &points))
                (compared)
                @for (point, gallery) in points.iter().zip(&galleries) {
                    h2 { "Views" @if points.len() > 1 { " · " (label(&points, point)) } }
                    (gallery)
                }
                (stages(run))
            }
        }
    })
}

/// What stages warned of, before anything else.
fn warnings(run: &RunRecord) -> Markup {
    let found = warnings_by_node(run);
    html! {
        @if !found.is_empty() {
            div id="warnings" {
                h2 { "Warnings" }
                ul { @for (node, warning) in &found { li { b { (node) } ": " (warning) } } }
            }
        }
    }
}

/// A table of means, one row a point, the best figure of each column in bold.
fn scores(run: &RunRecord, points: &[Point<'_>]) -> Markup {
    let figures = figures(points);
    html! {
        table id="scores" {
            thead {
                tr {
                    th { "point" }
                    @for figure in &figures { th { (figure.label) } }
                    th { "views" } th { "training" } th { "rendering" }
                }
            }
            tbody {
                @for point in points {
                    tr {
                        td { (label(points, point)) }
                        @for figure in &figures { (mean(figure, point, points)) }
                        td class="n" { (point.metrics["views"].as_array().map_or(0, Vec::len)) }
                        @let [training, rendering] = times(run, point);
                        td class="n" { (duration(training)) }
                        td class="n" { (duration(rendering)) }
                    }
                }
            }
        }
        @if let Some(point) = points.first() {
            details {
                summary { "How these figures were made" }
                ul {
                    @for (name, text) in point.metrics["conventions"].as_object().into_iter().flatten() {
                        li { b { (name) } ": " (text.as_str().unwrap_or_default()) }
                    }
                }
            }
        }
    }
}

/// A cell of that table.
fn mean(figure: &Figure, point: &Point<'_>, points: &[Point<'_>]) -> Markup {
    let Some(value) = figure.mean(point) else {
        // Without HR truth no weights would help.
        let has_truth = point.metrics["mean"]["psnr"].is_number();
        let missing = figure.missing.as_deref().filter(|_| has_truth);
        return html! { td { (missing.unwrap_or("–")) } };
    };
    let class = if figure.is_best(value, points) { "n best" } else { "n" };
    html! { td class=(class) { (figure.text(value)) } }
}

/// What tells a point from the others: its values in the sweep and, where several blocks score,
/// whose scores they are (`eval-refined`: refined).
pub(crate) fn label(points: &[Point<'_>], point: &Point<'_>) -> String {
    let (stage, values) = (point.node.stage.as_str(), point.node.point.as_str());
    let whose = stage.strip_prefix("eval-").unwrap_or(stage);
    match (points.iter().any(|p| p.node.stage != stage), values) {
        (false, "") => "default".to_owned(),
        (false, values) => values.to_owned(),
        (true, "") => whose.to_owned(),
        (true, values) => format!("{whose}, {values}"),
    }
}

/// Seconds of training and of rendering. What was rendered on the way to a refiner belongs to its
/// training.
fn times(run: &RunRecord, point: &Point<'_>) -> [f64; 2] {
    let mut rendered = Vec::new();
    let mut next = point.node.inputs.get("views").and_then(|input| input.node);
    while let Some(index) = next {
        rendered.push(index);
        next = run.nodes[index].inputs.get("views").and_then(|input| input.node);
    }
    let seconds = |i: &usize| run.nodes[*i].seconds;
    let trains = |i: &usize| {
        ["field", "refiner", "views"].contains(&run.nodes[*i].kind.as_str())
            && !rendered.contains(i)
    };
    [
        run.ancestors(point.index).iter().filter(|i| trains(i)).map(seconds).sum(),
        rendered.iter().map(seconds).sum(),
    ]
}

fn duration(seconds: f64) -> String {
    if seconds < 90.0 { format!("{seconds:.1} s") } else { format!("{:.1} min", seconds / 60.0) }
}

/// LR input, render, truth, error, depth of some views.
fn gallery(run: &RunRecord, point: &Point<'_>, count: usize) -> anyhow::Result<Markup> {
    let folder = |input: &str| point.node.inputs.get(input).map(|s| run.folder_of(s));
    let (Some(rendered), Some(truth)) = (folder("views"), folder("truth")) else {
        return Ok(html! { p { "These metrics have no inputs `views` and `truth` to show." } });
    };
    let (views, truths) = (Views::of_folder(&rendered)?, Views::of_folder(&truth)?);
    let all = point.metrics["views"].as_array().cloned().unwrap_or_default();
    let shown = count.min(all.len());
    let find =
        |list: &Views, name: &str| list.views.iter().find(|v| v.camera.name == name).cloned();
    let chosen = (0..shown).map(|k| &all[k * all.len() / shown]).filter_map(|scores| {
        let name = scores["name"].as_str()?;
        Some((scores, find(&views, name)?, find(&truths, name)?))
    });
    let chosen: Vec<_> = chosen.collect();
    let range = depths_of(&rendered, chosen.iter().map(|(_, view, _)| view))?.unwrap_or((0.0, 1.0));
    let mut rows = Vec::new();
    for (scores, view, true_view) in chosen {
        let name = &view.camera.name;
        let figure = |class: &str, uri: Option<String>, caption: String| {
            html! {
                @if let Some(uri) = uri {
                    figure {
                        img class=(class) src=(uri) alt=(format!("{caption}, view {name}"));
                        figcaption { (caption) }
                    }
                }
            }
        };
        let embedded = |folder: &Path,
                        file: &Option<String>,
                        background|
         -> anyhow::Result<Option<(String, usize)>> {
            let image = file.as_ref().map(|f| colour(folder, f, background)).transpose()?;
            Ok(image.map(|i| (shown_in_gallery(&i), i.width)))
        };
        let lr = embedded(&truth, &true_view.low_resolution, truths.background)?;
        let found = embedded(&rendered, &view.image, views.background)?;
        let expected = embedded(&truth, &true_view.image, truths.background)?;
        let map = |file: &Value| -> anyhow::Result<Option<String>> {
            let file = file.as_str().map(|f| read_png(&point.node.folder.join(f))).transpose()?;
            Ok(file.map(|map| shown_in_gallery(&map)))
        };
        let (error, warped) = (map(&scores["error_map"])?, map(&scores["pictures"]["warp"])?);
        let depth = depth(&rendered, &view, range)?;
        let caption = |what: &str, found: &Option<(String, usize)>| {
            found.as_ref().map(|(_, w)| format!("{what}, {w} px")).unwrap_or_default()
        };
        let number = |key: &str, digits: usize| {
            scores["scores"]
                .pointer(key)
                .and_then(Value::as_f64)
                .map(|v| format!("{v:.digits$}"))
                .unwrap_or_else(|| "–".to_owned())
        };
        let (psnr, ssim) = (number("/psnr", 2), number("/ssim", 4));
        let at_lr = number("/low_resolution/psnr", 2);
        let of_error = if expected.is_some() { "error" } else { "error at LR" };
        let of_warp = format!("neighbour by depth, {} dB (red: not seen)", number("/warp/psnr", 2));
        rows.push(html! {
            h3 {
                "View " (name) " "
                small { "PSNR " (psnr) " dB · SSIM " (ssim) " · at LR " (at_lr) " dB" }
            }
            div class="row" {
                (figure("lr", lr.clone().map(|l| l.0), caption("LR", &lr)))
                (figure("px", found.clone().map(|f| f.0), caption("render", &found)))
                (figure("px", expected.clone().map(|e| e.0), caption("ground truth", &expected)))
                (figure("px", error, of_error.to_owned()))
                (figure("px", warped, of_warp))
                (figure("px", depth.map(|d| shown_in_gallery(&d)),
                    "depth (warm is near)".to_owned()))
            }
        });
    }
    Ok(html! { @for row in rows { (row) } })
}

/// A parameter's value; where that was left to the scene, the one in use.
fn parameter(given: &Value, resolved: Option<&Value>) -> String {
    match resolved {
        Some(value) if given.is_null() && !value.is_null() => format!("{value} (by scene)"),
        _ => given.to_string(),
    }
}

/// Every node with parameters, hashes and times.
fn stages(run: &RunRecord) -> Markup {
    let source = |input: &RunInput| match (input.node, &input.subtree) {
        (Some(i), Some(folder)) => format!("{}/{folder}", run.nodes[i].stage),
        (Some(i), None) => run.nodes[i].stage.clone(),
        (None, _) => input.folder.as_ref().map(|f| f.display().to_string()).unwrap_or_default(),
    };
    html! {
        h2 { "What was run" }
        table id="stages" {
            thead { tr { th { "stage" } th { "point" } th { "artifact" } th { "key" } th { "time" } th { "threads" } th { "parameters and inputs" } } }
            tbody {
                @for node in &run.nodes {
                    tr {
                        td { (node.stage) }
                        td { (node.point) }
                        td { code title=(node.output) { (node.output.get(..10).unwrap_or_default()) } }
                        td { code title=(node.key) { (node.key.get(..10).unwrap_or_default()) } }
                        td class="n" { (format!("{:.1} s", node.seconds)) }
                        td class="n" { (node.threads) }
                        td { details { summary { (node.parameters.len()) " parameters, " (node.inputs.len()) " inputs" }
                            @for (name, value) in &node.parameters { div { code { (name) ": " (parameter(value, node.resolved.get(name))) } } }
                            @for (name, input) in &node.inputs { div { code { (name) " ← " (source(input)) } } }
                        } }
                    }
                }
            }
        }
    }
}
