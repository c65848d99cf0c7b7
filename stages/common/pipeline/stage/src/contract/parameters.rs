use artifact::{known_names, nearest};
use serde_json::{Map, Value, json};

use crate::contract::error::ContractError;
use crate::contract::tagged::Tag;
use crate::contract::validator::{Validator, Violation};
use crate::contract::values::Reader;

/// Compiled parameter schema of a stage, from which runner and stage take defaults and checks.
///
/// Parameters are given and hashed by name, without nesting. One of them may select a variant of
/// the type ([`Tag`]): its value is the variant's name, and the variant's own parameters are on the
/// same level. Within a variant, names are unique.
#[derive(Debug)]
pub struct Schema {
    /// One per variant, the default variant first; exactly one if there is no tag.
    variants: Vec<VariantSchema>,
    tag: Option<Tag>,
}

/// Schema of the common parameters and those of one variant, without nesting.
#[derive(Debug)]
struct VariantSchema {
    schema: Value,
    validator: Validator,
}

/// Error message for an invalid parameter.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("parameter {name}: {problem}")]
pub struct ParameterProblem {
    /// Name of the parameter.
    pub name: String,
    /// Problem and, if known, remedy.
    pub problem: String,
}

impl Schema {
    /// Compiles a stage's parameter schema.
    pub fn new(schema: &Value) -> Result<Self, ContractError> {
        let tag = Tag::find(schema)?;
        let schemas =
            tag.as_ref().map_or_else(|| vec![schema.clone()], |t| t.variant_schemas(schema));
        let variants = schemas.into_iter().map(VariantSchema::new).collect::<Result<_, _>>()?;
        Ok(Self { variants, tag })
    }

    /// Returns the names of all parameters, sorted.
    pub fn names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.variants.iter().flat_map(VariantSchema::names).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// Converts a parameter's value to the form that is hashed. Numbers have the form of their
    /// type, so that 2, 2.0 and 2e0 are equal. A value equal to the default is written as in the
    /// schema.
    pub fn canonical_value(&self, name: &str, value: &Value) -> Value {
        let variant = self.variants.iter().find(|variant| variant.property(name).is_some());
        variant.map_or_else(|| value.clone(), |variant| variant.canonical_value(name, value))
    }

    /// Converts nested parameters, `field: {grid: {n_levels: 4}}`, to unnested ones, `field: grid`
    /// and `n_levels: 4`.
    pub fn flattened(&self, given: &Map<String, Value>) -> Map<String, Value> {
        self.tag.as_ref().map_or_else(|| given.clone(), |tag| tag.flattened(given))
    }

    /// Overrides earlier parameters with later ones. If the later ones select a variant, earlier
    /// parameters of other variants are dropped.
    pub fn override_with(&self, given: &mut Map<String, Value>, later: &Map<String, Value>) {
        let later = self.flattened(later);
        if self.tag.as_ref().is_some_and(|tag| later.contains_key(tag.name())) {
            let variant = self.selected_variant(&later);
            let known = self.names();
            given.retain(|name, _| {
                variant.property(name).is_some() || !known.contains(&name.as_str())
            });
        }
        given.extend(later);
    }

    /// Returns all parameters, with defaults for those not given, in the form that is hashed and
    /// passed to the stage.
    pub fn resolve(&self, given: &Map<String, Value>) -> Result<Value, Vec<ParameterProblem>> {
        let given = self.flattened(given);
        let variant = self.selected_variant(&given);
        let mut resolved = variant.defaults();
        let mut problems = Vec::new();
        for (name, value) in &given {
            if variant.property(name).is_some() {
                resolved.insert(name.clone(), variant.canonical_value(name, value));
            } else {
                let problem = self.unknown_parameter(variant, name);
                problems.push(ParameterProblem { name: name.clone(), problem });
            }
        }
        let resolved = Value::Object(resolved);
        for violation in variant.validator.violations(&resolved) {
            problems.push(variant.problem(violation));
        }
        if problems.is_empty() { Ok(resolved) } else { Err(problems) }
    }

    /// Converts resolved parameters to the form of the stage's type, in which a variant's
    /// parameters are nested.
    pub fn nested(&self, resolved: &Value) -> Value {
        self.tag.as_ref().map_or_else(|| resolved.clone(), |tag| tag.nested(resolved))
    }

    /// Returns the names of the resolved parameters whose value depends on the scene.
    pub fn by_scene<'a>(&'a self, resolved: &'a Value) -> Vec<&'a str> {
        let variant = self.selected_variant(resolved.as_object().unwrap_or(&Map::new()));
        let scene_dependent = variant.names().filter(|name| {
            let default = variant.property(name).and_then(|property| property.get(DEFAULT_KEYWORD));
            resolved[*name].is_null() && default.is_some_and(|default| default == BY_SCENE)
        });
        scene_dependent.collect()
    }

    /// Returns whether parameters select the default variant, or none.
    pub fn is_default_variant(&self, given: &Map<String, Value>) -> bool {
        std::ptr::eq(self.selected_variant(&self.flattened(given)), &self.variants[0])
    }

    /// Returns the schema of the selected variant; of the default one if none or an unknown one is
    /// selected.
    fn selected_variant(&self, flat: &Map<String, Value>) -> &VariantSchema {
        let selected = self.tag.as_ref().and_then(|tag| tag.selected(flat));
        &self.variants[selected.unwrap_or(0)]
    }

    /// Describes the problem of a parameter that the selected variant doesn't have.
    fn unknown_parameter(&self, variant: &VariantSchema, name: &str) -> String {
        let owner = self.variants.iter().position(|other| other.property(name).is_some());
        match (&self.tag, owner) {
            (Some(tag), Some(owner)) => tag.other_variant_message(owner),
            _ => format!("unknown; {}", known_names(name, variant.names())),
        }
    }
}

/// Schema keyword that describes a default of null.
pub(crate) const DEFAULT_KEYWORD: &str = "x-default";
/// Description of the default if the value depends on the scene.
const BY_SCENE: &str = "by scene";

impl VariantSchema {
    fn new(schema: Value) -> Result<Self, ContractError> {
        let mut bounded = schema.clone();
        bound_formats(&mut bounded);
        let validator = Validator::new(&bounded)
            .map_err(|e| ContractError(format!("invalid or unsupported JSON Schema: {e}")))?;
        Ok(Self { schema, validator })
    }

    fn names(&self) -> impl Iterator<Item = &str> {
        self.properties().into_iter().flat_map(|properties| properties.keys().map(String::as_str))
    }

    fn properties(&self) -> Option<&Map<String, Value>> {
        self.schema.get("properties").and_then(Value::as_object)
    }

    fn property(&self, name: &str) -> Option<&Value> {
        self.properties()?.get(name)
    }

    fn defaults(&self) -> Map<String, Value> {
        self.properties()
            .into_iter()
            .flatten()
            .filter_map(|(name, property)| Some((name.clone(), property.get("default")?.clone())))
            .collect()
    }

    fn canonical_value(&self, name: &str, value: &Value) -> Value {
        let Some(property) = self.property(name) else { return value.clone() };
        let reader = Reader::new(&self.schema);
        let value = reader.read(property, value);
        match property.get("default") {
            Some(default) if reader.read(property, default) == value => default.clone(),
            _ => value,
        }
    }

    fn problem(&self, violation: Violation) -> ParameterProblem {
        let name = violation.path.trim_start_matches('/').to_owned();
        let problem = match self.choices(&name) {
            Some(choices) => not_one_of_message(&violation.value, &choices),
            None => violation.problem,
        };
        ParameterProblem { name: if name.is_empty() { "(all)".to_owned() } else { name }, problem }
    }

    /// Returns the allowed values of a choice as JSON. The validator's own message only says that
    /// no alternative fits.
    fn choices(&self, name: &str) -> Option<Vec<String>> {
        let choices = Reader::new(&self.schema).choices(self.property(name)?)?;
        Some(choices.into_iter().map(|(value, _)| value.to_string()).collect())
    }
}

fn not_one_of_message(value: &Value, choices: &[String]) -> String {
    let suggestion = nearest(&value.to_string(), choices.iter().map(String::as_str))
        .map_or_else(String::new, |choice| format!("; did you mean {choice}?"));
    format!("{value} is not one of {}{suggestion}", choices.join(", "))
}

/// Adds the bounds of sized integers (`format`: `uint32`, …) that the schema doesn't state, so that
/// a value out of the type's range is refused before the stage starts.
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
            if let Some((min, max)) = bounds {
                entries.entry("minimum").or_insert(min);
                entries.entry("maximum").or_insert(max);
            }
            for (keyword, inner) in entries {
                // These keywords contain values, not schemas.
                if !["default", "const", "enum", "examples"].contains(&keyword.as_str()) {
                    bound_formats(inner);
                }
            }
        }
        Value::Array(items) => {
            for item in items {
                bound_formats(item);
            }
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use artifact::canonical_json;
    use serde_json::json;

    use super::*;

    fn schema() -> Schema {
        Schema::new(&json!({
            "type": "object",
            "additionalProperties": false,
            "properties": {
                "scale": {"type": "integer", "format": "uint32", "minimum": 1, "default": 2},
                "rate": {"type": "number", "default": 2.0},
                "peak": {"type": "number", "default": 255},
                "width": {"type": ["integer", "null"], "default": null},
                "place": {"type": "array", "items": {"type": "number"}, "default": [1, 0.5]},
                "kernel": {"$ref": "#/$defs/Kernel", "default": "lanczos"},
                "assumed": {"anyOf": [{"$ref": "#/$defs/Kernel"}, {"type": "null"}],
                "default": null}
            },
            "$defs": {"Kernel": {"oneOf": [{"const": "box", "type": "string"},
            {"const": "lanczos", "type": "string"}]}}
        }))
        .unwrap()
    }

    fn resolve(given: &Value) -> Result<Value, Vec<ParameterProblem>> {
        schema().resolve(given.as_object().unwrap())
    }

    #[test]
    fn defaults_are_filled_in() {
        let all = json!({
            "assumed": null, "kernel": "lanczos", "peak": 255, "place": [1, 0.5], "rate": 2.0,
            "scale": 4, "width": null
        });
        assert_eq!(resolve(&json!({"scale": 4})).unwrap(), all);
    }

    /// Equal values have one form, and hence one key. An explicit default has the form of an
    /// omitted parameter.
    #[test]
    fn equal_values_have_one_form() {
        let defaults = resolve(&json!({})).unwrap();
        for explicit in [
            json!({"scale": 2}),
            json!({"scale": 2.0}),
            json!({"rate": 2}),
            json!({"rate": 2.0}),
            json!({"peak": 255.0}),
            json!({"width": null}),
            json!({"assumed": null}),
            json!({"place": [1.0, 0.5]}),
        ] {
            assert_eq!(
                canonical_json(&resolve(&explicit).unwrap()),
                canonical_json(&defaults),
                "{explicit}"
            );
        }
        for (one, other) in [
            (json!({"scale": 6e4}), json!({"scale": 60000})),
            (json!({"rate": 3}), json!({"rate": 3e0})),
            (json!({"width": 7.0}), json!({"width": 7})),
            (json!({"place": [2, 3.0]}), json!({"place": [2.0, 3]})),
        ] {
            let [one, other] = [one, other].map(|given| canonical_json(&resolve(&given).unwrap()));
            assert_eq!(one, other);
            assert_ne!(one, canonical_json(&defaults));
        }
        let problems = resolve(&json!({"rate": null})).unwrap_err();
        assert!(
            problems[0].to_string().contains("parameter rate: null is not a number"),
            "{}",
            problems[0]
        );
    }

    #[test]
    fn unknown_names_and_invalid_values_are_refused() {
        for (given, name, expected) in [
            (
                json!({"kernal": "box"}),
                "kernal",
                "did you mean kernel? known: assumed, kernel, peak, place, rate, scale, width",
            ),
            (json!({"kernel": "lancsoz"}), "kernel", r#"did you mean "lanczos"?"#),
            (json!({"scale": 5_000_000_000u64}), "scale", "maximum of 4294967295"),
            (json!({"scale": 1e30}), "scale", "maximum of 4294967295"),
            (json!({"scale": 2.5}), "scale", "is not a whole number"),
            (json!({"scale": 0}), "scale", "minimum"),
            (json!({"scale": "two"}), "scale", "is not a whole number"),
            (json!({"kernel": "gauss"}), "kernel", r#""gauss" is not one of "box", "lanczos""#),
            (json!({"assumed": "gauss"}), "assumed", r#""gauss" is not one of "box", "lanczos""#),
        ] {
            let problems = resolve(&given).unwrap_err();
            assert_eq!(problems[0].name, name);
            assert!(problems[0].problem.contains(expected), "{}", problems[0]);
        }
    }
}
