//! What differs between two lists of named values, such as two keys.

use std::collections::BTreeSet;

use serde::Serialize;
use serde_json::{Map, Value};

/// A named value that differs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Change {
    /// Its name, such as `parameter kernel`.
    pub name: String,
    /// What it was, if it was there.
    pub before: Option<Value>,
    /// What it is, if it is there.
    pub now: Option<Value>,
}

/// The values that differ, by name.
pub fn changes(before: &Map<String, Value>, now: &Map<String, Value>) -> Vec<Change> {
    let names: BTreeSet<&String> = before.keys().chain(now.keys()).collect();
    let differing = names.into_iter().filter(|name| before.get(*name) != now.get(*name));
    differing
        .map(|name| Change {
            name: name.clone(),
            before: before.get(name).cloned(),
            now: now.get(name).cloned(),
        })
        .collect()
}

/// The beginning of a hash, for people.
pub fn short(hash: &str) -> &str {
    hash.get(..10).unwrap_or(hash)
}

impl std::fmt::Display for Change {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {} → {}", self.name, words(self.before.as_ref()), words(self.now.as_ref()))?;
        match (
            self.before.as_ref().and_then(Value::as_f64),
            self.now.as_ref().and_then(Value::as_f64),
        ) {
            (Some(before), Some(now)) if self.name.starts_with("metric ") => {
                write!(f, " ({:+.4})", now - before)
            }
            _ => Ok(()),
        }
    }
}

fn words(value: Option<&Value>) -> String {
    match value {
        None => "absent".to_owned(),
        Some(Value::String(hash)) if hash.len() == 64 && hash.is_ascii() => short(hash).to_owned(),
        // A whole number is one, however it was given.
        Some(value) => value.to_string().trim_end_matches(".0").to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn every_difference_in_words() {
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
