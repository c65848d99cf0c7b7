use serde_json::{Map, Value};

/// A stage's parameter schema, compiled: defaults and checks come from the types, in the runner and in the stage alike.
pub struct Schema {
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
    /// Compiles the schema of `describe`; the error says what is wrong with it.
    pub fn new(schema: &Value) -> Result<Self, String> {
        let validator = jsonschema::validator_for(schema).map_err(|e| format!("not a JSON Schema: {e}"))?;
        Ok(Self { schema: schema.clone(), validator })
    }

    /// Names of all parameters, sorted.
    pub fn names(&self) -> Vec<&str> {
        let mut names: Vec<_> = self.properties().map(|p| p.keys().map(String::as_str).collect()).unwrap_or_default();
        names.sort_unstable();
        names
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
                resolved.insert(name.clone(), value.clone());
            } else {
                let known = self.names();
                let known = if known.is_empty() { "there are none".to_owned() } else { format!("known: {}", known.join(", ")) };
                problems.push(ParameterProblem { name: name.clone(), problem: format!("unknown; {known}") });
            }
        }
        let resolved = Value::Object(resolved);
        for error in self.validator.iter_errors(&resolved) {
            let path = error.instance_path().to_string();
            let name = path.trim_start_matches('/').to_owned();
            let problem = match self.choices(&name) {
                Some(choices) => format!("{} is not one of {}", error.instance(), choices.join(", ")),
                None => error.to_string(),
            };
            let name = if name.is_empty() { "(all)".to_owned() } else { name };
            problems.push(ParameterProblem { name, problem });
        }
        if problems.is_empty() { Ok(resolved) } else { Err(problems) }
    }

    /// The words a parameter may be, where it is a choice: the validator itself only says that no alternative fits.
    fn choices(&self, name: &str) -> Option<Vec<String>> {
        let property = self.properties()?.get(name)?;
        // What may be left out is a choice between its kind and null.
        let is_null = |one: &&Value| one.get("type").is_some_and(|t| t == "null");
        let inner = property.get("anyOf").and_then(Value::as_array).and_then(|of| of.iter().find(|one| !is_null(one)));
        let property = inner.unwrap_or(property);
        let definition = property.get("$ref").and_then(Value::as_str).and_then(|r| self.schema.pointer(r.strip_prefix('#')?));
        let definition = definition.unwrap_or(property);
        if let Some(words) = definition.get("enum").and_then(Value::as_array) {
            return Some(words.iter().map(ToString::to_string).collect());
        }
        definition.get("oneOf")?.as_array()?.iter().map(|one| one.get("const").map(ToString::to_string)).collect()
    }

    fn properties(&self) -> Option<&Map<String, Value>> {
        self.schema.get("properties").and_then(Value::as_object)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn schema() -> Schema {
        Schema::new(&json!({
            "type": "object",
            "additionalProperties": false,
            "properties": {
                "scale": {"type": "integer", "minimum": 1, "default": 2},
                "kernel": {"$ref": "#/$defs/Kernel", "default": "lanczos"},
                "assumed": {"anyOf": [{"$ref": "#/$defs/Kernel"}, {"type": "null"}], "default": null}
            },
            "$defs": {"Kernel": {"oneOf": [{"const": "box", "type": "string"}, {"const": "lanczos", "type": "string"}]}}
        }))
        .unwrap()
    }

    fn resolve(given: &Value) -> Result<Value, Vec<ParameterProblem>> {
        schema().resolve(given.as_object().unwrap())
    }

    #[test]
    fn defaults_are_filled_in() {
        assert_eq!(resolve(&json!({"scale": 4})).unwrap(), json!({"assumed": null, "kernel": "lanczos", "scale": 4}));
    }

    #[test]
    fn unknown_names_types_and_ranges_are_refused() {
        for (given, name, word) in [
            (json!({"kernal": "box"}), "kernal", "known: assumed, kernel, scale"),
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
