//! The contract: what a stage says of itself, and how values are checked by it.
//!
//! * [`Description`]: what `STAGE describe` prints, all that the runner knows of a stage.
//! * [`Input`], [`Output`]: artifacts that a stage takes, and the one that it makes.
//! * [`Schema`]: a stage's parameters: their defaults, what they may be, and the form in which they
//!   are hashed.
//! * [`Rule`]: what parameters and inputs must be together.
//! * [`RENAMES`]: names that parameters and inputs had once.
//! * [`ParameterSection`]: parameters as people read them. [`plain`]: a value as they read it.
//!
//! The runner checks values by this crate before it starts a stage. The stage checks them again.
//!
//! ```
//! use contract::Schema;
//! use serde_json::{Map, json};
//!
//! let properties = json!({"rays": {"type": "integer", "minimum": 1, "default": 5}});
//! let schema = Schema::new(&json!({"properties": properties}))?;
//! assert_eq!(schema.resolve(&Map::new()).unwrap(), json!({"rays": 5}));
//! let none = Map::from_iter([("rays".to_owned(), json!(0))]);
//! let problems = schema.resolve(&none).unwrap_err();
//! assert_eq!(problems[0].to_string(), "parameter rays: 0 is less than the minimum of 1");
//! # Ok::<(), contract::SchemaError>(())
//! ```

#![cfg_attr(not(test), warn(clippy::print_stdout, clippy::print_stderr))]

mod describe;
mod documented;
mod error;
mod input;
mod output;
mod parameters;
mod rules;
mod tagged;
mod validator;
mod values;
#[cfg(test)]
mod variant_tests;

pub use describe::{Description, DescriptionError};
pub use documented::{GROUPS, ParameterSection, ParameterText, by_group, plain};
pub use error::{KeywordError, SchemaError};
pub use input::Input;
pub use output::Output;
pub use parameters::{ParameterProblem, Schema};
pub use rules::{GivenInputs, Rule, RuleError};
