use artifact::print_lines;
use planning::{Origin, Plan, Request, State};

use crate::session::Session;

/// Output format of `graph`.
// Values have no doc comments: clap would give every verb's help its long form.
#[derive(Clone, Copy, clap::ValueEnum)]
pub(crate) enum Format {
    Text,
    Dot,
}

/// Draws the plan as text or for Graphviz.
pub(crate) fn graph(session: &Session, request: &Request, format: Format) -> anyhow::Result<()> {
    let planned = session.plan_with_states(request)?;
    let vertices = vertices(&planned.plan, &planned.states);
    print_lines(&match format {
        Format::Text => draw_as_text(&vertices),
        Format::Dot => draw_for_graphviz(&vertices),
    });
    Ok(())
}

/// A node or sink in the graph.
struct Vertex<'a> {
    label: String,
    state: &'static str,
    is_sink: bool,
    /// Inputs as text, such as `scene = prep/train`; for a sink, the nodes that it displays.
    inputs: Vec<String>,
    /// Index and subtree of each parent. Parents come before their children.
    parents: Vec<(usize, &'a str)>,
}

/// Returns the nodes in the plan's order, then the sinks.
fn vertices<'a>(plan: &'a Plan, states: &[State]) -> Vec<Vertex<'a>> {
    let mut vertices = Vec::with_capacity(plan.nodes.len() + plan.sinks.len());
    for (index, node) in plan.nodes.iter().enumerate() {
        let (mut inputs, mut parents) = (Vec::new(), Vec::new());
        for input in &node.inputs {
            let source = match &input.from {
                Origin::Node { index, subtree } => {
                    parents.push((*index, subtree.as_deref().unwrap_or_default()));
                    let slash = if subtree.is_some() { "/" } else { "" };
                    let subtree = subtree.as_deref().unwrap_or_default();
                    format!("{}{slash}{subtree}", plan.nodes[*index].label())
                }
                Origin::Folder(folder) => folder.display().to_string(),
            };
            inputs.push(format!("{} = {source}", input.name));
        }
        let state = states[index].name();
        vertices.push(Vertex { label: node.label(), state, is_sink: false, inputs, parents });
    }
    for sink in &plan.sinks {
        vertices.push(Vertex {
            label: sink.stage.clone(),
            state: "displays the run",
            is_sink: true,
            inputs: sink.nodes().into_iter().map(|index| plan.nodes[index].label()).collect(),
            parents: sink.nodes().into_iter().map(|index| (index, "")).collect(),
        });
    }
    vertices
}

/// Draws each vertex on a line of its own, indented by the length of the longest path to it.
fn draw_as_text(vertices: &[Vertex]) -> String {
    let mut depths: Vec<usize> = Vec::with_capacity(vertices.len());
    let mut text = String::new();
    for vertex in vertices {
        let depth = vertex.parents.iter().map(|(parent, _)| depths[*parent] + 1).max().unwrap_or(0);
        depths.push(depth);
        text += &format!("{}{} ({})", "  ".repeat(depth), vertex.label, vertex.state);
        if !vertex.inputs.is_empty() {
            text += &format!("  ← {}", vertex.inputs.join(", "));
        }
        text.push('\n');
    }
    text
}

fn draw_for_graphviz(vertices: &[Vertex]) -> String {
    let mut text = "digraph pipeline {\n  rankdir=LR;\n  node [shape=box];\n".to_owned();
    for (i, vertex) in vertices.iter().enumerate() {
        let shape = if vertex.is_sink { ", shape=note" } else { "" };
        text += &format!("  n{i} [label={}{shape}];\n", quoted(&vertex.label));
        for (parent, subtree) in &vertex.parents {
            text += &format!("  n{parent} -> n{i} [label={}];\n", quoted(subtree));
        }
    }
    text + "}\n"
}

/// Quotes a text for Graphviz, which knows fewer escapes than Rust.
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_quoted_for_graphviz() {
        assert_eq!(quoted("a \"b\" \\ e\u{301}"), "\"a \\\"b\\\" \\\\ e\u{301}\"");
    }
}
