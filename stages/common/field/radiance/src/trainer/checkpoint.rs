use std::path::Path;

use safetensors::{Dtype, SafeTensors};

use super::{ParameterBuffers, Trainer};
use crate::field::Field;
use crate::occupancy::CELLS;
use crate::tensors::{FieldError, floats, read_tensor, read_tensors, write_tensors};
use crate::training_state::TrainingState;

impl Trainer {
    /// Writes a checkpoint from which a resumed training ends in the same bytes. Not atomic: the
    /// caller renames the file.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), FieldError> {
        let counters = self.state.counters();
        let occupied = self.field.occupancy.to_bytes();
        let density = self.field.occupancy.densities();
        let mut tensors = vec![
            ("counters", Dtype::U64, bytemuck::cast_slice(&counters)),
            floats("density", &density),
            floats("grid", &self.field.grid),
            ("moments.grid", Dtype::U32, bytemuck::cast_slice::<u32, u8>(&self.moments.grid)),
            ("moments.network", Dtype::U32, bytemuck::cast_slice::<u32, u8>(&self.moments.network)),
            floats("network", &self.field.network),
            ("occupied", Dtype::U8, &occupied),
        ];
        if let Some(average) = &self.average {
            tensors.push(floats("average.grid", &average.grid));
            tensors.push(floats("average.network", &average.network));
        }
        write_tensors(path, &tensors)
    }

    /// Resumes from a checkpoint of a trainer with the same field and options. On error the trainer
    /// is unchanged.
    pub fn resume(&mut self, path: &Path) -> Result<(), FieldError> {
        read_tensors(path, |tensors| {
            let mut counters = [0; 6];
            read_tensor(tensors, "counters", Dtype::U64, &mut counters)?;
            let field = &mut self.field;
            let mut moments = ParameterBuffers::zeros(field);
            read_tensor(tensors, "moments.grid", Dtype::U32, &mut moments.grid)?;
            read_tensor(tensors, "moments.network", Dtype::U32, &mut moments.network)?;
            let weights = read_parameters(tensors, "", field)?;
            let is_averaged = tensors.names().contains(&"average.grid");
            let average =
                is_averaged.then(|| read_parameters(tensors, "average.", field)).transpose()?;
            let (mut density, mut occupied) = (vec![0.0; CELLS], vec![0; CELLS]);
            read_tensor(tensors, "density", Dtype::F32, &mut density)?;
            read_tensor(tensors, "occupied", Dtype::U8, &mut occupied)?;
            // Nothing fails from here on.
            (self.moments, self.average) = (moments, average);
            (field.grid, field.network) = (weights.grid, weights.network);
            field.occupancy.restore(density, &occupied);
            self.state = TrainingState::from_counters(counters);
            Ok(())
        })
    }
}

/// Reads the tensors `{prefix}grid` and `{prefix}network`.
fn read_parameters(
    tensors: &SafeTensors<'_>,
    prefix: &str,
    field: &Field,
) -> Result<ParameterBuffers, String> {
    let mut parameters = ParameterBuffers::zeros(field);
    read_tensor(tensors, &format!("{prefix}grid"), Dtype::F32, &mut parameters.grid)?;
    read_tensor(tensors, &format!("{prefix}network"), Dtype::F32, &mut parameters.network)?;
    Ok(parameters)
}
