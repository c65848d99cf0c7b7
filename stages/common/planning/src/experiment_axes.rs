use std::collections::BTreeMap;

use artifact::known_names;
use contract::plain;
use serde_json::{Map, Value};

use crate::axes::{Axis, AxisValue, Kind, Scope, Setting, folder};
use crate::experiment::{Experiment, Selection, Variant};
use crate::request::{PlanError, Request};

/// The scene that is the pipeline's own.
const DEMO: &str = "demo";
/// The preset of protocols that have none.
const OTHER: &str = "other";
/// The preset of what all protocols have.
const EVERY: &str = "every";

/// The axes of an experiment; none where the pipeline is none.
pub(crate) fn axes(scope: &Scope<'_>, request: &Request) -> Result<Vec<Axis>, PlanError> {
    let (experiment, choice) = (&scope.pipeline.experiment, &request.choice);
    if experiment.is_none() {
        let is_asked = !(choice.scenes.is_empty()
            && choice.protocols.is_empty()
            && choice.variants.is_empty());
        let problem = "--scene, --protocol and --variant are for experiments; name one as target, \
            such as quality";
        return if is_asked { Err(PlanError::Usage(problem.to_owned())) } else { Ok(Vec::new()) };
    }
    let asked = Asked { scope, experiment, choice };
    let axes = [
        ("scene", asked.scenes()?),
        ("protocol", asked.protocols()?),
        ("variant", asked.variants()?),
    ];
    let axes = axes
        .into_iter()
        .filter(|(_, values)| !values.is_empty())
        .map(|(name, values)| Axis::new(name, values));
    let sweeps = experiment.sweeps.iter().map(|(name, values)| asked.sweep(name, values));
    axes.map(Ok).chain(sweeps).collect()
}

/// An experiment and what of it is wanted.
struct Asked<'a> {
    scope: &'a Scope<'a>,
    experiment: &'a Experiment,
    choice: &'a Selection,
}

impl Asked<'_> {
    fn scenes(&self) -> Result<Vec<AxisValue>, PlanError> {
        let names = if self.choice.scenes.is_empty() {
            &self.experiment.scenes
        } else {
            &self.choice.scenes
        };
        let common = self.inputs(&self.experiment.inputs)?;
        names.iter().map(|name| self.scene(name, &common)).collect()
    }

    /// A scene with its data set, besides what all of them have.
    fn scene(&self, name: &str, common: &[Setting]) -> Result<AxisValue, PlanError> {
        let mut settings = common.to_vec();
        if name != DEMO {
            let own = self.scope.setting(Kind::Input, "dataset", &self.scene_folder(name)?)?;
            settings.extend(self.alike(&own));
        }
        Ok(AxisValue { text: name.to_owned(), settings })
    }

    /// That input of a block, and those of other blocks that come from the same source.
    fn alike(&self, own: &Setting) -> Vec<Setting> {
        let stages = &self.scope.pipeline.stages;
        let Some(source) = stages[&own.stage].inputs.get(&own.name) else {
            return vec![own.clone()];
        };
        let inputs = stages.iter().flat_map(|(stage, block)| {
            block.inputs.iter().map(move |(name, from)| (stage, name, from))
        });
        let same = inputs.filter(|(.., from)| *from == source);
        same.map(|(stage, name, _)| Setting {
            stage: stage.clone(),
            name: name.clone(),
            ..own.clone()
        })
        .collect()
    }

    /// The folder of a scene.
    fn scene_folder(&self, name: &str) -> Result<Value, PlanError> {
        let data = self.experiment.data(self.choice);
        let place = |inside: &String| data.join(inside).join(name);
        let here = ".".to_owned();
        let found =
            self.experiment.folders.iter().chain([&here]).map(place).find(|path| path.is_dir());
        match found {
            Some(path) => Ok(folder(&path.to_string_lossy())),
            None => {
                let problem = format!(
                    "no scene {name} in {}; --data names a folder that has it",
                    data.display()
                );
                Err(PlanError::Usage(problem))
            }
        }
    }

    /// Inputs from the data sets' folder, those that are there.
    fn inputs(&self, inputs: &BTreeMap<String, String>) -> Result<Vec<Setting>, PlanError> {
        let data = self.experiment.data(self.choice);
        let there = inputs
            .iter()
            .map(|(name, inside)| (name, data.join(inside)))
            .filter(|(_, path)| path.is_dir());
        there
            .map(|(name, path)| {
                self.scope.setting(Kind::Input, name, &folder(&path.to_string_lossy()))
            })
            .collect()
    }

    fn protocols(&self) -> Result<Vec<AxisValue>, PlanError> {
        let names = if self.choice.protocols.is_empty() {
            &self.experiment.protocols
        } else {
            &self.choice.protocols
        };
        let protocols = names.iter().map(|name| {
            Ok(AxisValue { text: name.clone(), settings: self.parameters(&self.preset(name)?)? })
        });
        protocols.collect()
    }

    /// A preset's parameters over those of `every`; those of `other` with the width and the scale
    /// for one that isn't named.
    fn preset(&self, name: &str) -> Result<Map<String, Value>, PlanError> {
        let presets = &self.experiment.presets;
        let is_protocol = |name: &str| ![OTHER, EVERY].contains(&name);
        let sizes = sizes(name);
        let mut preset = presets.get(EVERY).cloned().unwrap_or_default();
        match (presets.get(name).filter(|_| is_protocol(name)), sizes) {
            (Some(own), _) => preset.extend(own.clone()),
            (None, Some((width, scale))) => {
                preset.extend(presets.get(OTHER).cloned().unwrap_or_default());
                preset.insert("lr_width".to_owned(), Value::from(width));
                preset.insert("prep.scale".to_owned(), Value::from(scale));
            }
            (None, None) => {
                let known = known_names(
                    name,
                    presets.keys().map(String::as_str).filter(|known| is_protocol(known)),
                );
                return Err(PlanError::Usage(format!(
                    "no protocol {name:?}, and not of the form WIDTHxSCALE; {known}"
                )));
            }
        }
        if let Some(sizes) = sizes {
            preset.values_mut().for_each(|value| fill(value, sizes));
        }
        Ok(preset)
    }

    fn variants(&self) -> Result<Vec<AxisValue>, PlanError> {
        let (all, chosen) = (&self.experiment.variants, &self.choice.variants);
        let known = |name: &str| known_names(name, all.iter().map(|variant| variant.name.as_str()));
        if let Some(name) =
            chosen.iter().find(|name| !all.iter().any(|variant| variant.name == **name))
        {
            return Err(PlanError::Usage(format!("no variant {name:?}; {}", known(name))));
        }
        let wanted =
            all.iter().filter(|variant| chosen.is_empty() || chosen.contains(&variant.name));
        let first = wanted.take(self.choice.first.unwrap_or(usize::MAX));
        first.map(|variant| self.variant(variant)).collect()
    }

    fn variant(&self, variant: &Variant) -> Result<AxisValue, PlanError> {
        let settings =
            [self.parameters(&variant.parameters)?, self.inputs(&variant.inputs)?].concat();
        Ok(AxisValue { text: variant.name.clone(), settings })
    }

    /// A parameter with several values.
    fn sweep(&self, name: &str, values: &[Value]) -> Result<Axis, PlanError> {
        let values = values.iter().map(|value| {
            let text = plain(value);
            Ok(AxisValue {
                text,
                settings: vec![self.scope.setting(Kind::Parameter, name, value)?],
            })
        });
        let values = values.collect::<Result<Vec<_>, PlanError>>()?;
        let name = values
            .first()
            .and_then(|value| value.settings.first())
            .map_or(name, |setting| &setting.name)
            .to_owned();
        Ok(Axis::new(&name, values))
    }

    fn parameters(&self, parameters: &Map<String, Value>) -> Result<Vec<Setting>, PlanError> {
        parameters
            .iter()
            .map(|(name, value)| self.scope.setting(Kind::Parameter, name, value))
            .collect()
    }
}

/// LR width and scale of a protocol's name, WIDTHxSCALE.
fn sizes(name: &str) -> Option<(u32, f64)> {
    let (width, scale) = name.split_once('x')?;
    Some((width.parse().ok()?, scale.parse().ok()?))
}

/// Puts a protocol's sizes into a word that names them; what is a number then, is meant as one.
fn fill(value: &mut Value, (width, scale): (u32, f64)) {
    let Some(word) = value.as_str().filter(|word| word.contains('{')) else { return };
    let sizes = [
        ("{width}", f64::from(width)),
        ("{scale}", scale),
        ("{hr_width}", (f64::from(width) * scale).round()),
    ];
    let filled = sizes
        .iter()
        .fold(word.to_owned(), |word, (name, size)| word.replace(name, &size.to_string()));
    *value = filled.parse().map_or_else(|_| Value::from(filled.as_str()), Value::Number);
}
