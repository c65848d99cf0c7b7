//! Checks JSON values against the part of JSON Schema (draft 2020-12) that parameters need. The
//! whole of it would be most of a stage's compile time, and of its start.

use std::cmp::Ordering;

use serde_json::{Map, Number, Value};

use crate::error::KeywordError;

/// Keywords that constrain values and aren't understood: a schema that has one is refused, so that
/// nothing passes unchecked.
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
const TYPES: [&str; 7] = ["array", "boolean", "integer", "null", "number", "object", "string"];
/// Deeper than any value that was read; only a schema that leads back to itself comes here.
const DEEPEST_NESTING: usize = 512;

/// A schema whose keywords are all understood.
#[derive(Clone, Debug)]
pub(crate) struct Validator {
    root: Value,
}

/// What doesn't fit, and where.
#[derive(Debug, PartialEq)]
pub(crate) struct Misfit {
    /// JSON pointer of the value inside the one that was checked.
    pub(crate) path: String,
    /// The value.
    pub(crate) value: Value,
    /// What is wrong with it.
    pub(crate) problem: String,
}

impl Validator {
    /// Takes a schema; the error names the keyword that can't be used.
    pub(crate) fn new(schema: &Value) -> Result<Self, KeywordError> {
        check(schema, schema)?;
        Ok(Self { root: schema.clone() })
    }

    /// Whether a value fits.
    pub(crate) fn is_valid(&self, value: &Value) -> bool {
        self.misfits(value).is_empty()
    }

    /// Everything that doesn't fit.
    pub(crate) fn misfits(&self, value: &Value) -> Vec<Misfit> {
        let mut check = Check { root: &self.root, path: Vec::new(), found: Vec::new() };
        check.value(&self.root, value, 0);
        check.found
    }
}

/// Checks a schema itself.
fn check(root: &Value, schema: &Value) -> Result<(), KeywordError> {
    let keywords = match schema {
        Value::Bool(_) => return Ok(()),
        Value::Object(keywords) => keywords,
        other => return Err(KeywordError::Kind(other.clone())),
    };
    for (keyword, value) in keywords {
        let wrong =
            || Err(KeywordError::Misused { keyword: keyword.clone(), value: value.clone() });
        match keyword.as_str() {
            "type" => {
                let is_type = |one: &Value| one.as_str().is_some_and(|t| TYPES.contains(&t));
                if !is_type(value) && !value.as_array().is_some_and(|all| all.iter().all(is_type)) {
                    return wrong();
                }
            }
            "enum" | "required" if !value.is_array() => return wrong(),
            "minimum" | "maximum" | "exclusiveMinimum" | "exclusiveMaximum"
                if !value.is_number() =>
            {
                return wrong();
            }
            "multipleOf" if value.as_f64().is_none_or(|step| step <= 0.0) => return wrong(),
            "minLength" | "maxLength" | "minItems" | "maxItems" if value.as_u64().is_none() => {
                return wrong();
            }
            "$ref" if referred(root, value).is_none() => return wrong(),
            "items" | "additionalProperties" | "not" => check(root, value)?,
            "anyOf" | "oneOf" | "allOf" | "prefixItems" => {
                let Some(schemas) = value.as_array() else { return wrong() };
                schemas.iter().try_for_each(|schema| check(root, schema))?;
            }
            "properties" | "$defs" | "definitions" => {
                let Some(schemas) = value.as_object() else { return wrong() };
                schemas.values().try_for_each(|schema| check(root, schema))?;
            }
            other if UNSUPPORTED.contains(&other) => {
                return Err(KeywordError::Unsupported(other.to_owned()));
            }
            // Descriptions, defaults, formats, and words of somebody's own.
            _ => {}
        }
    }
    Ok(())
}

/// The schema that a `$ref` leads to inside the same document.
fn referred<'a>(root: &'a Value, reference: &Value) -> Option<&'a Value> {
    root.pointer(reference.as_str()?.strip_prefix('#')?)
}

/// A check under way.
struct Check<'a> {
    root: &'a Value,
    /// Keys and indices from the whole value to the part at hand.
    path: Vec<String>,
    found: Vec<Misfit>,
}

impl<'a> Check<'a> {
    fn misfit(&mut self, value: &Value, problem: String) {
        let path = self.path.iter().map(|part| format!("/{part}")).collect();
        self.found.push(Misfit { path, value: value.clone(), problem });
    }

    /// Checks a part of the value against a schema.
    fn value(&mut self, schema: &'a Value, value: &Value, depth: usize) {
        let Value::Object(keywords) = schema else {
            if schema == &Value::Bool(false) {
                self.misfit(value, format!("{value} isn't allowed"));
            }
            return;
        };
        if depth > DEEPEST_NESTING {
            self.misfit(value, "its schema leads back to itself".to_owned());
            return;
        }
        if let Some(schema) = keywords.get("$ref").and_then(|to| referred(self.root, to)) {
            self.value(schema, value, depth + 1);
        }
        self.kind(keywords, value);
        match value {
            Value::Number(number) => self.number(keywords, number, value),
            Value::String(text) => {
                let length = text.chars().count();
                self.count(keywords, ("minLength", "maxLength"), length, "character", value);
            }
            Value::Array(items) => self.items(keywords, items, depth),
            Value::Object(entries) => self.entries(keywords, entries, depth),
            Value::Null | Value::Bool(_) => {}
        }
        self.combined(keywords, value, depth);
    }

    /// `type`, `const`, `enum`.
    fn kind(&mut self, keywords: &Map<String, Value>, value: &Value) {
        if let Some(types) = keywords.get("type") {
            let names: Vec<&str> = match types {
                Value::Array(names) => names.iter().filter_map(Value::as_str).collect(),
                one => one.as_str().into_iter().collect(),
            };
            if !names.iter().any(|name| is_of_type(value, name)) {
                let s = if names.len() > 1 { "s" } else { "" };
                let names: Vec<String> = names.iter().map(|name| format!("{name:?}")).collect();
                self.misfit(value, format!("{value} is not of type{s} {}", names.join(", ")));
            }
        }
        if let Some(constant) = keywords.get("const").filter(|constant| !equal(constant, value)) {
            self.misfit(value, format!("{constant} was expected"));
        }
        if let Some(choices) = keywords.get("enum").and_then(Value::as_array)
            && !choices.iter().any(|choice| equal(choice, value))
        {
            let choices: Vec<String> = choices.iter().map(ToString::to_string).collect();
            self.misfit(value, format!("{value} is not one of {}", choices.join(", ")));
        }
    }

    fn number(&mut self, keywords: &Map<String, Value>, number: &Number, value: &Value) {
        use Ordering::{Equal, Greater, Less};
        for (keyword, wrong, words) in [
            ("minimum", &[Less][..], "less than the minimum"),
            ("maximum", &[Greater], "greater than the maximum"),
            ("exclusiveMinimum", &[Less, Equal], "less than or equal to the minimum"),
            ("exclusiveMaximum", &[Greater, Equal], "greater than or equal to the maximum"),
        ] {
            if let Some(Value::Number(bound)) = keywords.get(keyword)
                && compare(number, bound).is_none_or(|order| wrong.contains(&order))
            {
                self.misfit(value, format!("{value} is {words} of {bound}"));
            }
        }
        if let Some(Value::Number(step)) = keywords.get("multipleOf")
            && !is_multiple(number, step)
        {
            self.misfit(value, format!("{value} is not a multiple of {step}"));
        }
    }

    /// Bounds of a length.
    fn count(
        &mut self,
        keywords: &Map<String, Value>,
        (least, most): (&str, &str),
        count: usize,
        noun: &str,
        value: &Value,
    ) {
        let bound = |keyword: &str| keywords.get(keyword).and_then(Value::as_u64);
        let count = count as u64;
        if let Some(bound) = bound(least).filter(|&bound| count < bound) {
            self.misfit(value, format!("{value} has less than {bound} {noun}s"));
        }
        if let Some(bound) = bound(most).filter(|&bound| count > bound) {
            self.misfit(value, format!("{value} has more than {bound} {noun}s"));
        }
    }

    fn items(&mut self, keywords: &'a Map<String, Value>, items: &[Value], depth: usize) {
        let whole = Value::Array(items.to_vec());
        self.count(keywords, ("minItems", "maxItems"), items.len(), "item", &whole);
        let placed = keywords.get("prefixItems").and_then(Value::as_array);
        for (index, item) in items.iter().enumerate() {
            let schema = placed.and_then(|schemas| schemas.get(index));
            if let Some(schema) = schema.or_else(|| keywords.get("items")) {
                self.inside(schema, &index.to_string(), item, depth);
            }
        }
    }

    fn entries(
        &mut self,
        keywords: &'a Map<String, Value>,
        entries: &Map<String, Value>,
        depth: usize,
    ) {
        let required = keywords.get("required").and_then(Value::as_array).into_iter().flatten();
        for name in required.filter_map(Value::as_str).filter(|name| !entries.contains_key(*name)) {
            self.misfit(&Value::Object(entries.clone()), format!("{name:?} is missing"));
        }
        for (name, entry) in entries {
            match keywords.get("properties").and_then(|properties| properties.get(name)) {
                Some(schema) => self.inside(schema, name, entry, depth),
                None => match keywords.get("additionalProperties") {
                    Some(Value::Bool(false)) => {
                        let problem = format!("{name:?} is not expected");
                        self.misfit(&Value::Object(entries.clone()), problem);
                    }
                    Some(schema) => self.inside(schema, name, entry, depth),
                    None => {}
                },
            }
        }
    }

    fn inside(&mut self, schema: &'a Value, name: &str, value: &Value, depth: usize) {
        self.path.push(name.to_owned());
        self.value(schema, value, depth + 1);
        self.path.pop();
    }

    /// `allOf`, `anyOf`, `oneOf`, `not`.
    fn combined(&mut self, keywords: &'a Map<String, Value>, value: &Value, depth: usize) {
        let list = |keyword: &str| keywords.get(keyword).and_then(Value::as_array);
        for schema in list("allOf").into_iter().flatten() {
            self.value(schema, value, depth + 1);
        }
        let any = list("anyOf");
        if any.is_some_and(|all| !all.iter().any(|schema| self.fits(schema, value, depth))) {
            self.misfit(value, format!("{value} fits none of the alternatives"));
        }
        let one = list("oneOf");
        match one.map(|all| all.iter().filter(|one| self.fits(one, value, depth)).count()) {
            Some(0) => self.misfit(value, format!("{value} fits none of the alternatives")),
            None | Some(1) => {}
            Some(_) => self.misfit(value, format!("{value} fits several alternatives")),
        }
        if keywords.get("not").is_some_and(|schema| self.fits(schema, value, depth)) {
            self.misfit(value, format!("{value} isn't allowed"));
        }
    }

    /// Whether the value at hand fits another schema.
    fn fits(&self, schema: &'a Value, value: &Value, depth: usize) -> bool {
        let mut check = Check { root: self.root, path: Vec::new(), found: Vec::new() };
        check.value(schema, value, depth + 1);
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
        Value::Number(number) => name == "number" || (name == "integer" && whole(number).is_some()),
    }
}

/// Whether two values are the same, as numbers are: 2 is 2.0.
fn equal(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => compare(a, b) == Some(Ordering::Equal),
        (Value::Array(a), Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| equal(a, b))
        }
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len() && a.iter().all(|(name, a)| b.get(name).is_some_and(|b| equal(a, b)))
        }
        _ => a == b,
    }
}

/// A number without a part behind the point, exactly.
fn whole(number: &Number) -> Option<i128> {
    /// Far beyond 64 bits, and less than an `i128` holds.
    const LIMIT: f64 = 1e36;
    if let Some(value) = number.as_u64().map(i128::from).or(number.as_i64().map(i128::from)) {
        return Some(value);
    }
    number.as_f64().filter(|v| v.fract() == 0.0 && v.abs() < LIMIT).map(|v| v as i128)
}

fn compare(a: &Number, b: &Number) -> Option<Ordering> {
    match (whole(a), whole(b)) {
        (Some(a), Some(b)) => Some(a.cmp(&b)),
        _ => a.as_f64()?.partial_cmp(&b.as_f64()?),
    }
}

fn is_multiple(number: &Number, step: &Number) -> bool {
    /// Decimal fractions have no exact binary form: 0.3 is three times 0.1.
    const ROUNDING: f64 = 1e-9;
    match (whole(number), whole(step)) {
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
