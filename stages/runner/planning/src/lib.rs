//! Plans from pipeline files, command lines and descriptions of stages. No stage runs, except to
//! print its description.
//!
//! * [`PipelineFile`]: content of one file. [`Pipeline`]: blocks of a file and of the files that it
//!   extends. [`find_targets`] also searches the files in `pipelines/` and `experiments/`.
//! * [`Experiment`]: scenes, protocols and variants of a file, each of which sets several
//!   parameters and inputs.
//! * [`Quality`]: trade of speed for accuracy, as one word that sets several parameters.
//! * [`Programs`]: description of each stage's program, cached in the store.
//! * [`Plan`]: nodes (stages × swept values) in topological order, and their states: cached, to run
//!   or waiting. `check` checks the whole pipeline, `arguments` and `axes` parse the command line,
//!   `expand` creates the nodes.
//! * [`Source`]: content hash of a folder outside the store, and detection of later changes.
//!   [`StageProgram::confirm`] checks that a program is still the planned one.
//! * [`stage_call`]: the caller's half of the stage contract, for descriptions and for runs.
//! * [`key_parts`]: parts of an action's key. The key is their hash, and [`changes`] explains
//!   differences.
//!
//! ```no_run
//! use planning::{Describing, Pipeline, Plan, Request};
//! let pipeline = Pipeline::read("pipeline.yaml".as_ref())?;
//! let store = store::Store::open(".nerf-sr".as_ref())?;
//! let plan = Plan::new(&pipeline, &store, &Request::default(), Describing::OwnOnly)?;
//! println!("{} nodes", plan.nodes.len());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod arguments;
mod axes;
mod check;
mod expand;
mod experiment;
mod experiment_axes;
mod file;
mod frozen;
mod key;
mod left_out;
mod node;
mod pipeline;
mod plan;
mod quality;
mod request;
mod sources;
pub mod stage_call;
mod stages;
mod targets;
mod yaml_lines;

pub use experiment::{Experiment, Selection, Variant};
pub use file::{Part, PipelineError, PipelineFile, StageBlock};
pub use frozen::FrozenPlan;
pub use key::{
    Change, changes, environment_parts, explain, key_parts, nearest_changes, nearest_record,
    short_hash,
};
pub use node::{Devices, Node, NodeInput, Origin, Plan, ShownPoint, Sink, State};
pub use pipeline::Pipeline;
pub use plan::{HashedInputs, hash_inputs, read_source, stored_inputs};
pub use quality::Quality;
pub use request::{PlanError, Request};
pub use sources::{Source, SourceError, Stamp};
pub use stages::{Describing, Programs, StageProgram, executable, is_own, own_program};
pub use targets::find_targets;
