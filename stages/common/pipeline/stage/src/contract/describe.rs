use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use artifact::relative_path;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::contract::error::ContractError;
use crate::contract::parameters::Schema;
use crate::contract::rules::{GivenInputs, Rule};

/// Output of `STAGE describe`: all that the runner knows about a stage.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Name of the stage and of its binary.
    pub name: String,
    /// Human-readable version; not part of a key.
    pub version: String,
    /// Fingerprint of the code; part of every key.
    pub code: String,
    /// Purpose of the stage, in one sentence.
    pub summary: String,
    /// JSON Schema of the parameters: an object, every property with its default. `x-group` is a
    /// parameter's group. `x-default` describes a default that is null; `by scene` means that the
    /// inputs determine the value.
    pub parameters: Value,
    /// Inputs by name.
    pub inputs: BTreeMap<String, Input>,
    /// Artifact that the stage creates.
    pub output: Output,
    /// Names of environment variables that change the result; their values are part of the key.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub environment: Vec<String>,
    /// True for a sink: it presents a run and is never cached. Its input `run` is the run's record.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sink: bool,
    /// True for a sink that accepts a run with failed nodes and presents the finished ones.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub partial: bool,
    /// True if the stage accepts `--from-checkpoint`, which writes the output from the latest
    /// checkpoint.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub from_checkpoint: bool,
    /// True if the program contains libtorch, which takes memory of its own.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub libtorch: bool,
    /// Constraints between parameters and inputs.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rules: Vec<Rule>,
}

/// Input of a stage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Accepted kinds of artifact.
    pub kinds: Vec<String>,
    /// True if the stage runs without this input.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub optional: bool,
    /// Description of the input, in one sentence.
    pub summary: String,
}

impl Input {
    /// Creates a required input.
    pub fn required(kinds: &[&str], summary: &str) -> Self {
        Self {
            kinds: kinds.iter().map(ToString::to_string).collect(),
            optional: false,
            summary: summary.to_owned(),
        }
    }

    /// Creates an optional input.
    pub fn optional(kinds: &[&str], summary: &str) -> Self {
        Self { optional: true, ..Self::required(kinds, summary) }
    }

    /// Returns the inputs of a sink: the record of a run, `run`.
    pub fn of_sink(summary: &str) -> Vec<(&'static str, Self)> {
        vec![("run", Self::required(&["run"], summary))]
    }
}

/// Artifact that a stage creates.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Kind of the artifact.
    pub kind: String,
    /// Folders of the artifact that an input may refer to (`prep/train`), with their kinds.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub subtrees: BTreeMap<String, String>,
    /// JSON file in the artifact whose entry `resolved` has, by name, the final values of the
    /// parameters whose default depends on the inputs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resolved: Option<String>,
}

impl Output {
    /// Creates an output without subtrees.
    pub fn kind(kind: &str) -> Self {
        Self { kind: kind.to_owned(), subtrees: BTreeMap::new(), resolved: None }
    }

    /// Adds a folder that an input may refer to.
    #[must_use]
    pub fn with_subtree(mut self, folder: &str, kind: &str) -> Self {
        self.subtrees.insert(folder.to_owned(), kind.to_owned());
        self
    }

    /// Sets the file with the final values of the parameters whose default depends on the inputs.
    #[must_use]
    pub fn with_resolved(mut self, file: &str) -> Self {
        self.resolved = Some(file.to_owned());
        self
    }

    /// Reads the final parameter values that a finished artifact records, by parameter name.
    pub fn resolved(&self, artifact: &Path) -> Map<String, Value> {
        let bytes = self.resolved.as_ref().and_then(|file| std::fs::read(artifact.join(file)).ok());
        // Artifacts of older builds have no such file.
        let file: Option<Value> = bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        file.and_then(|file| file.get("resolved")?.as_object().cloned()).unwrap_or_default()
    }
}

impl Description {
    /// Checks that the schema is valid, the stage has a name, folders are inside the output, and
    /// rules refer to existing names.
    pub fn check(&self) -> Result<(), ContractError> {
        let schema = Schema::new(&self.parameters)
            .map_err(|e| ContractError(format!("parameter schema: {e}")))?;
        if self.name.is_empty() {
            return Err(ContractError("the description has no name".to_owned()));
        }
        for folder in self.output.subtrees.keys().chain(&self.output.resolved) {
            relative_path(folder).map_err(|e| ContractError(format!("output: {e}")))?;
        }
        for (index, rule) in self.rules.iter().enumerate() {
            rule.check(&schema.names(), &self.inputs)
                .map_err(|problem| ContractError(format!("rule {}: {problem}", index + 1)))?;
        }
        Ok(())
    }

    /// Returns the message of the first rule that is violated.
    pub fn broken_rule(&self, parameters: &Value, inputs: &GivenInputs) -> Option<String> {
        self.rules
            .iter()
            .find(|rule| !rule.is_satisfied(parameters, inputs))
            .map(|rule| rule.message.clone())
    }

    /// Returns the first input whose folder lacks files that a rule requires, with the rule's
    /// message. `folders` are the inputs' folders outside the store.
    pub fn missing_files(
        &self,
        parameters: &Value,
        inputs: &GivenInputs,
        folders: &BTreeMap<String, PathBuf>,
    ) -> Option<(&str, String)> {
        self.rules.iter().find_map(|rule| rule.missing_files(parameters, inputs, folders))
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
            libtorch: false,
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
    fn rules_apply_under_their_conditions() {
        let alpha_scene = || Some(json!({"background": "alpha"}));
        for (parameters, inputs, expected) in [
            (json!({"method": "imdn"}), vec![], Some("weights are needed")),
            (json!({"method": "imdn"}), vec![("weights", None)], None),
            (json!({"method": "bicubic"}), vec![], None),
            (json!({"kernel": "average", "scale": 2.7}), vec![], Some("the scale must be whole")),
            (json!({"kernel": "average", "scale": 2.0}), vec![], None),
            (json!({"kernel": "average", "scale": null}), vec![], None),
            (json!({"kernel": "average"}), vec![], None),
            (json!({"kernel": "box", "scale": 2.7}), vec![], None),
            (json!({"method": "b"}), vec![("scene", alpha_scene())], Some("it must be closed")),
            (json!({"method": "a"}), vec![("scene", alpha_scene())], None),
            (json!({"method": "b"}), vec![("scene", Some(json!({"background": "white"})))], None),
            (json!({"method": "b"}), vec![("scene", Some(json!({})))], None),
            (json!({"method": "b"}), vec![("scene", None)], None),
        ] {
            let given = inputs
                .iter()
                .map(|(name, made_with)| ((*name).to_owned(), made_with.clone()))
                .collect();
            assert_eq!(
                description().broken_rule(&parameters, &given).as_deref(),
                expected,
                "{parameters} {inputs:?}"
            );
        }
    }

    #[test]
    fn folders_must_contain_the_files_of_a_rule() {
        let folder = tempfile::tempdir().unwrap();
        for file in ["a_x2", "b", "b.heads"] {
            std::fs::write(folder.path().join(file), "").unwrap();
        }
        let folders = BTreeMap::from([("weights".to_owned(), folder.path().to_path_buf())]);
        let missing = |rule: Rule, parameters: Value| {
            let rule = rule.when("method", json!({"const": "imdn"}));
            let description = Description { rules: vec![rule], ..description() };
            description.check().unwrap();
            assert_eq!(
                description.missing_files(&parameters, &GivenInputs::new(), &BTreeMap::new()),
                None
            );
            let found = description.missing_files(&parameters, &GivenInputs::new(), &folders);
            found.map(|(input, message)| format!("{input}: {message}"))
        };
        let one_file = || Rule::new("no a_x{scale}").or_files("weights", &["a_x{scale}"]);
        let imdn = |scale: u32| json!({"method": "imdn", "scale": scale});
        assert_eq!(missing(one_file(), imdn(2)), None);
        assert_eq!(missing(one_file(), imdn(3)).unwrap(), "weights: no a_x3");
        assert_eq!(missing(one_file(), json!({"method": "liif", "scale": 3})), None);
        let two_files = Rule::new("no b").or_files("weights", &["c", "c.heads"]);
        assert!(missing(two_files.clone(), imdn(2)).is_some());
        assert_eq!(missing(two_files.or_files("weights", &["b", "b.heads"]), imdn(2)), None);
    }

    #[test]
    fn invalid_descriptions_are_refused() {
        description().check().unwrap();
        let invalid_schema = json!({"type": "nonsense"});
        let with = |rule: Rule| Description { rules: vec![rule], ..description() };
        for (broken, expected) in [
            (with(Rule::new("").needs("nothing")), "rule 1: no input \"nothing\""),
            (with(Rule::new("").when("nothing", json!({}))), "no parameter \"nothing\""),
            (with(Rule::new("").must("nothing.x", json!({}))), "no parameter \"nothing.x\""),
            (
                with(Rule::new("").must("scale", invalid_schema.clone())),
                "scale: invalid or unsupported JSON Schema",
            ),
            (Description { parameters: invalid_schema, ..description() }, "parameter schema"),
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
            assert!(problem.contains(expected), "{problem}");
        }
    }
}
