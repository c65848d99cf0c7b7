use std::collections::BTreeMap;

use artifact::{PathError, relative_path};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::SchemaError;
use crate::input::Input;
use crate::output::Output;
use crate::parameters::Schema;
use crate::rules::{GivenInputs, Rule, RuleError};

/// What `STAGE describe` prints: all that the runner knows of a stage.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// The stage's name; also its binary's.
    pub name: String,
    /// Version for people; not part of a key.
    pub version: String,
    /// Fingerprint of the code: part of every key.
    pub code: String,
    /// One sentence: what the stage makes of what.
    pub summary: String,
    /// JSON Schema of the parameters: an object, every property with its default. `x-group` names a
    /// parameter's group; `x-default` stands for a default that is null, and is `by scene` where
    /// the inputs decide.
    pub parameters: Value,
    /// Inputs by name.
    pub inputs: BTreeMap<String, Input>,
    /// What comes out.
    pub output: Output,
    /// Names of environment variables that change the result; their values join the key.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub environment: Vec<String>,
    /// A sink shows a run (times, hashes) and is never cached; its input `run` is the run's record.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sink: bool,
    /// A sink that shows what there is, where some of it couldn't be made.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub partial: bool,
    /// Whether the stage accepts `--from-checkpoint`: then it writes its output from the latest
    /// checkpoint.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub from_checkpoint: bool,
    /// What parameters and inputs must be together.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rules: Vec<Rule>,
}

/// A description that contradicts itself: what is wrong with it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DescriptionError {
    /// Its parameter schema.
    #[error("its parameter schema is {0}")]
    Schema(#[from] SchemaError),
    /// It doesn't say its name.
    #[error("it has no name")]
    Unnamed,
    /// A folder of its output.
    #[error("its output: {0}")]
    Output(#[from] PathError),
    /// A rule.
    #[error("its rule {number}: {problem}")]
    Rule {
        /// Which, counted from 1.
        number: usize,
        /// What is wrong.
        problem: RuleError,
    },
}

impl Description {
    /// Says what is wrong with a description that has the right form: what it names must be there,
    /// and its folders inside the output.
    pub fn check(&self) -> Result<(), DescriptionError> {
        let schema = Schema::new(&self.parameters)?;
        if self.name.is_empty() {
            return Err(DescriptionError::Unnamed);
        }
        for folder in self.output.subtrees.keys().chain(&self.output.resolved) {
            relative_path(folder)?;
        }
        for (index, rule) in self.rules.iter().enumerate() {
            rule.check(&schema.names(), &self.inputs)
                .map_err(|problem| DescriptionError::Rule { number: index + 1, problem })?;
        }
        Ok(())
    }

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
