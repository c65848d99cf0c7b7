//! Messages of parsers, with types in English: "expected a whole number, found 2.5" in place of
//! "invalid type: floating point `2.5`, expected u32".

/// Beginnings of serde's messages about a value of another type.
const BEGINNINGS: [&str; 3] = ["invalid type: ", "invalid value: ", "invalid length "];

/// Rewrites serde's messages in a text; other text is unchanged.
pub(crate) fn in_words(text: &str) -> String {
    let Some((before, found, after)) = BEGINNINGS.iter().find_map(|beginning| {
        let (before, rest) = text.split_once(beginning)?;
        let (found, after) = rest.split_once(", expected ")?;
        Some((before, found, after))
    }) else {
        return text.to_owned();
    };
    // The position follows the expected type.
    let end = [" at line ", ": "].iter().filter_map(|start| after.find(start)).min();
    let (expected, position) = after.split_at(end.unwrap_or(after.len()));
    format!("{before}expected {}, found {}{position}", expected_words(expected), found_words(found))
}

fn found_words(found: &str) -> &str {
    for kind in ["integer ", "floating point ", "boolean ", "string ", "character "] {
        if let Some(value) = found.strip_prefix(kind) {
            return value.trim_matches('`');
        }
    }
    match found {
        "map" => "a mapping",
        "sequence" => "a list",
        "unit value" | "Option value" => "null",
        other => other,
    }
}

fn expected_words(expected: &str) -> String {
    for (start, noun) in [("a tuple of size ", "values"), ("an array of length ", "values")] {
        if let Some(count) = expected.strip_prefix(start) {
            return format!("a list of {count} {noun}");
        }
    }
    match expected {
        "u8" => "a whole number from 0 to 255",
        "u16" => "a whole number from 0 to 65535",
        "u32" => "a whole number from 0 to 4294967295",
        "u64" | "usize" => "a whole number of at least 0",
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "f32" | "f64" => "a number",
        "a boolean" => "true or false",
        "a string" | "a borrowed string" | "str" => "text",
        "a map" => "a mapping",
        "a sequence" => "a list",
        other if other.starts_with("struct ") => "a mapping",
        other => other,
    }
    .to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_named_in_english() {
        for (text, expected) in [
            (
                "a.yaml:3: gpus: invalid type: integer `-1`, expected u32",
                "a.yaml:3: gpus: expected a whole number from 0 to 4294967295, found -1",
            ),
            (
                "x.json: w: invalid type: floating point `2.5`, expected u32 at line 1 column 9",
                "x.json: w: expected a whole number from 0 to 4294967295, found 2.5 at line 1 \
                column 9",
            ),
            ("invalid type: string \"a\", expected f64", "expected a number, found \"a\""),
            ("invalid type: map, expected a sequence", "expected a list, found a mapping"),
            (
                "invalid type: unit value, expected struct StageBlock",
                "expected a mapping, found null",
            ),
            (
                "invalid length 3, expected an array of length 4",
                "expected a list of 4 values, found 3",
            ),
            ("missing field `a`", "missing field `a`"),
            ("invalid type: string \"yyy…", "invalid type: string \"yyy…"),
        ] {
            assert_eq!(in_words(text), expected);
        }
    }

    /// A new version of serde may change its messages.
    #[test]
    fn serdes_messages_are_recognised() {
        let message = |text: &str| serde_json::from_str::<(u32, bool)>(text).unwrap_err();
        for (text, expected) in [
            ("[2.5, true]", "expected a whole number from 0 to 4294967295, found 2.5 at line"),
            ("[4294967296, true]", "expected a whole number from 0 to 4294967295, found 4294"),
            ("[2, 1]", "expected true or false, found 1 at line"),
            ("{}", "expected a list of 2 values, found a mapping at line"),
            ("[2]", "expected a list of 2 values, found 1 at line"),
        ] {
            let found = in_words(&message(text).to_string());
            assert!(found.starts_with(expected), "{found}");
        }
    }
}
