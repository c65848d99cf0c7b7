//! Numbers in the form that a schema gives them: what is equal is written alike, and so hashed
//! alike.

use serde_json::{Number, Value};

/// A schema with what its references lead to.
#[derive(Clone, Copy)]
pub(crate) struct Reader<'a> {
    root: &'a Value,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(root: &'a Value) -> Self {
        Self { root }
    }

    /// A value as a schema reads it. Where the schema has `number`, 2 becomes 2.0. Elsewhere 2.0
    /// becomes 2. Arrays and objects likewise inside. What doesn't fit the schema stays, for the
    /// validator to name.
    pub(crate) fn read(&self, schema: &'a Value, value: &Value) -> Value {
        self.read_by(&self.alternatives(&[schema]), value)
    }

    fn read_by(&self, schemas: &[&'a Value], value: &Value) -> Value {
        match value {
            Value::Number(number) if schemas.iter().any(|s| has_type(s, "number")) => {
                let is_short =
                    schemas.iter().any(|s| s.get("format").is_some_and(|format| format == "float"));
                as_float(number, is_short).unwrap_or_else(|| value.clone())
            }
            Value::Number(number) => as_integer(number).unwrap_or_else(|| value.clone()),
            Value::Array(items) => {
                let items = items.iter().enumerate().map(|(index, item)| {
                    self.read_by(&self.inside(schemas, |s| item_schema(s, index)), item)
                });
                items.collect()
            }
            Value::Object(entries) => {
                let entries = entries.iter().map(|(name, entry)| {
                    let inside = self.inside(schemas, |s| property_schema(s, name));
                    (name.clone(), self.read_by(&inside, entry))
                });
                Value::Object(entries.collect())
            }
            _ => value.clone(),
        }
    }

    /// The schemas of what is inside a value that has these.
    fn inside(
        &self,
        schemas: &[&'a Value],
        find: impl Fn(&'a Value) -> Option<&'a Value>,
    ) -> Vec<&'a Value> {
        self.alternatives(&schemas.iter().filter_map(|s| find(s)).collect::<Vec<_>>())
    }

    /// Schemas, what they refer to, and their parts and alternatives; each once.
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

    /// The values that a choice may have, each with its description, where a schema is one. What
    /// may be left out is a choice between its kind and null.
    pub(crate) fn choices(&self, schema: &'a Value) -> Option<Vec<(&'a Value, &'a str)>> {
        let definition = self.present(schema);
        if let Some(words) = definition.get("enum").and_then(Value::as_array) {
            return Some(words.iter().map(|word| (word, "")).collect());
        }
        let choices = definition.get("oneOf")?.as_array()?.iter().map(|one| {
            let description = one.get("description").and_then(Value::as_str).unwrap_or_default();
            Some((one.get("const")?, description))
        });
        choices.collect()
    }

    /// The schema of a value that is there: without the null that stands for none, and behind its
    /// reference.
    pub(crate) fn present(&self, schema: &'a Value) -> &'a Value {
        let is_null = |one: &&Value| one.get("type").is_some_and(|t| t == "null");
        let inner = schema
            .get("anyOf")
            .and_then(Value::as_array)
            .and_then(|of| of.iter().find(|one| !is_null(one)));
        let schema = inner.unwrap_or(schema);
        self.referred(schema).unwrap_or(schema)
    }

    /// What a schema's `$ref` leads to inside the same document.
    pub(crate) fn referred(&self, schema: &Value) -> Option<&'a Value> {
        self.root.pointer(schema.get("$ref")?.as_str()?.strip_prefix('#')?)
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
    let placed = schema.get("prefixItems").and_then(|items| items.get(index));
    placed.or_else(|| schema.get("items"))
}

fn property_schema<'a>(schema: &'a Value, name: &str) -> Option<&'a Value> {
    let named = schema.get("properties").and_then(|properties| properties.get(name));
    named.or_else(|| schema.get("additionalProperties"))
}

/// With a point, as `f64` or `f32` print; -0 is 0.
fn as_float(number: &Number, is_short: bool) -> Option<Value> {
    let value = number.as_f64()? + 0.0;
    Number::from_f64(if is_short { f64::from(value as f32) } else { value }).map(Value::Number)
}

/// Without a point, where it is whole and a 64-bit integer holds it.
fn as_integer(number: &Number) -> Option<Value> {
    if !number.is_f64() {
        return None;
    }
    let value = number.as_f64()?;
    const LIMIT: f64 = 18_446_744_073_709_551_616.0; // 2^64
    if value.fract() != 0.0 || !(-LIMIT / 2.0..LIMIT).contains(&value) {
        return None;
    }
    Some(if value < 0.0 { Value::from(value as i64) } else { Value::from(value as u64) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn equal_numbers_are_written_alike() {
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
