use crate::contract::{Description, Input, Output, Rule};
use schemars::JsonSchema;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::context::Context;

/// Stage of the pipeline: creates one artifact from inputs and parameters.
pub trait Stage {
    /// Parameters. Defaults, ranges and documentation come from the type; `#[serde(default,
    /// deny_unknown_fields)]` is expected. One field may be an externally tagged `enum` of structs:
    /// it selects a variant, whose parameters are given on the same level.
    type Params: Serialize + DeserializeOwned + JsonSchema + Default + 'static;
    /// Name of the stage and of its binary.
    const NAME: &'static str;
    /// Purpose of the stage, in one sentence.
    const SUMMARY: &'static str;
    /// True if the stage is a sink, which presents a run and is never cached.
    const SINK: bool = false;
    /// True if the sink accepts a run with failed nodes.
    const ACCEPTS_FAILURES: bool = false;
    /// True if the stage accepts `--from-checkpoint` ([`Context::from_checkpoint`]).
    const FROM_CHECKPOINT: bool = false;
    /// True if this build of the program contains libtorch.
    const LIBTORCH: bool = false;
    /// Environment variables that change the result.
    const ENVIRONMENT: &'static [&'static str] = &[];

    /// Returns the inputs by name.
    fn inputs() -> Vec<(&'static str, Input)> {
        Vec::new()
    }

    /// Returns the kind of the output and its subtrees.
    fn output() -> Output;

    /// Returns the constraints between parameters and inputs.
    fn rules() -> Vec<Rule> {
        Vec::new()
    }

    /// Runs the stage: reads inputs and writes the output through `context`.
    ///
    /// After a signal the stage has a second to write a checkpoint and to return, then its process
    /// ends. A file outside the output must therefore be complete before it gets its final name.
    fn run(context: &Context, params: &Self::Params) -> anyhow::Result<()>;

    /// Describes the stage, as `describe` prints it; `code` is the build's fingerprint.
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
            partial: Self::ACCEPTS_FAILURES,
            from_checkpoint: Self::FROM_CHECKPOINT,
            libtorch: Self::LIBTORCH,
            rules: Self::rules(),
        }
    }
}
