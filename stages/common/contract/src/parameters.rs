use artifact::{known_names, nearest};
use serde_json::{Map, Value, json};

use crate::error::SchemaError;
use crate::tagged::Tag;
use crate::validator::{Misfit, Validator};
use crate::values::Reader;

/// A stage's parameter schema, compiled: defaults and checks come from the types, in the runner and
/// in the stage alike.
///
/// Parameters are given and hashed by name, on one level. One of them may select a variant of the
/// type ([`Tag`]): then its value is the variant's name, and the variant's own parameters stand
/// beside it. A name means one parameter of a variant at most.
#[derive(Debug)]
pub struct Schema {
    /// One for each variant, the default's first; a single one where nothing is selected.
    forms: Vec<Form>,
    tag: Option<Tag>,
}

/// The parameters of one variant on one level.
#[derive(Debug)]
struct Form {
    schema: Value,
    validator: Validator,
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
    /// Compiles the schema that a program describes.
    pub fn new(schema: &Value) -> Result<Self, SchemaError> {
        let tag = Tag::find(schema)?;
        let forms = match &tag {
            None => vec![Form::new(schema.clone())?],
            Some(tag) => tag.forms(schema).into_iter().map(Form::new).collect::<Result<_, _>>()?,
        };
        Ok(Self { forms, tag })
    }

    /// Names of all parameters, sorted.
    pub fn names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.forms.iter().flat_map(Form::names).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// A parameter's value in the form that is hashed: numbers as the schema's type has them, so
    /// that 2, 2.0 and 2e0 are one value, and what equals the default as the default is written.
    pub fn canonical_value(&self, name: &str, value: &Value) -> Value {
        let form = self.forms.iter().find(|form| form.property(name).is_some());
        form.map_or_else(|| value.clone(), |form| form.canonical_value(name, value))
    }

    /// Parameters on one level, whichever way they are written: `field: {grid: {n_levels: 4}}` is
    /// `field: grid` and `n_levels: 4`.
    pub fn flattened(&self, given: &Map<String, Value>) -> Map<String, Value> {
        self.tag.as_ref().map_or_else(|| given.clone(), |tag| tag.flattened(given))
    }

    /// Lays later parameters over earlier ones. Where the later ones select a variant, earlier ones
    /// that it doesn't have go.
    pub fn lay_over(&self, given: &mut Map<String, Value>, later: &Map<String, Value>) {
        let later = self.flattened(later);
        if self.tag.as_ref().is_some_and(|tag| later.contains_key(tag.name())) {
            let (form, known) = (self.form(&later), self.names());
            given
                .retain(|name, _| form.property(name).is_some() || !known.contains(&name.as_str()));
        }
        given.extend(later);
    }

    /// Every parameter with its value: the given one, else the default. The result is what is
    /// hashed and passed to the stage.
    pub fn resolve(&self, given: &Map<String, Value>) -> Result<Value, Vec<ParameterProblem>> {
        let given = self.flattened(given);
        let form = self.form(&given);
        let mut resolved = form.defaults();
        let mut problems = Vec::new();
        for (name, value) in &given {
            if form.property(name).is_some() {
                resolved.insert(name.clone(), form.canonical_value(name, value));
            } else {
                let problem = self.unknown(form, name);
                problems.push(ParameterProblem { name: name.clone(), problem });
            }
        }
        let resolved = Value::Object(resolved);
        problems.extend(form.problems(&resolved));
        if problems.is_empty() { Ok(resolved) } else { Err(problems) }
    }

    /// Resolved parameters as the stage's type has them, a variant's parameters inside it.
    pub fn nested(&self, resolved: &Value) -> Value {
        self.tag.as_ref().map_or_else(|| resolved.clone(), |tag| tag.nested(resolved))
    }

    /// Names of the resolved parameters that are left to the scene.
    pub fn by_scene<'a>(&'a self, resolved: &'a Value) -> Vec<&'a str> {
        let form = self.form(resolved.as_object().unwrap_or(&Map::new()));
        let open = form.names().filter(|name| {
            let default = form.property(name).and_then(|property| property.get(DEFAULT_KEYWORD));
            resolved[*name].is_null() && default.is_some_and(|default| default == BY_SCENE)
        });
        open.collect()
    }

    /// The form that parameters select; the default's where they select none, or none that there
    /// is.
    fn form(&self, flat: &Map<String, Value>) -> &Form {
        let selected = self.tag.as_ref().and_then(|tag| tag.selected(flat));
        &self.forms[selected.unwrap_or(0)]
    }

    /// Describes the problem of a parameter that doesn't exist.
    fn unknown(&self, form: &Form, name: &str) -> String {
        let others = || self.forms.iter().position(|other| other.property(name).is_some());
        match &self.tag {
            Some(tag) if others().is_some() => tag.foreign(others().unwrap_or(0)),
            _ => format!("unknown; {}", known_names(name, form.names())),
        }
    }
}

/// Keyword of a parameter's schema: stands for the default where that is null.
pub(crate) const DEFAULT_KEYWORD: &str = "x-default";
/// Its value where the scene decides.
const BY_SCENE: &str = "by scene";

impl Form {
    fn new(schema: Value) -> Result<Self, SchemaError> {
        let mut bounded = schema.clone();
        bound_formats(&mut bounded);
        let validator = Validator::new(&bounded).map_err(SchemaError::Keyword)?;
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

    fn problems(&self, resolved: &Value) -> Vec<ParameterProblem> {
        let misfits = self.validator.misfits(resolved).into_iter();
        misfits.map(|misfit| self.problem(misfit)).collect()
    }

    fn problem(&self, misfit: Misfit) -> ParameterProblem {
        let name = misfit.path.trim_start_matches('/').to_owned();
        let problem = match self.choices(&name) {
            Some(choices) => not_one_of(&misfit.value, &choices),
            None => misfit.problem,
        };
        ParameterProblem { name: if name.is_empty() { "(all)".to_owned() } else { name }, problem }
    }

    /// The words a parameter may be, where it is a choice: the validator itself only says that no
    /// alternative fits.
    fn choices(&self, name: &str) -> Option<Vec<String>> {
        let words = Reader::new(&self.schema).choices(self.property(name)?)?;
        Some(words.into_iter().map(|(word, _)| word.to_string()).collect())
    }
}

fn not_one_of(value: &Value, choices: &[String]) -> String {
    let meant = nearest(&value.to_string(), choices.iter().map(String::as_str));
    let meant = meant.map(|choice| format!("; did you mean {choice}?")).unwrap_or_default();
    format!("{value} is not one of {}{meant}", choices.join(", "))
}

/// Gives integers of a size (`format`: `uint32`, …) the bounds of that size, where the schema
/// states none: what a stage can't hold is refused before it is started.
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
            for (name, bound) in
                bounds.into_iter().flat_map(|(least, most)| [("minimum", least), ("maximum", most)])
            {
                entries.entry(name).or_insert(bound);
            }
            let data = ["default", "const", "enum", "examples"];
            entries
                .iter_mut()
                .filter(|(name, _)| !data.contains(&name.as_str()))
                .for_each(|(_, inside)| bound_formats(inside));
        }
        Value::Array(items) => items.iter_mut().for_each(bound_formats),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use artifact::canonical;
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
            assert_eq!(canonical(&resolve(&said).unwrap()), canonical(&unsaid), "{said}");
        }
        for (one, other) in [
            (json!({"scale": 6e4}), json!({"scale": 60000})),
            (json!({"rate": 3}), json!({"rate": 3e0})),
            (json!({"width": 7.0}), json!({"width": 7})),
            (json!({"place": [2, 3.0]}), json!({"place": [2.0, 3]})),
        ] {
            let [one, other] = [one, other].map(|given| canonical(&resolve(&given).unwrap()));
            assert_eq!(one, other);
            assert_ne!(one, canonical(&unsaid));
        }
        let problems = resolve(&json!({"rate": null})).unwrap_err();
        assert!(
            problems[0].to_string().contains("parameter rate: null is not of type"),
            "{}",
            problems[0]
        );
    }

    #[test]
    fn unknown_names_types_and_ranges_are_refused() {
        for (given, name, word) in [
            (
                json!({"kernal": "box"}),
                "kernal",
                "did you mean kernel? known: assumed, kernel, peak, place, rate, scale, width",
            ),
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
