//! Experiments: scenes, protocols and variants of a pipeline file, each of which sets several
//! parameters and inputs (docs/design/034).

use std::collections::BTreeMap;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// The experiment of a pipeline file. A file that extends others overrides parts of their
/// experiments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Experiment {
    /// Folder of the data sets, relative to the current folder; `--data` overrides it.
    pub data: Option<String>,
    /// Folders inside `data` that are searched for a scene, in order.
    pub folders: Vec<String>,
    /// Scenes: names of data sets, or `demo` for the pipeline's own data set.
    pub scenes: Vec<String>,
    /// Protocols: names of `presets`, or WIDTHxSCALE for the preset `other`.
    pub protocols: Vec<String>,
    /// Groups of parameters by name, each by `[STAGE.]NAME`. All protocols inherit the preset
    /// `every`. In texts, `{width}`, `{scale}` and `{hr_width}` are replaced by the protocol's
    /// values.
    pub presets: BTreeMap<String, Map<String, Value>>,
    /// Inputs by `[STAGE.]NAME`: folders inside `data`, ignored if they don't exist.
    pub inputs: BTreeMap<String, String>,
    /// Required files by block: paths inside `data`, in which `{NAME}` is replaced by the block's
    /// parameter. A block without its file is left out.
    pub needs: BTreeMap<String, String>,
    /// Inputs of sinks to show unless the command line selects others, by name or stage. A sink
    /// with none of them shows all its inputs.
    pub show: Vec<String>,
    /// Variants, in the order of the table. They form no product with one another.
    pub variants: Vec<Variant>,
    /// Values of parameters by `[STAGE.]NAME`. The parameters form a product. `-p` replaces a
    /// parameter's values.
    pub sweeps: BTreeMap<String, Vec<Value>>,
}

/// A named set of parameters and inputs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// Name in tables.
    pub name: String,
    /// Parameters by `[STAGE.]NAME`.
    #[serde(default)]
    pub parameters: Map<String, Value>,
    /// Inputs by `[STAGE.]NAME`: folders inside `data`.
    #[serde(default)]
    pub inputs: BTreeMap<String, String>,
}

/// Parts of an experiment that the command line selects; an empty list selects all.
#[derive(Clone, Debug, Default)]
pub struct Selection {
    /// Folder of the data sets.
    pub data: Option<PathBuf>,
    /// Names of scenes.
    pub scenes: Vec<String>,
    /// Names of protocols.
    pub protocols: Vec<String>,
    /// Names of variants.
    pub variants: Vec<String>,
    /// Maximum number of variants; further ones are left out.
    pub max_variants: Option<usize>,
    /// Inputs of sinks, by name or stage.
    pub show: Vec<String>,
}

impl Experiment {
    /// Overrides the parts that `other` sets; presets, inputs, needs and sweeps entry by entry.
    pub fn override_with(&mut self, other: &Self) {
        replace_unless_empty(&mut self.folders, &other.folders);
        replace_unless_empty(&mut self.scenes, &other.scenes);
        replace_unless_empty(&mut self.protocols, &other.protocols);
        replace_unless_empty(&mut self.show, &other.show);
        replace_unless_empty(&mut self.variants, &other.variants);
        if other.data.is_some() {
            self.data.clone_from(&other.data);
        }
        for (name, preset) in &other.presets {
            self.presets.entry(name.clone()).or_default().extend(preset.clone());
        }
        self.inputs.extend(other.inputs.clone());
        self.needs.extend(other.needs.clone());
        self.sweeps.extend(other.sweeps.clone());
    }

    /// Returns whether any preset, variant, input or sweep sets a name.
    pub(crate) fn sets(&self, name: &str) -> bool {
        self.inputs.contains_key(name)
            || self.sweeps.contains_key(name)
            || self.presets.values().any(|preset| preset.contains_key(name))
            || self.variants.iter().any(|variant| {
                variant.parameters.contains_key(name) || variant.inputs.contains_key(name)
            })
    }

    /// Returns whether the pipeline isn't an experiment.
    pub(crate) fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Returns the folder of the data sets.
    pub(crate) fn data_folder(&self, selection: &Selection) -> PathBuf {
        let folder = selection.data.clone().or_else(|| self.data.as_ref().map(PathBuf::from));
        folder.unwrap_or_else(|| PathBuf::from("."))
    }
}

fn replace_unless_empty<T: Clone>(list: &mut Vec<T>, other: &[T]) {
    if !other.is_empty() {
        *list = other.to_vec();
    }
}
