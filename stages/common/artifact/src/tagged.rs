//! A parameter that selects a variant with parameters of its own, as an externally tagged `enum` of
//! structs has them.

use serde_json::{Map, Value, json};

use crate::values::Reader;

/// Such a parameter of a type, with its variants, the default's first.
#[derive(Debug)]
pub(crate) struct Tag {
    name: String,
    variants: Vec<Variant>,
}

#[derive(Debug)]
struct Variant {
    name: String,
    /// Schemas of its parameters by name.
    properties: Map<String, Value>,
}

impl Tag {
    /// The one that a schema has, if any. Fails where there are two, or where a name would mean two
    /// parameters of one variant.
    pub(crate) fn find(schema: &Value) -> Result<Option<Self>, String> {
        let Some(properties) = schema.get("properties").and_then(Value::as_object) else {
            return Ok(None);
        };
        let mut tags: Vec<Self> = properties
            .iter()
            .filter_map(|(name, property)| Self::read(schema, name, property))
            .collect();
        if tags.len() > 1 {
            return Err(format!(
                "one where {} and {} both select a variant",
                tags[0].name, tags[1].name
            ));
        }
        let Some(tag) = tags.pop() else { return Ok(None) };
        for variant in &tag.variants {
            if let Some(name) =
                variant.properties.keys().find(|name| properties.contains_key(*name))
            {
                return Err(format!(
                    "one where {name} is a parameter beside {} and inside its {}",
                    tag.name, variant.name
                ));
            }
        }
        Ok(Some(tag))
    }

    fn read(schema: &Value, name: &str, property: &Value) -> Option<Self> {
        let reader = Reader::new(schema);
        let alternatives =
            reader.referred(property).unwrap_or(property).get("oneOf")?.as_array()?;
        let mut variants: Vec<Variant> = alternatives
            .iter()
            .map(|alternative| Variant::read(reader, alternative))
            .collect::<Option<_>>()?;
        let default = property
            .get("default")
            .and_then(Value::as_object)
            .and_then(|default| default.keys().next());
        if let Some(at) = variants.iter().position(|variant| Some(&variant.name) == default) {
            variants[..=at].rotate_right(1);
        }
        (!variants.is_empty()).then(|| Self { name: name.to_owned(), variants })
    }

    /// Its name.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// The variants' names, the default's first.
    pub(crate) fn variants(&self) -> impl Iterator<Item = &str> {
        self.variants.iter().map(|variant| variant.name.as_str())
    }

    /// A schema for each variant, with its parameters on the level of all others.
    pub(crate) fn forms(&self, schema: &Value) -> Vec<Value> {
        let choices: Vec<&str> = self.variants().collect();
        self.variants.iter().map(|variant| self.form(schema, &choices, variant)).collect()
    }

    fn form(&self, schema: &Value, choices: &[&str], variant: &Variant) -> Value {
        let mut form = schema.clone();
        let tag = &mut form["properties"][&self.name];
        let mut own = json!({"enum": choices, "default": choices[0]});
        for (keyword, value) in tag
            .as_object()
            .into_iter()
            .flatten()
            .filter(|(k, _)| !["$ref", "oneOf", "default"].contains(&k.as_str()))
        {
            own[keyword] = value.clone();
        }
        *tag = own;
        if let Some(properties) = form["properties"].as_object_mut() {
            properties.extend(variant.properties.clone());
        }
        form
    }

    /// The number of the variant that parameters select; none where they leave it out or name none.
    pub(crate) fn selected(&self, flat: &Map<String, Value>) -> Option<usize> {
        let name = flat.get(&self.name)?.as_str()?;
        self.variants().position(|variant| variant == name)
    }

    /// Parameters with those of a variant beside its name. What isn't a variant stays, for the
    /// validator to name.
    pub(crate) fn flattened(&self, given: &Map<String, Value>) -> Map<String, Value> {
        let nested =
            given.get(&self.name).and_then(Value::as_object).filter(|nested| nested.len() == 1);
        let inside = nested
            .and_then(|nested| nested.iter().next())
            .and_then(|(name, inner)| Some((name, inner.as_object()?)));
        let Some((variant, inner)) =
            inside.filter(|(name, _)| self.variants().any(|variant| variant == *name))
        else {
            return given.clone();
        };
        // A name that is said outside, too, is as it is said there.
        let mut flat = inner.clone();
        flat.extend(given.clone());
        flat.insert(self.name.clone(), json!(variant));
        flat
    }

    /// Resolved parameters with those of the variant inside it, as the type has them.
    pub(crate) fn nested(&self, resolved: &Value) -> Value {
        let Some(flat) = resolved.as_object() else { return resolved.clone() };
        let Some(index) = self.selected(flat) else { return resolved.clone() };
        let variant = &self.variants[index];
        let (own, mut nested): (Map<_, _>, Map<_, _>) =
            flat.clone().into_iter().partition(|(name, _)| variant.properties.contains_key(name));
        nested.insert(self.name.clone(), json!({ &variant.name: own }));
        Value::Object(nested)
    }

    /// What to say of a parameter that only another variant has.
    pub(crate) fn foreign(&self, variant: usize) -> String {
        format!(
            "belongs to {0}: {1}; leave it out, or choose {0}: {1}",
            self.name, self.variants[variant].name
        )
    }
}

impl Variant {
    /// The variant that an alternative of a tagged `enum` is: an object with one property, itself
    /// an object.
    fn read(reader: Reader<'_>, alternative: &Value) -> Option<Self> {
        let outer = alternative.get("properties")?.as_object()?;
        let (name, inner) = outer.iter().next().filter(|_| outer.len() == 1)?;
        let properties = reader.referred(inner).unwrap_or(inner).get("properties")?.as_object()?;
        Some(Self { name: name.clone(), properties: properties.clone() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Schema;

    fn described() -> Value {
        json!({
            "type": "object",
            "additionalProperties": false,
            "properties": {
                "seed": {"type": "integer", "default": 0},
                "field": {"$ref": "#/$defs/Field", "default": {"grid": {"rays": 30, "levels": 8}},
                "description": "Which."}
            },
            "$defs": {
                "Field": {"oneOf": [
                    {"type": "object", "properties": {"mlp": {"$ref": "#/$defs/Mlp"}},
                        "required": ["mlp"]},
                    {"type": "object", "properties": {"grid": {"$ref": "#/$defs/Grid"}},
                        "required": ["grid"]}
                ]},
                "Grid": {"properties": {
                    "rays": {"type": "integer", "default": 30},
                    "levels": {"type": "integer", "maximum": 16, "default": 8},
                    "steps": {"type": ["integer", "null"], "default": null, "x-default": "by scene"}
                }},
                "Mlp": {"properties": {
                    "rays": {"type": ["integer", "null"], "default": null, "x-default": "by scene"},
                    "layers": {"type": "integer", "default": 8}
                }}
            }
        })
    }

    fn schema() -> Schema {
        Schema::new("x", &described()).unwrap()
    }

    fn map(value: &Value) -> Map<String, Value> {
        value.as_object().cloned().unwrap()
    }

    fn with(base: &Value, name: &str, value: u32) -> Value {
        let mut changed = base.clone();
        changed[name] = json!(value);
        changed
    }

    #[test]
    fn both_ways_of_writing_resolve_alike() {
        let grid = json!({"field": "grid", "rays": 30, "levels": 8, "steps": null, "seed": 0});
        let mlp = json!({"field": "mlp", "rays": null, "layers": 8, "seed": 0});
        for (given, expected) in [
            (json!({}), grid.clone()),
            (json!({"field": "grid"}), grid.clone()),
            (json!({"field": {"grid": {}}}), grid.clone()),
            (json!({"levels": 4}), with(&grid, "levels", 4)),
            (json!({"field": {"grid": {"levels": 4.0}}}), with(&grid, "levels", 4)),
            (json!({"field": {"grid": {"levels": 4}}, "levels": 5}), with(&grid, "levels", 5)),
            (json!({"field": "mlp"}), mlp.clone()),
            (json!({"field": {"mlp": {}}}), mlp.clone()),
            (json!({"field": "mlp", "layers": 2}), with(&mlp, "layers", 2)),
            (json!({"field": {"mlp": {"rays": 5}}}), with(&mlp, "rays", 5)),
        ] {
            assert_eq!(schema().resolve(&map(&given)).unwrap(), expected, "{given}");
        }
    }

    #[test]
    fn foreign_and_unknown_parameters_are_refused() {
        for (given, words) in [
            (
                json!({"layers": 2}),
                "parameter layers: belongs to field: mlp; leave it out, or choose field: mlp",
            ),
            (json!({"field": "mlp", "levels": 2}), "parameter levels: belongs to field: grid"),
            (json!({"field": {"mlp": {"levels": 2}}}), "parameter levels: belongs to field: grid"),
            (
                json!({"field": {"grid": {"levels": 17}}}),
                "parameter levels: 17 is greater than the maximum",
            ),
            (
                json!({"field": {"grid": {"levles": 2}}}),
                "parameter levles: unknown; did you mean levels?",
            ),
            (
                json!({"field": "voxels"}),
                r#"parameter field: "voxels" is not one of "grid", "mlp""#,
            ),
            (json!({"field": {"voxels": {}}}), "parameter field: {\"voxels\":{}} is not one of"),
            (json!({"field": {"grid": 3}}), "parameter field: {\"grid\":3} is not one of"),
            (json!({"field": {"grid": {}, "mlp": {}}}), "is not one of"),
            (json!({"field": null}), "null is not one of"),
        ] {
            let problems = schema().resolve(&map(&given)).unwrap_err();
            assert!(problems[0].to_string().contains(words), "{given}: {}", problems[0]);
        }
    }

    /// A variant that is selected later comes with its own defaults; what all variants have stays.
    #[test]
    fn a_later_choice_drops_what_it_does_not_have() {
        for (earlier, later, expected) in [
            (
                json!({"levels": 4, "rays": 9}),
                json!({"field": "mlp"}),
                json!({"field": "mlp", "rays": 9}),
            ),
            (
                json!({"field": {"grid": {"levels": 4}}, "seed": 1}),
                json!({"field": "mlp"}),
                json!({"field": "mlp", "seed": 1}),
            ),
            (
                json!({"field": {"grid": {"levels": 4}}}),
                json!({"levels": 5}),
                json!({"field": "grid", "levels": 5}),
            ),
            (json!({"levels": 4}), json!({"field": "grid"}), json!({"field": "grid", "levels": 4})),
            (json!({"levles": 4}), json!({"field": "mlp"}), json!({"field": "mlp", "levles": 4})),
            (json!({"levels": 4}), json!({"layers": 5}), json!({"levels": 4, "layers": 5})),
        ] {
            let mut given = Map::new();
            [&earlier, &later]
                .into_iter()
                .for_each(|layer| schema().lay_over(&mut given, &map(layer)));
            assert_eq!(Value::Object(given), expected, "{earlier}, then {later}");
        }
    }

    #[test]
    fn the_stage_gets_what_its_type_has() {
        let resolved = schema().resolve(&map(&json!({"field": "mlp"}))).unwrap();
        assert_eq!(
            schema().nested(&resolved),
            json!({"field": {"mlp": {"rays": null, "layers": 8}}, "seed": 0})
        );
        assert_eq!(schema().by_scene(&resolved), ["rays"]);
        assert_eq!(schema().names(), ["field", "layers", "levels", "rays", "seed", "steps"]);
        assert_eq!(schema().canonical_value("layers", &json!(8.0)), json!(8));
    }

    #[test]
    fn a_name_means_one_parameter() {
        let mut twice = described();
        twice["properties"]["layers"] = json!({"default": 1});
        assert!(
            Schema::new("x", &twice)
                .unwrap_err()
                .to_string()
                .contains("layers is a parameter beside field and inside its mlp")
        );
        let mut two = described();
        two["properties"]["other"] = two["properties"]["field"].clone();
        assert!(Schema::new("x", &two).unwrap_err().to_string().contains("both select a variant"));
    }
}
