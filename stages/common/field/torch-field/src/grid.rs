use radiance::spec::{
    BASIS, BRICK, DENSITY_OUTPUTS, FEATURES, FIRST_RAW_COLOUR, FIRST_VIEW_FEATURE, HASH_FACTORS,
    MAX_OPTICAL_DEPTH, MAX_RAW_DENSITY, MIN_HIT_WEIGHT, MIN_TOTAL_WEIGHT, MIN_TRANSMITTANCE,
    MIN_WEIGHT, OCCUPANCY_CELLS, TRAINING_ROUND_SAMPLES, VIEW_FEATURES,
};
use radiance::{
    Architecture, CellHit, Field, Occupancy, Pixel, Ray, RayField, RenderError, Strides,
};
use scene::Bounds;
use tch::{Device, IndexOp as _, Kind, TchError, Tensor, no_grad};

use crate::error::TorchFieldError;
use crate::ray_tensors::{RayTensors, matrix, multiply_add, to_host};
use crate::step::run_in_pieces;

/// The hash-grid field, [`radiance::Field`], in libtorch: an independent implementation with the
/// same parameters. It checks the hand-written field, and computes on CUDA (design note 023).
#[derive(Debug)]
pub struct TorchGrid {
    pub(crate) architecture: Architecture,
    pub(crate) bounds: Bounds,
    pub(crate) device: Device,
    pub(crate) levels: Vec<TorchLevel>,
    /// Features of all levels' entries: entries × 4.
    pub(crate) table: Tensor,
    /// Weights of the five layers: inputs × outputs each.
    pub(crate) layers: [Tensor; 5],
    /// States of the 128³ occupancy cells, x fastest: 0 is empty, 1 thin, 2 dense.
    pub(crate) cells: Tensor,
}

/// Level of the grid (Müller et al. 2022, "Instant neural graphics primitives").
#[derive(Clone, Copy, Debug)]
pub(crate) struct TorchLevel {
    /// Number of cells along each axis.
    resolution: [i64; 3],
    /// Number of bricks of 2³ vertices along each axis.
    bricks: [i64; 3],
    /// Index of the level's first entry in the table.
    first: i64,
    entries: i64,
    is_hashed: bool,
}

impl TorchLevel {
    /// Returns the level's rows of a table.
    pub(crate) fn rows(&self, table: &Tensor) -> Result<Tensor, TchError> {
        table.f_narrow(0, self.first, self.entries)
    }

    /// Finds the cells along an axis of positions in the unit cube (n × 3).
    fn cells(&self, positions: &Tensor, axis: usize) -> Result<AxisCells, TchError> {
        let cells = self.resolution[axis] as f64;
        let scaled = positions.i((.., axis as i64)).f_mul_scalar(cells)?;
        let cell = scaled.f_floor()?.f_clamp_max(cells - 1.0)?;
        let fraction = scaled.f_sub(&cell)?;
        let cell = cell.f_to_kind(Kind::Int64)?;
        Ok(AxisCells {
            vertices: [cell.shallow_clone(), cell.f_add_scalar(1)?],
            weights: [fraction.f_neg()?.f_add_scalar(1.0)?, fraction],
        })
    }

    /// Returns the table indices (n) of vertices, given their indices along each axis (n each).
    fn entry_index(&self, [x, y, z]: [&Tensor; 3]) -> Result<Tensor, TchError> {
        let (brick_x, brick_y) = (x.f_floor_divide_scalar(2)?, y.f_floor_divide_scalar(2)?);
        let brick_z = z.f_floor_divide_scalar(2)?;
        let brick = if self.is_hashed {
            let [factor_y, factor_z] = HASH_FACTORS.map(i64::from);
            brick_x
                .f_bitwise_xor_tensor(&brick_y.f_mul_scalar(factor_y)?)?
                .f_bitwise_xor_tensor(&brick_z.f_mul_scalar(factor_z)?)?
                .f_bitwise_and(self.entries / BRICK as i64 - 1)?
        } else {
            let [bricks_x, bricks_y, _] = self.bricks;
            let row = brick_z.f_mul_scalar(bricks_y)?.f_add(&brick_y)?;
            row.f_mul_scalar(bricks_x)?.f_add(&brick_x)?
        };
        let row = z.f_bitwise_and(1)?.f_mul_scalar(2)?.f_add(&y.f_bitwise_and(1)?)?;
        let within = row.f_mul_scalar(2)?.f_add(&x.f_bitwise_and(1)?)?;
        brick.f_mul_scalar(BRICK as i64)?.f_add(&within)?.f_add_scalar(self.first)
    }
}

/// Cells of n positions along an axis.
struct AxisCells {
    /// Indices of the cells' lower and upper vertices: n each.
    vertices: [Tensor; 2],
    /// Interpolation weights of these vertices: n each.
    weights: [Tensor; 2],
}

/// Samples of n rays of at most `count` steps each.
struct Marched {
    /// Parameter t of every step (n × count).
    t: Tensor,
    /// Linear indices of the steps that are samples, with their positions (… × 3) and lengths.
    kept: Tensor,
    positions: Tensor,
    length: Tensor,
    count: i64,
}

/// Sums samples' rows over each of n rays.
fn sum_by_ray(rows: &Tensor, ray: &Tensor, n: i64) -> Result<Tensor, TchError> {
    Tensor::f_zeros([n, rows.size()[1]], (Kind::Float, rows.device()))?.f_index_add(0, ray, rows)
}

/// Samples and colours of n rays.
pub(crate) struct GridForward {
    /// Premultiplied colours of the scene alone: n × 3.
    pub(crate) premultiplied: Tensor,
    /// Transmittance of each whole ray: n.
    pub(crate) transmittance: Tensor,
    /// Weights and parameters t of the steps: n × steps each.
    pub(crate) weights: Tensor,
    pub(crate) t: Tensor,
    /// True for samples that are composited: n × steps.
    pub(crate) counted: Tensor,
    /// Colours (s × 3), weights (s × 1) and ray indices (s) of the composited samples.
    pub(crate) shaded_colour: Tensor,
    pub(crate) shaded_weight: Tensor,
    pub(crate) shaded_ray: Tensor,
    /// Cells in which samples absorb light; only in training.
    pub(crate) hits: Vec<CellHit>,
    /// Number of samples that the hand-written field evaluates ([`count_marched`]); only in
    /// training.
    pub(crate) samples: usize,
    maps: RayTensors,
}

/// Returns the cells in which samples absorb light, from the samples' weights (s × 1), positions (s
/// × 3) and raw densities (s).
fn find_hits(weight: &Tensor, positions: &Tensor, raw: &Tensor) -> Result<Vec<CellHit>, TchError> {
    let hits = weight
        .f_squeeze_dim(-1)?
        .f_gt(f64::from(MIN_HIT_WEIGHT))?
        .f_nonzero()?
        .f_squeeze_dim(-1)?;
    let density = raw.f_index_select(0, &hits)?.f_clamp_max(f64::from(MAX_RAW_DENSITY))?.f_exp()?;
    let positions = to_host(&positions.f_index_select(0, &hits)?)?;
    let positions = positions.as_chunks::<3>().0;
    let densities = to_host(&density)?;
    Ok(positions.iter().zip(densities).map(|(&p, density)| CellHit::at(p, density)).collect())
}

/// Returns the levels, from the coarsest to the finest.
fn build_levels(architecture: &Architecture) -> Vec<TorchLevel> {
    let (coarsest, finest) =
        (f64::from(architecture.base_resolution), f64::from(architecture.max_resolution));
    let ratio = libm::pow(finest / coarsest, 1.0 / f64::from(architecture.n_levels.max(2) - 1));
    let mut levels = Vec::with_capacity(architecture.n_levels as usize);
    let mut first = 0;
    for i in 0..architecture.n_levels {
        let cells = (coarsest * ratio.powi(i as i32)).round() as i64;
        let resolution = [cells, cells, cells.min(i64::from(architecture.finest_z))];
        let bricks = resolution.map(|n| n / 2 + 1);
        let vertices = bricks.iter().product::<i64>() * BRICK as i64;
        let is_hashed = vertices > 1 << architecture.log2_hashmap_size;
        let entries = if is_hashed { 1 << architecture.log2_hashmap_size } else { vertices };
        levels.push(TorchLevel { resolution, bricks, first, entries, is_hashed });
        first += entries;
    }
    levels
}

/// Number of outputs of the density network.
const OUTPUTS: i64 = DENSITY_OUTPUTS as i64;

/// Returns inputs and outputs of the five layers.
fn layer_shapes(architecture: &Architecture) -> [(i64, i64); 5] {
    let features = FEATURES as i64 * i64::from(architecture.n_levels);
    let hidden = i64::from(architecture.hidden_dim);
    [
        (features, hidden),
        (hidden, OUTPUTS),
        ((VIEW_FEATURES + BASIS) as i64, hidden),
        (hidden, hidden),
        (hidden, 3),
    ]
}

/// Returns the real spherical harmonics up to degree 2 of unit directions (n × 3): n × 9.
fn harmonics(direction: &Tensor) -> Result<Tensor, TchError> {
    let [x, y, z] = [0, 1, 2].map(|i| direction.i((.., i)));
    let pi = std::f64::consts::PI;
    let (one, two) = ((3.0 / (4.0 * pi)).sqrt(), (15.0 / (4.0 * pi)).sqrt());
    Tensor::f_stack(
        &[
            x.f_full_like((1.0 / (4.0 * pi)).sqrt())?,
            y.f_mul_scalar(-one)?,
            z.f_mul_scalar(one)?,
            x.f_mul_scalar(-one)?,
            x.f_mul(&y)?.f_mul_scalar(two)?,
            y.f_mul(&z)?.f_mul_scalar(-two)?,
            z.f_square()?
                .f_mul_scalar(3.0)?
                .f_sub_scalar(1.0)?
                .f_mul_scalar((5.0 / (16.0 * pi)).sqrt())?,
            x.f_mul(&z)?.f_mul_scalar(-two)?,
            x.f_square()?.f_sub(&y.f_square()?)?.f_mul_scalar(0.5 * two)?,
        ],
        -1,
    )
}

/// Copies values to a device as a matrix that requires gradients.
fn trainable_matrix(values: &[f32], shape: [i64; 2], device: Device) -> Result<Tensor, TchError> {
    Ok(matrix(values, shape, device)?.set_requires_grad(true))
}

/// Returns optical depths up to the ends of steps, and the steps' transmittances and weights (rays
/// × count each), given the optical depths `sample_tau` of the samples `kept`.
fn optical_depths(
    sample_tau: &Tensor,
    kept: &Tensor,
    rays: i64,
    count: i64,
) -> Result<[Tensor; 3], TchError> {
    let zeros = Tensor::f_zeros([rays * count], (Kind::Float, sample_tau.device()))?;
    let tau = zeros.f_index_put(&[Some(kept)], sample_tau, false)?.f_reshape([rays, count])?;
    let through = tau.f_cumsum(1, None::<Kind>)?;
    let transmittance = through.f_sub(&tau)?.f_neg()?.f_exp()?;
    let weights = transmittance.f_mul(&tau.f_neg()?.f_expm1()?.f_neg()?)?;
    Ok([through, transmittance, weights])
}

/// Counts the samples in `kept` that a training step of the hand-written field evaluates: in rounds
/// ([`TRAINING_ROUND_SAMPLES`]), until a ray's optical depth reaches [`MAX_OPTICAL_DEPTH`].
/// `through` is the optical depth up to each step's end.
fn count_marched(through: &Tensor, kept: &Tensor) -> Result<usize, TchError> {
    let exists = through.f_zeros_like()?.f_reshape([-1])?.f_index_fill(0, kept, 1.0)?;
    let exists = exists.f_reshape_as(through)?;
    let ordinal = exists.f_cumsum(1, None::<Kind>)?;
    let [first @ .., later] = TRAINING_ROUND_SAMPLES.map(|samples| samples as i64);
    let mut end = 0;
    let mut is_end = exists.f_lt(0.0)?;
    for samples in first {
        end += samples;
        is_end = is_end.f_logical_or(&ordinal.f_eq(end)?)?;
    }
    let is_later = ordinal.f_sub_scalar(end)?.f_remainder(later)?.f_eq(0)?;
    is_end = is_end.f_logical_or(&is_later.f_logical_and(&ordinal.f_gt(end)?)?)?;
    let is_opaque =
        through.f_ge(f64::from(MAX_OPTICAL_DEPTH))?.f_logical_and(&is_end)?.f_mul(&exists)?;
    let is_over = is_opaque.f_cumsum(1, None::<Kind>)?.f_sub(&is_opaque)?.f_gt(0.0)?;
    let marched = exists.f_logical_and(&is_over.f_logical_not()?)?;
    Ok(marched.f_sum(Kind::Int64)?.f_int64_value(&[])? as usize)
}

impl TorchGrid {
    /// Copies a field's parameters and occupancy to a device.
    pub fn new(field: &Field, device: Device) -> Result<Self, TorchFieldError> {
        let (grid, network, occupancy) = field.parts();
        let levels = build_levels(&field.architecture);
        let entries: i64 = levels.iter().map(|l| l.entries).sum();
        let mut first = 0;
        let mut layers = Vec::with_capacity(5);
        for (inputs, outputs) in layer_shapes(&field.architecture) {
            let weights = &network[first..first + (inputs * outputs) as usize];
            layers.push(trainable_matrix(weights, [inputs, outputs], device)?);
            first += weights.len();
        }
        let mut copy = Self {
            architecture: field.architecture,
            bounds: field.bounds,
            device,
            levels,
            table: trainable_matrix(grid, [entries, FEATURES as i64], device)?,
            layers: layers.try_into().expect("five layers"),
            cells: Tensor::new(),
        };
        copy.set_occupancy(occupancy)?;
        Ok(copy)
    }

    /// Copies the states of the occupancy cells.
    pub(crate) fn set_occupancy(&mut self, occupancy: &Occupancy) -> Result<(), TchError> {
        self.cells = Tensor::f_from_slice(&occupancy.to_bytes())?.f_to_device(self.device)?;
        Ok(())
    }

    /// Returns handles to the table and the five layers.
    pub(crate) fn parameters(&self) -> Vec<Tensor> {
        std::iter::once(&self.table).chain(&self.layers).map(Tensor::shallow_clone).collect()
    }

    /// Returns the distance between samples in sides of the cube.
    pub(crate) fn march_step(&self) -> f64 {
        f64::from(self.architecture.march_step())
    }

    /// Returns densities, per side of the cube, at positions in the unit cube (n × 3).
    pub(crate) fn densities(&self, positions: &Tensor) -> Result<Tensor, TchError> {
        no_grad(|| {
            self.outputs(positions)?.i((.., 0)).f_clamp_max(f64::from(MAX_RAW_DENSITY))?.f_exp()
        })
    }

    /// Returns outputs of the density network at positions (n × 3): n × 16.
    fn outputs(&self, positions: &Tensor) -> Result<Tensor, TchError> {
        self.encode(positions)?.f_matmul(&self.layers[0])?.f_relu()?.f_matmul(&self.layers[1])
    }

    /// Interpolates the features at positions in the unit cube (n × 3): n × 4·levels.
    fn encode(&self, positions: &Tensor) -> Result<Tensor, TchError> {
        let mut features = Vec::with_capacity(self.levels.len());
        let positions = positions.f_clamp(0.0, 1.0)?;
        for level in &self.levels {
            let x = level.cells(&positions, 0)?;
            let y = level.cells(&positions, 1)?;
            let z = level.cells(&positions, 2)?;
            let mut sum: Option<Tensor> = None;
            for corner in 0..8 {
                let [i, j, k] = [corner & 1, corner >> 1 & 1, corner >> 2];
                let weight = z.weights[k].f_mul(&y.weights[j].f_mul(&x.weights[i])?)?;
                let vertex = [&x.vertices[i], &y.vertices[j], &z.vertices[k]];
                let entry = self.table.f_index_select(0, &level.entry_index(vertex)?)?;
                let weighted = entry.f_mul(&weight.f_unsqueeze(-1)?)?;
                sum = Some(match sum {
                    None => weighted,
                    Some(sum) => sum.f_add(&weighted)?,
                });
            }
            features.push(sum.expect("eight corners"));
        }
        Tensor::f_cat(&features, -1)
    }

    /// Marches rays, with samples shifted by `offsets` (n) of a step, and composites the samples.
    pub(crate) fn forward(
        &self,
        rays: &[Ray],
        offsets: &Tensor,
        strides: Strides,
    ) -> Result<GridForward, TchError> {
        let n = rays.len() as i64;
        let maps = RayTensors::new(&self.bounds, rays, self.device)?;
        let Marched { t, kept, positions, length, count } = self.march(&maps, offsets, strides)?;

        let outputs = self.outputs(&positions)?;
        let tau =
            outputs.i((.., 0)).f_clamp_max(f64::from(MAX_RAW_DENSITY))?.f_exp()?.f_mul(&length)?;
        // Samples that are not composited get no gradient.
        let counted = no_grad(|| -> Result<Tensor, TchError> {
            let [_, transmittance, weights] = optical_depths(&tau, &kept, n, count)?;
            transmittance
                .f_gt(f64::from(MIN_TRANSMITTANCE))?
                .f_logical_and(&weights.f_gt(f64::from(MIN_WEIGHT))?)
        })?;
        let is_counted = counted.f_reshape([-1])?.f_index_select(0, &kept)?;
        let tau = tau.f_where_self(&is_counted, &tau.f_detach()?)?;
        let [through, _, weights] = optical_depths(&tau, &kept, n, count)?;

        let shaded = is_counted.f_nonzero()?.f_squeeze_dim(-1)?;
        let step = kept.f_index_select(0, &shaded)?;
        let ray = step.f_div_scalar_mode(count, "floor")?;
        let weight = weights.f_reshape([-1])?.f_index_select(0, &step)?.f_unsqueeze(-1)?;
        let outputs = outputs.f_index_select(0, &shaded)?;
        let (hits, samples) = match strides {
            // Rendering needs neither.
            Strides::Single => (Vec::new(), 0),
            Strides::ByCell | Strides::Double => no_grad(|| -> Result<_, TchError> {
                let positions = positions.f_index_select(0, &shaded)?;
                let hits = find_hits(&weight, &positions, &outputs.i((.., 0)))?;
                Ok((hits, count_marched(&through, &kept)?))
            })?,
        };
        let colour = self.shade(&maps, &outputs, &weight, &ray, n)?;
        Ok(GridForward {
            premultiplied: sum_by_ray(&weight.f_mul(&colour)?, &ray, n)?,
            transmittance: through.i((.., count - 1)).f_neg()?.f_exp()?,
            weights,
            t,
            counted,
            shaded_colour: colour,
            shaded_weight: weight,
            shaded_ray: ray,
            hits,
            samples,
            maps,
        })
    }

    /// Returns the samples of rays in occupied cells.
    fn march(
        &self,
        maps: &RayTensors,
        offsets: &Tensor,
        strides: Strides,
    ) -> Result<Marched, TchError> {
        let longest = maps.leave.f_sub(&maps.enter)?.f_max()?.f_double_value(&[])?;
        let count = ((longest / self.march_step()).ceil() as i64).max(1);
        let steps = Tensor::f_arange(count, (Kind::Float, self.device))?;
        let k = steps.f_add(&offsets.f_unsqueeze(-1)?)?;
        let step = k.f_full_like(self.march_step())?;
        let t = multiply_add(&k, &step, &maps.enter)?;
        let states = self
            .cell_states(&maps.positions(&t)?)?
            .f_where_self(&t.f_lt_tensor(&maps.leave)?, &t.f_zeros_like()?)?;
        // With double strides every other step is one sample, in the middle of two steps.
        let is_double = match strides {
            // False everywhere.
            Strides::Single => states.f_lt(0.0)?,
            Strides::ByCell => states.f_eq(1.0)?,
            Strides::Double => states.f_gt(0.0)?,
        };
        let middle = multiply_add(&k.f_add_scalar(0.5)?, &step, &maps.enter)?;
        let t = middle.f_where_self(&is_double, &t)?;
        let length = is_double.f_to_kind(Kind::Float)?.f_add_scalar(1.0)?;
        let is_odd = steps.f_remainder(2.0)?.f_ne(0.0)?;
        let inside = states.f_gt(0.0)?.f_logical_and(&t.f_lt_tensor(&maps.leave)?)?;
        let inside = inside.f_logical_and(&is_double.f_logical_and(&is_odd)?.f_logical_not()?)?;
        let kept = inside.f_reshape([-1])?.f_nonzero()?.f_squeeze_dim(-1)?;
        let positions = maps.positions(&t)?.f_reshape([-1, 3])?.f_index_select(0, &kept)?;
        let length =
            length.f_reshape([-1])?.f_index_select(0, &kept)?.f_mul_scalar(self.march_step())?;
        Ok(Marched { t, kept, positions, length, count })
    }

    /// Returns the colours of composited samples: the sigmoid of the sample's own raw colour plus
    /// its ray's (deferred shading).
    fn shade(
        &self,
        maps: &RayTensors,
        outputs: &Tensor,
        weight: &Tensor,
        ray: &Tensor,
        rays: i64,
    ) -> Result<Tensor, TchError> {
        let features = outputs.f_narrow(1, FIRST_VIEW_FEATURE as i64, VIEW_FEATURES as i64)?;
        let features = sum_by_ray(&weight.f_mul(&features)?, ray, rays)?;
        let input = Tensor::f_cat(&[&features, &harmonics(&maps.view)?], -1)?;
        let hidden =
            input.f_matmul(&self.layers[2])?.f_relu()?.f_matmul(&self.layers[3])?.f_relu()?;
        let ray_colour = hidden.f_matmul(&self.layers[4])?.f_index_select(0, ray)?;
        outputs.f_narrow(1, FIRST_RAW_COLOUR as i64, 3)?.f_add(&ray_colour)?.f_sigmoid()
    }

    /// Returns the states of the occupancy cells at positions (n × m × 3), as f32: n × m.
    fn cell_states(&self, positions: &Tensor) -> Result<Tensor, TchError> {
        const CELLS: i64 = OCCUPANCY_CELLS as i64;
        let cell = positions.f_nan_to_num(0.0, 0.0, 0.0)?.f_mul_scalar(CELLS as f64)?.f_floor()?;
        let cell = cell.f_clamp(0.0, CELLS as f64 - 1.0)?.f_to_kind(Kind::Int64)?;
        let [x, y, z] = [0, 1, 2].map(|i| cell.i((.., .., i)));
        let cell = z.f_mul_scalar(CELLS)?.f_add(&y)?.f_mul_scalar(CELLS)?.f_add(&x)?;
        self.cells.f_take(&cell)?.f_to_kind(Kind::Float)
    }

    /// Renders colour, opacity and depth of each ray in pieces, which get smaller after running out
    /// of memory.
    pub fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, TorchFieldError> {
        const MIN_RAYS: usize = 64;
        let size = if self.device == Device::Cpu { 1 << 10 } else { 1 << 15 };
        let pieces = run_in_pieces(rays.len(), size, MIN_RAYS, |range| {
            no_grad(|| self.render_piece(&rays[range]))
        })?;
        Ok(pieces.concat())
    }

    fn render_piece(&self, rays: &[Ray]) -> Result<Vec<Pixel>, TchError> {
        let offsets = Tensor::f_full([rays.len() as i64], 0.5, (Kind::Float, self.device))?;
        let forward = self.forward(rays, &offsets, Strides::Single)?;
        let maps = &forward.maps;
        let weights = forward.weights.f_mul(&forward.counted)?;
        let distances = maps
            .distances(&forward.t)?
            .f_where_self(&forward.counted, &forward.t.f_zeros_like()?)?;
        let weight = to_host(&sum_over_steps(&weights)?)?;
        let distance = to_host(&sum_over_steps(&weights.f_mul(&distances)?)?)?;
        let is_half = forward.weights.f_cumsum(1, None::<Kind>)?.f_ge(0.5)?;
        let before =
            is_half.f_logical_not()?.f_sum_dim_intlist([1i64].as_slice(), true, Kind::Int64)?;
        let last = forward.t.size()[1] - 1;
        let has_median = to_host(&before.f_le(last)?)?;
        let median = forward.t.f_gather(1, &before.f_clamp_max(last)?, false)?;
        let median = to_host(&maps.distances(&median)?)?;
        let premultiplied = to_host(&forward.premultiplied)?;
        let transmittance = to_host(&forward.transmittance)?;
        let hits = to_host(&maps.hits()?)?;
        let leave = to_host(&maps.distances(&maps.leave)?)?;
        let pixels = rays.iter().enumerate().map(|(i, ray)| {
            let own: [f32; 3] = std::array::from_fn(|c| premultiplied[3 * i + c]);
            let far = if hits[i] > 0.0 { leave[i] } else { self.bounds.far as f32 };
            Pixel {
                colour: std::array::from_fn(|c| {
                    transmittance[i].mul_add(ray.background[c], own[c])
                }),
                premultiplied: own,
                opacity: 1.0 - transmittance[i],
                depth: if weight[i] > MIN_TOTAL_WEIGHT { distance[i] / weight[i] } else { far },
                median_depth: if has_median[i] > 0.0 { median[i] } else { far },
            }
        });
        Ok(pixels.collect())
    }
}

/// Sums a matrix (n × steps) over the steps: n.
fn sum_over_steps(values: &Tensor) -> Result<Tensor, TchError> {
    values.f_sum_dim_intlist([1i64].as_slice(), false, None::<Kind>)
}

impl RayField for TorchGrid {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        Self::render(self, rays).map_err(|e| RenderError::Backend(e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use numerics::CounterRng;
    use radiance::Passes;

    use super::*;

    /// Returns a ray from a distance of 4 towards a random point of the cube of side 2·`reach`.
    fn random_ray(i: u64, reach: f32) -> Ray {
        let mut rng = CounterRng::new(3, 1, i);
        let mut random_vector = |range: f32| [0, 1, 2].map(|_| range * (2.0 * rng.uniform() - 1.0));
        let (from, to) = (random_vector(1.0), random_vector(reach));
        let length = |v: [f32; 3]| v.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-6);
        let origin = from.map(|x| 4.0 * x / length(from));
        let difference: [f32; 3] = std::array::from_fn(|k| to[k] - origin[k]);
        let direction = difference.map(|x| f64::from(x / length(difference)));
        Ray { origin: origin.map(f64::from), direction, background: [1.0; 3] }
    }

    fn rays(count: u64, reach: f32) -> Vec<Ray> {
        (0..count).map(|i| random_ray(i, reach)).collect()
    }

    /// Returns a field whose features are uniform in ±`spread` instead of ±1e-4.
    fn example(architecture: Architecture, bounds: Bounds, spread: f32) -> Field {
        let mut field = Field::new(architecture, bounds, 5);
        field.parts_mut().0.iter_mut().for_each(|x| *x *= spread / 1e-4);
        field
    }

    /// Returns the norm of the difference relative to the norm of `reference`.
    fn relative_error(values: &[f32], reference: &[f32]) -> f64 {
        let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
        let difference = norm(&mut values.iter().zip(reference).map(|(a, b)| f64::from(a - b)));
        difference / norm(&mut reference.iter().map(|&b| f64::from(b))).max(1e-12)
    }

    fn values_of(pixels: &[Pixel], values: &dyn Fn(&Pixel) -> Vec<f32>) -> Vec<f32> {
        pixels.iter().flat_map(values).collect()
    }

    /// Colours and gradients equal those of the hand-written field, with dense and hashed levels,
    /// faint and opaque density, on the CPU and on a GPU if one exists.
    #[test]
    fn agrees_with_the_hand_written_field() {
        let bounds = Bounds {
            min: [-1.0, -0.8, -1.0],
            max: [1.0, 1.0, 0.7],
            near: 1.0,
            far: 9.0,
            ..Default::default()
        };
        let mut devices = vec![Device::Cpu];
        devices.extend(nets::device("cuda").ok());
        for (spread, log2_hashmap_size, hidden_dim) in [(0.0, 12, 16), (0.3, 12, 32), (3.0, 14, 64)]
        {
            let architecture = Architecture {
                max_resolution: 96,
                finest_z: 40,
                log2_hashmap_size,
                hidden_dim,
                march_steps: 256,
                ..Architecture::default()
            };
            let field = example(architecture, bounds, spread);
            let rays = rays(300, 1.0);
            let mut passes = Passes::new(&field);
            passes.run(&field, &rays, true);
            passes.scatter(&field);
            let table = passes.grid_gradient(&field);
            let network = passes.network_gradient();
            let ours = field.render(&rays);
            for &device in &devices {
                let torch_field = TorchGrid::new(&field, device).unwrap();
                let rendered = torch_field
                    .forward(
                        &rays,
                        &Tensor::full([300], 0.5, (Kind::Float, device)),
                        Strides::Single,
                    )
                    .unwrap();
                let background = rendered.transmittance.unsqueeze(-1);
                let gradients = Tensor::run_backward(
                    &[(rendered.premultiplied + background).sum(Kind::Float)],
                    &torch_field.parameters(),
                    false,
                    false,
                );
                let flat: Vec<f32> =
                    gradients[1..].iter().flat_map(|g| to_host(g).unwrap()).collect();
                let case = format!("spread {spread} on {device:?}");
                let (table_error, network_error) = (
                    relative_error(&table, &to_host(&gradients[0]).unwrap()),
                    relative_error(&network[..flat.len()], &flat),
                );
                assert!(
                    table_error < 1e-4 && network_error < 1e-4,
                    "{case}: gradients {table_error} {network_error}"
                );
                let theirs = torch_field.render(&rays).unwrap();
                for (quantity, values) in [
                    ("colour", &(|p: &Pixel| p.colour.to_vec()) as &dyn Fn(&Pixel) -> Vec<f32>),
                    ("opacity", &|p| vec![p.opacity]),
                    ("depth", &|p| vec![p.depth]),
                    ("median depth", &|p| vec![p.median_depth]),
                ] {
                    let error =
                        relative_error(&values_of(&ours, values), &values_of(&theirs, values));
                    // A median may fall on the next sample.
                    let tolerance = if quantity == "median depth" { 5e-3 } else { 1e-4 };
                    assert!(error < tolerance, "{case}: {quantity} {error}");
                }
            }
        }
    }

    fn is_finite(p: &Pixel) -> bool {
        p.colour.iter().chain(&[p.opacity, p.depth, p.median_depth]).all(|x| x.is_finite())
    }

    /// Rays that miss the box, run along its faces, start inside, have no length or aren't finite.
    #[test]
    fn extreme_rays_have_equal_finite_colours() {
        let bounds = Bounds::cube(1.0, 0.0, 1e6);
        let architecture = Architecture {
            max_resolution: 64,
            log2_hashmap_size: 12,
            hidden_dim: 16,
            march_steps: 64,
            ..Architecture::default()
        };
        let field = example(architecture, bounds, 1.0);
        let torch_field = TorchGrid::new(&field, Device::Cpu).unwrap();
        let rays: Vec<Ray> = [
            ([0.0, 0.0, 4.0], [0.0, 0.0, -1.0]),
            ([0.0, 3.0, 4.0], [0.0, 0.0, -1.0]),
            ([1.0, 0.0, 4.0], [0.0, 0.0, -1.0]),
            ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
            ([0.0, 0.0, 4.0], [0.0, 0.0, 1.0]),
            ([0.0, 0.0, 0.5], [0.0, 0.0, 0.0]),
            ([f64::NAN, 0.0, 4.0], [0.0, 0.0, -1.0]),
            ([0.0, 0.0, 4.0], [0.0, f64::INFINITY, -1.0]),
            ([1e30, 0.0, 0.0], [-1.0, 0.0, 0.0]),
        ]
        .map(|(origin, direction)| Ray { origin, direction, background: [0.3, 0.6, 0.9] })
        .to_vec();
        for (i, (ours, theirs)) in
            field.render(&rays).iter().zip(torch_field.render(&rays).unwrap()).enumerate()
        {
            assert!(is_finite(ours) && is_finite(&theirs), "{i}: {ours:?} {theirs:?}");
            let close = ours.colour.iter().zip(&theirs.colour).all(|(a, b)| (a - b).abs() < 1e-4);
            assert!(close, "{i}: {ours:?} {theirs:?}");
        }
    }
}
