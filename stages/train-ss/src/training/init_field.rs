use std::path::PathBuf;

use anyhow::Context as _;
use artifact::{Failure, GivenInput};
use fields::{FieldFile, FieldModel};
use glam::DVec3;
use radiance::{TRAINING_FILE, TrainingLog};
use stage::Context;

/// Input `init`: the field that training is initialised from.
pub(crate) struct InitField<'a> {
    input: &'a GivenInput,
    members: u32,
}

impl<'a> InitField<'a> {
    /// Reads the initial field's description and fails if it differs from `file`, the description
    /// of the field to train. Older versions neither rounded bounds nor scaled positions. So that
    /// their fields can still be trained, `file` takes the initial field's `scaled_positions`.
    /// `file` also takes the initial bounds if these, rounded around `anchor` (the first camera's
    /// centre), equal its own.
    pub(crate) fn read(
        input: &'a GivenInput,
        file: &mut FieldFile,
        anchor: DVec3,
    ) -> anyhow::Result<Self> {
        let init = fields::read_field_file(input)?;
        if init.bounds.rounded(anchor) == file.bounds {
            file.bounds = init.bounds;
        }
        if let (FieldModel::Mlp(init), FieldModel::Mlp(mlp)) = (init.field, &mut file.field) {
            mlp.scaled_positions = init.scaled_positions;
        }
        let problem = if init.bounds != file.bounds {
            "the field's bounds differ from the scene's; give the scene that the field was \
            trained on"
        } else if init.background != file.background {
            "the field's background differs from the scene's; give the scene that the field was \
            trained on"
        } else if init.field != file.field {
            "the field's architecture differs from the parameters; give the parameters that the \
            field was trained with"
        } else {
            return Ok(Self { input, members: init.members });
        };
        Err(Failure::BadInput(format!("input init: {problem}")).into())
    }

    /// Returns the path of the weights that a member is initialised from. If the ensemble has more
    /// members than the initial field, the initial field's members are reused in turn.
    pub(crate) fn member(&self, index: u32) -> PathBuf {
        self.input.path(&FieldFile::member_file(index % self.members))
    }

    /// True if the initial field's training estimated exposures.
    pub(crate) fn has_exposures(&self) -> anyhow::Result<bool> {
        let log: Option<TrainingLog> = self.input.read_optional_json(TRAINING_FILE)?;
        Ok(log.is_some_and(|log| !log.exposures.is_empty()))
    }

    /// Copies the initial field's members to the output, before those to train, and returns their
    /// number.
    pub(crate) fn copy_members(
        &self,
        context: &Context,
        file: &mut FieldFile,
    ) -> anyhow::Result<u32> {
        file.members += self.members;
        file.check().map_err(|reason| {
            let message = format!(
                "parameter ensemble: {reason} including those of input init; lower it, or set \
                combine to average_weights"
            );
            Failure::Usage(message)
        })?;
        for index in 0..self.members {
            std::fs::copy(self.member(index), context.output_path(&FieldFile::member_file(index))?)
                .context("cannot copy input init")?;
        }
        Ok(self.members)
    }
}

#[cfg(test)]
mod tests {
    use fields::{FIELD_FILE, FIELD_FORMAT};
    use scene::{Background, Bounds};
    use torch_field::MlpArchitecture;

    use super::*;

    /// Initialises the requested field from another and returns the result. Each pair consists of a
    /// field's bounds and its `scaled_positions`.
    fn initialise(
        init: (Bounds, bool),
        requested: (Bounds, bool),
    ) -> Result<(Bounds, bool), String> {
        let file = |(bounds, scaled_positions)| FieldFile {
            format: FIELD_FORMAT,
            field: FieldModel::Mlp(MlpArchitecture { scaled_positions, ..Default::default() }),
            members: 1,
            bounds,
            background: Background::White,
        };
        let folder = tempfile::tempdir().unwrap();
        artifact::write_json(&folder.path().join(FIELD_FILE), &file(init)).unwrap();
        let (input, mut requested) =
            (GivenInput::open("init", folder.path()).unwrap(), file(requested));
        InitField::read(&input, &mut requested, DVec3::Y).map_err(|error| error.to_string())?;
        let FieldModel::Mlp(architecture) = requested.field else { panic!("the model stays") };
        Ok((requested.bounds, architecture.scaled_positions))
    }

    /// A field written before bounds were rounded and positions scaled keeps its own frame.
    #[test]
    fn older_fields_keep_their_frame() {
        let bounds =
            Bounds { min: [-1.1; 3], max: [1.3; 3], near: 0.7, far: 6.1, ..Bounds::default() };
        let rounded = bounds.rounded(DVec3::Y);
        assert_eq!(initialise((bounds, false), (rounded, true)), Ok((bounds, false)));
        assert_eq!(initialise((rounded, true), (rounded, true)), Ok((rounded, true)));
        let moved = bounds.moved(DVec3::splat(1e-4));
        let error = initialise((moved, true), (rounded, true)).unwrap_err();
        assert!(error.contains("bounds differ"), "{error}");
    }
}
