use std::fmt;

use serde::de::{Deserialize, Deserializer, Error, Unexpected, Visitor};

/// Number in a JSON file, including Python's non-finite numbers, which [`quote_python_numbers`] has
/// quoted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Number(pub(crate) f64);

/// Python's words for numbers that JSON lacks.
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

/// Puts quotes around Python's `NaN` and `Infinity` outside strings, so that JSON with them can be
/// parsed; `None` if there are none.
pub(crate) fn quote_python_numbers(json: &str) -> Option<String> {
    let (mut text, mut rest, mut in_string) = (String::with_capacity(json.len() + 64), json, false);
    while let Some(next) = rest.chars().next() {
        let word = WORDS
            .iter()
            .find(|(word, _)| !in_string && rest.starts_with(word))
            .map(|(word, _)| *word);
        let taken = match (word, next) {
            (Some(word), _) => {
                text.push_str(&format!("\"{word}\""));
                rest = &rest[word.len()..];
                continue;
            }
            // An escaped quote doesn't end the string.
            (None, '\\') if in_string => 1 + rest[1..].chars().next().map_or(0, char::len_utf8),
            (None, '"') => {
                in_string = !in_string;
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
    fn only_python_numbers_outside_strings_are_quoted() {
        let json = r#"{"NaN.png \" Infinity": [1, NaN, -Infinity, Infinity, "NaN é", -2.5e3]}"#;
        let text = quote_python_numbers(json).unwrap();
        assert_eq!(
            text,
            r#"{"NaN.png \" Infinity": [1, "NaN", "-Infinity", "Infinity", "NaN é", -2.5e3]}"#
        );
        assert_eq!(quote_python_numbers(r#"{"Infinity": [1]}"#), None);
        let numbers: Vec<Number> =
            serde_json::from_str(r#"[1, -1, "NaN", "-Infinity", "Infinity", 0.5]"#).unwrap();
        assert!(numbers[2].0.is_nan());
        let without_nan: Vec<f64> = [0, 1, 3, 4, 5].map(|i: usize| numbers[i].0).to_vec();
        assert_eq!(without_nan, [1.0, -1.0, f64::NEG_INFINITY, f64::INFINITY, 0.5]);
        assert!(
            serde_json::from_str::<Number>(r#""ten""#)
                .unwrap_err()
                .to_string()
                .contains("expected a number")
        );
    }
}
