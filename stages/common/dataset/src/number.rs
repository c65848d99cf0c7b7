use std::fmt;

use serde::de::{Deserialize, Deserializer, Error, Unexpected, Visitor};

/// A number of a JSON file; also what Python writes that JSON doesn't have, once [`words_as_text`]
/// has made text of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Number(pub(crate) f64);

const WORDS: [(&str, f64); 3] =
    [("NaN", f64::NAN), ("-Infinity", f64::NEG_INFINITY), ("Infinity", f64::INFINITY)];

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NumberOrWord)
    }
}

struct NumberOrWord;

impl Visitor<'_> for NumberOrWord {
    type Value = Number;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number")
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Number, E> {
        Ok(Number(value))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Number, E> {
        Ok(Number(value as f64))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Number, E> {
        Ok(Number(value as f64))
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Number, E> {
        let word = WORDS.iter().find(|(word, _)| *word == text);
        word.map(|(_, value)| Number(*value))
            .ok_or_else(|| E::invalid_type(Unexpected::Str(text), &self))
    }
}

/// JSON in which Python's words for what is no number stand in quotes, so that they can be parsed
/// and their places named. `None` where there are none.
pub(crate) fn words_as_text(json: &str) -> Option<String> {
    let (mut text, mut rest, mut is_string) = (String::with_capacity(json.len() + 64), json, false);
    while let Some(next) = rest.chars().next() {
        let word = WORDS
            .iter()
            .find(|(word, _)| !is_string && rest.starts_with(word))
            .map(|(word, _)| *word);
        let taken = match (word, next) {
            (Some(word), _) => {
                text.push_str(&format!("\"{word}\""));
                rest = &rest[word.len()..];
                continue;
            }
            // What is escaped ends no string.
            (None, '\\') if is_string => 1 + rest[1..].chars().next().map_or(0, char::len_utf8),
            (None, '"') => {
                is_string = !is_string;
                1
            }
            (None, other) => other.len_utf8(),
        };
        text.push_str(&rest[..taken]);
        rest = &rest[taken..];
    }
    (text.len() > json.len()).then_some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_numbers_outside_of_names_alone() {
        let json = r#"{"NaN.png \" Infinity": [1, NaN, -Infinity, Infinity, "NaN é", -2.5e3]}"#;
        let text = words_as_text(json).unwrap();
        assert_eq!(
            text,
            r#"{"NaN.png \" Infinity": [1, "NaN", "-Infinity", "Infinity", "NaN é", -2.5e3]}"#
        );
        assert_eq!(words_as_text(r#"{"Infinity": [1]}"#), None);
        let numbers: Vec<Number> =
            serde_json::from_str(r#"[1, -1, "NaN", "-Infinity", "Infinity", 0.5]"#).unwrap();
        assert!(numbers[2].0.is_nan());
        let others: Vec<f64> = [0, 1, 3, 4, 5].map(|i: usize| numbers[i].0).to_vec();
        assert_eq!(others, [1.0, -1.0, f64::NEG_INFINITY, f64::INFINITY, 0.5]);
        assert!(
            serde_json::from_str::<Number>(r#""ten""#)
                .unwrap_err()
                .to_string()
                .contains("expected a number")
        );
    }
}
