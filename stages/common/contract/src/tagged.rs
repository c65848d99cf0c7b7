//! A parameter that selects a variant with parameters of its own, as an externally tagged `enum` of
//! structs has them.

use serde_json::{Map, Value, json};

use crate::error::SchemaError;
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
    pub(crate) fn find(schema: &Value) -> Result<Option<Self>, SchemaError> {
        let Some(properties) = schema.get("properties").and_then(Value::as_object) else {
            return Ok(None);
        };
        let mut tags: Vec<Self> = properties
            .iter()
            .filter_map(|(name, property)| Self::read(schema, name, property))
            .collect();
        if let [first, second, ..] = &tags[..] {
            let (first, second) = (first.name.clone(), second.name.clone());
            return Err(SchemaError::Selectors { first, second });
        }
        let Some(tag) = tags.pop() else { return Ok(None) };
        for variant in &tag.variants {
            if let Some(name) =
                variant.properties.keys().find(|name| properties.contains_key(*name))
            {
                return Err(SchemaError::Ambiguous {
                    name: name.clone(),
                    selector: tag.name.clone(),
                    variant: variant.name.clone(),
                });
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
