//! Values on the command line: `-p NAME=VALUE[,VALUE…]` (docs/design/030, S3.6).
//!
//! A JSON number, `true`, `false` or `null` is parsed as JSON. An empty text is `null`, but an
//! empty value in a list is refused. A value that starts with `[`, `{` or `"` is JSON and may
//! contain commas. Any other value is a string, including `0x10`, `+2`, `02` and ` 2`, which
//! numeric parameters therefore refuse.

use serde_json::Value;

/// Parses a list of values. Returns each with its text, or fails with the problem and a remedy.
pub(crate) fn values(text: &str) -> Result<Vec<(&str, Value)>, String> {
    if text.is_empty() {
        return Ok(vec![("", Value::Null)]);
    }
    split(text).into_iter().map(|part| Ok((part, parse_value(part)?))).collect()
}

/// Parses a list of folders. Fails with the problem and a remedy.
pub(crate) fn folders(text: &str) -> Result<Vec<&str>, String> {
    if text.is_empty() {
        return Err("expected a folder after `=`".to_owned());
    }
    let folders: Vec<&str> = text.split(',').collect();
    if folders.contains(&"") {
        return Err("empty folder name in the list; remove the comma".to_owned());
    }
    Ok(folders)
}

fn parse_value(text: &str) -> Result<Value, String> {
    if text.is_empty() {
        return Err("empty value in the list; remove the comma, or write null".to_owned());
    }
    let parsed = serde_json::from_str::<Value>(text);
    if text.starts_with(JSON_START) {
        return parsed.map_err(|problem| format!("{text} is invalid JSON: {problem}"));
    }
    // A value with white space around it is a string, although JSON allows white space.
    Ok(parsed.ok().filter(|_| text.trim() == text).unwrap_or_else(|| Value::from(text)))
}

/// First characters of JSON values that may contain commas.
const JSON_START: [char; 3] = ['[', '{', '"'];

/// Splits a list at the commas that aren't inside JSON.
fn split(text: &str) -> Vec<&str> {
    let mut parts = Vec::new();
    let mut rest = Some(text);
    while let Some(text) = rest {
        let end = if text.starts_with(JSON_START) {
            json_end(text)
        } else {
            text.find(',').unwrap_or(text.len())
        };
        parts.push(&text[..end]);
        rest = text.get(end + 1..);
    }
    parts
}

/// Returns the position of the first comma after the JSON value at the start of a text, or the
/// length of the text.
fn json_end(text: &str) -> usize {
    let mut values = serde_json::Deserializer::from_str(text).into_iter::<Value>();
    if values.next().is_none_or(|value| value.is_err()) {
        return text.len();
    }
    let end = values.byte_offset();
    text[end..].find(',').map_or(text.len(), |comma| end + comma)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn values_are_json_or_else_strings() {
        for (text, expected) in [
            ("", json!([null])),
            ("null", json!([null])),
            ("null,2", json!([null, 2])),
            ("2", json!([2])),
            ("2.0", json!([2.0])),
            ("2e0", json!([2.0])),
            ("-0.5,6e4", json!([-0.5, 6e4])),
            ("true,false", json!([true, false])),
            ("box", json!(["box"])),
            ("True,Null,~,yes", json!(["True", "Null", "~", "yes"])),
            ("0x10,+2, 2,02,1_0,.5,2.", json!(["0x10", "+2", " 2", "02", "1_0", ".5", "2."])),
            ("nan,.inf,1e999", json!(["nan", ".inf", "1e999"])),
            ("\"2\"", json!(["2"])),
            ("\"a,\\\"b\",c", json!(["a,\"b", "c"])),
            ("[0,1,2]", json!([[0, 1, 2]])),
            ("[0,1],[2,3]", json!([[0, 1], [2, 3]])),
            ("{\"a\": [1,2]},3", json!([{"a": [1, 2]}, 3])),
            ("a: b", json!(["a: b"])),
            ("5\"", json!(["5\""])),
        ] {
            let found: Vec<Value> =
                values(text).unwrap().into_iter().map(|(_, value)| value).collect();
            assert_eq!(Value::from(found), expected, "{text}");
        }
    }

    #[test]
    fn empty_values_and_invalid_json_are_refused() {
        for (text, expected) in [
            (",", "empty value in the list"),
            ("1,,2", "empty value in the list"),
            ("1,", "write null"),
            ("[1,2", "is invalid JSON"),
            ("\"a", "is invalid JSON"),
        ] {
            let problem = values(text).unwrap_err();
            assert!(problem.contains(expected), "{text}: {problem}");
        }
        assert_eq!(folders("a,./b").unwrap(), ["a", "./b"]);
        assert!(folders("").unwrap_err().contains("expected a folder"));
        assert!(folders("a,,b").unwrap_err().contains("remove the comma"));
    }
}
