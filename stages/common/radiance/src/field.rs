use std::path::Path;

use counter_rng::CounterRng;
use safetensors::SafeTensors;
use scene::Bounds;

use crate::aligned::Aligned;
use crate::architecture::Architecture;
use crate::grid::{Level, levels};
use crate::mlp::Layers;
use crate::occupancy::{CELLS, Cell, Occupancy};
use crate::simd::LANES;
use crate::spec::FEATURES;
use crate::tensors::{FieldError, FieldProblem, Tensor, read_f32, read_u8, write_tensors};

/// A radiance field: density and view-dependent colour of every point of a box.
#[derive(Clone, Debug)]
pub struct Field {
    /// What it is made of.
    pub architecture: Architecture,
    /// Where it lies.
    pub bounds: Bounds,
    pub(crate) levels: Vec<Level>,
    pub(crate) layers: Layers,
    pub(crate) grid: Aligned,
    pub(crate) network: Aligned,
    pub(crate) occupancy: Occupancy,
}

impl Field {
    /// A field before training: faint density, drawn from a seed.
    pub fn new(architecture: Architecture, bounds: Bounds, seed: u64) -> Self {
        let mut field = Self::empty(architecture, bounds);
        for (i, value) in field.grid.iter_mut().enumerate() {
            *value = 2e-4 * (counter_rng::uniform(seed, 1, i as u64) - 0.5);
        }
        let mut rng = CounterRng::new(seed, 2, 0);
        for layer in field.layers.all() {
            // He et al. 2015, uniform.
            let bound = (6.0 / layer.inputs as f32).sqrt();
            for value in &mut field.network[layer.range()] {
                *value = bound * (2.0 * rng.uniform() - 1.0);
            }
        }
        field
    }

    fn empty(architecture: Architecture, bounds: Bounds) -> Self {
        let levels = levels(&architecture);
        let layers = Layers::new(levels.len() * FEATURES, architecture.hidden as usize);
        let grid = Aligned::zeros(architecture.grid_len());
        // Whole vectors, for the optimiser.
        let network = Aligned::zeros(layers.len().next_multiple_of(LANES));
        Self { architecture, bounds, levels, layers, grid, network, occupancy: Occupancy::full() }
    }

    /// Distance between samples, in cube sides.
    pub fn step(&self) -> f32 {
        self.architecture.step()
    }

    /// Share of the cells that may hold something.
    pub fn occupied(&self) -> f64 {
        self.occupancy.cells().count() as f64 / CELLS as f64
    }

    /// Numbers in the grid.
    pub fn grid_len(&self) -> usize {
        self.grid.len()
    }

    /// The grid's entries, level by level; the networks' weights, layer by layer, each input by
    /// input, filled up with 0 to whole vectors; and where there may be something: for whoever
    /// renders or trains them elsewhere.
    pub fn parts(&self) -> (&[f32], &[f32], &Occupancy) {
        (&self.grid, &self.network, &self.occupancy)
    }

    /// The same, to be changed.
    pub fn parts_mut(&mut self) -> (&mut [f32], &mut [f32], &mut Occupancy) {
        (&mut self.grid, &mut self.network, &mut self.occupancy)
    }

    /// Multiplications of the density network for one sample, forward; backward takes twice as
    /// many.
    pub fn network_multiplications(&self) -> usize {
        self.layers.density.iter().map(|l| l.inputs * l.outputs).sum()
    }

    /// Makes every parameter the mean of its own and of another field's of the same architecture.
    /// Where one was trained on from the other, that is nearly what the mean of both's colours is
    /// (Wortsman et al. 2022, "Robust fine-tuning"). Where there may be something stays as it is.
    pub fn average_with(&mut self, other: &Self) {
        let own = self.grid.iter_mut().chain(&mut *self.network);
        own.zip(other.grid.iter().chain(&*other.network))
            .for_each(|(own, other)| *own = 0.5 * (*own + other));
    }

    /// Keeps a training that goes on from this field to the cells that may hold something, and
    /// those around them. Elsewhere no image says anything, or that there is nothing: opened again,
    /// it would fill with what is as bright as the background, which images taken before it don't
    /// show.
    pub fn limit_to_occupied(&mut self) {
        self.occupancy.limit_to_occupied();
    }

    /// Keeps a training that starts from this field to some cells of the occupancy, 128³ over the
    /// unit cube, x fastest.
    ///
    /// # Panics
    /// When there aren't so many.
    pub fn limit_to(&mut self, cells: Vec<bool>) {
        assert_eq!(cells.len(), CELLS, "a cell of the occupancy each");
        self.occupancy.limit_to(cells);
    }

    /// Whether every parameter is finite.
    pub fn is_finite(&self) -> bool {
        self.grid.iter().chain(&*self.network).all(|x| x.is_finite())
    }

    /// Writes a safetensors file: `grid`, `network` (f32) and `occupancy` (u8, 128³, x fastest: 0
    /// empty, 1 thin, 2 dense). No metadata, so bytes repeat.
    pub fn write(&self, path: &Path) -> Result<(), FieldError> {
        let occupancy = self.occupancy.to_bytes();
        write_tensors(
            path,
            &[
                ("grid", Tensor::F32(&self.grid)),
                ("network", Tensor::F32(&self.network)),
                ("occupancy", Tensor::U8(&occupancy)),
            ],
        )
    }

    /// Reads what [`Field::write`] wrote; sizes must fit the architecture and numbers be finite.
    pub fn read(
        path: &Path,
        architecture: Architecture,
        bounds: Bounds,
    ) -> Result<Self, FieldError> {
        let format = |reason| FieldError::Format { path: path.to_path_buf(), reason };
        check(&architecture, &bounds).map_err(format)?;
        let bytes = std::fs::read(path)
            .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })?;
        Self::from_tensors(&bytes, architecture, bounds).map_err(format)
    }

    fn from_tensors(
        bytes: &[u8],
        architecture: Architecture,
        bounds: Bounds,
    ) -> Result<Self, FieldProblem> {
        let tensors = SafeTensors::deserialize(bytes)?;
        let mut field = Self::empty(architecture, bounds);
        read_f32(&tensors, "grid", &mut field.grid)?;
        read_f32(&tensors, "network", &mut field.network)?;
        let occupancy = read_u8(&tensors, "occupancy", CELLS)?;
        field.occupancy.set(|cell| Cell::from_byte(occupancy[cell]));
        if !field.is_finite() {
            return Err(FieldProblem::NotFinite);
        }
        Ok(field)
    }
}

fn check(architecture: &Architecture, bounds: &Bounds) -> Result<(), FieldProblem> {
    architecture.check()?;
    if !bounds.is_valid() {
        return Err(FieldProblem::NoInside(Box::new(*bounds)));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameters(field: &Field) -> Vec<f32> {
        field.grid.iter().chain(&*field.network).copied().collect()
    }

    /// Every parameter is the mean of both fields', and rays are stopped where the field's own
    /// were.
    #[test]
    fn fields_are_averaged() {
        let architecture = Architecture {
            finest: 32,
            levels: 4,
            log2_entries: 10,
            steps: 64,
            ..Architecture::default()
        };
        let [mut mean, own, other] =
            [3, 3, 4].map(|seed| Field::new(architecture, Bounds::default(), seed));
        mean.occupancy.set(|cell| if cell % 3 == 0 { Cell::Thin } else { Cell::Empty });
        mean.average_with(&other);
        let expected = parameters(&own)
            .into_iter()
            .zip(parameters(&other))
            .map(|(own, other)| 0.5 * (own + other));
        assert!(
            parameters(&mean).into_iter().eq(expected) && parameters(&own) != parameters(&other)
        );
        assert!(mean.occupancy.cells().all(|cell| cell % 3 == 0));
    }
}
