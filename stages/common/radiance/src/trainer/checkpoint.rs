use std::path::Path;

use safetensors::SafeTensors;

use super::{Moments, Trainer};
use crate::occupancy::CELLS;
use crate::tally::Tally;
use crate::tensors::{FieldError, FieldProblem, Tensor, read_f32, read_u8, write_tensors};

impl Trainer {
    /// Writes all that a resumed training needs to end in the same bytes. The caller makes it
    /// atomic.
    pub fn write_checkpoint(&self, path: &Path) -> Result<(), FieldError> {
        let counters = self.tally.counters().into_iter().chain([self.samples_per_ray.to_bits()]);
        let counters: Vec<u8> = counters.flat_map(u64::to_le_bytes).collect();
        let occupied = self.field.occupancy.to_bytes();
        let average = self.average.iter();
        let average = average.flat_map(|a| {
            [("average.grid", Tensor::F32(&a.grid)), ("average.network", Tensor::F32(&a.network))]
        });
        let tensors: Vec<_> = average
            .chain([
                ("counters", Tensor::U8(&counters)),
                ("density", Tensor::F32(self.field.occupancy.density())),
                ("first.grid", Tensor::F32(&self.first.grid)),
                ("first.network", Tensor::F32(&self.first.network)),
                ("grid", Tensor::F32(&self.field.grid)),
                ("network", Tensor::F32(&self.field.network)),
                ("occupied", Tensor::U8(&occupied)),
                ("second.grid", Tensor::F32(&self.second.grid)),
                ("second.network", Tensor::F32(&self.second.network)),
            ])
            .collect();
        write_tensors(path, &tensors)
    }

    /// The step a checkpoint was written at.
    pub fn checkpoint_step(path: &Path) -> Result<u64, FieldError> {
        read_counters(path, |_, counters| Ok(counters[0]))
    }

    /// Goes on from a checkpoint of a trainer made with the same field and options. After an error
    /// the trainer is as it was.
    pub fn resume(&mut self, path: &Path) -> Result<(), FieldError> {
        read_counters(path, |tensors, counters| {
            let field = &mut self.field;
            let moments = |name: &str| {
                let mut moments = Moments::zeros(field);
                read_f32(tensors, &format!("{name}grid"), &mut moments.grid)?;
                read_f32(tensors, &format!("{name}network"), &mut moments.network)?;
                Ok::<_, FieldProblem>(moments)
            };
            let (first, second, weights) = (moments("first.")?, moments("second.")?, moments("")?);
            let is_averaged = tensors.names().contains(&"average.grid");
            let average = is_averaged.then(|| moments("average.")).transpose()?;
            let mut density = vec![0.0; CELLS];
            read_f32(tensors, "density", &mut density)?;
            let occupied = read_u8(tensors, "occupied", CELLS)?;
            // Nothing fails from here on.
            (self.first, self.second, self.average) = (first, second, average);
            (field.grid, field.network) = (weights.grid, weights.network);
            field.occupancy.restore(density, &occupied);
            let [tally @ .., samples_per_ray] = counters;
            self.tally = Tally::from_counters(tally);
            self.samples_per_ray = f64::from_bits(samples_per_ray);
            Ok(())
        })
    }
}

/// Opens a checkpoint and reads its six counters.
fn read_counters<T>(
    path: &Path,
    then: impl FnOnce(&SafeTensors<'_>, [u64; 6]) -> Result<T, FieldProblem>,
) -> Result<T, FieldError> {
    let bytes = std::fs::read(path)
        .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })?;
    counters_of(&bytes, then)
        .map_err(|reason| FieldError::Format { path: path.to_path_buf(), reason })
}

/// The same of a checkpoint's bytes.
fn counters_of<T>(
    bytes: &[u8],
    then: impl FnOnce(&SafeTensors<'_>, [u64; 6]) -> Result<T, FieldProblem>,
) -> Result<T, FieldProblem> {
    let tensors = SafeTensors::deserialize(bytes)?;
    let counters = read_u8(&tensors, "counters", 48)?;
    then(&tensors, std::array::from_fn(|i| u64::from_le_bytes(counters.as_chunks::<8>().0[i])))
}
