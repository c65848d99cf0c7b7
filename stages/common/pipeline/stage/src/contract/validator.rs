//! Checks of JSON values against the part of JSON Schema (draft 2020-12) that parameters need. A
//! complete validator would dominate a stage's compile time and start-up time.

use std::cmp::Ordering;

use serde_json::{Map, Number, Value};

use crate::contract::error::ContractError;

/// Unsupported keywords that constrain values. A schema with one of them is refused, so that no
/// value passes unchecked.
const UNSUPPORTED: [&str; 20] = [
    "$dynamicRef",
    "additionalItems",
    "contains",
    "dependencies",
    "dependentRequired",
    "dependentSchemas",
    "else",
    "if",
    "maxContains",
    "maxProperties",
    "minContains",
    "minProperties",
    "pattern",
    "patternProperties",
    "propertyNames",
    "then",
    "unevaluatedItems",
    "unevaluatedProperties",
    "uniqueItems",
    "$recursiveRef",
];
/// JSON types with their English names.
const TYPES: [(&str, &str); 7] = [
    ("array", "a list"),
    ("boolean", "true or false"),
    ("integer", "a whole number"),
    ("null", "null"),
    ("number", "a number"),
    ("object", "a mapping"),
    ("string", "text"),
];
/// Maximum depth of nested schemas. No JSON value is as deep; only a schema that refers to itself
/// exceeds it.
const MAX_DEPTH: usize = 512;

/// Validator of a schema whose keywords are all supported.
#[derive(Clone, Debug)]
pub(crate) struct Validator {
    root: Value,
}

/// Value that violates the schema.
#[derive(Debug, PartialEq)]
pub(crate) struct Violation {
    /// Keys and indices from the checked value to the invalid one, each after a `/`.
    pub(crate) path: String,
    /// Invalid value.
    pub(crate) value: Value,
    /// Problem, as a sentence.
    pub(crate) problem: String,
}

impl Validator {
    /// Creates a validator; fails if a keyword of the schema is invalid or unsupported.
    pub(crate) fn new(schema: &Value) -> Result<Self, ContractError> {
        check_schema(schema, schema)?;
        Ok(Self { root: schema.clone() })
    }

    /// Returns whether a value is valid.
    pub(crate) fn is_valid(&self, value: &Value) -> bool {
        self.violations(value).is_empty()
    }

    /// Finds all violations of the schema.
    pub(crate) fn violations(&self, value: &Value) -> Vec<Violation> {
        let mut check = Check { root: &self.root, path: Vec::new(), found: Vec::new() };
        check.check_value(&self.root, value, 0);
        check.found
    }
}

/// Checks that a schema can be used.
fn check_schema(root: &Value, schema: &Value) -> Result<(), ContractError> {
    let keywords = match schema {
        Value::Bool(_) => return Ok(()),
        Value::Object(keywords) => keywords,
        other => {
            let problem = format!("{other} is neither an object nor true or false");
            return Err(ContractError(problem));
        }
    };
    for (keyword, value) in keywords {
        let is_valid = match keyword.as_str() {
            "type" => type_names(value).is_some(),
            "enum" | "required" | "anyOf" | "oneOf" | "allOf" | "prefixItems" => value.is_array(),
            "minimum" | "maximum" | "exclusiveMinimum" | "exclusiveMaximum" => value.is_number(),
            "multipleOf" => value.as_f64().is_some_and(|step| step > 0.0),
            "minLength" | "maxLength" | "minItems" | "maxItems" => value.is_u64(),
            "$ref" => resolve_reference(root, value).is_some(),
            "properties" | "$defs" | "definitions" => value.is_object(),
            // Any value is allowed for `const`, descriptions, defaults, formats and extensions such
            // as `x-group`. `items`, `additionalProperties` and `not` are checked below.
            other if !UNSUPPORTED.contains(&other) => true,
            other => {
                let problem = format!("keyword {other} isn't supported; leave it out");
                return Err(ContractError(problem));
            }
        };
        if !is_valid {
            let problem = format!("keyword {keyword} cannot have the value {value}");
            return Err(ContractError(problem));
        }
        let schemas: Vec<&Value> = match (keyword.as_str(), value) {
            ("items" | "additionalProperties" | "not", schema) => vec![schema],
            ("anyOf" | "oneOf" | "allOf" | "prefixItems", Value::Array(all)) => {
                all.iter().collect()
            }
            ("properties" | "$defs" | "definitions", Value::Object(all)) => all.values().collect(),
            _ => Vec::new(),
        };
        for schema in schemas {
            check_schema(root, schema)?;
        }
    }
    Ok(())
}

/// Returns the types of the keyword `type`, with their English names; `None` if one is unknown.
fn type_names(types: &Value) -> Option<Vec<(&str, &str)>> {
    let names = types.as_array().map_or(std::slice::from_ref(types), Vec::as_slice).iter();
    names.map(|name| TYPES.into_iter().find(|(known, _)| name == known)).collect()
}

/// Returns the schema in the same document that a `$ref` refers to.
pub(crate) fn resolve_reference<'a>(root: &'a Value, reference: &Value) -> Option<&'a Value> {
    root.pointer(reference.as_str()?.strip_prefix('#')?)
}

/// State of the check of a value.
struct Check<'a> {
    root: &'a Value,
    /// Keys and indices from the outermost value to the current one.
    path: Vec<String>,
    found: Vec<Violation>,
}

impl<'a> Check<'a> {
    fn report(&mut self, value: &Value, problem: String) {
        let path = self.path.iter().map(|part| format!("/{part}")).collect();
        self.found.push(Violation { path, value: value.clone(), problem });
    }

    /// Checks the current value against a schema.
    fn check_value(&mut self, schema: &'a Value, value: &Value, depth: usize) {
        let Value::Object(keywords) = schema else {
            if schema == &Value::Bool(false) {
                self.report(value, format!("{value} isn't allowed"));
            }
            return;
        };
        if depth > MAX_DEPTH {
            self.report(value, "its schema refers to itself".to_owned());
            return;
        }
        if let Some(schema) =
            keywords.get("$ref").and_then(|reference| resolve_reference(self.root, reference))
        {
            self.check_value(schema, value, depth + 1);
        }
        self.check_kind(keywords, value);
        match value {
            Value::Number(number) => self.check_number(keywords, number, value),
            Value::String(text) => {
                let length = text.chars().count();
                self.check_length(keywords, ["minLength", "maxLength"], length, "character", value);
            }
            Value::Array(items) => self.check_items(keywords, items, value, depth),
            Value::Object(entries) => self.check_entries(keywords, entries, value, depth),
            Value::Null | Value::Bool(_) => {}
        }
        self.check_combined(keywords, value, depth);
    }

    /// Checks `type`, `const` and `enum`.
    fn check_kind(&mut self, keywords: &Map<String, Value>, value: &Value) {
        if let Some(types) = keywords.get("type").and_then(type_names)
            && !types.iter().any(|(name, _)| is_of_type(value, name))
        {
            let names: Vec<&str> = types.into_iter().map(|(_, text)| text).collect();
            self.report(value, format!("{value} is not {}", names.join(" or ")));
        }
        if let Some(constant) = keywords.get("const").filter(|constant| !are_equal(constant, value))
        {
            self.report(value, format!("{constant} was expected"));
        }
        if let Some(choices) = keywords.get("enum").and_then(Value::as_array)
            && !choices.iter().any(|choice| are_equal(choice, value))
        {
            let choices: Vec<String> = choices.iter().map(ToString::to_string).collect();
            self.report(value, format!("{value} is not one of {}", choices.join(", ")));
        }
    }

    fn check_number(&mut self, keywords: &Map<String, Value>, number: &Number, value: &Value) {
        use Ordering::{Equal, Greater, Less};
        for (keyword, wrong, problem) in [
            ("minimum", &[Less][..], "less than the minimum of"),
            ("maximum", &[Greater], "greater than the maximum of"),
            ("exclusiveMinimum", &[Less, Equal], "not greater than"),
            ("exclusiveMaximum", &[Greater, Equal], "not less than"),
        ] {
            if let Some(Value::Number(bound)) = keywords.get(keyword)
                && compare(number, bound).is_none_or(|order| wrong.contains(&order))
            {
                self.report(value, format!("{value} is {problem} {bound}"));
            }
        }
        if let Some(Value::Number(step)) = keywords.get("multipleOf")
            && !is_multiple(number, step)
        {
            self.report(value, format!("{value} is not a multiple of {step}"));
        }
    }

    /// Checks the bounds of a string's or array's length.
    fn check_length(
        &mut self,
        keywords: &Map<String, Value>,
        [min, max]: [&str; 2],
        length: usize,
        noun: &str,
        value: &Value,
    ) {
        let length = length as u64;
        let [min, max] = [min, max].map(|keyword| keywords.get(keyword).and_then(Value::as_u64));
        if let Some(min) = min.filter(|&min| length < min) {
            self.report(value, format!("{value} has fewer than {min} {noun}s"));
        }
        if let Some(max) = max.filter(|&max| length > max) {
            self.report(value, format!("{value} has more than {max} {noun}s"));
        }
    }

    fn check_items(
        &mut self,
        keywords: &'a Map<String, Value>,
        items: &[Value],
        value: &Value,
        depth: usize,
    ) {
        self.check_length(keywords, ["minItems", "maxItems"], items.len(), "item", value);
        let prefix = keywords.get("prefixItems").and_then(Value::as_array);
        for (index, item) in items.iter().enumerate() {
            let schema = prefix.and_then(|schemas| schemas.get(index));
            if let Some(schema) = schema.or_else(|| keywords.get("items")) {
                self.check_inner(schema, &index.to_string(), item, depth);
            }
        }
    }

    fn check_entries(
        &mut self,
        keywords: &'a Map<String, Value>,
        entries: &Map<String, Value>,
        value: &Value,
        depth: usize,
    ) {
        let required = keywords.get("required").and_then(Value::as_array).into_iter().flatten();
        for name in required.filter_map(Value::as_str).filter(|name| !entries.contains_key(*name)) {
            self.report(value, format!("{name:?} is missing"));
        }
        for (name, entry) in entries {
            let schema = keywords.get("properties").and_then(|properties| properties.get(name));
            match (schema, keywords.get("additionalProperties")) {
                (Some(schema), _) => self.check_inner(schema, name, entry, depth),
                (None, Some(Value::Bool(false))) => {
                    self.report(value, format!("{name:?} is not expected"));
                }
                (None, Some(schema)) => self.check_inner(schema, name, entry, depth),
                (None, None) => {}
            }
        }
    }

    fn check_inner(&mut self, schema: &'a Value, name: &str, value: &Value, depth: usize) {
        self.path.push(name.to_owned());
        self.check_value(schema, value, depth + 1);
        self.path.pop();
    }

    /// Checks `allOf`, `anyOf`, `oneOf` and `not`.
    fn check_combined(&mut self, keywords: &'a Map<String, Value>, value: &Value, depth: usize) {
        for schema in keywords.get("allOf").and_then(Value::as_array).into_iter().flatten() {
            self.check_value(schema, value, depth + 1);
        }
        // Matches beyond the limit don't change the result.
        for (keyword, limit) in [("anyOf", 1), ("oneOf", 2)] {
            let Some(schemas) = keywords.get(keyword).and_then(Value::as_array) else { continue };
            let matches = schemas.iter().filter(|one| self.matches(one, value, depth));
            match matches.take(limit).count() {
                0 => self.report(value, format!("{value} fits none of the alternatives")),
                1 => {}
                _ => self.report(value, format!("{value} fits several alternatives")),
            }
        }
        if keywords.get("not").is_some_and(|schema| self.matches(schema, value, depth)) {
            self.report(value, format!("{value} isn't allowed"));
        }
    }

    /// Returns whether a value matches another schema.
    fn matches(&self, schema: &'a Value, value: &Value, depth: usize) -> bool {
        let mut check = Check { root: self.root, path: Vec::new(), found: Vec::new() };
        check.check_value(schema, value, depth + 1);
        check.found.is_empty()
    }
}

fn is_of_type(value: &Value, name: &str) -> bool {
    match value {
        Value::Null => name == "null",
        Value::Bool(_) => name == "boolean",
        Value::String(_) => name == "string",
        Value::Array(_) => name == "array",
        Value::Object(_) => name == "object",
        Value::Number(number) => {
            name == "number" || (name == "integer" && exact_integer(number).is_some())
        }
    }
}

/// Returns whether two values are equal; numbers compare by value, so 2 equals 2.0.
fn are_equal(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => compare(a, b) == Some(Ordering::Equal),
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| are_equal(a, b))
        }
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len()
                && a.iter().all(|(name, a)| b.get(name).is_some_and(|b| are_equal(a, b)))
        }
        _ => a == b,
    }
}

/// Returns the exact value of a whole number; `None` for fractions and for floats of magnitude
/// `LIMIT` or more.
pub(crate) fn exact_integer(number: &Number) -> Option<i128> {
    /// Bound of the floats that are converted: larger than any 64-bit integer, and within `i128`.
    const LIMIT: f64 = 1e36;
    if let Some(value) = number.as_u64().map(i128::from).or(number.as_i64().map(i128::from)) {
        return Some(value);
    }
    number.as_f64().filter(|v| v.fract() == 0.0 && v.abs() < LIMIT).map(|v| v as i128)
}

fn compare(a: &Number, b: &Number) -> Option<Ordering> {
    match (exact_integer(a), exact_integer(b)) {
        (Some(a), Some(b)) => Some(a.cmp(&b)),
        _ => a.as_f64()?.partial_cmp(&b.as_f64()?),
    }
}

fn is_multiple(number: &Number, step: &Number) -> bool {
    /// Tolerance of the ratio: decimal fractions are rounded, yet 0.3 is a multiple of 0.1. Chosen
    /// by hand.
    const ROUNDING: f64 = 1e-9;
    match (exact_integer(number), exact_integer(step)) {
        (Some(number), Some(step)) => number.checked_rem(step) == Some(0),
        _ => {
            let (Some(number), Some(step)) = (number.as_f64(), step.as_f64()) else { return false };
            let ratio = number / step;
            (ratio - ratio.round()).abs() <= ROUNDING * ratio.abs().max(1.0)
        }
    }
}

#[cfg(test)]
#[path = "validator_tests.rs"]
mod tests;
