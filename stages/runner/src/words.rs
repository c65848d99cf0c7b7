//! States of nodes, in words.

use std::collections::BTreeSet;
use std::path::PathBuf;

use artifact::hash_json;
use planning::{Node, Plan, Sink, State, short_hash};
use serde_json::Value;
use stage_call::seconds;
use store::Record;

use crate::session::Session;

/// The nodes that will run for sure and on which a waiting node depends, directly or not.
pub(crate) fn causes(states: &[State], index: usize) -> Vec<usize> {
    let mut found = BTreeSet::new();
    let mut waiting = vec![index];
    while let Some(i) = waiting.pop() {
        if let State::Waits { on } = &states[i] {
            waiting.extend(on);
            found
                .extend(on.iter().copied().filter(|&p| matches!(states[p], State::WillRun { .. })));
        }
    }
    found.into_iter().collect()
}

/// A node's state in words; with records, why it will run.
pub(crate) fn words(
    session: &Session,
    plan: &Plan,
    index: usize,
    state: &State,
    records: Option<&[Record]>,
) -> String {
    match state {
        State::Cached(record) => {
            format!("cached ({}, made in {})", age(record), seconds(record.seconds))
        }
        State::Waits { on } => {
            let names: Vec<String> = on.iter().map(|&p| plan.nodes[p].label()).collect();
            format!("waits for {}; if that comes out as before, it stays cached", names.join(", "))
        }
        State::WillRun { key_parts } => {
            match records
                .map(|records| planning::explain(key_parts, &plan.nodes[index].stage, records))
            {
                None => "will run".to_owned(),
                Some(None) => "will run: it never ran before".to_owned(),
                Some(Some(changes)) if changes.is_empty() => {
                    match session.store.record(&hash_json(key_parts)) {
                        Ok(Some(record)) => format!(
                            "will run: its artifact {} is gone or incomplete",
                            short_hash(&record.output)
                        ),
                        _ => "will run".to_owned(),
                    }
                }
                Some(Some(changes)) => format!("will run: {}", changes.join("; ")),
            }
        }
    }
}

/// A line on the parameters that the scene decides: their values where the node is cached, else
/// their names.
pub(crate) fn by_scene(session: &Session, node: &Node, state: &State) -> Option<String> {
    let artifact = match state {
        State::Cached(record) => session.store.object(&record.output),
        _ => PathBuf::new(),
    };
    let entries = node.by_scene(&artifact).into_iter().map(|(name, value)| match value {
        Value::Null => name,
        Value::String(word) => format!("{name}={word}"),
        value => format!("{name}={value}"),
    });
    let entries: Vec<String> = entries.collect();
    (!entries.is_empty()).then(|| format!("by scene: {}", entries.join(", ")))
}

/// What becomes of a sink at the end of a run. Whether its page is there is for `run` to see: it
/// alone knows where pages are written.
pub(crate) fn shown(plan: &Plan, sink: &Sink, states: &[State]) -> String {
    let mut names: Vec<String> =
        sink.shows.iter().map(|&index| plan.nodes[index].stage.clone()).collect();
    names.dedup();
    let is_old = sink.shows.iter().all(|&index| matches!(states[index], State::Cached(_)));
    let when = if is_old {
        "all cached: a run writes it only where it isn't there"
    } else {
        "a run writes it anew where they change"
    };
    format!("shows {}; {when}", names.join(", "))
}

pub(crate) fn age(record: &Record) -> String {
    let now = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |d| d.as_secs());
    match now.saturating_sub(record.started_unix) {
        s if s < 120 => format!("{s} s ago"),
        s if s < 7200 => format!("{} min ago", s / 60),
        s if s < 172_800 => format!("{} h ago", s / 3600),
        s => format!("{} days ago", s / 86_400),
    }
}
