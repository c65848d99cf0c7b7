use std::collections::BTreeMap;

use artifact::known_names;
use serde_json::{Map, Value};
use stage::plain;

use crate::axes::{Axis, AxisValue, Kind, Scope, Setting, canonical_folder};
use crate::experiment::{Experiment, Selection, Variant};
use crate::request::{PlanError, Request};

/// Scene with the pipeline's own data set.
const DEMO: &str = "demo";
/// Preset of protocols WIDTHxSCALE without a preset of their own.
const OTHER: &str = "other";
/// Preset that all protocols inherit.
const EVERY: &str = "every";

/// Returns the axes of an experiment; none if the pipeline isn't one.
pub(crate) fn axes(scope: &Scope<'_>, request: &Request) -> Result<Vec<Axis>, PlanError> {
    let (experiment, selection) = (&scope.pipeline.experiment, &request.selection);
    if experiment.is_empty() {
        let Selection { scenes, protocols, variants, max_variants, .. } = selection;
        let is_any = !scenes.is_empty() || !protocols.is_empty() || !variants.is_empty();
        if !is_any && max_variants.is_none() {
            return Ok(Vec::new());
        }
        let problem = "--scene, --protocol, --variant and --first-variants are for experiments; \
            give an experiment as target, such as paper-table";
        return Err(PlanError::Usage(problem.to_owned()));
    }
    let selected = SelectedExperiment { scope, experiment, selection };
    let mut axes = vec![
        Axis::new("scene", selected.scenes()?),
        Axis::new("protocol", selected.protocols()?),
        Axis::new("variant", selected.variants()?),
    ];
    axes.retain(|axis| !axis.values.is_empty());
    for (name, values) in &experiment.sweeps {
        axes.push(selected.sweep(name, values)?);
    }
    Ok(axes)
}

/// Experiment with the parts that the command line selects.
struct SelectedExperiment<'a> {
    scope: &'a Scope<'a>,
    experiment: &'a Experiment,
    selection: &'a Selection,
}

impl SelectedExperiment<'_> {
    fn scenes(&self) -> Result<Vec<AxisValue>, PlanError> {
        let common = self.inputs(&self.experiment.inputs)?;
        let mut values = Vec::new();
        for name in selected_or_all(&self.selection.scenes, &self.experiment.scenes) {
            let mut settings = common.clone();
            if name != DEMO {
                let folder = self.scene_folder(name)?;
                let setting = self.scope.setting(Kind::Input, "dataset", &folder)?;
                settings.extend(self.for_all_inputs(&setting));
            }
            values.push(AxisValue { text: name.clone(), settings });
        }
        Ok(values)
    }

    /// Repeats an input's setting for all inputs of the pipeline with the same source.
    fn for_all_inputs(&self, setting: &Setting) -> Vec<Setting> {
        let stages = &self.scope.pipeline.stages;
        let Some(source) = stages[&setting.stage].inputs.get(&setting.name) else {
            return vec![setting.clone()];
        };
        let mut settings = Vec::new();
        for (stage, block) in stages {
            for (name, _) in block.inputs.iter().filter(|(_, other)| *other == source) {
                let (stage, name) = (stage.clone(), name.clone());
                settings.push(Setting { stage, name, ..setting.clone() });
            }
        }
        settings
    }

    /// Returns the folder of a scene's data set.
    fn scene_folder(&self, name: &str) -> Result<Value, PlanError> {
        let data = self.experiment.data_folder(self.selection);
        for folder in self.experiment.folders.iter().map(String::as_str).chain(["."]) {
            let path = data.join(folder).join(name);
            if path.is_dir() {
                return Ok(canonical_folder(&path));
            }
        }
        Err(PlanError::Usage(format!(
            "no scene {name} in {}; set the folder of data sets with --data",
            data.display()
        )))
    }

    /// Returns the settings of inputs whose folders exist.
    fn inputs(&self, inputs: &BTreeMap<String, String>) -> Result<Vec<Setting>, PlanError> {
        let data = self.experiment.data_folder(self.selection);
        let mut settings = Vec::new();
        for (name, folder) in inputs {
            let path = data.join(folder);
            if path.is_dir() {
                settings.push(self.scope.setting(Kind::Input, name, &canonical_folder(&path))?);
            }
        }
        Ok(settings)
    }

    fn protocols(&self) -> Result<Vec<AxisValue>, PlanError> {
        let names = selected_or_all(&self.selection.protocols, &self.experiment.protocols);
        let protocols = names.iter().map(|name| {
            Ok(AxisValue { text: name.clone(), settings: self.parameters(&self.preset(name)?)? })
        });
        protocols.collect()
    }

    /// Returns the parameters of a protocol: those of `every`, overridden by the protocol's preset.
    /// A protocol WIDTHxSCALE without a preset has those of `other`, with its width and scale.
    fn preset(&self, name: &str) -> Result<Map<String, Value>, PlanError> {
        let presets = &self.experiment.presets;
        let own = presets.get(name).filter(|_| is_protocol(name));
        let sizes = parse_sizes(name);
        let mut preset = presets.get(EVERY).cloned().unwrap_or_default();
        match (own, sizes) {
            (Some(own), _) => preset.extend(own.clone()),
            (None, Some((width, scale))) => {
                preset.extend(presets.get(OTHER).cloned().unwrap_or_default());
                preset.insert("lr_width".to_owned(), Value::from(width));
                preset.insert("prep.scale".to_owned(), Value::from(scale));
            }
            (None, None) => {
                let names = presets.keys().map(String::as_str).filter(|known| is_protocol(known));
                return Err(PlanError::Usage(format!(
                    "no protocol {name:?}, and the name isn't WIDTHxSCALE; {}",
                    known_names(name, names)
                )));
            }
        }
        if let Some(sizes) = sizes {
            for value in preset.values_mut() {
                fill_placeholders(value, sizes);
            }
        }
        Ok(preset)
    }

    fn variants(&self) -> Result<Vec<AxisValue>, PlanError> {
        let all = &self.experiment.variants;
        let selected = &self.selection.variants;
        for name in selected {
            if !all.iter().any(|variant| variant.name == *name) {
                let known = known_names(name, all.iter().map(|variant| variant.name.as_str()));
                return Err(PlanError::Usage(format!("no variant {name:?}; {known}")));
            }
        }
        let mut chosen: Vec<&Variant> = all.iter().collect();
        chosen.retain(|variant| selected.is_empty() || selected.contains(&variant.name));
        chosen.truncate(self.selection.max_variants.unwrap_or(usize::MAX));
        let values = chosen.into_iter().map(|variant| {
            let mut settings = self.parameters(&variant.parameters)?;
            settings.extend(self.inputs(&variant.inputs)?);
            Ok(AxisValue { text: variant.name.clone(), settings })
        });
        values.collect()
    }

    /// Returns the axis of a parameter with several values.
    fn sweep(&self, name: &str, values: &[Value]) -> Result<Axis, PlanError> {
        let mut axis = Axis::new(name, Vec::new());
        for value in values {
            let setting = self.scope.setting(Kind::Parameter, name, value)?;
            // Without the stage.
            axis.name.clone_from(&setting.name);
            axis.values.push(AxisValue { text: plain(value), settings: vec![setting] });
        }
        Ok(axis)
    }

    fn parameters(&self, parameters: &Map<String, Value>) -> Result<Vec<Setting>, PlanError> {
        parameters
            .iter()
            .map(|(name, value)| self.scope.setting(Kind::Parameter, name, value))
            .collect()
    }
}

fn selected_or_all<'a>(selected: &'a Vec<String>, all: &'a Vec<String>) -> &'a Vec<String> {
    if selected.is_empty() { all } else { selected }
}

fn is_protocol(preset: &str) -> bool {
    ![OTHER, EVERY].contains(&preset)
}

/// Parses the LR width and scale of a protocol WIDTHxSCALE.
fn parse_sizes(name: &str) -> Option<(u32, f64)> {
    let (width, scale) = name.split_once('x')?;
    let scale = scale.parse().ok().filter(|scale: &f64| scale.is_finite())?;
    Some((width.parse().ok()?, scale))
}

/// Replaces placeholders in a text by a protocol's sizes. If the result is a number, the value
/// becomes one.
fn fill_placeholders(value: &mut Value, (width, scale): (u32, f64)) {
    let Some(text) = value.as_str().filter(|text| text.contains('{')) else { return };
    let mut filled = text.to_owned();
    for (placeholder, size) in [
        ("{width}", f64::from(width)),
        ("{scale}", scale),
        ("{hr_width}", (f64::from(width) * scale).round()),
    ] {
        filled = filled.replace(placeholder, &size.to_string());
    }
    *value = filled.parse().map_or_else(|_| Value::from(filled.as_str()), Value::Number);
}
