//! Names that parameters and inputs had once: who gives one is told the new one.

use std::collections::BTreeSet;

use serde_json::Value;

/// What has a name of its own in a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Named {
    /// A parameter.
    Parameter,
    /// An input.
    Input,
}

/// A name that is no more.
#[derive(Clone, Copy, Debug)]
pub struct Rename {
    /// Name of the stage's program.
    pub program: &'static str,
    /// What had the name.
    pub kind: Named,
    /// The name it had.
    pub old: &'static str,
    /// The name it has.
    pub new: &'static str,
    /// Values that are said otherwise now, each with what to write.
    pub values: &'static [(&'static str, &'static str)],
}

impl Rename {
    /// What to say to somebody who gives the old name, with this value.
    pub fn problem(&self, value: Option<&Value>) -> String {
        let given = value.and_then(Value::as_str);
        let write = self.values.iter().find(|(old, _)| given == Some(old));
        let hint =
            write.map(|(old, write)| format!("; for {old} write {write}")).unwrap_or_default();
        format!("is called {} now{hint}", self.new)
    }
}

const fn parameter(program: &'static str, old: &'static str, new: &'static str) -> Rename {
    Rename { program, kind: Named::Parameter, old, new, values: &[] }
}

/// Every name that changed.
pub const RENAMES: &[Rename] = &[
    parameter("demo-scene", "samples", "samples_per_axis"),
    parameter("prep", "lr", "lr_width"),
    parameter("prep", "hr", "hr_width"),
    Rename {
        values: &[
            ("none", "lr_source: photographs"),
            ("lanczos", "lr_source: downscaled, kernel: lanczos"),
            ("bicubic", "lr_source: downscaled, kernel: bicubic"),
            ("box", "lr_source: downscaled, kernel: box"),
            ("average", "lr_source: downscaled, kernel: average"),
        ],
        ..parameter("prep", "degrade", "lr_source")
    },
    parameter("prep", "references", "hr_references"),
    parameter("refine", "references", "max_references"),
    parameter("refine", "strength", "residual_weight"),
    parameter("refine", "turns", "self_ensemble"),
    parameter("render-depth", "sub_rays", "samples_per_axis"),
    parameter("train-refine", "channels", "features"),
    parameter("train-refine", "references", "references_per_view"),
    parameter("train-refine", "square", "patch_size"),
    parameter("train-ss", "averaging", "ema_decay"),
    parameter("train-ss", "batch", "max_rays_per_step"),
    Rename {
        values: &[("beside", "combine: ensemble"), ("averaged", "combine: average_weights")],
        ..parameter("train-ss", "begun", "combine")
    },
    parameter("train-ss", "coarse", "supersample_warmup"),
    parameter("train-ss", "coarsest", "base_resolution"),
    parameter("train-ss", "crop_steps", "precrop_steps"),
    parameter("train-ss", "detail", "pixel_importance"),
    parameter("train-ss", "direction_octaves", "direction_frequencies"),
    Rename { kind: Named::Input, ..parameter("train-ss", "field", "init") },
    parameter("train-ss", "final_rate", "learning_rate_decay"),
    parameter("train-ss", "finest", "max_resolution"),
    parameter("train-ss", "haze", "floater_loss"),
    parameter("train-ss", "hidden", "hidden_dim"),
    parameter("train-ss", "levels", "n_levels"),
    parameter("train-ss", "log2_entries", "log2_hashmap_size"),
    parameter("train-ss", "members", "ensemble"),
    parameter("train-ss", "network_rate", "mlp_learning_rate"),
    parameter("train-ss", "noise", "density_noise_std"),
    parameter("train-ss", "position_octaves", "position_frequencies"),
    parameter("train-ss", "rate", "learning_rate"),
    parameter("train-ss", "references", "max_references"),
    parameter("train-ss", "samples", "samples_per_step"),
    parameter("train-ss", "steps", "march_steps"),
];

/// What a name of a program became.
pub fn renamed(kind: Named, program: &str, old: &str) -> Option<&'static Rename> {
    RENAMES.iter().find(|rename| (rename.kind, rename.program, rename.old) == (kind, program, old))
}

/// What to say where programs had the name, if any of them did.
pub fn renamed_in<'a>(
    kind: Named,
    programs: impl IntoIterator<Item = &'a str>,
    old: &str,
    value: Option<&Value>,
) -> Option<String> {
    let found = programs.into_iter().filter_map(|program| renamed(kind, program, old));
    let problems: BTreeSet<String> = found.map(|rename| rename.problem(value)).collect();
    (!problems.is_empty()).then(|| problems.into_iter().collect::<Vec<_>>().join(", or "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn renamed_parameter(programs: &[&str], old: &str) -> Option<String> {
        renamed_in(Named::Parameter, programs.iter().copied(), old, None)
    }

    #[test]
    fn a_name_is_old_for_its_own_program_only() {
        assert!(renamed(Named::Parameter, "train-refine", "rate").is_none());
        assert!(renamed(Named::Parameter, "train-ss", "field").is_none());
        assert_eq!(renamed_parameter(&["eval"], "samples"), None);
        let both = renamed_parameter(&["demo-scene", "train-ss"], "samples").unwrap();
        assert_eq!(both, "is called samples_per_axis now, or is called samples_per_step now");
    }
}
