//! Parameters that select a variant with parameters of its own: externally tagged `enum`s of
//! structs.

use serde_json::{Map, Value, json};

use crate::contract::error::ContractError;
use crate::contract::values::Reader;

/// Parameter that selects a variant, with its variants, the default one first.
#[derive(Debug)]
pub(crate) struct Tag {
    name: String,
    variants: Vec<Variant>,
}

#[derive(Debug)]
struct Variant {
    name: String,
    /// Schemas of the variant's parameters by name.
    properties: Map<String, Value>,
}

impl Tag {
    /// Finds the tag of a schema. Fails if there are two, or if a variant has a parameter of the
    /// same name as a common one.
    pub(crate) fn find(schema: &Value) -> Result<Option<Self>, ContractError> {
        let Some(properties) = schema.get("properties").and_then(Value::as_object) else {
            return Ok(None);
        };
        let mut tags: Vec<Self> = properties
            .iter()
            .filter_map(|(name, property)| Self::read(schema, name, property))
            .collect();
        if let [first, second, ..] = &tags[..] {
            return Err(ContractError(format!(
                "{} and {} both select a variant; at most one parameter may",
                first.name, second.name
            )));
        }
        let Some(tag) = tags.pop() else { return Ok(None) };
        for variant in &tag.variants {
            if let Some(name) =
                variant.properties.keys().find(|name| properties.contains_key(*name))
            {
                return Err(ContractError(format!(
                    "variant {} of {} has a parameter {name}, like the stage itself",
                    variant.name, tag.name
                )));
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
        let default =
            property.get("default").and_then(|default| default.as_object()?.keys().next());
        if let Some(index) = variants.iter().position(|variant| Some(&variant.name) == default) {
            variants[..=index].rotate_right(1);
        }
        (!variants.is_empty()).then(|| Self { name: name.to_owned(), variants })
    }

    /// Returns the name of the parameter.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Returns the names of the variants, the default one first.
    pub(crate) fn variants(&self) -> impl Iterator<Item = &str> {
        self.variants.iter().map(|variant| variant.name.as_str())
    }

    /// Returns one schema per variant, in which the variant's parameters are not nested.
    pub(crate) fn variant_schemas(&self, schema: &Value) -> Vec<Value> {
        self.variants.iter().map(|variant| self.variant_schema(schema, variant)).collect()
    }

    fn variant_schema(&self, schema: &Value, variant: &Variant) -> Value {
        let mut unnested = schema.clone();
        if let Some(tag) = unnested["properties"][&self.name].as_object_mut() {
            tag.retain(|keyword, _| !["$ref", "oneOf"].contains(&keyword.as_str()));
            tag.insert("enum".to_owned(), self.variants().collect());
            tag.insert("default".to_owned(), json!(self.variants[0].name));
        }
        if let Some(properties) = unnested["properties"].as_object_mut() {
            properties.extend(variant.properties.clone());
        }
        unnested
    }

    /// Returns the index of the selected variant; `None` if none or an unknown one is selected.
    pub(crate) fn selected(&self, flat: &Map<String, Value>) -> Option<usize> {
        let name = flat.get(&self.name)?.as_str()?;
        self.variants().position(|variant| variant == name)
    }

    /// Moves a variant's nested parameters to the level of the tag. Anything but a known variant
    /// stays unchanged; the validator reports it.
    pub(crate) fn flattened(&self, given: &Map<String, Value>) -> Map<String, Value> {
        let nested = given.get(&self.name).and_then(Value::as_object).filter(|n| n.len() == 1);
        let Some((variant, Value::Object(inner))) = nested.and_then(|nested| nested.iter().next())
        else {
            return given.clone();
        };
        if !self.variants().any(|name| name == variant) {
            return given.clone();
        }
        // An unnested parameter overrides a nested one of the same name.
        let mut flat = inner.clone();
        flat.extend(given.clone());
        flat.insert(self.name.clone(), json!(variant));
        flat
    }

    /// Moves the selected variant's parameters into the tag, as the stage's type nests them.
    pub(crate) fn nested(&self, resolved: &Value) -> Value {
        let Some(flat) = resolved.as_object() else { return resolved.clone() };
        let Some(index) = self.selected(flat) else { return resolved.clone() };
        let variant = &self.variants[index];
        let (own, mut nested): (Map<_, _>, Map<_, _>) =
            flat.clone().into_iter().partition(|(name, _)| variant.properties.contains_key(name));
        nested.insert(self.name.clone(), json!({ &variant.name: own }));
        Value::Object(nested)
    }

    /// Returns the message for a parameter of `variant`, which isn't selected.
    pub(crate) fn other_variant_message(&self, variant: usize) -> String {
        format!(
            "belongs to {0}: {1}; leave it out, or choose {0}: {1}",
            self.name, self.variants[variant].name
        )
    }
}

impl Variant {
    /// Reads a variant from an alternative of a tagged `enum`: an object whose only property is
    /// itself an object.
    fn read(reader: Reader<'_>, alternative: &Value) -> Option<Self> {
        let outer = alternative.get("properties")?.as_object()?;
        let (name, inner) = outer.iter().next().filter(|_| outer.len() == 1)?;
        let properties = reader.referred(inner).unwrap_or(inner).get("properties")?.as_object()?;
        Some(Self { name: name.clone(), properties: properties.clone() })
    }
}
