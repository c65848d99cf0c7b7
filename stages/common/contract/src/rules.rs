use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::KeywordError;
use crate::input::Input;
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
        reason: KeywordError,
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

    /// Whether parameters and inputs are as it says.
    pub(crate) fn is_kept(&self, parameters: &Value, inputs: &GivenInputs) -> bool {
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
