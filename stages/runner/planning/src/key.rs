//! Key of an action: the hash of one flat list of parts; and differences between two such lists, or
//! other maps of named values. `why` reports them, so that its explanation always agrees with the
//! key (docs/design/002).

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::Path;

use serde::Serialize;
use serde_json::{Map, Value, json};
use stage::Description;
use store::{KEY_VERSION, KEY_VERSION_PART, Record};

use crate::node::Node;
use crate::sources::path_text;

/// Returns everything that may change a node's result, by name. Threads, paths, verbosity, host and
/// the block's name are left out, since they don't change it.
pub fn key_parts(node: &Node, inputs: &[(String, String)], device: &str) -> Map<String, Value> {
    let description = &node.program.description;
    let mut parts = Map::new();
    parts.insert(KEY_VERSION_PART.to_owned(), json!(KEY_VERSION));
    parts.insert("stage".to_owned(), json!(description.name));
    parts.insert("code".to_owned(), json!(description.code));
    // All CUDA devices are of one kind.
    parts.insert("device".to_owned(), json!(device.split(':').next().unwrap_or(device)));
    for (name, value) in node.parameters.as_object().into_iter().flatten() {
        parts.insert(format!("parameter {name}"), value.clone());
    }
    for (name, hash) in inputs {
        parts.insert(format!("input {name}"), json!(hash));
    }
    parts.extend(environment_parts(description));
    parts
}

/// Returns the parts of the environment variables that a stage declares.
pub fn environment_parts(description: &Description) -> Map<String, Value> {
    let names = description.environment.iter();
    names
        .map(|name| (format!("environment {name}"), environment_value(std::env::var_os(name))))
        .collect()
}

/// Returns a unique JSON value for each value of an environment variable; null for an unset one.
fn environment_value(value: Option<OsString>) -> Value {
    json!(value.map(|value| path_text(Path::new(&value))))
}

/// Returns the differences between a key and the nearest earlier one of the same block, as text;
/// `None` if there is no earlier one.
pub fn explain(parts: &Map<String, Value>, stage: &str, records: &[Record]) -> Option<Vec<String>> {
    Some(nearest_changes(parts, stage, records)?.iter().map(ToString::to_string).collect())
}

/// Returns the differences between a key and the nearest earlier one of the same block; `None` if
/// there is no earlier one.
pub fn nearest_changes(
    parts: &Map<String, Value>,
    stage: &str,
    records: &[Record],
) -> Option<Vec<Change>> {
    let record = nearest_record(parts, records.iter().filter(|record| record.stage == stage))?;
    Some(changes(&record.key_parts, parts))
}

/// Returns the record whose key differs in the fewest parts, the newest if there are several.
pub fn nearest_record<'a>(
    parts: &Map<String, Value>,
    records: impl Iterator<Item = &'a Record>,
) -> Option<&'a Record> {
    records.min_by_key(|record| {
        (changes(&record.key_parts, parts).len(), Reverse(record.started_unix))
    })
}

/// Named value that differs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Change {
    /// Name, such as `parameter kernel`.
    pub name: String,
    /// Earlier value; `None` if it was absent.
    pub before: Option<Value>,
    /// Present value; `None` if it is absent.
    pub now: Option<Value>,
}

/// Returns the values that differ, sorted by name.
pub fn changes(before: &Map<String, Value>, now: &Map<String, Value>) -> Vec<Change> {
    let names: BTreeSet<&String> = before.keys().chain(now.keys()).collect();
    names
        .into_iter()
        .filter(|name| before.get(*name) != now.get(*name))
        .map(|name| Change {
            name: name.clone(),
            before: before.get(name).cloned(),
            now: now.get(name).cloned(),
        })
        .collect()
}

/// Returns the first digits of a hash, for messages.
pub fn short_hash(hash: &str) -> &str {
    hash.get(..10).unwrap_or(hash)
}

impl std::fmt::Display for Change {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, before, now } = self;
        write!(f, "{name}: {} → {}", format_value(before.as_ref()), format_value(now.as_ref()))?;
        if name.starts_with("metric ")
            && let Some(before) = before.as_ref().and_then(Value::as_f64)
            && let Some(now) = now.as_ref().and_then(Value::as_f64)
        {
            write!(f, " ({:+.4})", now - before)?;
        }
        Ok(())
    }
}

fn format_value(value: Option<&Value>) -> String {
    match value {
        None => "absent".to_owned(),
        Some(Value::String(hash)) if store::is_hash(hash) => short_hash(hash).to_owned(),
        // Whole numbers are written 2, not 2.0.
        Some(value) => {
            let text = value.to_string();
            text.strip_suffix(".0").unwrap_or(&text).to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt as _;

    use super::*;

    #[test]
    fn every_value_of_a_variable_has_its_own_part() {
        let value = |bytes: &[u8]| environment_value(Some(OsStr::from_bytes(bytes).to_owned()));
        assert_eq!((environment_value(None), value("ä".as_bytes())), (json!(null), json!("ä")));
        assert_eq!((value(b"\xff"), value(b"\xfe")), (json!("\0ff"), json!("\0fe")));
    }

    fn record(stage: &str, started_unix: u64, parts: &Value) -> Record {
        Record {
            stage: stage.to_owned(),
            key_parts: parts.as_object().unwrap().clone(),
            started_unix,
            ..Record::default()
        }
    }

    #[test]
    fn changes_are_from_the_nearest_earlier_run_of_the_stage() {
        let records = [
            record("prep", 1, &json!({"code": "a", "parameter kernel": "box"})),
            record("prep", 9, &json!({"code": "z", "parameter kernel": "avg"})),
            record("eval", 9, &json!({"code": "a", "parameter kernel": "lanczos"})),
        ];
        let key_parts = json!({"code": "a", "parameter kernel": "lanczos"});
        let changes = explain(key_parts.as_object().unwrap(), "prep", &records).unwrap();
        assert_eq!(changes, [r#"parameter kernel: "box" → "lanczos""#]);
        assert_eq!(explain(key_parts.as_object().unwrap(), "other", &records), None);
        assert!(explain(key_parts.as_object().unwrap(), "eval", &records).unwrap().is_empty());
    }

    #[test]
    fn changes_are_formatted_as_text() {
        let map = |value: Value| value.as_object().cloned().unwrap();
        let before = map(json!({
            "code": "a".repeat(64), "parameter kernel": "box", "parameter near": null,
            "parameter scale": 2, "metric mean.psnr": 30.25, "device": "cpu", "input x": "y"
        }));
        let now = map(json!({
            "code": "b".repeat(64), "parameter kernel": "lanczos", "parameter near": 0.5,
            "parameter scale": 4.0, "metric mean.psnr": 31, "device": "cpu", "input z": "y"
        }));
        let found: Vec<String> = changes(&before, &now).iter().map(ToString::to_string).collect();
        let expected = [
            "code: aaaaaaaaaa → bbbbbbbbbb",
            "input x: \"y\" → absent",
            "input z: absent → \"y\"",
            "metric mean.psnr: 30.25 → 31 (+0.7500)",
            "parameter kernel: \"box\" → \"lanczos\"",
            "parameter near: null → 0.5",
            "parameter scale: 2 → 4",
        ];
        assert_eq!(found, expected);
    }
}
