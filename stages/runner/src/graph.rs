//! Pictures of a plan: text, Graphviz, SVG.

use std::fmt::Write as _;

use crate::plan::{Origin, Plan, State};

/// Edges of a node, in words: `prep/train`, `./folder`.
fn sources(plan: &Plan, index: usize) -> Vec<String> {
    let show = |from: &Origin| match from {
        Origin::Node { index, subtree: Some(folder) } => format!("{}/{folder}", plan.nodes[*index].label()),
        Origin::Node { index, subtree: None } => plan.nodes[*index].label(),
        Origin::Folder(folder) => folder.display().to_string(),
    };
    plan.nodes[index].inputs.iter().map(|i| format!("{} = {}", i.name, show(&i.from))).collect()
}

pub(crate) fn state_word(state: &State) -> &'static str {
    match state {
        State::Cached(_) => "cached",
        State::WillRun { .. } => "will run",
        State::Waits { .. } => "waits",
    }
}

pub(crate) fn ascii(plan: &Plan, states: &[State]) -> String {
    let mut text = String::new();
    let depths = depths(plan);
    for (i, node) in plan.nodes.iter().enumerate() {
        let indent = "  ".repeat(depths[i]);
        let made_of = sources(plan, i).join(", ");
        let arrow = if made_of.is_empty() { String::new() } else { format!("  ← {made_of}") };
        writeln!(text, "{indent}{} ({}){arrow}", node.label(), state_word(&states[i])).expect("a string can be written");
    }
    text
}

pub(crate) fn dot(plan: &Plan) -> String {
    let mut text = "digraph pipeline {\n  rankdir=LR;\n  node [shape=box];\n".to_owned();
    for (i, node) in plan.nodes.iter().enumerate() {
        writeln!(text, "  n{i} [label={:?}];", node.label()).expect("a string can be written");
        for input in &node.inputs {
            if let Origin::Node { index, subtree } = &input.from {
                writeln!(text, "  n{index} -> n{i} [label={:?}];", subtree.as_deref().unwrap_or_default())
                    .expect("a string can be written");
            }
        }
    }
    text + "}\n"
}

pub(crate) fn svg(plan: &Plan, states: &[State]) -> String {
    const BOX: (usize, usize) = (190, 36);
    const GAP: (usize, usize) = (60, 20);
    let depths = depths(plan);
    let mut rows = vec![0; depths.iter().max().map_or(0, |d| d + 1)];
    let places: Vec<(usize, usize)> = depths
        .iter()
        .map(|&d| {
            rows[d] += 1;
            (20 + d * (BOX.0 + GAP.0), 20 + (rows[d] - 1) * (BOX.1 + GAP.1))
        })
        .collect();
    let (width, height) = (rows.len() * (BOX.0 + GAP.0) + 20, rows.iter().max().unwrap_or(&0) * (BOX.1 + GAP.1) + 20);
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n"
    );
    for (i, node) in plan.nodes.iter().enumerate() {
        for parent in node.parents() {
            let (x1, y1) = (places[parent].0 + BOX.0, places[parent].1 + BOX.1 / 2);
            let (x2, y2) = (places[i].0, places[i].1 + BOX.1 / 2);
            let middle = usize::midpoint(x1, x2);
            writeln!(text, "<path d=\"M{x1} {y1} C{middle} {y1} {middle} {y2} {x2} {y2}\" fill=\"none\" stroke=\"#888\"/>")
                .expect("a string can be written");
        }
    }
    for (i, node) in plan.nodes.iter().enumerate() {
        let (x, y) = places[i];
        let fill = if matches!(states[i], State::Cached(_)) { "#dcefdc" } else { "#f4e3c3" };
        let label = node.label().replace('&', "&amp;").replace('<', "&lt;");
        writeln!(
            text,
            "<rect x=\"{x}\" y=\"{y}\" width=\"{}\" height=\"{}\" rx=\"6\" fill=\"{fill}\" stroke=\"#555\"/><text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{label}</text>",
            BOX.0, BOX.1, x + BOX.0 / 2, y + BOX.1 / 2 + 4
        )
        .expect("a string can be written");
    }
    text + "</svg>\n"
}

/// Longest way from a source, for each node.
fn depths(plan: &Plan) -> Vec<usize> {
    let mut depths: Vec<usize> = Vec::with_capacity(plan.nodes.len());
    for node in &plan.nodes {
        depths.push(node.parents().map(|p| depths[p] + 1).max().unwrap_or(0));
    }
    depths
}
