use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _};
use radiance::{Field, RayField, StepReport, Trainer, TrainingState};
use scene::Bounds;

use crate::params::{Resolved, ResolvedField};
use crate::supervision::Supersampling;

/// Trainer of any kind of field, one step at a time, with checkpoints.
pub(crate) trait FieldTrainer {
    /// Takes a step; returns `None` after all rays have been cast.
    fn step(&mut self, supervision: &mut Supersampling) -> anyhow::Result<Option<StepReport>>;
    /// Returns the current field.
    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>>;
    /// Returns the progress of the training.
    fn state(&self) -> &TrainingState;
    /// Writes a checkpoint.
    fn write_checkpoint(&self, path: &Path) -> anyhow::Result<()>;
    /// Resumes from a checkpoint and returns whether that succeeded. A trainer that failed may be
    /// partly restored: create another one.
    fn resume(&mut self, path: &Path) -> bool;
    /// Ends the training and writes the field's weights, or their mean with those of a file `init`
    /// (design note 020).
    fn finish(self: Box<Self>, weights: &Path, init: Option<&Path>) -> anyhow::Result<()>;
}

/// Creates a trainer of a new field, or of one initialised from the weights `init`. A grid is
/// limited to a mask of occupancy cells.
pub(crate) fn new_trainer(
    params: &Resolved,
    init: Option<&Path>,
    bounds: Bounds,
    cells: Option<&[bool]>,
    device: &str,
) -> anyhow::Result<Box<dyn FieldTrainer>> {
    match &params.field {
        ResolvedField::Grid { architecture, regularisers, given } => {
            let mut field = match init {
                Some(weights) => {
                    let mut field =
                        Field::read(weights, *architecture, bounds).bad_input("input init")?;
                    field.limit_to_occupied();
                    field
                }
                None => Field::new(*architecture, bounds, params.seed),
            };
            if let Some(cells) = cells {
                field.limit_to(cells.to_vec());
            }
            let options = params.grid_training(given, *regularisers);
            if device == "cpu" {
                return Ok(Box::new(Trainer::new(field, options)));
            }
            #[cfg(feature = "torch")]
            return Ok(Box::new(torch_field::GridTrainer::new(
                &field,
                options,
                fields::torch_device(device)?,
            )?));
            #[cfg(not(feature = "torch"))]
            Err(fields::needs_libtorch(&format!("--device {device}")).into())
        }
        #[cfg(feature = "torch")]
        ResolvedField::Mlp { architecture, density_noise_std } => {
            let device = fields::torch_device(device)?;
            let field = match init {
                Some(weights) => torch_field::Mlp::read(weights, *architecture, bounds, device)
                    .bad_input("input init")?,
                None => torch_field::Mlp::new(*architecture, bounds, params.seed, device)?,
            };
            let options = params.mlp_training(*density_noise_std);
            Ok(Box::new(torch_field::MlpTrainer::new(field, options)?))
        }
        #[cfg(not(feature = "torch"))]
        ResolvedField::Mlp { .. } => Err(fields::needs_libtorch("parameter field: mlp").into()),
    }
}

/// Context of errors while trained weights are averaged with the initial ones.
const CANNOT_AVERAGE: &str = "cannot average the weights";

/// Implements the methods of [`FieldTrainer`] that all trainers have under the same names.
macro_rules! forwarded {
    () => {
        fn state(&self) -> &TrainingState {
            Self::state(self)
        }

        fn write_checkpoint(&self, path: &Path) -> anyhow::Result<()> {
            Ok(Self::write_checkpoint(self, path)?)
        }

        fn resume(&mut self, path: &Path) -> bool {
            Self::resume(self, path).is_ok()
        }
    };
}

impl FieldTrainer for Trainer {
    fn step(&mut self, supervision: &mut Supersampling) -> anyhow::Result<Option<StepReport>> {
        Self::step(self, supervision).map_err(|e| Failure::Numerical(e.to_string()).into())
    }

    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>> {
        Ok(Box::new(Self::field(self)))
    }

    forwarded!();

    fn finish(self: Box<Self>, weights: &Path, init: Option<&Path>) -> anyhow::Result<()> {
        let steps = Self::state(&self).steps;
        write_grid(Self::finish(*self), steps, weights, init)
    }
}

/// Writes a grid without its specks, averaged with the weights `init`; fails if a parameter isn't
/// finite.
fn write_grid(
    mut field: Field,
    steps: u64,
    weights: &Path,
    init: Option<&Path>,
) -> anyhow::Result<()> {
    if !field.is_finite() {
        return Err(Failure::Numerical(format!(
            "step {steps}: a parameter is not finite; lower the learning rate"
        ))
        .into());
    }
    field.remove_specks();
    if let Some(init) = init {
        let init = Field::read(init, field.architecture, field.bounds);
        field.average_with(&init.context(CANNOT_AVERAGE)?);
    }
    field.write(weights).context("cannot write the field")
}

#[cfg(feature = "torch")]
impl FieldTrainer for torch_field::GridTrainer {
    fn step(&mut self, supervision: &mut Supersampling) -> anyhow::Result<Option<StepReport>> {
        Self::step(self, supervision).map_err(torch_failure)
    }

    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>> {
        Ok(Box::new(Self::field(self)?))
    }

    forwarded!();

    fn finish(self: Box<Self>, weights: &Path, init: Option<&Path>) -> anyhow::Result<()> {
        write_grid(Self::field(&self)?, Self::state(&self).steps, weights, init)
    }
}

/// Converts an error of a libtorch trainer.
#[cfg(feature = "torch")]
fn torch_failure(error: torch_field::TorchFieldError) -> anyhow::Error {
    match error {
        torch_field::TorchFieldError::Diverged { .. } => {
            Failure::Numerical(error.to_string()).into()
        }
        _ => error.into(),
    }
}

#[cfg(feature = "torch")]
impl FieldTrainer for torch_field::MlpTrainer {
    fn step(&mut self, supervision: &mut Supersampling) -> anyhow::Result<Option<StepReport>> {
        Self::step(self, supervision).map_err(torch_failure)
    }

    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>> {
        Ok(Box::new(Self::field(self)))
    }

    forwarded!();

    fn finish(self: Box<Self>, weights: &Path, init: Option<&Path>) -> anyhow::Result<()> {
        let field = Self::field(&self);
        if let Some(init) = init {
            field.average_with(init).context(CANNOT_AVERAGE)?;
        }
        field.write(weights).context("cannot write the field")
    }
}

#[cfg(test)]
mod tests {
    use radiance::Architecture;

    use super::*;

    /// Returns a small field with two thin cells, one of them next to an opaque cell.
    fn field() -> Field {
        let architecture =
            Architecture { n_levels: 2, log2_hashmap_size: 8, ..Architecture::default() };
        let bounds = Bounds::cube(1.0, 2.0, 6.0);
        let mut field = Field::new(architecture, bounds, 1);
        let (.., occupancy) = field.parts_mut();
        let (mut density, mut cells) =
            (occupancy.densities(), vec![0; occupancy.densities().len()]);
        density[5000..5002].copy_from_slice(&[10.0, 1000.0]);
        cells[5000..5002].copy_from_slice(&[1, 2]);
        (density[9000], cells[9000]) = (10.0, 1);
        occupancy.restore(density, &cells);
        field
    }

    #[test]
    fn a_field_is_written_without_specks() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        let Field { architecture, bounds, .. } = field();
        write_grid(field(), 7, &path, None).unwrap();
        let read = Field::read(&path, architecture, bounds).unwrap();
        let (.., occupancy) = read.parts();
        let cells = occupancy.to_bytes();
        let occupied: Vec<usize> = (0..cells.len()).filter(|&cell| cells[cell] != 0).collect();
        assert_eq!(occupied, [5000, 5001]);
    }

    #[test]
    fn a_parameter_that_is_not_finite_is_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        let mut field = field();
        field.parts_mut().0[3] = f32::NAN;
        let error = write_grid(field, 7, &path, None).unwrap_err();
        assert!(matches!(error.downcast_ref::<Failure>(), Some(Failure::Numerical(_))));
        assert!(!path.exists());
    }
}
