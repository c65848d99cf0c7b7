use std::path::Path;

use safetensors::SafeTensors;

use super::{ParameterBuffers, Trainer};
use crate::field::Field;
use crate::occupancy::CELLS;
use crate::tensors::{
    FieldError, FieldProblem, Tensor, read_f32, read_tensors, read_u8, read_u32, write_tensors,
};
use crate::training_state::TrainingState;

impl Trainer {
    /// Writes a checkpoint from which a resumed training ends in the same bytes. Not atomic: the
    /// caller renames the file.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), FieldError> {
        let counters = self.state.counters().into_iter().chain([self.samples_per_ray.to_bits()]);
        let counters: Vec<u8> = counters.flat_map(u64::to_le_bytes).collect();
        let occupied = self.field.occupancy.to_bytes();
        let density = self.field.occupancy.densities();
        let average = self.average.iter();
        let average = average.flat_map(|a| {
            [
                ("average.grid", Tensor::of_floats(&a.grid)),
                ("average.network", Tensor::of_floats(&a.network)),
            ]
        });
        let tensors: Vec<_> = average
            .chain([
                ("counters", Tensor::of_bytes(&counters)),
                ("density", Tensor::of_floats(&density)),
                ("grid", Tensor::of_floats(&self.field.grid)),
                ("moments.grid", Tensor::of_integers(&self.moments.grid)),
                ("moments.network", Tensor::of_integers(&self.moments.network)),
                ("network", Tensor::of_floats(&self.field.network)),
                ("occupied", Tensor::of_bytes(&occupied)),
            ])
            .collect();
        write_tensors(path, &tensors)
    }

    /// Returns the step at which a checkpoint was written.
    pub fn checkpoint_step(path: &Path) -> Result<u64, FieldError> {
        read_tensors(path, |tensors| Ok(read_counters(tensors)?[0]))
    }

    /// Resumes from a checkpoint of a trainer with the same field and options. On error the trainer
    /// is unchanged.
    pub fn resume(&mut self, path: &Path) -> Result<(), FieldError> {
        read_tensors(path, |tensors| {
            let [state @ .., samples_per_ray] = read_counters(tensors)?;
            let field = &mut self.field;
            let mut moments = ParameterBuffers::zeros(field);
            read_u32(tensors, "moments.grid", &mut moments.grid)?;
            read_u32(tensors, "moments.network", &mut moments.network)?;
            let weights = read_parameters(tensors, "", field)?;
            let is_averaged = tensors.names().contains(&"average.grid");
            let average =
                is_averaged.then(|| read_parameters(tensors, "average.", field)).transpose()?;
            let mut density = vec![0.0; CELLS];
            read_f32(tensors, "density", &mut density)?;
            let occupied = read_u8(tensors, "occupied", CELLS)?;
            // Nothing fails from here on.
            (self.moments, self.average) = (moments, average);
            (field.grid, field.network) = (weights.grid, weights.network);
            field.occupancy.restore(density, &occupied);
            self.state = TrainingState::from_counters(state);
            self.samples_per_ray = f64::from_bits(samples_per_ray);
            Ok(())
        })
    }
}

/// Reads the tensors `{prefix}grid` and `{prefix}network`.
fn read_parameters(
    tensors: &SafeTensors<'_>,
    prefix: &str,
    field: &Field,
) -> Result<ParameterBuffers, FieldProblem> {
    let mut parameters = ParameterBuffers::zeros(field);
    read_f32(tensors, &format!("{prefix}grid"), &mut parameters.grid)?;
    read_f32(tensors, &format!("{prefix}network"), &mut parameters.network)?;
    Ok(parameters)
}

/// Reads a checkpoint's six counters.
fn read_counters(tensors: &SafeTensors<'_>) -> Result<[u64; 6], FieldProblem> {
    let bytes = read_u8(tensors, "counters", 48)?;
    Ok(std::array::from_fn(|i| u64::from_le_bytes(bytes.as_chunks::<8>().0[i])))
}
