use std::path::PathBuf;

use anyhow::Context as _;
use artifact::{Failure, GivenInput};
use radiance::FieldFile;
use stage::Context;

/// A field to go on from.
pub(crate) struct InitField<'a> {
    input: &'a GivenInput,
    members: u32,
}

impl<'a> InitField<'a> {
    /// Reads what it says of itself, which must be what is to be trained.
    pub(crate) fn read(input: &'a GivenInput, wanted: &FieldFile) -> anyhow::Result<Self> {
        let file = fields::read_file(input)?;
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
        self.input.path(&FieldFile::member(index % self.members))
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
            std::fs::copy(self.member(index), context.output_path(&FieldFile::member(index))?)
                .context("cannot keep input init")?;
        }
        Ok(self.members)
    }
}
