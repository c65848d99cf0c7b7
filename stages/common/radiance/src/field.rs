use std::borrow::Cow;
use std::path::{Path, PathBuf};

use counter_rng::CounterRng;
use rayon::prelude::*;
use safetensors::tensor::{Dtype, SafeTensors, View};
use scene::Bounds;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::chunk::Chunk;
use crate::field_file::in_ranges;
use crate::grid::{Level, levels};
use crate::mlp::Layer;
use crate::occupancy::{CELLS, Cell, Occupancy, Strides};
use crate::ray::{Ray, clip};
use crate::spec::{DENSITY_OUTPUTS, FEATURES, VIEW_INPUTS};

/// What a field is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Architecture {
    /// Levels of the grid.
    pub levels: u32,
    /// Cells along an axis of the coarsest level.
    pub coarsest: u32,
    /// Cells along an axis of the finest level.
    pub finest: u32,
    /// Cells along z at most, of any level: in NDC rays run along z, and cells that lie closer than
    /// their samples learn little each.
    pub finest_z: u32,
    /// Base-2 logarithm of the most entries a level may have; finer levels are hashed.
    pub log2_entries: u32,
    /// Width of the hidden layers.
    pub hidden: u32,
    /// Samples along the diagonal of the unit cube.
    pub steps: u32,
}

/// Cells along an axis, at most.
const MOST_CELLS: u32 = 4096;

impl Default for Architecture {
    fn default() -> Self {
        Self {
            levels: 8,
            coarsest: 16,
            finest: 256,
            finest_z: MOST_CELLS,
            log2_entries: 17,
            hidden: 64,
            steps: 512,
        }
    }
}

impl Architecture {
    /// Says which number can't be.
    pub fn check(&self) -> Result<(), String> {
        let ranges = [
            ("levels", self.levels, 1, 16),
            ("coarsest", self.coarsest, 2, 512),
            ("finest", self.finest, self.coarsest, MOST_CELLS),
            ("finest_z", self.finest_z, 2, MOST_CELLS),
            ("log2_entries", self.log2_entries, 8, 22),
            ("hidden", self.hidden, 16, 128),
            ("steps", self.steps, 16, 8192),
        ];
        in_ranges(&ranges)
    }

    /// Numbers in the grid of a field with this architecture.
    pub fn grid_len(&self) -> usize {
        levels(self).last().map_or(0, |level| level.range().end)
    }

    /// Samples of a ray through all of the cube, more or less: what a training expects before it
    /// has seen any.
    pub fn full_ray(&self) -> f64 {
        f64::from(self.steps) * 0.6
    }
}

/// A radiance field: density and view-dependent colour of every point of a box.
#[derive(Clone, Debug)]
pub struct Field {
    /// What it is made of.
    pub architecture: Architecture,
    /// Where it lies.
    pub bounds: Bounds,
    pub(crate) levels: Vec<Level>,
    pub(crate) layers: Layers,
    pub(crate) grid: Vec<f32>,
    pub(crate) network: Vec<f32>,
    pub(crate) occupancy: Occupancy,
}

/// The five layers of the two networks: a sample's features → raw density, raw colour and view
/// features; a ray's composited view features and direction → what is added to the raw colours of
/// its samples.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layers {
    pub(crate) density: [Layer; 2],
    pub(crate) view: [Layer; 3],
}

impl Layers {
    fn new(features: usize, hidden: usize) -> Self {
        let mut offset = 0;
        let mut layer = |inputs, outputs| {
            let layer = Layer { inputs, outputs, offset };
            offset += inputs * outputs;
            layer
        };
        Self {
            density: [layer(features, hidden), layer(hidden, DENSITY_OUTPUTS)],
            view: [layer(VIEW_INPUTS, hidden), layer(hidden, hidden), layer(hidden, 3)],
        }
    }

    pub(crate) fn all(&self) -> [Layer; 5] {
        let ([a, b], [c, d, e]) = (self.density, self.view);
        [a, b, c, d, e]
    }

    fn len(&self) -> usize {
        self.view[2].range().end
    }
}

/// What a ray sees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel {
    /// Colour over the ray's background.
    pub colour: [f32; 3],
    /// Colour of the scene alone, weighted by opacity (premultiplied).
    pub premultiplied: [f32; 3],
    /// Share of the ray that is stopped.
    pub opacity: f32,
    /// Expected distance where it is stopped, in scene units; the far end where nothing stops it.
    pub depth: f32,
    /// Distance at which half of the ray is stopped; the far end where it never is.
    pub median_depth: f32,
}

impl Pixel {
    /// Whether all of it is finite.
    pub fn is_finite(&self) -> bool {
        let depths = [self.opacity, self.depth, self.median_depth];
        self.colour.iter().chain(&self.premultiplied).chain(&depths).all(|v| v.is_finite())
    }
}

/// Rays that couldn't be cast.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// What the field is computed by refused: a library, or its device.
    #[error("the field can't be rendered: {0}")]
    Backend(String),
    /// A pixel isn't finite.
    #[error("the field renders numbers that aren't finite; train it again, with a lower rate")]
    NotFinite,
}

/// Whatever rays can be cast through: what renders views needn't know which field it has.
pub trait RayField {
    /// Colour, opacity and depth of each ray.
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError>;
}

impl<F: RayField + ?Sized> RayField for &F {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        (**self).render(rays)
    }
}

impl RayField for Field {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        Ok(Self::render(self, rays))
    }
}

/// A field that can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FieldError {
    /// The file can't be opened.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file isn't a field.
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

/// Rays in one chunk: enough samples to fill the vectors, few enough to stay in the cache.
pub(crate) const CHUNK_RAYS: usize = 64;

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
        let grid = vec![0.0; architecture.grid_len()];
        // Whole vectors, for the optimiser.
        let network = vec![0.0; layers.len().next_multiple_of(crate::simd::LANES)];
        Self { architecture, bounds, levels, layers, grid, network, occupancy: Occupancy::full() }
    }

    /// Distance between samples, in cube sides.
    pub fn step(&self) -> f32 {
        3.0f32.sqrt() / self.architecture.steps as f32
    }

    /// Colour, opacity and depth of each ray, in parallel; the result doesn't depend on the number
    /// of threads.
    pub fn render(&self, rays: &[Ray]) -> Vec<Pixel> {
        rays.par_chunks(CHUNK_RAYS)
            .map_init(Chunk::default, |chunk, rays| {
                let clipped: Vec<_> = rays.iter().map(|r| clip(&self.bounds, r)).collect();
                chunk.forward(self, &clipped, &[0.5; CHUNK_RAYS][..rays.len()], Strides::Even);
                let pixel = |(i, ray): (usize, &Ray)| {
                    let sum = &chunk.sums[i];
                    let far = if clipped[i].leave > clipped[i].enter {
                        clipped[i].distance(clipped[i].leave)
                    } else {
                        self.bounds.far as f32
                    };
                    let opacity = 1.0 - sum.transmittance;
                    Pixel {
                        colour: std::array::from_fn(|c| {
                            sum.transmittance.mul_add(ray.background[c], sum.colour[c])
                        }),
                        premultiplied: sum.colour,
                        opacity,
                        depth: if sum.weight > 1e-4 { sum.distance / sum.weight } else { far },
                        median_depth: sum.median.map_or(far, |t| clipped[i].distance(t)),
                    }
                };
                rays.iter().enumerate().map(pixel).collect::<Vec<_>>()
            })
            .flatten_iter()
            .collect()
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
        let own = self.grid.iter_mut().chain(&mut self.network);
        own.zip(other.grid.iter().chain(&other.network))
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
        self.grid.iter().chain(&self.network).all(|x| x.is_finite())
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
        let format = |reason: String| FieldError::Format { path: path.to_path_buf(), reason };
        architecture.check().map_err(format)?;
        if !bounds.is_valid() {
            return Err(format(format!("the box {bounds:?} has no inside")));
        }
        let bytes = std::fs::read(path)
            .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(|e| format(e.to_string()))?;
        let mut field = Self::empty(architecture, bounds);
        read_f32(&tensors, "grid", &mut field.grid).map_err(format)?;
        read_f32(&tensors, "network", &mut field.network).map_err(format)?;
        let occupancy = read_u8(&tensors, "occupancy", CELLS).map_err(format)?;
        field.occupancy.set(|cell| Cell::from_byte(occupancy[cell]));
        if !field.is_finite() {
            return Err(format("a parameter is not finite".to_owned()));
        }
        Ok(field)
    }
}

/// A tensor to write.
pub(crate) enum Tensor<'a> {
    F32(&'a [f32]),
    U8(&'a [u8]),
}

/// A tensor with its shape, whose bytes are made when they are written: a copy of the largest
/// tensor at a time.
struct Written<'a>(&'a Tensor<'a>, [usize; 1]);

impl View for Written<'_> {
    fn dtype(&self) -> Dtype {
        match self.0 {
            Tensor::F32(_) => Dtype::F32,
            Tensor::U8(_) => Dtype::U8,
        }
    }

    fn shape(&self) -> &[usize] {
        &self.1
    }

    fn data(&self) -> Cow<'_, [u8]> {
        match self.0 {
            Tensor::F32(numbers) => {
                Cow::Owned(numbers.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            Tensor::U8(bytes) => Cow::Borrowed(bytes),
        }
    }

    fn data_len(&self) -> usize {
        match self.0 {
            Tensor::F32(numbers) => size_of_val(*numbers),
            Tensor::U8(bytes) => bytes.len(),
        }
    }
}

impl Tensor<'_> {
    fn len(&self) -> usize {
        match self {
            Self::F32(numbers) => numbers.len(),
            Self::U8(bytes) => bytes.len(),
        }
    }
}

pub(crate) fn write_tensors(path: &Path, tensors: &[(&str, Tensor<'_>)]) -> Result<(), FieldError> {
    let views = tensors.iter().map(|(name, tensor)| (*name, Written(tensor, [tensor.len()])));
    let io = |source| FieldError::Io { path: path.to_path_buf(), source };
    let whole = safetensors::serialize(views, None)
        .map_err(|e| io(std::io::Error::other(e.to_string())))?;
    std::fs::write(path, whole).map_err(io)
}

pub(crate) fn read_f32(
    tensors: &SafeTensors<'_>,
    name: &str,
    into: &mut [f32],
) -> Result<(), String> {
    let tensor = tensors.tensor(name).map_err(|e| format!("tensor {name}: {e}"))?;
    let (data, rest) = tensor.data().as_chunks::<4>();
    if tensor.dtype() != Dtype::F32 || data.len() != into.len() || !rest.is_empty() {
        return Err(format!(
            "tensor {name}: {:?} {:?} where {} f32 are expected",
            tensor.dtype(),
            tensor.shape(),
            into.len()
        ));
    }
    for (value, bytes) in into.iter_mut().zip(data) {
        *value = f32::from_le_bytes(*bytes);
    }
    Ok(())
}

pub(crate) fn read_u8(
    tensors: &SafeTensors<'_>,
    name: &str,
    len: usize,
) -> Result<Vec<u8>, String> {
    let tensor = tensors.tensor(name).map_err(|e| format!("tensor {name}: {e}"))?;
    if tensor.dtype() != Dtype::U8 || tensor.data().len() != len {
        return Err(format!(
            "tensor {name}: {:?} {:?} where {len} u8 are expected",
            tensor.dtype(),
            tensor.shape()
        ));
    }
    Ok(tensor.data().to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let all = |field: &Field| -> Vec<f32> {
            field.grid.iter().chain(&field.network).copied().collect()
        };
        let expected =
            all(&own).into_iter().zip(all(&other)).map(|(own, other)| 0.5 * (own + other));
        assert!(all(&mean).into_iter().eq(expected) && all(&own) != all(&other));
        assert!(mean.occupancy.cells().all(|cell| cell % 3 == 0));
    }
}
