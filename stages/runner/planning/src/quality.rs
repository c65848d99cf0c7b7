//! Qualities: one word that sets several parameters of several stages (docs/design/048).

use std::collections::BTreeMap;
use std::sync::LazyLock;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::stages::StageProgram;

/// Name that selects a quality, as a parameter and as a field of pipeline files.
pub(crate) const QUALITY: &str = "quality";

/// Trade of speed for accuracy. `qualities.yaml` lists the parameters of each quality.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Quality {
    /// A thirtieth of the time of `best`: shows whether a scene works.
    Draft,
    /// A tenth of the time of `best`.
    Fast,
    /// A third of the time of `best`.
    #[default]
    Balanced,
    /// All stages with their own defaults.
    Best,
}

/// Parameters by quality and by name of the stage's program.
type Rows = BTreeMap<Quality, BTreeMap<String, Map<String, Value>>>;

static ROWS: LazyLock<Rows> = LazyLock::new(|| {
    serde_yaml::from_str(include_str!("qualities.yaml")).expect("qualities.yaml is valid")
});

impl Quality {
    /// All qualities, the fastest first.
    pub const ALL: [Self; 4] = [Self::Draft, Self::Fast, Self::Balanced, Self::Best];

    /// Returns the word for the quality.
    pub fn name(self) -> &'static str {
        match self {
            Self::Draft => "draft",
            Self::Fast => "fast",
            Self::Balanced => "balanced",
            Self::Best => "best",
        }
    }

    /// Parses the value of a parameter. Fails with the problem and a remedy.
    pub(crate) fn parse(value: &Value) -> Result<Self, String> {
        let named = Self::ALL.into_iter().find(|quality| value == quality.name());
        named.ok_or_else(|| {
            let [draft, fast, balanced, best] = Self::ALL.map(Self::name);
            let given = stage::plain(value);
            format!("no quality {given:?}; choose {draft}, {fast}, {balanced} or {best}")
        })
    }

    /// Returns whether qualities set parameters of a program.
    pub(crate) fn affects(program: &StageProgram) -> bool {
        ROWS.values().any(|row| row.contains_key(&program.description.name))
    }

    /// Returns a note if a block named after a program with qualities runs a program of another
    /// name that has some of these parameters.
    pub(crate) fn note(block: &str, program: &StageProgram) -> Option<String> {
        let name = &program.description.name;
        let row = ROWS[&Self::default()].get(block).filter(|_| !Self::affects(program))?;
        row.keys().any(|parameter| program.schema.names().contains(&parameter.as_str())).then(|| {
            format!(
                "{block}: qualities set no parameters of {name}; to use them, name it {block} in \
                its description"
            )
        })
    }

    /// Adds the quality's parameters to the `given` ones, which win. Qualities only set
    /// parameters of default variants, such as `field: grid`.
    pub(crate) fn fill(self, program: &StageProgram, given: &mut Map<String, Value>) {
        if !program.schema.is_default_variant(given) {
            return;
        }
        let names = program.schema.names();
        for (name, value) in ROWS[&self].get(&program.description.name).into_iter().flatten() {
            // A program of the user's own may have the name of a stage, but other parameters.
            if names.contains(&name.as_str()) {
                given.entry(name.clone()).or_insert_with(|| value.clone());
            }
        }
    }
}

#[cfg(test)]
#[path = "quality_tests.rs"]
mod tests;
