//! What stands after `=` on the command line: `-p NAME=VALUE[,VALUE…]`.
//!
//! One rule for a value: a JSON number, `true`, `false` or `null` is that; nothing at all is
//! `null`; what begins with `[`, `{` or `"` is JSON, commas inside it included; anything else is a
//! word, as it stands. So `0x10`, `+2`, `02` and ` 2` are words, and where a number is expected the
//! parameter's type refuses them.

use serde_json::Value;

/// What is wrong after `=`, and what to do.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ArgumentError {
    /// One of several values is empty.
    #[error("a value between commas is empty; leave the comma out, or write null")]
    EmptyValue,
    /// A value isn't the JSON that it begins like.
    #[error("{value} begins like JSON and isn't: {problem}")]
    Json {
        /// The value.
        value: String,
        /// What is wrong.
        problem: serde_json::Error,
    },
    /// There is no folder.
    #[error("no folder is named")]
    NoFolder,
    /// One of several folders has no name.
    #[error("a folder's name between commas is empty; leave the comma out")]
    EmptyFolder,
}

/// The values of a list with what they mean. Of several none may be empty.
pub(crate) fn values(text: &str) -> Result<Vec<(&str, Value)>, ArgumentError> {
    if text.is_empty() {
        return Ok(vec![("", Value::Null)]);
    }
    split(text).into_iter().map(|piece| Ok((piece, value(piece)?))).collect()
}

/// The folders of a list.
pub(crate) fn folders(text: &str) -> Result<Vec<&str>, ArgumentError> {
    let folders: Vec<&str> = text.split(',').collect();
    match folders.iter().any(|folder| folder.is_empty()) {
        true if text.is_empty() => Err(ArgumentError::NoFolder),
        true => Err(ArgumentError::EmptyFolder),
        false => Ok(folders),
    }
}

fn value(piece: &str) -> Result<Value, ArgumentError> {
    if piece.is_empty() {
        return Err(ArgumentError::EmptyValue);
    }
    let parsed = serde_json::from_str::<Value>(piece);
    if piece.starts_with(JSON) {
        return parsed.map_err(|problem| ArgumentError::Json { value: piece.to_owned(), problem });
    }
    // JSON itself allows white space around a value.
    Ok(parsed.ok().filter(|_| piece.trim() == piece).unwrap_or_else(|| Value::from(piece)))
}

/// What JSON with commas inside begins with.
const JSON: [char; 3] = ['[', '{', '"'];

fn split(text: &str) -> Vec<&str> {
    let mut pieces = Vec::new();
    let mut rest = Some(text);
    while let Some(text) = rest {
        let end = if text.starts_with(JSON) {
            json_end(text)
        } else {
            text.find(',').unwrap_or(text.len())
        };
        pieces.push(&text[..end]);
        rest = text.get(end + 1..);
    }
    pieces
}

/// Where the first comma outside brackets and quotes stands, or the end.
fn json_end(text: &str) -> usize {
    let (mut depth, mut is_quoted, mut is_escaped) = (0usize, false, false);
    for (at, c) in text.char_indices() {
        match c {
            _ if is_escaped => is_escaped = false,
            '\\' if is_quoted => is_escaped = true,
            '"' => is_quoted = !is_quoted,
            '[' | '{' if !is_quoted => depth += 1,
            ']' | '}' if !is_quoted => depth = depth.saturating_sub(1),
            ',' if !is_quoted && depth == 0 => return at,
            _ => {}
        }
    }
    text.len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_are_json_numbers_and_all_else_is_a_word() {
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
    fn what_cannot_be_meant_is_refused() {
        for (text, words) in [
            (",", "between commas is empty"),
            ("1,,2", "between commas is empty"),
            ("1,", "write null"),
            ("[1,2", "begins like JSON and isn't"),
            ("\"a", "begins like JSON and isn't"),
        ] {
            let problem = values(text).unwrap_err().to_string();
            assert!(problem.contains(words), "{text}: {problem}");
        }
        assert_eq!(folders("a,./b").unwrap(), ["a", "./b"]);
        assert!(folders("").unwrap_err().to_string().contains("no folder"));
        assert!(folders("a,,b").unwrap_err().to_string().contains("leave the comma out"));
    }
}
