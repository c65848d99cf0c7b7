//! Fuzzes the inputs of the runner: pipeline.yaml, a stage's description, the command line, and
//! records. The first byte selects one; the others are the seeds of `seeds.py`.
#![no_main]

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use planning::{Pipeline, Plan, Request};
use stage::{Description, Schema};
use store::Record;

macro_rules! seed {
    ($name:literal) => {
        include_bytes!(concat!(env!("FUZZ_SEEDS"), "/runner/", $name)).split_at(1).1
    };
}

/// Parses a request: each line is a letter and a parameter (`p`), an input (`i`) or a target (any
/// other letter).
fn request(data: &[u8]) -> Request {
    let mut request = Request::default();
    for line in String::from_utf8_lossy(data)
        .split('\n')
        .filter(|line| line.is_char_boundary(1) && !line.is_empty())
    {
        let (kind, rest) = line.split_at(1);
        match kind {
            "p" => request.parameters.push(rest.to_owned()),
            "i" => request.inputs.push(rest.to_owned()),
            _ => request.targets.push(rest.to_owned()),
        }
    }
    request
}

/// Parses a stage's description.
fn description(data: &[u8]) -> Option<Description> {
    serde_json::from_slice(data).ok()
}

/// Plans a pipeline and returns the number of nodes; `None` if an input is refused.
fn plan(pipeline: &[u8], train: &[u8], arguments: &[u8]) -> Option<usize> {
    let pipeline = Pipeline::parse(pipeline, Path::new("pipeline.yaml")).ok()?;
    let stages =
        [("make", seed!("describe-make")), ("train", train), ("report", seed!("describe-report"))];
    let descriptions: BTreeMap<String, Description> = stages
        .iter()
        .filter_map(|(name, data)| Some(((*name).to_owned(), description(data)?)))
        .collect();
    let plan = Plan::from_descriptions(&pipeline, &descriptions, &request(arguments)).ok()?;
    for node in &plan.nodes {
        assert!(!node.label().is_empty() && node.parameters.is_object());
    }
    Some(plan.nodes.len())
}

/// Checks once that the seeds can be planned; otherwise most inputs would be refused early.
static SEEDS: LazyLock<()> = LazyLock::new(|| {
    assert_eq!(plan(seed!("pipeline"), seed!("describe-train"), b""), Some(3));
    assert!(plan(seed!("pipeline"), seed!("describe-train"), seed!("arguments")).is_some());
});

/// Checks that resolved parameters resolve to themselves, so that reading parameters again doesn't
/// change a key.
fn resolve(data: &[u8]) {
    let Some(description) = description(data).filter(|d| d.check().is_ok()) else { return };
    let schema = Schema::new(&description.parameters).expect("the description was checked");
    let Ok(resolved) = schema.resolve(&serde_json::Map::new()) else { return };
    let again = schema.resolve(resolved.as_object().expect("parameters are an object"));
    assert_eq!(again.ok(), Some(resolved));
}

/// Reads a record as the verb `why` does.
fn record(data: &[u8]) {
    let Ok(record) = serde_json::from_slice::<Record>(data) else { return };
    assert_eq!(record.key().len(), 64);
    let records = [record];
    let parts = serde_json::Map::from_iter([("code".to_owned(), "1".into())]);
    planning::explain(&parts, &records[0].stage, &records);
}

fuzz_target!(|data: &[u8]| {
    LazyLock::force(&SEEDS);
    let Some((which, data)) = data.split_first() else { return };
    match which % 4 {
        0 => _ = plan(data, seed!("describe-train"), b""),
        1 => {
            resolve(data);
            _ = plan(seed!("pipeline"), data, seed!("arguments"));
        }
        2 => _ = plan(seed!("pipeline"), seed!("describe-train"), data),
        _ => record(data),
    }
});
