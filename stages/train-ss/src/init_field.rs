use std::path::PathBuf;

use anyhow::Context as _;
use artifact::{Failure, GivenInput};
use glam::DVec3;
use radiance::{FieldFile, FieldModel};
use stage::Context;

/// A field to go on from.
pub(crate) struct InitField<'a> {
    input: &'a GivenInput,
    members: u32,
}

impl<'a> InitField<'a> {
    /// Reads what it says of itself, which must be what is to be trained. An older field keeps its
    /// frame: bounds that differ from those of `wanted` by rounding, as seen from `anchor`, and its
    /// positions.
    pub(crate) fn read(
        input: &'a GivenInput,
        wanted: &mut FieldFile,
        anchor: DVec3,
    ) -> anyhow::Result<Self> {
        let file = fields::read_field_file(input)?;
        if file.bounds.rounded(anchor) == wanted.bounds {
            wanted.bounds = file.bounds;
        }
        if let (FieldModel::Mlp(own), FieldModel::Mlp(wanted)) = (file.field, &mut wanted.field) {
            wanted.scaled_positions = own.scaled_positions;
        }
        let differs = [
            ("lies elsewhere; train both from one prep", file.bounds != wanted.bounds),
            (
                "has another background; train both from one prep",
                file.background != wanted.background,
            ),
            (
                "is made of something else than the parameters ask for; give those it was trained \
                with",
                file.field != wanted.field,
            ),
        ];
        match differs.iter().find(|(_, differs)| *differs) {
            Some((what, _)) => Err(Failure::BadInput(format!("input init: it {what}")).into()),
            None => Ok(Self { input, members: file.members }),
        }
    }

    /// Weights of a member; where it has fewer of them, they are gone on from in turn.
    pub(crate) fn member(&self, index: u32) -> PathBuf {
        self.input.path(&FieldFile::member_file(index % self.members))
    }

    /// Writes all of its members before those of `file`, and returns how many they are.
    pub(crate) fn keep_beside(
        &self,
        context: &Context,
        file: &mut FieldFile,
    ) -> anyhow::Result<u32> {
        file.members += self.members;
        file.check().map_err(|reason| {
            let message = format!(
                "parameter ensemble: {reason} with those of input init; lower it, or set \
                    combine to average_weights"
            );
            Failure::Usage(message)
        })?;
        for index in 0..self.members {
            std::fs::copy(self.member(index), context.output_path(&FieldFile::member_file(index))?)
                .context("cannot keep input init")?;
        }
        Ok(self.members)
    }
}

#[cfg(test)]
mod tests {
    use radiance::{FIELD_FILE, FIELD_FORMAT, MlpArchitecture};
    use scene::{Background, Bounds};

    use super::*;

    /// Reads a field that is initialised from another; both by their bounds and positions.
    fn read(init: (Bounds, bool), wanted: (Bounds, bool)) -> Result<(Bounds, bool), String> {
        let file = |(bounds, scaled_positions)| FieldFile {
            format: FIELD_FORMAT,
            field: FieldModel::Mlp(MlpArchitecture { scaled_positions, ..Default::default() }),
            members: 1,
            bounds,
            background: Background::White,
        };
        let folder = tempfile::tempdir().unwrap();
        artifact::write_json(&folder.path().join(FIELD_FILE), &file(init)).unwrap();
        let (input, mut wanted) = (GivenInput::open("init", folder.path()).unwrap(), file(wanted));
        InitField::read(&input, &mut wanted, DVec3::Y).map_err(|error| error.to_string())?;
        let FieldModel::Mlp(architecture) = wanted.field else { panic!("the model stays") };
        Ok((wanted.bounds, architecture.scaled_positions))
    }

    /// A field from before bounds were rounded and positions scaled is trained on in its own frame.
    #[test]
    fn older_fields_keep_their_frame() {
        let bounds =
            Bounds { min: [-1.1; 3], max: [1.3; 3], near: 0.7, far: 6.1, ..Bounds::default() };
        let rounded = bounds.rounded(DVec3::Y);
        assert_eq!(read((bounds, false), (rounded, true)), Ok((bounds, false)));
        assert_eq!(read((rounded, true), (rounded, true)), Ok((rounded, true)));
        let elsewhere = bounds.moved(DVec3::splat(1e-4));
        let refused = read((elsewhere, true), (rounded, true)).unwrap_err();
        assert!(refused.contains("it lies elsewhere"), "{refused}");
    }
}
