//! A plan with the states of its nodes, and these as text.

use std::collections::BTreeSet;
use std::path::PathBuf;

use artifact::{format_duration, hash_json, unix_time};
use planning::{Plan, Sink, State, short_hash};
use serde_json::{Map, Value};
use store::{Record, Store};

/// A plan with the states of its nodes.
pub(crate) struct Planned<'a> {
    pub(crate) store: &'a Store,
    pub(crate) plan: Plan,
    pub(crate) states: Vec<State>,
}

impl Planned<'_> {
    /// Finds the nodes that will run and on which a waiting node depends, directly or not.
    pub(crate) fn blocking_nodes(&self, index: usize) -> BTreeSet<usize> {
        let mut found = BTreeSet::new();
        let mut open = vec![index];
        while let Some(index) = open.pop() {
            let State::Waits { on } = &self.states[index] else { continue };
            open.extend(on);
            let will_run = |&&parent: &&usize| matches!(self.states[parent], State::WillRun { .. });
            found.extend(on.iter().filter(will_run));
        }
        found
    }

    /// Describes a node's state. With records, explains why the node will run.
    pub(crate) fn state_text(&self, index: usize, records: Option<&[Record]>) -> String {
        match (&self.states[index], records) {
            (State::Cached(record), _) => {
                let age = age_text(record.started_unix);
                format!("cached ({age}, took {})", format_duration(record.seconds))
            }
            (State::Waits { on }, _) => {
                let names: Vec<String> =
                    on.iter().map(|&parent| self.plan.nodes[parent].label()).collect();
                format!("waits for {}; stays cached if results don't change", names.join(", "))
            }
            (State::WillRun { .. }, None) => "will run".to_owned(),
            (State::WillRun { key_parts }, Some(records)) => {
                match planning::explain(key_parts, &self.plan.nodes[index].stage, records) {
                    None => "will run: no earlier run of this stage".to_owned(),
                    Some(changes) if changes.is_empty() => self.missing_text(key_parts),
                    Some(changes) => format!("will run: {}", changes.join("; ")),
                }
            }
        }
    }

    /// Describes the state of a node that will run, although a record has its key.
    fn missing_text(&self, key_parts: &Map<String, Value>) -> String {
        match self.store.record(&hash_json(key_parts)) {
            Ok(Some(record)) => {
                let output = short_hash(&record.output);
                format!("will run: its artifact {output} is missing or incomplete")
            }
            _ => "will run".to_owned(),
        }
    }

    /// Returns the parameters that the scene decides, with their values if the node is cached.
    pub(crate) fn scene_defaults(&self, index: usize) -> Map<String, Value> {
        let artifact = match &self.states[index] {
            State::Cached(record) => self.store.object(&record.output),
            _ => PathBuf::new(),
        };
        self.plan.nodes[index].scene_defaults(&artifact)
    }

    /// Lists [`Self::scene_defaults`].
    pub(crate) fn by_scene_text(&self, index: usize) -> Option<String> {
        let mut entries = Vec::new();
        for (name, value) in self.scene_defaults(index) {
            entries.push(match value {
                Value::Null => name,
                Value::String(text) => format!("{name}={text}"),
                value => format!("{name}={value}"),
            });
        }
        (!entries.is_empty()).then(|| format!("by scene: {}", entries.join(", ")))
    }

    /// Describes a sink's nodes and when a run writes the sink's page. The text doesn't depend on
    /// an existing page, because only `run` knows the folder of pages.
    pub(crate) fn sink_text(&self, sink: &Sink) -> String {
        let nodes = sink.nodes();
        let mut names: Vec<&str> =
            nodes.iter().map(|&index| self.plan.nodes[index].stage.as_str()).collect();
        names.dedup();
        let is_cached = nodes.iter().all(|&index| matches!(self.states[index], State::Cached(_)));
        let when = if is_cached {
            "all cached: a run writes the page only if it doesn't exist"
        } else {
            "a run writes the page again if results change"
        };
        format!("shows {}; {when}", names.join(", "))
    }
}

/// Returns the time that has passed since a time: `5 s ago`.
pub(crate) fn age_text(unix: u64) -> String {
    match unix_time().saturating_sub(unix) {
        s if s < 120 => format!("{s} s ago"),
        s if s < 7200 => format!("{} min ago", s / 60),
        s if s < 172_800 => format!("{} h ago", s / 3600),
        s => format!("{} days ago", s / 86_400),
    }
}
