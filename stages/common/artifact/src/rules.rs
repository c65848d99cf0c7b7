use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::describe::{Description, Input};
use crate::validator::Validator;

/// What parameters and inputs must be together, beyond what each may be alone. The runner checks it
/// in the plan, the stage when it starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// When it applies: parameters, each with a JSON Schema that its value fits then.
    /// `INPUT.PARAMETER` is a parameter of the stage that the input comes from; where that isn't
    /// known, the rule doesn't apply.
    pub when: BTreeMap<String, Value>,
    /// Inputs that must be given then.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<String>,
    /// What parameters must fit then, likewise.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub must: BTreeMap<String, Value>,
    /// What to say where it isn't kept: what is wrong, and what to do.
    pub message: String,
}

/// The inputs that are given, each with the parameters of the stage that it comes from, where those
/// are known.
pub type GivenInputs = BTreeMap<String, Option<Value>>;

/// What is wrong with a rule.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RuleError {
    /// It names an input that the stage doesn't have.
    #[error("there is no input {0:?}")]
    Input(String),
    /// It names a parameter that the stage doesn't have.
    #[error("there is no parameter {0:?}")]
    Parameter(String),
    /// What a value must fit.
    #[error("{name}: not a JSON Schema: {reason}")]
    Schema {
        /// The value's name.
        name: String,
        /// What is wrong.
        reason: String,
    },
}

impl Rule {
    /// A rule that always applies and asks for nothing yet.
    pub fn new(message: &str) -> Self {
        Self {
            when: BTreeMap::new(),
            needs: Vec::new(),
            must: BTreeMap::new(),
            message: message.to_owned(),
        }
    }

    /// Applies it only where a parameter fits a JSON Schema.
    #[must_use]
    pub fn when(mut self, parameter: &str, fits: Value) -> Self {
        self.when.insert(parameter.to_owned(), fits);
        self
    }

    /// Asks for an input.
    #[must_use]
    pub fn needs(mut self, input: &str) -> Self {
        self.needs.push(input.to_owned());
        self
    }

    /// Asks that a parameter fits a JSON Schema.
    #[must_use]
    pub fn must(mut self, parameter: &str, fit: Value) -> Self {
        self.must.insert(parameter.to_owned(), fit);
        self
    }

    /// Says what is wrong with the rule itself.
    pub(crate) fn check(
        &self,
        parameters: &[&str],
        inputs: &BTreeMap<String, Input>,
    ) -> Result<(), RuleError> {
        if let Some(input) = self.needs.iter().find(|input| !inputs.contains_key(*input)) {
            return Err(RuleError::Input(input.clone()));
        }
        for (name, schema) in self.when.iter().chain(&self.must) {
            let is_known = match name.split_once('.') {
                Some((input, _)) => inputs.contains_key(input),
                None => parameters.contains(&name.as_str()),
            };
            if !is_known {
                return Err(RuleError::Parameter(name.clone()));
            }
            Validator::new(schema)
                .map_err(|reason| RuleError::Schema { name: name.clone(), reason })?;
        }
        Ok(())
    }

    fn is_kept(&self, parameters: &Value, inputs: &GivenInputs) -> bool {
        let applies = self
            .when
            .iter()
            .all(|(name, schema)| fits(name, schema, parameters, inputs) == Some(true));
        if !applies {
            return true;
        }
        let is_given = self.needs.iter().all(|input| inputs.contains_key(input));
        is_given
            && self
                .must
                .iter()
                .all(|(name, schema)| fits(name, schema, parameters, inputs) != Some(false))
    }
}

/// Whether the value of a name fits a schema; nothing where the value isn't known.
fn fits(name: &str, schema: &Value, parameters: &Value, inputs: &GivenInputs) -> Option<bool> {
    let value = match name.split_once('.') {
        Some((input, inner)) => inputs.get(input).and_then(|made_by| made_by.as_ref()?.get(inner)),
        None => parameters.get(name),
    };
    Some(Validator::new(schema).ok()?.is_valid(value?))
}

impl Description {
    /// What the first rule that isn't kept says.
    pub fn broken_rule(&self, parameters: &Value, inputs: &GivenInputs) -> Option<String> {
        self.rules
            .iter()
            .find(|rule| !rule.is_kept(parameters, inputs))
            .map(|rule| rule.message.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::describe::Output;
    use serde_json::json;

    fn description() -> Description {
        let methods = json!({"enum": ["imdn", "liif"]});
        Description {
            name: "x".to_owned(),
            version: String::new(),
            code: String::new(),
            summary: String::new(),
            parameters: json!({"properties": {"method": {}, "scale": {}, "kernel": {}}}),
            inputs: ["scene", "weights"]
                .map(|name| (name.to_owned(), Input::optional(&["any"], "")))
                .into(),
            output: Output::kind("x"),
            environment: Vec::new(),
            sink: false,
            partial: false,
            from_checkpoint: false,
            rules: vec![
                Rule::new("weights are needed").when("method", methods).needs("weights"),
                Rule::new("the scale must be whole")
                    .when("kernel", json!({"const": "average"}))
                    .must("scale", json!({"multipleOf": 1})),
                Rule::new("it must be closed")
                    .when("scene.background", json!({"const": "alpha"}))
                    .must("method", json!({"const": "a"})),
            ],
        }
    }

    #[test]
    fn rules_hold_where_they_apply() {
        let open = || Some(json!({"background": "alpha"}));
        for (parameters, inputs, expected) in [
            (json!({"method": "imdn"}), vec![], Some("weights are needed")),
            (json!({"method": "imdn"}), vec![("weights", None)], None),
            (json!({"method": "bicubic"}), vec![], None),
            (json!({"kernel": "average", "scale": 2.7}), vec![], Some("the scale must be whole")),
            (json!({"kernel": "average", "scale": 2.0}), vec![], None),
            (json!({"kernel": "average", "scale": null}), vec![], None),
            (json!({"kernel": "average"}), vec![], None),
            (json!({"kernel": "box", "scale": 2.7}), vec![], None),
            (json!({"method": "b"}), vec![("scene", open())], Some("it must be closed")),
            (json!({"method": "a"}), vec![("scene", open())], None),
            (json!({"method": "b"}), vec![("scene", Some(json!({"background": "white"})))], None),
            (json!({"method": "b"}), vec![("scene", Some(json!({})))], None),
            (json!({"method": "b"}), vec![("scene", None)], None),
        ] {
            let given = inputs
                .iter()
                .map(|(name, made_by)| ((*name).to_owned(), made_by.clone()))
                .collect();
            assert_eq!(
                description().broken_rule(&parameters, &given).as_deref(),
                expected,
                "{parameters} {inputs:?}"
            );
        }
    }

    #[test]
    fn a_description_that_cannot_be_meant_is_refused() {
        description().check().unwrap();
        let no_schema = json!({"type": "nonsense"});
        let with = |rule: Rule| Description { rules: vec![rule], ..description() };
        for (broken, words) in [
            (with(Rule::new("").needs("nothing")), "rule 1: there is no input \"nothing\""),
            (with(Rule::new("").when("nothing", json!({}))), "there is no parameter \"nothing\""),
            (
                with(Rule::new("").must("nothing.x", json!({}))),
                "there is no parameter \"nothing.x\"",
            ),
            (with(Rule::new("").must("scale", no_schema.clone())), "scale: not a JSON Schema"),
            (Description { parameters: no_schema, ..description() }, "parameter schema"),
            (Description { name: String::new(), ..description() }, "no name"),
            (
                Description {
                    output: Output::kind("x").with_subtree("../x", "x"),
                    ..description()
                },
                "not a path inside the folder",
            ),
        ] {
            let problem = broken.check().unwrap_err().to_string();
            assert!(problem.contains(words), "{problem}");
        }
    }
}
