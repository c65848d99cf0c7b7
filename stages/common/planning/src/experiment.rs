//! Experiments: a pipeline file with scenes, protocols and variants, each of which sets several
//! things at once.

use std::collections::BTreeMap;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// What a pipeline file says of an experiment, besides its blocks. A file that extends others
/// changes theirs part by part.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Experiment {
    /// Folder of the data sets, from the current folder, unless `--data` names another.
    pub data: Option<String>,
    /// Folders inside it in which a scene is looked for; the first that has it counts.
    pub folders: Vec<String>,
    /// Scenes: names of data sets, or `demo` for the pipeline's own.
    pub scenes: Vec<String>,
    /// Protocols: names of `presets`. An unknown one of the form WIDTHxSCALE has the settings of
    /// preset `other`.
    pub protocols: Vec<String>,
    /// Parameters that go together, by name and then by `[STAGE.]NAME`. Preset `every` holds what
    /// all of them have, where they don't say otherwise. In words, `{width}`, `{scale}` and
    /// `{hr_width}` stand for a protocol's own.
    pub presets: BTreeMap<String, Map<String, Value>>,
    /// Inputs that come from the folder of the data sets, by `[STAGE.]NAME`; left out where the
    /// folder isn't there.
    pub inputs: BTreeMap<String, String>,
    /// Files in the folder of the data sets without which a block isn't made, by block. `{NAME}`
    /// stands for the block's parameter.
    pub needs: BTreeMap<String, String>,
    /// Inputs of sinks that are shown unless the command line chooses, by their names or by the
    /// blocks that they are; a sink that has none of them shows all of its own.
    pub show: Vec<String>,
    /// Variants, in the order of the table; they form no product.
    pub variants: Vec<Variant>,
    /// Parameters with several values each, by `[STAGE.]NAME`; they form a product. `-p` takes the
    /// place of one.
    pub sweeps: BTreeMap<String, Vec<Value>>,
}

/// Parameters and inputs that go together.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// Its name in tables.
    pub name: String,
    /// Parameters, by `[STAGE.]NAME`.
    #[serde(default)]
    pub parameters: Map<String, Value>,
    /// Inputs from the folder of the data sets, by `[STAGE.]NAME`.
    #[serde(default)]
    pub inputs: BTreeMap<String, String>,
}

/// What of an experiment the command line wants; nothing means all that the file names.
#[derive(Clone, Debug, Default)]
pub struct Selection {
    /// Folder of the data sets.
    pub data: Option<PathBuf>,
    /// Scenes.
    pub scenes: Vec<String>,
    /// Protocols.
    pub protocols: Vec<String>,
    /// Variants, by name.
    pub variants: Vec<String>,
    /// Only so many variants, the first.
    pub first: Option<usize>,
    /// Only these inputs of sinks, by their names or by the blocks that they are.
    pub show: Vec<String>,
}

impl Experiment {
    /// Takes what a file that extends this one's says.
    pub fn change(&mut self, by: &Self) {
        take(&mut self.folders, &by.folders);
        take(&mut self.scenes, &by.scenes);
        take(&mut self.protocols, &by.protocols);
        take(&mut self.show, &by.show);
        if !by.variants.is_empty() {
            self.variants.clone_from(&by.variants);
        }
        self.data = by.data.clone().or_else(|| self.data.take());
        for (name, preset) in &by.presets {
            self.presets.entry(name.clone()).or_default().extend(preset.clone());
        }
        self.inputs.extend(by.inputs.clone());
        self.needs.extend(by.needs.clone());
        self.sweeps.extend(by.sweeps.clone());
    }

    /// Whether it sets something of that name, itself.
    pub(crate) fn names(&self, name: &str) -> bool {
        let parameters =
            self.presets.values().chain(self.variants.iter().map(|variant| &variant.parameters));
        let inputs =
            [&self.inputs].into_iter().chain(self.variants.iter().map(|variant| &variant.inputs));
        parameters.into_iter().any(|parameters| parameters.contains_key(name))
            || inputs.into_iter().any(|inputs| inputs.contains_key(name))
            || self.sweeps.contains_key(name)
    }

    pub(crate) fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// The folder of the data sets.
    pub(crate) fn data(&self, choice: &Selection) -> PathBuf {
        let stated = self.data.as_ref().map(PathBuf::from);
        choice.data.clone().or(stated).unwrap_or_else(|| PathBuf::from("."))
    }
}

/// Takes another list, unless it is empty.
fn take(mine: &mut Vec<String>, by: &[String]) {
    if !by.is_empty() {
        *mine = by.to_vec();
    }
}
