use serde_json::{Map, Value, json};

use crate::nearest::{known_names, nearest};
use crate::renames::{Named, renamed};
use crate::values::Reader;

/// A stage's parameter schema, compiled: defaults and checks come from the types, in the runner and in the stage alike.
#[derive(Debug)]
pub struct Schema {
    program: String,
    schema: Value,
    validator: jsonschema::Validator,
}

/// A parameter that doesn't fit, in words for a person.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("parameter {name}: {problem}")]
pub struct ParameterProblem {
    /// The parameter.
    pub name: String,
    /// What is wrong and what would be right.
    pub problem: String,
}

impl Schema {
    /// Compiles the schema that a program describes; the error says what is wrong with it.
    pub fn new(program: &str, schema: &Value) -> Result<Self, String> {
        let mut bounded = schema.clone();
        bound_formats(&mut bounded);
        let validator = jsonschema::validator_for(&bounded).map_err(|e| format!("not a JSON Schema: {e}"))?;
        Ok(Self { program: program.to_owned(), schema: schema.clone(), validator })
    }

    /// Names of all parameters, sorted.
    pub fn names(&self) -> Vec<&str> {
        let mut names: Vec<_> = self.properties().map(|p| p.keys().map(String::as_str).collect()).unwrap_or_default();
        names.sort_unstable();
        names
    }

    /// A parameter's value in the form that is hashed: numbers as the schema's type has them, so that 2, 2.0 and 2e0 are one value, and what
    /// equals the default as the default is written.
    pub fn canonical_value(&self, name: &str, value: &Value) -> Value {
        let Some(property) = self.properties().and_then(|p| p.get(name)) else { return value.clone() };
        let reader = Reader::new(&self.schema);
        let value = reader.read(property, value);
        match property.get("default") {
            Some(default) if reader.read(property, default) == value => default.clone(),
            _ => value,
        }
    }

    /// Every parameter with its value: the given one, else the default. The result is what is hashed and passed to the stage.
    pub fn resolve(&self, given: &Map<String, Value>) -> Result<Value, Vec<ParameterProblem>> {
        let mut resolved = Map::new();
        for (name, property) in self.properties().into_iter().flatten() {
            if let Some(default) = property.get("default") {
                resolved.insert(name.clone(), default.clone());
            }
        }
        let mut problems = Vec::new();
        for (name, value) in given {
            if self.properties().is_some_and(|p| p.contains_key(name)) {
                resolved.insert(name.clone(), self.canonical_value(name, value));
            } else {
                problems.push(ParameterProblem { name: name.clone(), problem: self.unknown(name, value) });
            }
        }
        let resolved = Value::Object(resolved);
        for error in self.validator.iter_errors(&resolved) {
            let path = error.instance_path().to_string();
            let name = path.trim_start_matches('/').to_owned();
            let problem = match self.choices(&name) {
                Some(choices) => not_one_of(error.instance(), &choices),
                None => error.to_string(),
            };
            let name = if name.is_empty() { "(all)".to_owned() } else { name };
            problems.push(ParameterProblem { name, problem });
        }
        if problems.is_empty() { Ok(resolved) } else { Err(problems) }
    }

    /// What to say of a parameter that there isn't.
    fn unknown(&self, name: &str, value: &Value) -> String {
        match renamed(Named::Parameter, &self.program, name) {
            Some(rename) => rename.problem(Some(value)),
            None => format!("unknown; {}", known_names(name, self.names())),
        }
    }

    /// The words a parameter may be, where it is a choice: the validator itself only says that no alternative fits.
    fn choices(&self, name: &str) -> Option<Vec<String>> {
        let property = self.properties()?.get(name)?;
        // What may be left out is a choice between its kind and null.
        let is_null = |one: &&Value| one.get("type").is_some_and(|t| t == "null");
        let inner = property.get("anyOf").and_then(Value::as_array).and_then(|of| of.iter().find(|one| !is_null(one)));
        let property = inner.unwrap_or(property);
        let definition = Reader::new(&self.schema).referred(property).unwrap_or(property);
        if let Some(words) = definition.get("enum").and_then(Value::as_array) {
            return Some(words.iter().map(ToString::to_string).collect());
        }
        definition.get("oneOf")?.as_array()?.iter().map(|one| one.get("const").map(ToString::to_string)).collect()
    }

    fn properties(&self) -> Option<&Map<String, Value>> {
        self.schema.get("properties").and_then(Value::as_object)
    }
}

fn not_one_of(value: &Value, choices: &[String]) -> String {
    let meant = nearest(&value.to_string(), choices.iter().map(String::as_str));
    let meant = meant.map(|choice| format!("; did you mean {choice}?")).unwrap_or_default();
    format!("{value} is not one of {}{meant}", choices.join(", "))
}

/// Gives integers of a size (`format`: `uint32`, …) the bounds of that size, where the schema states none: what a stage can't hold is refused
/// before it is started.
fn bound_formats(schema: &mut Value) {
    match schema {
        Value::Object(entries) => {
            let bounds = match entries.get("format").and_then(Value::as_str) {
                Some("uint8") => Some((json!(0), json!(u8::MAX))),
                Some("uint16") => Some((json!(0), json!(u16::MAX))),
                Some("uint32") => Some((json!(0), json!(u32::MAX))),
                Some("uint64" | "uint") => Some((json!(0), json!(u64::MAX))),
                Some("int8") => Some((json!(i8::MIN), json!(i8::MAX))),
                Some("int16") => Some((json!(i16::MIN), json!(i16::MAX))),
                Some("int32") => Some((json!(i32::MIN), json!(i32::MAX))),
                Some("int64" | "int") => Some((json!(i64::MIN), json!(i64::MAX))),
                _ => None,
            };
            for (name, bound) in bounds.into_iter().flat_map(|(least, most)| [("minimum", least), ("maximum", most)]) {
                entries.entry(name).or_insert(bound);
            }
            let data = ["default", "const", "enum", "examples"];
            entries.iter_mut().filter(|(name, _)| !data.contains(&name.as_str())).for_each(|(_, inside)| bound_formats(inside));
        }
        Value::Array(items) => items.iter_mut().for_each(bound_formats),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn schema() -> Schema {
        Schema::new(
            "x",
            &json!({
                "type": "object",
                "additionalProperties": false,
                "properties": {
                    "scale": {"type": "integer", "format": "uint32", "minimum": 1, "default": 2},
                    "rate": {"type": "number", "default": 2.0},
                    "peak": {"type": "number", "default": 255},
                    "width": {"type": ["integer", "null"], "default": null},
                    "place": {"type": "array", "items": {"type": "number"}, "default": [1, 0.5]},
                    "kernel": {"$ref": "#/$defs/Kernel", "default": "lanczos"},
                    "assumed": {"anyOf": [{"$ref": "#/$defs/Kernel"}, {"type": "null"}], "default": null}
                },
                "$defs": {"Kernel": {"oneOf": [{"const": "box", "type": "string"}, {"const": "lanczos", "type": "string"}]}}
            }),
        )
        .unwrap()
    }

    fn resolve(given: &Value) -> Result<Value, Vec<ParameterProblem>> {
        schema().resolve(given.as_object().unwrap())
    }

    #[test]
    fn defaults_are_filled_in() {
        let all = json!({
            "assumed": null, "kernel": "lanczos", "peak": 255, "place": [1, 0.5], "rate": 2.0, "scale": 4, "width": null
        });
        assert_eq!(resolve(&json!({"scale": 4})).unwrap(), all);
    }

    /// What is equal has one form, so one key; a default has the same said and unsaid.
    #[test]
    fn equal_values_have_one_form() {
        let unsaid = resolve(&json!({})).unwrap();
        for said in [
            json!({"scale": 2}),
            json!({"scale": 2.0}),
            json!({"rate": 2}),
            json!({"rate": 2.0}),
            json!({"peak": 255.0}),
            json!({"width": null}),
            json!({"assumed": null}),
            json!({"place": [1.0, 0.5]}),
        ] {
            assert_eq!(crate::canonical(&resolve(&said).unwrap()), crate::canonical(&unsaid), "{said}");
        }
        for (one, other) in [
            (json!({"scale": 6e4}), json!({"scale": 60000})),
            (json!({"rate": 3}), json!({"rate": 3e0})),
            (json!({"width": 7.0}), json!({"width": 7})),
            (json!({"place": [2, 3.0]}), json!({"place": [2.0, 3]})),
        ] {
            let [one, other] = [one, other].map(|given| crate::canonical(&resolve(&given).unwrap()));
            assert_eq!(one, other);
            assert_ne!(one, crate::canonical(&unsaid));
        }
        let problems = resolve(&json!({"rate": null})).unwrap_err();
        assert!(problems[0].to_string().contains("parameter rate: null is not of type"), "{}", problems[0]);
    }

    #[test]
    fn unknown_names_types_and_ranges_are_refused() {
        for (given, name, word) in [
            (json!({"kernal": "box"}), "kernal", "did you mean kernel? known: assumed, kernel, peak, place, rate, scale, width"),
            (json!({"kernel": "lancsoz"}), "kernel", r#"did you mean "lanczos"?"#),
            (json!({"scale": 5_000_000_000u64}), "scale", "maximum of 4294967295"),
            (json!({"scale": 1e30}), "scale", "maximum of 4294967295"),
            (json!({"scale": 2.5}), "scale", "integer"),
            (json!({"scale": 0}), "scale", "minimum"),
            (json!({"scale": "two"}), "scale", "integer"),
            (json!({"kernel": "gauss"}), "kernel", r#""gauss" is not one of "box", "lanczos""#),
            (json!({"assumed": "gauss"}), "assumed", r#""gauss" is not one of "box", "lanczos""#),
        ] {
            let problems = resolve(&given).unwrap_err();
            assert_eq!(problems[0].name, name);
            assert!(problems[0].problem.contains(word), "{}", problems[0]);
        }
    }
}
