//! From pipeline files, command lines and what stages say of themselves to a plan; nothing is run.
//!
//! * [`PipelineFile`]: a file as written. [`Pipeline`]: its blocks with those of the files that it
//!   extends. [`find`] looks for targets in `pipelines/` and `experiments/`, too.
//! * [`Experiment`]: scenes, protocols and variants of a file, each of which sets several things.
//! * [`Programs`]: what each stage says of itself; those that aren't known are asked.
//! * [`Plan`]: stages × swept values as nodes in an order that works, and what of them is cached,
//!   will run, or waits. `check` looks at the whole file, `arguments` and `axes` at the command
//!   line, `expand` makes the nodes.
//! * [`Source`]: a folder outside the store, its content hash and what was done to it since.
//!   [`StageProgram::confirm`]: whether a program is still the planned one.
//! * [`parts`]: the parts of an action's key; one list feeds both the hash and `why` ([`changes`]).
//!
//! ```no_run
//! use planning::{Asking, Pipeline, Plan, Request};
//! let pipeline = Pipeline::read("pipeline.yaml".as_ref())?;
//! let store = store::Store::open(".nerf-sr".as_ref())?;
//! let plan = Plan::new(&pipeline, &store, &Request::default(), Asking::Look)?;
//! println!("{} nodes", plan.nodes.len());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod arguments;
mod axes;
mod changes;
mod check;
mod confirm;
mod expand;
mod experiment;
mod experiment_axes;
mod extend;
mod file;
mod frozen;
mod key;
mod left_out;
mod node;
mod part;
mod pipeline;
mod plan;
mod request;
mod sources;
mod stages;
mod stamp;
mod targets;

pub use changes::{Change, changes, short};
pub use confirm::Unconfirmed;
pub use experiment::{Experiment, Selection, Variant};
pub use extend::JoinError;
pub use file::{PipelineFile, StageBlock};
pub use frozen::{Frozen, FrozenError};
pub use key::{explain, nearest, nearest_changes, parts};
pub use node::{Devices, Node, NodeInput, Origin, Plan, Sink, State};
pub use part::{Part, PipelineError};
pub use pipeline::Pipeline;
pub use plan::{FoundInputs, find_inputs, read_source};
pub use request::{PlanError, Request};
pub use sources::{Source, SourceError};
pub use stages::{Asking, ProgramError, Programs, StageProgram, executable};
pub use stamp::Stamp;
pub use targets::find;
