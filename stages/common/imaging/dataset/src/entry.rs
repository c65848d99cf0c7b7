use anyhow::{Context as _, bail};
use artifact::shortened;
use serde_json::{Map, Value};

/// JSON object; errors name the key. `null` counts as missing.
#[derive(Clone, Debug)]
pub(crate) struct Entry(Map<String, Value>);

impl Entry {
    /// Wraps an object; fails for another value.
    pub(crate) fn new(value: &Value) -> anyhow::Result<Self> {
        let object = value.as_object().with_context(|| expectation("a mapping", value))?;
        Ok(Self(object.clone()))
    }

    /// Returns the values of several keys, as an entry.
    pub(crate) fn part(&self, keys: &[&str]) -> Self {
        let values = keys.iter().filter_map(|key| Some(((*key).to_owned(), self.value(key)?)));
        Self(values.map(|(key, value)| (key, value.clone())).collect())
    }

    /// Adds the values of `other`, in place of existing ones.
    pub(crate) fn extend(&mut self, other: Self) {
        self.0.extend(other.0);
    }

    /// Removes a key.
    pub(crate) fn remove(&mut self, key: &str) {
        self.0.remove(key);
    }

    /// Returns whether a key has a value.
    pub(crate) fn has(&self, key: &str) -> bool {
        self.value(key).is_some()
    }

    /// Returns a value of any type.
    pub(crate) fn value(&self, key: &str) -> Option<&Value> {
        self.0.get(key).filter(|value| !value.is_null())
    }

    /// Returns a number, also one of Python's non-finite numbers.
    pub(crate) fn number(&self, key: &str) -> anyhow::Result<Option<f64>> {
        self.converted(key, "a number", parse_number)
    }

    /// Returns text.
    pub(crate) fn text(&self, key: &str) -> anyhow::Result<Option<&str>> {
        self.converted(key, "text", Value::as_str)
    }

    /// Returns a flag.
    pub(crate) fn flag(&self, key: &str) -> anyhow::Result<Option<bool>> {
        self.converted(key, "true or false", Value::as_bool)
    }

    /// Removes and returns a required list.
    pub(crate) fn take(&mut self, key: &str) -> anyhow::Result<Vec<Value>> {
        match self.0.remove(key) {
            Some(Value::Array(list)) => Ok(list),
            Some(other) => bail!("{key}: {}", expectation("a list", &other)),
            None => bail!("missing field `{key}`"),
        }
    }

    /// Returns a list; empty if missing.
    pub(crate) fn list(&self, key: &str) -> anyhow::Result<&[Value]> {
        let list = self.converted(key, "a list", |value| value.as_array().map(Vec::as_slice))?;
        Ok(list.unwrap_or_default())
    }

    fn converted<'a, T>(
        &'a self,
        key: &str,
        expected: &str,
        convert: impl FnOnce(&'a Value) -> Option<T>,
    ) -> anyhow::Result<Option<T>> {
        let Some(value) = self.value(key) else { return Ok(None) };
        let converted = convert(value);
        let error = || format!("{key}: {}", expectation(expected, value));
        converted.with_context(error).map(Some)
    }
}

/// Describes a value of the wrong type.
pub(crate) fn expectation(expected: &str, found: &Value) -> String {
    format!("expected {expected}, found {}", shortened(&found.to_string()))
}

/// Python's words for numbers that JSON lacks.
const WORDS: [(&str, f64); 3] =
    [("NaN", f64::NAN), ("-Infinity", f64::NEG_INFINITY), ("Infinity", f64::INFINITY)];

/// Converts a number, or one of Python's words that [`quote_python_numbers`] has quoted.
pub(crate) fn parse_number(value: &Value) -> Option<f64> {
    let word = WORDS.iter().find(|(word, _)| value == *word);
    value.as_f64().or(word.map(|(_, number)| *number))
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
        let number = |value: Value| parse_number(&value);
        assert!(number("NaN".into()).unwrap().is_nan());
        let values: [Value; 5] =
            [1.into(), (-1).into(), "-Infinity".into(), "Infinity".into(), 0.5.into()];
        let expected = [1.0, -1.0, f64::NEG_INFINITY, f64::INFINITY, 0.5];
        assert_eq!(values.map(number), expected.map(Some));
        assert_eq!(number("ten".into()), None);
    }
}
