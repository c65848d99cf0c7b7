//! Numbers in the form that a schema prescribes: equal values are written, and so hashed, equally.

use serde_json::{Number, Value};

use crate::contract::validator::{exact_integer, resolve_reference};

/// Reader of values by a schema, whose references are resolved in `root`.
#[derive(Clone, Copy)]
pub(crate) struct Reader<'a> {
    root: &'a Value,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(root: &'a Value) -> Self {
        Self { root }
    }

    /// Converts a value, including nested values, to the schema's form: for type `number` 2 becomes
    /// 2.0, otherwise 2.0 becomes 2, and for type `integer` "2k" becomes 2000. Invalid values stay
    /// unchanged; the validator reports them.
    pub(crate) fn read(&self, schema: &'a Value, value: &Value) -> Value {
        self.read_by(&self.alternatives(&[schema]), value)
    }

    fn read_by(&self, schemas: &[&'a Value], value: &Value) -> Value {
        match value {
            Value::Number(number) if schemas.iter().any(|s| has_type(s, "number")) => {
                let is_f32 =
                    schemas.iter().any(|s| s.get("format").is_some_and(|format| format == "float"));
                as_float(number, is_f32).unwrap_or_else(|| value.clone())
            }
            Value::Number(number) => as_integer(number).unwrap_or_else(|| value.clone()),
            Value::String(text)
                if schemas.iter().any(|s| has_type(s, "integer"))
                    && !schemas.iter().any(|s| has_type(s, "string")) =>
            {
                with_suffix(text).map_or_else(|| value.clone(), Value::from)
            }
            Value::Array(items) => {
                let items = items.iter().enumerate().map(|(index, item)| {
                    self.read_by(&self.inner_schemas(schemas, |s| item_schema(s, index)), item)
                });
                items.collect()
            }
            Value::Object(entries) => {
                let entries = entries.iter().map(|(name, entry)| {
                    let inner = self.inner_schemas(schemas, |s| property_schema(s, name));
                    (name.clone(), self.read_by(&inner, entry))
                });
                Value::Object(entries.collect())
            }
            _ => value.clone(),
        }
    }

    /// Returns the schemas of a nested value, found in each schema of the outer value by `find`.
    fn inner_schemas(
        &self,
        schemas: &[&'a Value],
        find: impl Fn(&'a Value) -> Option<&'a Value>,
    ) -> Vec<&'a Value> {
        self.alternatives(&schemas.iter().filter_map(|s| find(s)).collect::<Vec<_>>())
    }

    /// Returns the schemas with all schemas that they refer to or combine, each once.
    fn alternatives(&self, schemas: &[&'a Value]) -> Vec<&'a Value> {
        let mut found: Vec<&Value> = Vec::new();
        let mut open = schemas.to_vec();
        while let Some(schema) = open.pop() {
            if found.iter().any(|known| std::ptr::eq(*known, schema)) {
                continue;
            }
            found.push(schema);
            open.extend(self.referred(schema));
            for part in ["anyOf", "oneOf", "allOf"] {
                open.extend(schema.get(part).and_then(Value::as_array).into_iter().flatten());
            }
        }
        found
    }

    /// Returns the allowed values with their descriptions if the schema lists all of them. Null,
    /// which marks an optional value, is not among them.
    pub(crate) fn choices(&self, schema: &'a Value) -> Option<Vec<(&'a Value, &'a str)>> {
        let definition = self.present(schema);
        if let Some(values) = definition.get("enum").and_then(Value::as_array) {
            return Some(values.iter().map(|value| (value, "")).collect());
        }
        let mut choices = Vec::new();
        for choice in definition.get("oneOf")?.as_array()? {
            let description = choice.get("description").and_then(Value::as_str);
            choices.push((choice.get("const")?, description.unwrap_or_default()));
        }
        Some(choices)
    }

    /// Returns the schema of a value that is given: without the alternative null, and with `$ref`
    /// resolved.
    pub(crate) fn present(&self, schema: &'a Value) -> &'a Value {
        let alternatives = schema.get("anyOf").and_then(Value::as_array);
        let not_null = alternatives
            .and_then(|all| all.iter().find(|one| one.get("type").is_none_or(|t| t != "null")));
        let schema = not_null.unwrap_or(schema);
        self.referred(schema).unwrap_or(schema)
    }

    /// Returns the schema in the same document that a schema's `$ref` refers to.
    pub(crate) fn referred(&self, schema: &Value) -> Option<&'a Value> {
        resolve_reference(self.root, schema.get("$ref")?)
    }
}

fn has_type(schema: &Value, name: &str) -> bool {
    match schema.get("type") {
        Some(Value::String(one)) => one == name,
        Some(Value::Array(several)) => several.iter().any(|one| one == name),
        _ => false,
    }
}

fn item_schema(schema: &Value, index: usize) -> Option<&Value> {
    let prefix = schema.get("prefixItems").and_then(|items| items.get(index));
    prefix.or_else(|| schema.get("items"))
}

fn property_schema<'a>(schema: &'a Value, name: &str) -> Option<&'a Value> {
    let named = schema.get("properties").and_then(|properties| properties.get(name));
    named.or_else(|| schema.get("additionalProperties"))
}

/// Converts a number to a float, rounded to `f32` if the schema says so; -0 becomes 0.
fn as_float(number: &Number, is_f32: bool) -> Option<Value> {
    let value = number.as_f64()? + 0.0;
    Number::from_f64(if is_f32 { f64::from(value as f32) } else { value }).map(Value::Number)
}

/// Converts a float to an integer if it is whole and fits into 64 bits.
fn as_integer(number: &Number) -> Option<Value> {
    let value = exact_integer(number).filter(|_| number.is_f64())?;
    u64::try_from(value).map(Value::from).or_else(|_| i64::try_from(value).map(Value::from)).ok()
}

/// Converts a number with the suffix k, M or G, such as `1.5M`; `None` if the result isn't whole.
fn with_suffix(text: &str) -> Option<u64> {
    let (digits, zeros) = [("k", 3), ("M", 6), ("G", 9)]
        .into_iter()
        .find_map(|(suffix, zeros)| Some((text.strip_suffix(suffix)?, zeros)))?;
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let is_written = |part: &str| part.bytes().all(|digit| digit.is_ascii_digit());
    // As JSON does, a number starts with a digit, and a dot is followed by one.
    if whole.is_empty() || digits.ends_with('.') || !is_written(whole) || !is_written(fraction) {
        return None;
    }
    let fraction = fraction.trim_end_matches('0');
    if fraction.len() > zeros {
        return None;
    }
    // Not by way of f64, which rounds above 2^53.
    format!("{whole}{fraction:0<zeros$}").parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn suffixes_multiply_whole_numbers() {
        let root = json!({});
        let integer = json!({"type": ["integer", "null"]});
        for (text, expected) in [
            ("30M", json!(30_000_000)),
            ("1.5M", json!(1_500_000)),
            ("4.250k", json!(4250)),
            ("2G", json!(2_000_000_000)),
            ("0k", json!(0)),
            ("9007199254740.993k", json!(9_007_199_254_740_993u64)),
            ("18446744073709551.615k", json!(u64::MAX)),
            ("1.0000000000000000000000000k", json!(1000)),
        ] {
            assert_eq!(Reader::new(&root).read(&integer, &json!(text)), expected);
        }
        let invalid = [
            "M",
            ".5M",
            "5.M",
            "-5M",
            "1.2.3M",
            "1.23456k",
            "1.00000000000000000001k",
            "30m",
            "30 M",
            "1e3k",
            "18446744073709551.616k",
            "99999999999G",
        ];
        for text in invalid {
            assert_eq!(Reader::new(&root).read(&integer, &json!(text)), json!(text));
        }
        for other in [json!({"type": "number"}), json!({"type": ["integer", "string"]})] {
            assert_eq!(Reader::new(&root).read(&other, &json!("30M")), json!("30M"), "{other}");
        }
    }

    #[test]
    fn equal_numbers_have_equal_json() {
        let root = json!({
            "$defs": {
                "Deep": {"type": "array", "items": {"$ref": "#/$defs/Deep"}},
                "Size": {"type": ["integer", "null"]}
            }
        });
        for (schema, value, expected) in [
            (json!({"type": "number"}), json!(2), json!(2.0)),
            (json!({"type": "number"}), json!(2e0), json!(2.0)),
            (json!({"type": "number"}), json!(-0.0), json!(0.0)),
            (json!({"type": "number", "format": "float"}), json!(0.1), json!(0.1f32)),
            (json!({"type": ["number", "null"]}), json!(2), json!(2.0)),
            (json!({"type": ["number", "null"]}), Value::Null, Value::Null),
            (json!({"anyOf": [{"type": "number"}, {"type": "null"}]}), json!(2), json!(2.0)),
            (json!({"type": "integer"}), json!(6e4), json!(60000)),
            (json!({"type": "integer"}), json!(-3.0), json!(-3)),
            (json!({"type": "integer"}), json!(1e19), json!(10_000_000_000_000_000_000u64)),
            (json!({"type": "integer"}), json!(1e30), json!(1e30)),
            (json!({"type": "integer"}), json!(2.5), json!(2.5)),
            (json!({"type": "integer"}), json!(u64::MAX), json!(u64::MAX)),
            (json!({"$ref": "#/$defs/Size"}), json!(3.0), json!(3)),
            (
                json!({"anyOf": [{"$ref": "#/$defs/Size"}, {"type": "string"}]}),
                json!(3.0),
                json!(3),
            ),
            (
                json!({"type": "array", "items": {"type": "array", "items": {"type": "number"}}}),
                json!([[1, 2.0]]),
                json!([[1.0, 2.0]]),
            ),
            (
                json!({"prefixItems": [{"type": "integer"}], "items": {"type": "number"}}),
                json!([1.0, 1]),
                json!([1, 1.0]),
            ),
            (
                json!({"properties": {"a": {"type": "number"}}}),
                json!({"a": 1, "b": 1.0}),
                json!({"a": 1.0, "b": 1}),
            ),
            (
                json!({"additionalProperties": {"type": "number"}}),
                json!({"a": 1}),
                json!({"a": 1.0}),
            ),
            (json!({}), json!(2.0), json!(2)),
            (json!({"enum": [1, 2]}), json!(2.0), json!(2)),
            (json!({"type": "string"}), json!("2"), json!("2")),
            (json!({"$ref": "#/$defs/Deep"}), json!([[], [[]]]), json!([[], [[]]])),
            (json!(true), json!(2.0), json!(2)),
        ] {
            assert_eq!(
                Reader::new(&root).read(&schema, &value),
                expected,
                "{schema} reads {value}"
            );
        }
    }
}
