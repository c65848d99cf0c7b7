use std::collections::BTreeMap;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::contract::describe::Input;
use crate::contract::documented::plain;
use crate::contract::error::ContractError;
use crate::contract::validator::Validator;

/// Constraint between parameters and inputs, in addition to the checks of each alone. The runner
/// checks rules when it plans, a stage when it starts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Rule {
    /// Conditions: parameters with JSON Schemas. The rule applies if all values match.
    /// `INPUT.PARAMETER` is a parameter of the stage that created the input; if that value is
    /// unknown, the rule doesn't apply.
    pub when: BTreeMap<String, Value>,
    /// Inputs that are required if the rule applies.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<String>,
    /// Parameters, named as in `when`, with JSON Schemas that their values must match if the rule
    /// applies. An unknown value satisfies the rule.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub must: BTreeMap<String, Value>,
    /// Alternative lists of files by input: if the rule applies, the input's folder must contain
    /// all files of at least one list. A parameter's name in braces stands for its value. The
    /// runner checks the folders that the pipeline file or the command line names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub files: BTreeMap<String, Vec<Vec<String>>>,
    /// Message if the rule is violated: the problem and the remedy. With `files`, a parameter's
    /// name in braces stands for its value.
    pub message: String,
}

/// Given inputs by name, with the parameters of the stage that created each, if known.
pub type GivenInputs = BTreeMap<String, Option<Value>>;

impl Rule {
    /// Creates a rule that always applies and has no requirement yet.
    pub fn new(message: &str) -> Self {
        Self { message: message.to_owned(), ..Self::default() }
    }

    /// Adds a condition: the rule applies only if a parameter matches a JSON Schema.
    #[must_use]
    pub fn when(mut self, parameter: &str, schema: Value) -> Self {
        self.when.insert(parameter.to_owned(), schema);
        self
    }

    /// Requires an input.
    #[must_use]
    pub fn needs(mut self, input: &str) -> Self {
        self.needs.push(input.to_owned());
        self
    }

    /// Requires that a parameter matches a JSON Schema.
    #[must_use]
    pub fn must(mut self, parameter: &str, schema: Value) -> Self {
        self.must.insert(parameter.to_owned(), schema);
        self
    }

    /// Adds an alternative: the folder of an input, if given, must contain all files of at least
    /// one of the input's alternatives.
    #[must_use]
    pub fn or_files(mut self, input: &str, files: &[&str]) -> Self {
        let files = files.iter().map(ToString::to_string).collect();
        self.files.entry(input.to_owned()).or_default().push(files);
        self
    }

    /// Checks that the rule refers to existing names and that its schemas can be used.
    pub(crate) fn check(
        &self,
        parameters: &[&str],
        inputs: &BTreeMap<String, Input>,
    ) -> Result<(), ContractError> {
        let mut named = self.needs.iter().chain(self.files.keys());
        if let Some(input) = named.find(|input| !inputs.contains_key(*input)) {
            return Err(ContractError(format!("no input {input:?}")));
        }
        for (name, schema) in self.when.iter().chain(&self.must) {
            let is_known = match name.split_once('.') {
                Some((input, _)) => inputs.contains_key(input),
                None => parameters.contains(&name.as_str()),
            };
            if !is_known {
                return Err(ContractError(format!("no parameter {name:?}")));
            }
            Validator::new(schema).map_err(|reason| {
                ContractError(format!("{name}: invalid or unsupported JSON Schema: {reason}"))
            })?;
        }
        Ok(())
    }

    fn applies(&self, parameters: &Value, inputs: &GivenInputs) -> bool {
        self.when.iter().all(|entry| value_matches(entry, parameters, inputs) == Some(true))
    }

    /// Returns the first input whose folder lacks files, with the rule's message.
    pub(crate) fn missing_files(
        &self,
        parameters: &Value,
        inputs: &GivenInputs,
        folders: &BTreeMap<String, PathBuf>,
    ) -> Option<(&str, String)> {
        if !self.applies(parameters, inputs) {
            return None;
        }
        let (input, _) = self.files.iter().find(|(input, alternatives)| {
            folders.get(*input).is_some_and(|folder| {
                let exists = |file: &String| folder.join(filled(file, parameters)).is_file();
                !alternatives.iter().any(|files| files.iter().all(exists))
            })
        })?;
        Some((input, filled(&self.message, parameters)))
    }

    /// Returns whether the rule doesn't apply, or its `needs` and `must` are satisfied.
    /// [`Rule::missing_files`] checks `files`.
    pub(crate) fn is_satisfied(&self, parameters: &Value, inputs: &GivenInputs) -> bool {
        !self.applies(parameters, inputs)
            || (self.needs.iter().all(|input| inputs.contains_key(input))
                && self
                    .must
                    .iter()
                    .all(|entry| value_matches(entry, parameters, inputs) != Some(false)))
    }
}

/// Returns whether a parameter's value matches a schema; `None` if the value is unknown or the
/// schema invalid. [`Rule::check`] refuses invalid schemas.
fn value_matches(
    (name, schema): (&String, &Value),
    parameters: &Value,
    inputs: &GivenInputs,
) -> Option<bool> {
    let value = match name.split_once('.') {
        Some((input, inner)) => inputs.get(input).and_then(|made_by| made_by.as_ref()?.get(inner)),
        None => parameters.get(name.as_str()),
    };
    Some(Validator::new(schema).ok()?.is_valid(value?))
}

/// Replaces names of parameters in braces by their values.
fn filled(text: &str, parameters: &Value) -> String {
    let mut filled = text.to_owned();
    for (name, value) in parameters.as_object().into_iter().flatten() {
        filled = filled.replace(&format!("{{{name}}}"), &plain(value));
    }
    filled
}
