use std::path::Path;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _};
use radiance::{Field, FieldModel, RayField, StepReport, Trainer, TrainingError, TrainingOptions};
use scene::Bounds;

use crate::resolve::{Resolved, ResolvedField};
use crate::supervision::Supersampling;

/// Whatever is trained: a step at a time, with checkpoints.
pub(crate) trait FieldTrainer {
    /// Takes a step; `None` once all rays are spent.
    fn step(&mut self, supervision: &mut Supersampling) -> anyhow::Result<Option<StepReport>>;
    /// The field as it is now.
    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>>;
    /// Steps taken.
    fn steps(&self) -> u64;
    /// Rays cast so far.
    fn rays_done(&self) -> u64;
    /// The step that a checkpoint was written at, where it is whole.
    fn checkpoint_step(&self, path: &Path) -> Option<u64>;
    /// Writes all that a resumed training needs.
    fn write_checkpoint(&self, path: &Path) -> anyhow::Result<()>;
    /// Goes on from a checkpoint; whether it could. A trainer that can't is as it was, unless
    /// libtorch failed.
    fn resume(&mut self, path: &Path) -> bool;
    /// Ends the training and writes the field's weights.
    fn finish(self: Box<Self>, weights: &Path) -> anyhow::Result<()>;
}

/// A training that can't learn any more; another seed may do.
#[derive(Debug)]
pub(crate) struct Collapsed(pub(crate) String);

impl std::fmt::Display for Collapsed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Collapsed {}

/// A training that hasn't begun, from semi-transparent space or from weights that another training
/// wrote (`from`).
pub(crate) fn start(
    params: &Resolved,
    from: Option<&Path>,
    bounds: Bounds,
    device: &str,
) -> anyhow::Result<Box<dyn FieldTrainer>> {
    match &params.field {
        ResolvedField::Grid { architecture, regularisers, given } => {
            let field = match from {
                Some(weights) => {
                    let mut field =
                        Field::read(weights, *architecture, bounds).bad_input("input init")?;
                    field.limit_to_occupied();
                    field
                }
                None => Field::new(*architecture, bounds, params.seed),
            };
            let options = params.grid_training(given, regularisers);
            if device != "cpu" {
                return start_grid_on(device, &field, options);
            }
            Ok(Box::new(Trainer::new(field, options)))
        }
        #[cfg(feature = "torch")]
        ResolvedField::Mlp { architecture, density_noise_std, given } => {
            let device = nets::device(device).map_err(|e| Failure::Usage(e.to_string()))?;
            nets::deterministic();
            let field = match from {
                Some(weights) => torch_field::Mlp::read(weights, *architecture, bounds, device)
                    .bad_input("input init")?,
                None => torch_field::Mlp::new(*architecture, bounds, params.seed, device)?,
            };
            Ok(Box::new(torch_field::MlpTrainer::new(
                field,
                params.mlp_training(given, *density_noise_std),
            )?))
        }
        #[cfg(not(feature = "torch"))]
        ResolvedField::Mlp { .. } => {
            let message = "parameter field: mlp needs libtorch, and train-ss was built without \
                it; run `make build`";
            Err(Failure::Usage(message.to_owned()).into())
        }
    }
}

/// A field from weights that a training wrote.
pub(crate) fn read(
    model: FieldModel,
    bounds: Bounds,
    weights: &Path,
    device: &str,
) -> anyhow::Result<Box<dyn RayField>> {
    match model {
        FieldModel::Grid(architecture) => Ok(Box::new(Field::read(weights, architecture, bounds)?)),
        #[cfg(feature = "torch")]
        FieldModel::Mlp(architecture) => {
            let device = nets::device(device).map_err(|e| Failure::Usage(e.to_string()))?;
            Ok(Box::new(torch_field::Mlp::read(weights, architecture, bounds, device)?))
        }
        #[cfg(not(feature = "torch"))]
        FieldModel::Mlp(_) => {
            anyhow::bail!("a field of networks can't be read for {device}: there is no libtorch")
        }
    }
}

/// Makes trained weights the mean of those and of the ones that the training went on from: what
/// either makes up evens out, as if both fields were rendered, and little is lost of what was known
/// before.
pub(crate) fn average(
    model: FieldModel,
    bounds: Bounds,
    from: &Path,
    trained: &Path,
) -> anyhow::Result<()> {
    match model {
        FieldModel::Grid(architecture) => {
            let mut field = Field::read(trained, architecture, bounds)?;
            field.average_with(&Field::read(from, architecture, bounds)?);
            field.write(trained)?;
        }
        #[cfg(feature = "torch")]
        FieldModel::Mlp(architecture) => {
            let device = nets::device("cpu")?;
            let read = |path| torch_field::Mlp::read(path, architecture, bounds, device);
            let field = read(trained)?;
            field.average_with(&read(from)?)?;
            field.write(trained)?;
        }
        #[cfg(not(feature = "torch"))]
        FieldModel::Mlp(_) => {} // Nor could it be trained.
    }
    Ok(())
}

/// The same grid and the same training through libtorch.
#[cfg(feature = "torch")]
fn start_grid_on(
    device: &str,
    field: &Field,
    options: TrainingOptions,
) -> anyhow::Result<Box<dyn FieldTrainer>> {
    let device = nets::device(device).map_err(|e| Failure::Usage(e.to_string()))?;
    nets::deterministic();
    Ok(Box::new(torch_field::GridTrainer::new(field, options, device)?))
}

#[cfg(not(feature = "torch"))]
fn start_grid_on(
    device: &str,
    _: &Field,
    _: TrainingOptions,
) -> anyhow::Result<Box<dyn FieldTrainer>> {
    let message = format!(
        "--device {device}: it needs libtorch, and train-ss was built without it; run `make build`"
    );
    Err(Failure::Usage(message).into())
}

/// What all trainers have by the same names.
macro_rules! forwarded {
    () => {
        fn steps(&self) -> u64 {
            Self::steps(self)
        }

        fn rays_done(&self) -> u64 {
            Self::rays_done(self)
        }

        fn checkpoint_step(&self, path: &Path) -> Option<u64> {
            Self::checkpoint_step(path).ok()
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
        Self::step(self, supervision).map_err(|e| match e {
            TrainingError::NotFinite { .. } => Failure::Numerical(e.to_string()).into(),
        })
    }

    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>> {
        Ok(Box::new(Self::field(self)))
    }

    forwarded!();

    fn finish(self: Box<Self>, weights: &Path) -> anyhow::Result<()> {
        let steps = Self::steps(&self);
        write_grid(Self::finish(*self), steps, weights)
    }
}

fn write_grid(mut field: Field, steps: u64, weights: &Path) -> anyhow::Result<()> {
    if !field.is_finite() {
        return Err(Failure::Numerical(format!(
            "step {steps}: a parameter is not finite; lower the rate"
        ))
        .into());
    }
    field.remove_specks();
    field.write(weights).context("cannot write the field")
}

#[cfg(feature = "torch")]
impl FieldTrainer for torch_field::GridTrainer {
    fn step(&mut self, supervision: &mut Supersampling) -> anyhow::Result<Option<StepReport>> {
        Self::step(self, supervision).map_err(numerical)
    }

    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>> {
        Ok(Box::new(Self::field(self)?))
    }

    forwarded!();

    fn finish(self: Box<Self>, weights: &Path) -> anyhow::Result<()> {
        write_grid(self.field()?, Self::steps(&self), weights)
    }
}

/// What libtorch's trainings end with.
#[cfg(feature = "torch")]
fn numerical(error: torch_field::TorchFieldError) -> anyhow::Error {
    match error {
        torch_field::TorchFieldError::NotFinite { .. } => {
            Failure::Numerical(error.to_string()).into()
        }
        torch_field::TorchFieldError::Collapsed { .. } => Collapsed(error.to_string()).into(),
        _ => error.into(),
    }
}

#[cfg(feature = "torch")]
impl FieldTrainer for torch_field::MlpTrainer {
    fn step(&mut self, supervision: &mut Supersampling) -> anyhow::Result<Option<StepReport>> {
        Self::step(self, supervision).map_err(numerical)
    }

    fn field(&self) -> anyhow::Result<Box<dyn RayField + '_>> {
        Ok(Box::new(Self::field(self)))
    }

    forwarded!();

    fn finish(self: Box<Self>, weights: &Path) -> anyhow::Result<()> {
        Self::field(&self).write(weights).context("cannot write the field")
    }
}

#[cfg(test)]
mod tests {
    use radiance::Architecture;

    use super::*;

    /// A small field with two thin cells, one of them beside an opaque cell.
    fn field() -> Field {
        let architecture = Architecture { levels: 2, log2_entries: 8, ..Architecture::default() };
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 2.0, far: 6.0, ..Bounds::default() };
        let mut field = Field::new(architecture, bounds, 1);
        let (.., occupancy) = field.parts_mut();
        let (mut density, mut cells) =
            (occupancy.density().to_vec(), vec![0; occupancy.density().len()]);
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
        write_grid(field(), 7, &path).unwrap();
        let read = Field::read(&path, architecture, bounds).unwrap();
        let (.., occupancy) = read.parts();
        let cells = occupancy.to_bytes();
        let held: Vec<usize> = (0..cells.len()).filter(|&cell| cells[cell] != 0).collect();
        assert_eq!(held, [5000, 5001]);
    }

    #[test]
    fn a_parameter_that_is_not_finite_is_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        let mut field = field();
        field.parts_mut().0[3] = f32::NAN;
        let error = write_grid(field, 7, &path).unwrap_err();
        assert!(matches!(error.downcast_ref::<Failure>(), Some(Failure::Numerical(_))));
        assert!(!path.exists());
    }
}
