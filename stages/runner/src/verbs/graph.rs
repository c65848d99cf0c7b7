use std::process::ExitCode;

use artifact::print_lines;
use planning::{Origin, Plan, Request, State};

use crate::session::Session;

/// How a plan is drawn.
// Its values are without texts of their own: clap would give every verb's help its long form.
#[derive(Clone, Copy, clap::ValueEnum)]
pub(crate) enum GraphFormat {
    Ascii,
    Dot,
}

/// Draws the plan: as text, or for Graphviz.
pub(crate) fn graph(
    session: &Session,
    what: &Request,
    format: GraphFormat,
) -> anyhow::Result<ExitCode> {
    let plan = session.plan(what)?;
    let states = session.states(&plan)?;
    print_lines(&match format {
        GraphFormat::Ascii => ascii(&plan, &states),
        GraphFormat::Dot => dot(&plan, &states),
    });
    Ok(ExitCode::SUCCESS)
}

/// A node or a sink, as it is drawn.
struct Drawn<'a> {
    label: String,
    state: Drawing,
    /// What it is made of, in words: `scene = prep/train`.
    made_of: Vec<String>,
    /// The ones drawn before it that it is made of, and the folder of each that is meant.
    parents: Vec<(usize, &'a str)>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Drawing {
    Cached,
    WillRun,
    Waits,
    Sink,
}

impl Drawing {
    fn of(state: &State) -> Self {
        match state {
            State::Cached(_) => Self::Cached,
            State::WillRun { .. } => Self::WillRun,
            State::Waits { .. } => Self::Waits,
        }
    }

    fn word(self) -> &'static str {
        match self {
            Self::Cached => "cached",
            Self::WillRun => "will run",
            Self::Waits => "waits",
            Self::Sink => "shows the run",
        }
    }
}

/// The nodes in their order, and after them the sinks.
fn drawn<'a>(plan: &'a Plan, states: &[State]) -> Vec<Drawn<'a>> {
    let nodes = plan.nodes.iter().zip(states).map(|(node, state)| {
        let mut drawn = Drawn {
            label: node.label(),
            state: Drawing::of(state),
            made_of: Vec::new(),
            parents: Vec::new(),
        };
        for input in &node.inputs {
            let source = match &input.from {
                Origin::Node { index, subtree: Some(folder) } => {
                    format!("{}/{folder}", plan.nodes[*index].label())
                }
                Origin::Node { index, subtree: None } => plan.nodes[*index].label(),
                Origin::Folder(folder) => folder.display().to_string(),
            };
            drawn.made_of.push(format!("{} = {source}", input.name));
            if let Origin::Node { index, subtree } = &input.from {
                drawn.parents.push((*index, subtree.as_deref().unwrap_or_default()));
            }
        }
        drawn
    });
    let sinks = plan.sinks.iter().map(|sink| Drawn {
        label: sink.stage.clone(),
        state: Drawing::Sink,
        made_of: sink.shows.iter().map(|&index| plan.nodes[index].label()).collect(),
        parents: sink.shows.iter().map(|&index| (index, "")).collect(),
    });
    nodes.chain(sinks).collect()
}

fn ascii(plan: &Plan, states: &[State]) -> String {
    let all = drawn(plan, states);
    let lines = all.iter().zip(depths(&all)).map(|(drawn, depth)| {
        let made_of = drawn.made_of.join(", ");
        let arrow = if made_of.is_empty() { String::new() } else { format!("  ← {made_of}") };
        format!("{}{} ({}){arrow}\n", "  ".repeat(depth), drawn.label, drawn.state.word())
    });
    lines.collect()
}

fn dot(plan: &Plan, states: &[State]) -> String {
    let mut text = "digraph pipeline {\n  rankdir=LR;\n  node [shape=box];\n".to_owned();
    for (i, drawn) in drawn(plan, states).iter().enumerate() {
        let shape = if drawn.state == Drawing::Sink { ", shape=note" } else { "" };
        text += &format!("  n{i} [label={:?}{shape}];\n", drawn.label);
        for (parent, folder) in &drawn.parents {
            text += &format!("  n{parent} -> n{i} [label={folder:?}];\n");
        }
    }
    text + "}\n"
}

/// Longest way from a source, for each.
fn depths(all: &[Drawn]) -> Vec<usize> {
    let mut depths: Vec<usize> = Vec::with_capacity(all.len());
    for drawn in all {
        depths.push(drawn.parents.iter().map(|(parent, _)| depths[*parent] + 1).max().unwrap_or(0));
    }
    depths
}
