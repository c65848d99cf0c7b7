use std::collections::BTreeMap;
use std::path::PathBuf;

use artifact::{
    RunInput, RunNode, RunRecord, UnfinishedNode, format_count, format_duration, format_size,
    format_utc,
};
use maud::{Markup, html};
use serde_json::Value;
use stage::plain;

use crate::commands::{file_name, stage_command};
use crate::layout::{Drawing, HEIGHT, WIDTH, draw};

/// Nodes of a block at all points of a sweep.
#[derive(Default)]
struct Block<'a> {
    name: &'a str,
    done: Vec<&'a RunNode>,
    undone: Vec<&'a UnfinishedNode>,
}

/// State of a node. The first state among a block's nodes colours its box.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum State {
    Failed,
    NotRun,
    Ran,
    Cached,
    /// Finished; whether in this run or an earlier one isn't recorded.
    Finished,
}

impl State {
    fn of(node: &RunNode) -> Self {
        match node.is_cached {
            Some(true) => Self::Cached,
            Some(false) => Self::Ran,
            None => Self::Finished,
        }
    }

    fn of_unfinished(node: &UnfinishedNode) -> Self {
        if node.message.is_some() { Self::Failed } else { Self::NotRun }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Failed => "failed",
            Self::NotRun => "not run",
            Self::Ran => "ran",
            Self::Cached => "cached",
            Self::Finished => "done",
        }
    }

    /// Returns a symbol, so that states don't differ by colour alone.
    fn symbol(self) -> &'static str {
        match self {
            Self::Failed => "✕",
            Self::NotRun => "–",
            Self::Ran | Self::Finished => "●",
            Self::Cached => "○",
        }
    }
}

/// Section with the graph of blocks and the details of each node.
pub(crate) fn pipeline(run: &RunRecord) -> Markup {
    let (blocks, edges, folders) = graph(run);
    let drawing = draw(folders.len() + blocks.len(), &edges);
    html! {
        section id="pipeline" aria-labelledby="pipeline-heading" {
            h2 id="pipeline-heading" { "Pipeline" }
            p class="note" {
                "Time and peak memory were measured when a stage ran. "
                "A cached stage ran in an earlier run."
            }
            div class="pipeline" {
                div class="graph" tabindex="0" role="region" aria-label="Graph of the stages" {
                    (boxes(&blocks, &folders, &drawing))
                }
                div class="stages" {
                    @for (number, block) in blocks.iter().enumerate() {
                        (block_details(run, block, number))
                    }
                }
            }
        }
    }
}

/// Returns the blocks, the edges, and the input folders outside the store, which are the graph's
/// first boxes.
fn graph(run: &RunRecord) -> (Vec<Block<'_>>, Vec<(usize, usize)>, Vec<&PathBuf>) {
    let mut blocks: Vec<Block<'_>> = Vec::new();
    // Block of each node: finished nodes, then unfinished ones.
    let mut block_of: Vec<usize> = Vec::new();
    let names = run.nodes.iter().map(|node| &node.stage);
    for name in names.chain(run.unfinished.iter().map(|node| &node.stage)) {
        let known = blocks.iter().position(|block| block.name == name);
        block_of.push(known.unwrap_or_else(|| {
            blocks.push(Block { name, ..Block::default() });
            blocks.len() - 1
        }));
    }
    let mut folders: Vec<&PathBuf> = Vec::new();
    for input in run.nodes.iter().flat_map(|node| node.inputs.values()) {
        folders.extend(input.folder.as_ref().filter(|folder| !folders.contains(folder)));
    }
    let folder_count = folders.len();
    let mut edges: Vec<(usize, usize)> = Vec::new();
    for (index, node) in run.nodes.iter().enumerate() {
        blocks[block_of[index]].done.push(node);
        for input in node.inputs.values() {
            let by_node = input.node.map(|parent| folder_count + block_of[parent]);
            let by_folder = input.folder.as_ref();
            let by_folder = by_folder.and_then(|folder| folders.iter().position(|f| *f == folder));
            edges.extend(by_node.or(by_folder).map(|from| (from, folder_count + block_of[index])));
        }
    }
    for (index, node) in run.unfinished.iter().enumerate() {
        let block = block_of[run.nodes.len() + index];
        blocks[block].undone.push(node);
        let to = folder_count + block;
        edges.extend(node.needs.iter().map(|&needed| (folder_count + block_of[needed], to)));
    }
    // `draw` needs edges to later boxes. Edges within a block or to an earlier one are left out.
    edges.retain(|(from, to)| from < to);
    edges.sort_unstable();
    edges.dedup();
    (blocks, edges, folders)
}

fn boxes(blocks: &[Block<'_>], folders: &[&PathBuf], drawing: &Drawing) -> Markup {
    let Drawing { width, height, boxes, edges } = drawing;
    html! {
        div class="canvas" style=(format!("width:{width:.0}px;height:{height:.0}px")) {
            svg width=(width) height=(height) aria-hidden="true" {
                defs {
                    marker id="arrow" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7"
                        markerHeight="7" orient="auto" { path d="M0 0L8 4L0 8z" {} }
                }
                @for edge in edges { path class="edge" d=(edge) marker-end="url(#arrow)" {} }
            }
            @for (number, folder) in folders.iter().enumerate() {
                div class="box folder" style=(box_style(boxes[number])) title=(folder.display()) {
                    b { (file_name(folder)) } small { "folder" }
                }
            }
            @for (number, block) in blocks.iter().enumerate() {
                @let state = block.states().next().map_or(State::Finished, |(state, _)| state);
                a class={ "box " (state.name().replace(' ', "-")) }
                    style=(box_style(boxes[folders.len() + number]))
                    href={ "#stage-" (number) } {
                    b { (block.name) }
                    small { (block.cost()) }
                    small class="state" { (block.status()) }
                }
            }
        }
    }
}

fn box_style([x, y]: [f64; 2]) -> String {
    format!("left:{x:.0}px;top:{y:.0}px;width:{WIDTH}px;height:{HEIGHT}px")
}

impl Block<'_> {
    /// Counts the nodes in each state, in the states' order.
    fn states(&self) -> impl Iterator<Item = (State, usize)> {
        let mut states: BTreeMap<State, usize> = BTreeMap::new();
        let done = self.done.iter().map(|node| State::of(node));
        let undone = self.undone.iter().map(|node| State::of_unfinished(node));
        for state in done.chain(undone) {
            *states.entry(state).or_default() += 1;
        }
        states.into_iter()
    }

    fn count(&self) -> usize {
        self.done.len() + self.undone.len()
    }

    /// Returns time and peak memory as text.
    fn cost(&self) -> String {
        if self.done.is_empty() {
            return String::new();
        }
        let time = format_duration(self.done.iter().map(|node| node.seconds).sum());
        let memory = self.done.iter().filter_map(|node| node.peak_memory).max();
        memory.map_or(time.clone(), |bytes| format!("{time} · {}", format_size(bytes)))
    }

    /// Returns state and hash as text; for several points, their number in each state.
    fn status(&self) -> String {
        let states = self.states().map(|(state, count)| match self.count() {
            1 => format!("{} {}", state.symbol(), state.name()),
            _ => format!("{} {count} {}", state.symbol(), state.name()),
        });
        let states: Vec<String> = states.collect();
        let hash = match self.done.as_slice() {
            [node] if self.count() == 1 => node.output.get(..10).unwrap_or(&node.output),
            _ => "",
        };
        if hash.is_empty() { states.join(" ") } else { format!("{} · {hash}", states.join(" ")) }
    }
}

fn block_details(run: &RunRecord, block: &Block<'_>, number: usize) -> Markup {
    let program = block.done.first().map(|node| node.program.as_str()).unwrap_or_default();
    html! {
        details class="stage" {
            summary {
                b { (block.name) }
                @if !program.is_empty() && program != block.name { " " small { "(" (program) ")" } }
                " " small {
                    (block.status())
                    @if block.count() == 1 && block.undone.is_empty() { " · " (block.cost()) }
                }
            }
            // Target of the graph's links; following a link opens the details around the target.
            span id={ "stage-" (number) } class="target" {}
            @for node in &block.done {
                (at_point(block, &node.point, &node_details(run, node)))
            }
            @for node in &block.undone {
                (at_point(block, &node.point, &unfinished_details(node)))
            }
        }
    }
}

/// Details of a block's node, below its point if the block has several.
fn at_point(block: &Block<'_>, point: &str, node: &Markup) -> Markup {
    html! {
        @if block.count() == 1 {
            div class="node" { (node) }
        } @else {
            details class="point" { summary { (point) } (node) }
        }
    }
}

fn node_details(run: &RunRecord, node: &RunNode) -> Markup {
    let state = match State::of(node) {
        State::Cached => "cached: made by an earlier run",
        State::Ran => "ran in this run",
        _ => "done",
    };
    let mut facts: Vec<(&str, String)> = vec![
        ("State", state.to_owned()),
        ("Started", format_utc(node.started_unix)),
        ("Time", format_duration(node.seconds)),
    ];
    facts.extend(node.processor_seconds.map(|time| ("Processor time", format_duration(time))));
    facts.extend(node.peak_memory.map(|bytes| ("Peak memory", format_size(bytes))));
    facts.push(("Threads", node.threads.to_string()));
    if !node.host.is_empty() {
        facts.push(("Machine", node.host.clone()));
    }
    html! {
        dl class="facts" {
            @for (name, value) in &facts { dt { (name) } dd { (value) } }
            dt { "Artifact" } dd { code { (node.output) } }
            dt { "Key" } dd { code { (node.key) } }
            dt { "Folder" } dd { code { (node.folder.display()) } }
            @for (name, input) in &node.inputs {
                dt { "Input " (name) } dd { code { (source(run, input)) } }
            }
        }
        (parameters(&node.parameters, &node.resolved))
        (stage_command(run, node))
    }
}

fn unfinished_details(node: &UnfinishedNode) -> Markup {
    html! {
        @if let Some(message) = &node.message {
            p class="failure" { b { "Failed: " } (message) }
        } @else {
            p {
                "Not run: the stage of an input failed, or the run ended first. "
                code { "nerf-sr run" } " continues."
            }
        }
        (parameters(&node.parameters, &serde_json::Map::new()))
    }
}

fn source(run: &RunRecord, input: &RunInput) -> String {
    match (input.node, &input.subtree) {
        (Some(i), Some(folder)) => format!("{}/{folder}", run.nodes[i].stage),
        (Some(i), None) => run.nodes[i].stage.clone(),
        (None, _) => input.folder.as_ref().map(|f| f.display().to_string()).unwrap_or_default(),
    }
}

type Values = serde_json::Map<String, Value>;

/// Table of parameters with the values in use.
fn parameters(given: &Values, resolved: &Values) -> Markup {
    html! {
        @if !given.is_empty() {
            table class="parameters" {
                caption { (format_count(given.len(), "parameter")) }
                tbody {
                    @for (name, value) in given {
                        tr {
                            th scope="row" { (name) }
                            td { (parameter(value, resolved.get(name))) }
                        }
                    }
                }
            }
        }
    }
}

/// Value of a parameter; for a default by scene, the value in use.
fn parameter(given: &Value, resolved: Option<&Value>) -> Markup {
    html! {
        @match resolved {
            Some(value) if given.is_null() && !value.is_null() => {
                (plain(value)) " " small { "by scene" }
            }
            _ if given.is_null() => small { "default" },
            _ => (plain(given)),
        }
    }
}
