use contract::{Description, Input, Output, Rule};
use schemars::JsonSchema;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::context::Context;

/// A stage of the pipeline: inputs and parameters in, one artifact out.
pub trait Stage {
    /// Parameters. Defaults, ranges and documentation come from the type; `#[serde(default,
    /// deny_unknown_fields)]` is expected. One of them may be an externally tagged `enum` of
    /// structs: it selects a variant, whose parameters are given beside it.
    type Params: Serialize + DeserializeOwned + JsonSchema + Default;
    /// Name of stage and binary.
    const NAME: &'static str;
    /// What it makes of what, in a sentence.
    const SUMMARY: &'static str;
    /// Whether it shows a run and is never cached.
    const SINK: bool = false;
    /// Whether it shows what there is of a run, some of which failed.
    const PARTIAL: bool = false;
    /// Whether the stage accepts `--from-checkpoint` ([`Context::from_checkpoint`]).
    const FROM_CHECKPOINT: bool = false;
    /// Environment variables that change the result.
    const ENVIRONMENT: &'static [&'static str] = &[];

    /// Inputs by name.
    fn inputs() -> Vec<(&'static str, Input)> {
        Vec::new()
    }

    /// What comes out.
    fn output() -> Output;

    /// What parameters and inputs must be together.
    fn rules() -> Vec<Rule> {
        Vec::new()
    }

    /// Does the work: reads inputs and writes outputs through `context`.
    ///
    /// After a signal the stage has a second to write a checkpoint and to return; then its process
    /// is ended. So every file outside the output must be complete whenever it has its final name.
    fn run(context: &Context, params: &Self::Params) -> anyhow::Result<()>;

    /// What `describe` prints; `code` is the build's fingerprint.
    fn describe(version: &str, code: &str) -> Description {
        Description {
            name: Self::NAME.to_owned(),
            version: version.to_owned(),
            code: code.to_owned(),
            summary: Self::SUMMARY.to_owned(),
            parameters: schemars::schema_for!(Self::Params).to_value(),
            inputs: Self::inputs()
                .into_iter()
                .map(|(name, input)| (name.to_owned(), input))
                .collect(),
            output: Self::output(),
            environment: Self::ENVIRONMENT.iter().map(|&name| name.to_owned()).collect(),
            sink: Self::SINK,
            partial: Self::PARTIAL,
            from_checkpoint: Self::FROM_CHECKPOINT,
            rules: Self::rules(),
        }
    }
}
