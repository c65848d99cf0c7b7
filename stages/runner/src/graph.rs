//! Drawings of a plan: text, Graphviz, SVG.

use planning::{Origin, Plan, State};

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

    fn colour(self) -> &'static str {
        match self {
            Self::Cached => "#dcefdc",
            Self::WillRun | Self::Waits => "#f4e3c3",
            Self::Sink => "#ffffff",
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

pub(crate) fn ascii(plan: &Plan, states: &[State]) -> String {
    let all = drawn(plan, states);
    let lines = all.iter().zip(depths(&all)).map(|(drawn, depth)| {
        let made_of = drawn.made_of.join(", ");
        let arrow = if made_of.is_empty() { String::new() } else { format!("  ← {made_of}") };
        format!("{}{} ({}){arrow}\n", "  ".repeat(depth), drawn.label, drawn.state.word())
    });
    lines.collect()
}

pub(crate) fn dot(plan: &Plan, states: &[State]) -> String {
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

/// Size of a box, and the space between two.
const BOX: (usize, usize) = (190, 36);
const GAP: (usize, usize) = (60, 20);

pub(crate) fn svg(plan: &Plan, states: &[State]) -> String {
    let all = drawn(plan, states);
    let depths = depths(&all);
    let mut rows = vec![0; depths.iter().max().map_or(0, |d| d + 1)];
    let mut places: Vec<(usize, usize)> = Vec::new();
    for depth in depths {
        places.push((20 + depth * (BOX.0 + GAP.0), 20 + rows[depth] * (BOX.1 + GAP.1)));
        rows[depth] += 1;
    }
    let (width, height) =
        (rows.len() * (BOX.0 + GAP.0) + 20, rows.iter().max().unwrap_or(&0) * (BOX.1 + GAP.1) + 20);
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
        font-family=\"sans-serif\" font-size=\"12\">\n"
    );
    for (drawn, (x2, y2)) in all.iter().zip(&places) {
        for (x1, y1) in drawn.parents.iter().map(|(parent, _)| places[*parent]) {
            let (x1, y1, y2) = (x1 + BOX.0, y1 + BOX.1 / 2, y2 + BOX.1 / 2);
            let middle = usize::midpoint(x1, *x2);
            text += &format!(
                "<path d=\"M{x1} {y1} C{middle} {y1} {middle} {y2} {x2} {y2}\" fill=\"none\" \
                stroke=\"#888\"/>\n"
            );
        }
    }
    for (drawn, (x, y)) in all.iter().zip(&places) {
        let (width, height, fill) = (BOX.0, BOX.1, drawn.state.colour());
        let label = drawn.label.replace('&', "&amp;").replace('<', "&lt;");
        let (middle, baseline) = (x + width / 2, y + height / 2 + 4);
        text += &format!(
            "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" rx=\"6\" \
            fill=\"{fill}\" stroke=\"#555\"/>"
        );
        text += &format!(
            "<text x=\"{middle}\" y=\"{baseline}\" text-anchor=\"middle\">{label}</text>\n"
        );
    }
    text + "</svg>\n"
}

/// Longest way from a source, for each.
fn depths(all: &[Drawn]) -> Vec<usize> {
    let mut depths: Vec<usize> = Vec::with_capacity(all.len());
    for drawn in all {
        depths.push(drawn.parents.iter().map(|(parent, _)| depths[*parent] + 1).max().unwrap_or(0));
    }
    depths
}
