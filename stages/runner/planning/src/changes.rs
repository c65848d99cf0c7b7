//! Differences between two maps of named values, such as the parts of two keys.

use std::collections::BTreeSet;

use serde::Serialize;
use serde_json::{Map, Value};

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
    use super::*;
    use serde_json::json;

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
