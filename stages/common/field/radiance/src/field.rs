use std::path::Path;

use numerics::CounterRng;
use safetensors::{Dtype, SafeTensors};
use scene::Bounds;

use crate::aligned::Aligned;
use crate::architecture::Architecture;
use crate::grid::{Level, levels};
use crate::mlp::Layers;
use crate::occupancy::{CELLS, Cell, Occupancy};
use crate::spec::FEATURES;
use crate::tensors::{FieldError, floats, read_tensor, read_tensors, write_tensors};
use numerics::simd::LANES;

/// Radiance field: density and view-dependent colour at every point of the unit cube.
#[derive(Clone, Debug)]
pub struct Field {
    /// Sizes of grid and networks.
    pub architecture: Architecture,
    /// Bounds of the scene, in scene units.
    pub bounds: Bounds,
    pub(crate) levels: Vec<Level>,
    pub(crate) layers: Layers,
    pub(crate) grid: Aligned,
    pub(crate) network: Aligned,
    pub(crate) occupancy: Occupancy,
}

impl Field {
    /// Creates an untrained field with random parameters.
    pub fn new(architecture: Architecture, bounds: Bounds, seed: u64) -> Self {
        let mut field = Self::empty(architecture, bounds);
        for (i, value) in field.grid.iter_mut().enumerate() {
            *value = 2e-4 * (numerics::uniform(seed, 1, i as u64) - 0.5);
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
        let layers = Layers::new(levels.len() * FEATURES, architecture.hidden_dim as usize);
        let grid = Aligned::zeros(architecture.grid_len());
        // The optimiser takes whole vectors.
        let network = Aligned::zeros(layers.len().next_multiple_of(LANES));
        Self { architecture, bounds, levels, layers, grid, network, occupancy: Occupancy::full() }
    }

    /// Returns the distance between samples, in cube sides.
    pub fn march_step(&self) -> f32 {
        self.architecture.march_step()
    }

    /// Returns the number of floats in the grid.
    pub fn grid_len(&self) -> usize {
        self.grid.len()
    }

    /// Returns grid entries, network weights and occupancy, for torch-field's hash grid. Grid
    /// entries are ordered by level; weights by layer and input, padded with 0 to whole vectors.
    pub fn parts(&self) -> (&[f32], &[f32], &Occupancy) {
        (&self.grid, &self.network, &self.occupancy)
    }

    /// Returns the mutable parts of [`Field::parts`].
    pub fn parts_mut(&mut self) -> (&mut [f32], &mut [f32], &mut Occupancy) {
        (&mut self.grid, &mut self.network, &mut self.occupancy)
    }

    /// Returns the number of multiplications of the density network per sample of a forward pass; a
    /// backward pass has twice as many.
    pub fn density_multiplications(&self) -> usize {
        self.layers.density.iter().map(|l| l.inputs * l.outputs).sum()
    }

    /// Replaces every parameter by the mean of this field's and of `other`'s, a field of the same
    /// architecture; the occupancy is unchanged. If one field was fine-tuned from the other, the
    /// result renders nearly the mean of both renders (Wortsman et al. 2022, "Robust fine-tuning").
    pub fn average_with(&mut self, other: &Self) {
        for (own, other) in [(&mut self.grid, &other.grid), (&mut self.network, &other.network)] {
            for i in 0..own.len().min(other.len()) {
                own[i] = 0.5 * (own[i] + other[i]);
            }
        }
    }

    /// Limits fine-tuning of this field to its occupied cells and their neighbours. All other cells
    /// are empty in the images, or unseen. If fine-tuning could occupy these cells, they would fill
    /// with density of the background's colour.
    pub fn limit_to_occupied(&mut self) {
        self.occupancy.limit_to_occupied();
    }

    /// Limits training of this field to a mask of occupancy cells, 128³ over the unit cube, x
    /// fastest.
    ///
    /// # Panics
    /// If the mask has another length.
    pub fn limit_to(&mut self, cells: Vec<bool>) {
        assert_eq!(cells.len(), CELLS, "length of the mask of occupancy cells");
        self.occupancy.limit_to(cells);
    }

    /// Returns whether every parameter is finite.
    pub fn is_finite(&self) -> bool {
        self.grid.iter().chain(&*self.network).all(|x| x.is_finite())
    }

    /// Writes a safetensors file: `grid`, `network` (f32) and `occupancy` (u8, 128³, x fastest: 0
    /// empty, 1 thin, 2 dense). It has no metadata, so equal fields have equal bytes.
    pub fn write(&self, path: &Path) -> Result<(), FieldError> {
        let occupancy = self.occupancy.to_bytes();
        let occupancy = ("occupancy", Dtype::U8, &occupancy[..]);
        write_tensors(
            path,
            &[floats("grid", &self.grid), floats("network", &self.network), occupancy],
        )
    }

    /// Reads a file of [`Field::write`]; sizes must match the architecture, numbers must be finite.
    pub fn read(
        path: &Path,
        architecture: Architecture,
        bounds: Bounds,
    ) -> Result<Self, FieldError> {
        read_tensors(path, |tensors| {
            architecture.check().map_err(|error| error.0)?;
            if !bounds.is_valid() {
                return Err(format!("bounds {bounds:?} are empty or not finite"));
            }
            Self::from_tensors(tensors, architecture, bounds)
        })
    }

    fn from_tensors(
        tensors: &SafeTensors<'_>,
        architecture: Architecture,
        bounds: Bounds,
    ) -> Result<Self, String> {
        let mut field = Self::empty(architecture, bounds);
        read_tensor(tensors, "grid", Dtype::F32, &mut field.grid)?;
        read_tensor(tensors, "network", Dtype::F32, &mut field.network)?;
        let mut occupancy = vec![0u8; CELLS];
        read_tensor(tensors, "occupancy", Dtype::U8, &mut occupancy)?;
        field.occupancy.set(|cell| Cell::from_byte(occupancy[cell]));
        if !field.is_finite() {
            return Err("a parameter is not finite".to_owned());
        }
        Ok(field)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameters(field: &Field) -> Vec<f32> {
        field.grid.iter().chain(&*field.network).copied().collect()
    }

    /// Every parameter is the mean of both fields' parameters; the occupancy stays unchanged.
    #[test]
    fn fields_are_averaged() {
        let architecture = Architecture {
            max_resolution: 32,
            n_levels: 4,
            log2_hashmap_size: 10,
            march_steps: 64,
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
