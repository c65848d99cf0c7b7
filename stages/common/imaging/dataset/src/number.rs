use artifact::shortened;
use serde::Deserialize;
use serde_json::Value;

/// Number in a JSON file, including Python's non-finite numbers, which [`quote_python_numbers`] has
/// quoted.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(try_from = "Value")]
pub(crate) struct Number(pub(crate) f64);

/// Python's words for numbers that JSON lacks.
const WORDS: [(&str, f64); 3] =
    [("NaN", f64::NAN), ("-Infinity", f64::NEG_INFINITY), ("Infinity", f64::INFINITY)];

impl TryFrom<Value> for Number {
    type Error = String;

    fn try_from(value: Value) -> Result<Self, String> {
        let word = WORDS.iter().find(|(word, _)| value == *word).map(|(_, number)| *number);
        let number = value.as_f64().or(word).map(Self);
        number.ok_or_else(|| format!("expected a number, found {}", shortened(&value.to_string())))
    }
}

/// Puts quotes around Python's `NaN` and `Infinity` outside strings, so that JSON with them can be
/// parsed; `None` if there are none.
pub(crate) fn quote_python_numbers(json: &str) -> Option<String> {
    let (mut text, mut in_string) = (String::with_capacity(json.len() + 64), false);
    for (i, part) in json.split('"').enumerate() {
        if i > 0 {
            text.push('"');
        }
        if in_string {
            text.push_str(part);
            // An escaped quote doesn't end the string.
            let backslashes = part.len() - part.trim_end_matches('\\').len();
            in_string = !backslashes.is_multiple_of(2);
        } else {
            let part = part.replace("NaN", "\"NaN\"").replace("Infinity", "\"Infinity\"");
            text.push_str(&part.replace("-\"Infinity\"", "\"-Infinity\""));
            in_string = true;
        }
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
