//! A stage's description, and the checks of values against it.
//!
//! * [`Description`]: output of `STAGE describe`; all that the runner knows about a stage.
//! * [`Input`], [`Output`]: the artifacts that a stage reads, and the one that it creates.
//! * [`Schema`]: a stage's parameters: defaults, allowed values, and the form in which values are
//!   hashed.
//! * [`Rule`]: a constraint between parameters and inputs.
//! * [`ParameterSection`]: human-readable documentation of parameters. [`plain`]: a value as text.
//!
//! The runner checks values with this module before it starts a stage. The stage checks them again.
//!
//! ```
//! use stage::Schema;
//! use serde_json::{Map, json};
//!
//! let properties = json!({"rays": {"type": "integer", "minimum": 1, "default": 5}});
//! let schema = Schema::new(&json!({"properties": properties}))?;
//! assert_eq!(schema.resolve(&Map::new()).unwrap(), json!({"rays": 5}));
//! let none = Map::from_iter([("rays".to_owned(), json!(0))]);
//! let problems = schema.resolve(&none).unwrap_err();
//! assert_eq!(problems[0].to_string(), "parameter rays: 0 is less than the minimum of 1");
//! # Ok::<(), stage::ContractError>(())
//! ```

mod describe;
mod documented;
mod error;
mod parameters;
mod rules;
mod tagged;
mod validator;
mod values;
#[cfg(test)]
mod variant_tests;

pub use describe::{Description, Input, Output};
pub use documented::{
    PARAMETER_GROUPS, ParameterDoc, ParameterSection, group_parameters, plain, render_help,
};
pub use error::ContractError;
pub use parameters::{ParameterProblem, Schema};
pub use rules::{GivenInputs, Rule};
