use std::path::Path;

use radiance::{Architecture, Pixel, Ray, RayField};
use scene::Bounds;
use tch::{Device, IndexOp as _, Kind, TchError, Tensor, no_grad};

use crate::TorchFieldError;
use crate::mlp::host;

/// The fast field, [`radiance::Field`], through libtorch's operations: another reading of the same description and the same file, that
/// judges the hand-written one, and its way to CUDA.
#[derive(Debug)]
pub struct TorchGrid {
    pub(crate) architecture: Architecture,
    pub(crate) bounds: Bounds,
    pub(crate) device: Device,
    levels: Vec<Level>,
    /// Entries × 4, of all levels.
    pub(crate) table: Tensor,
    /// Five layers, each inputs × outputs.
    pub(crate) layers: [Tensor; 5],
    /// 128³, x fastest; bool.
    pub(crate) occupied: Tensor,
}

/// One level of the grid: Müller et al. 2022, "Instant neural graphics primitives".
#[derive(Clone, Copy, Debug)]
struct Level {
    resolution: i64,
    first: i64,
    entries: i64,
    hashed: bool,
}

/// Features of an entry, cells along an axis of the occupancy, raw outputs of the density network, spherical harmonics.
const FEATURES: i64 = 4;
const CELLS: i64 = 128;
const RAW: i64 = 16;
const HARMONICS: i64 = 9;
/// Samples behind this transmittance, and those of less weight, have no colour and no gradient.
const FAINT: f64 = 1e-4;
/// Density stops growing at e^15.
const MOST_RAW: f64 = 15.0;

/// What rays see.
pub(crate) struct GridSeen {
    /// n × 3, of the scene alone.
    pub(crate) premultiplied: Tensor,
    /// n: light that comes through.
    pub(crate) transmittance: Tensor,
    /// n × steps: weights and distances in cube sides.
    pub(crate) weights: Tensor,
    pub(crate) t: Tensor,
    /// n: where rays end, in cube sides; 0 where they miss the box.
    pub(crate) leave: Tensor,
}

fn levels(architecture: &Architecture) -> Vec<Level> {
    let (coarsest, finest) = (f64::from(architecture.coarsest), f64::from(architecture.finest));
    let ratio = (finest / coarsest).powf(1.0 / f64::from(architecture.levels.max(2) - 1));
    let mut first = 0;
    let level = |i: u32| {
        let resolution = (coarsest * ratio.powi(i as i32)).round() as i64;
        let vertices = (resolution + 1).pow(3);
        let hashed = vertices > 1 << architecture.log2_entries;
        // Dense levels end with whole cache lines.
        let entries = if hashed { 1 << architecture.log2_entries } else { (vertices + 15) / 16 * 16 };
        first += entries;
        Level { resolution, first: first - entries, entries, hashed }
    };
    (0..architecture.levels).map(level).collect()
}

fn layer_shapes(architecture: &Architecture) -> [(i64, i64); 5] {
    let (features, hidden) = (FEATURES * i64::from(architecture.levels), i64::from(architecture.hidden));
    [(features, hidden), (hidden, RAW), (RAW - 1 + HARMONICS, hidden), (hidden, hidden), (hidden, 3)]
}

/// Real spherical harmonics up to degree 2 of unit directions (n × 3): n × 9.
fn harmonics(direction: &Tensor) -> Result<Tensor, TchError> {
    let [x, y, z] = [0, 1, 2].map(|i| direction.i((.., i)));
    let product = |a: &Tensor, b: &Tensor, factor: f64| a.f_mul(b)?.f_mul_scalar(factor);
    let pi = std::f64::consts::PI;
    let (one, two) = ((3.0 / (4.0 * pi)).sqrt(), (15.0 / (4.0 * pi)).sqrt());
    Tensor::f_stack(
        &[
            x.f_full_like((1.0 / (4.0 * pi)).sqrt())?,
            y.f_mul_scalar(-one)?,
            z.f_mul_scalar(one)?,
            x.f_mul_scalar(-one)?,
            product(&x, &y, two)?,
            product(&y, &z, -two)?,
            z.f_square()?.f_mul_scalar(3.0)?.f_sub_scalar(1.0)?.f_mul_scalar((5.0 / (16.0 * pi)).sqrt())?,
            product(&x, &z, -two)?,
            x.f_square()?.f_sub(&y.f_square()?)?.f_mul_scalar(0.5 * two)?,
        ],
        -1,
    )
}

impl TorchGrid {
    /// Reads what [`radiance::Field::write`] wrote.
    pub fn read(path: &Path, architecture: Architecture, bounds: Bounds, device: Device) -> Result<Self, TorchFieldError> {
        let format = |reason: String| TorchFieldError::Format { path: path.to_path_buf(), reason };
        architecture.check().map_err(format)?;
        if bounds.space != scene::Space::Box {
            return Err(format("through libtorch the grid lives in a box; this one has another space".to_owned()));
        }
        let weights = nets::Weights::read(path)?;
        let levels = levels(&architecture);
        let entries: i64 = levels.iter().map(|l| l.entries).sum();
        let own = |t: Tensor| -> Result<Tensor, TchError> { Ok(t.f_to_device(device)?.f_detach_copy()?.set_requires_grad(true)) };
        let table = own(weights.tensor("grid", &[entries * FEATURES])?.f_reshape([entries, FEATURES])?)?;
        let shapes = layer_shapes(&architecture);
        let all = shapes.iter().map(|(i, o)| i * o).sum::<i64>();
        // The file pads the networks to whole vectors.
        let network = weights.tensor("network", &[(all + 15) / 16 * 16])?;
        let mut first = 0;
        let mut layers = Vec::with_capacity(5);
        for (inputs, outputs) in shapes {
            layers.push(own(network.f_narrow(0, first, inputs * outputs)?.f_reshape([inputs, outputs])?)?);
            first += inputs * outputs;
        }
        let occupied = weights.bytes("occupancy", CELLS.pow(3))?.f_to_device(device)?.f_ne(0)?;
        let layers = layers.try_into().expect("five layers");
        Ok(Self { architecture, bounds, device, levels, table, layers, occupied })
    }

    /// Distance between samples, in cube sides.
    fn step(&self) -> f64 {
        3f64.sqrt() / f64::from(self.architecture.steps)
    }

    /// Interpolated features of positions in the unit cube (n × 3): n × 4·levels.
    fn encode(&self, positions: &Tensor) -> Result<Tensor, TchError> {
        let mut features = Vec::with_capacity(self.levels.len());
        for level in &self.levels {
            let at = positions.f_clamp(0.0, 1.0)?.f_mul_scalar(level.resolution as f64)?;
            let cell = at.f_floor()?.f_clamp_max(level.resolution as f64 - 1.0)?;
            let fraction = at.f_sub(&cell)?;
            let cell = cell.f_to_kind(Kind::Int64)?;
            let mut sum: Option<Tensor> = None;
            for corner in 0..8i64 {
                let d = [corner & 1, corner >> 1 & 1, corner >> 2];
                let mut share = None;
                let mut index = Vec::with_capacity(3);
                for (axis, &d) in d.iter().enumerate() {
                    let f = fraction.i((.., axis as i64));
                    let f = if d == 1 { f } else { f.f_neg()?.f_add_scalar(1.0)? };
                    share = Some(match share {
                        None => f,
                        Some(product) => f.f_mul(&product)?,
                    });
                    index.push(cell.i((.., axis as i64)).f_add_scalar(d)?);
                }
                let index = if level.hashed {
                    let mixed = index[0]
                        .f_bitwise_xor_tensor(&index[1].f_mul_scalar(2_654_435_761i64)?)?
                        .f_bitwise_xor_tensor(&index[2].f_mul_scalar(805_459_861i64)?)?;
                    mixed.f_bitwise_and(level.entries - 1)?
                } else {
                    let side = level.resolution + 1;
                    index[2].f_mul_scalar(side)?.f_add(&index[1])?.f_mul_scalar(side)?.f_add(&index[0])?
                };
                let entry = self.table.f_index_select(0, &index.f_add_scalar(level.first)?)?;
                let part = entry.f_mul(&share.expect("three axes").f_unsqueeze(-1)?)?;
                sum = Some(match sum {
                    None => part,
                    Some(sum) => sum.f_add(&part)?,
                });
            }
            features.push(sum.expect("eight corners"));
        }
        Tensor::f_cat(&features, -1)
    }

    /// What rays see, with samples `offsets` (n) of a step along.
    pub(crate) fn see(&self, rays: &[Ray], offsets: &Tensor) -> Result<GridSeen, TchError> {
        let n = rays.len() as i64;
        let side = self.bounds.longest_side();
        let rows = |of: &dyn Fn(&Ray) -> [f64; 3]| {
            let values: Vec<f64> = rays.iter().flat_map(of).collect();
            Tensor::f_from_slice(&values)?.f_reshape([n, 3])
        };
        let min = self.bounds.min;
        let origin = rows(&|r| std::array::from_fn(|i| (f64::from(r.origin[i]) - min[i]) / side))?;
        let direction = rows(&|r| r.direction.map(f64::from))?;
        let extent: [f64; 3] = std::array::from_fn(|i| (self.bounds.max[i] - min[i]) / side);
        // Where rays are inside the box, in f64 and on the host: it is little, and must be exact. Parallel to two faces a ray is
        // between them for ever, or never.
        let a = origin.f_neg()?.f_div(&direction)?;
        let b = Tensor::f_from_slice(&extent)?.f_sub(&origin)?.f_div(&direction)?;
        let parallel = direction.f_eq(0.0)?;
        let between = origin.f_ge(0.0)?.f_logical_and(&origin.f_le_tensor(&Tensor::f_from_slice(&extent)?)?)?;
        let forever = a.f_full_like(f64::INFINITY)?;
        let never = forever.f_neg()?;
        let ends = |inner: Tensor, parallel_inside: &Tensor, parallel_outside: &Tensor| -> Result<Tensor, TchError> {
            inner.f_where_self(&parallel.f_logical_not()?, &parallel_inside.f_where_self(&between, parallel_outside)?)
        };
        let enter =
            ends(a.f_minimum(&b)?, &never, &forever)?.f_amax([1i64].as_slice(), false)?.f_clamp_min(self.bounds.near / side)?;
        let leave =
            ends(a.f_maximum(&b)?, &forever, &never)?.f_amin([1i64].as_slice(), false)?.f_clamp_max(self.bounds.far / side)?;
        let finite = |r: &Ray| r.origin.iter().chain(&r.direction).all(|x| x.is_finite()) && r.direction != [0.0; 3];
        let usable: Vec<bool> = rays.iter().map(finite).collect();
        let usable = Tensor::f_from_slice(&usable)?.f_logical_and(&enter.f_lt_tensor(&leave)?)?;
        let zero = enter.f_zeros_like()?;
        let (enter, leave) = (enter.f_where_self(&usable, &zero)?, leave.f_where_self(&usable, &zero)?);
        let float = |t: &Tensor| t.f_to_kind(Kind::Float)?.f_to_device(self.device);
        let (origin, direction, enter, leave) = (float(&origin)?, float(&direction)?, float(&enter)?, float(&leave)?);

        let longest = leave.f_sub(&enter)?.f_max()?.f_double_value(&[])?;
        let count = ((longest / self.step()).ceil() as i64).max(1);
        // As the hand-written field rounds: once, by fused multiply-adds, for which f64 stands here.
        let fused = |a: &Tensor, b: &Tensor, c: &Tensor| -> Result<Tensor, TchError> {
            let wide = |t: &Tensor| t.f_to_kind(Kind::Double);
            wide(a)?.f_mul(&wide(b)?)?.f_add(&wide(c)?)?.f_to_kind(Kind::Float)
        };
        let k = Tensor::f_arange(count, (Kind::Float, self.device))?.f_add(&offsets.f_unsqueeze(-1)?)?;
        let t = fused(&k, &k.f_full_like(self.step())?, &enter.f_unsqueeze(-1)?)?;
        let positions = fused(&direction.f_unsqueeze(1)?, &t.f_unsqueeze(-1)?, &origin.f_unsqueeze(1)?)?;
        let cell =
            positions.f_nan_to_num(0.0, 0.0, 0.0)?.f_mul_scalar(CELLS as f64)?.f_floor()?.f_clamp(0.0, CELLS as f64 - 1.0)?;
        let cell = cell.f_to_kind(Kind::Int64)?;
        let [x, y, z] = [0, 1, 2].map(|i| cell.i((.., .., i)));
        let cell = z.f_mul_scalar(CELLS)?.f_add(&y)?.f_mul_scalar(CELLS)?.f_add(&x)?;
        let inside = t.f_lt_tensor(&leave.f_unsqueeze(-1)?)?.f_logical_and(&self.occupied.f_take(&cell)?)?;
        let kept = inside.f_reshape([-1])?.f_nonzero()?.f_squeeze_dim(-1)?;
        let positions = positions.f_reshape([-1, 3])?.f_index_select(0, &kept)?;

        let hidden = self.encode(&positions)?.f_matmul(&self.layers[0])?.f_relu()?;
        let raw = hidden.f_matmul(&self.layers[1])?;
        let density = raw.i((.., 0)).f_clamp_max(MOST_RAW)?.f_exp()?.f_mul_scalar(self.step())?;
        let spread = |of: &Tensor, like: &Tensor| like.f_index_put(&[Some(&kept)], of, false)?.f_reshape([n, count]);
        let nothing = Tensor::f_zeros([n * count], (Kind::Float, self.device))?;
        let optical = |density: &Tensor| -> Result<[Tensor; 3], TchError> {
            let tau = spread(density, &nothing)?;
            let through = tau.f_cumsum(1, None::<Kind>)?;
            let transmittance = through.f_sub(&tau)?.f_neg()?.f_exp()?;
            let weights = transmittance.f_mul(&tau.f_neg()?.f_expm1()?.f_neg()?)?;
            Ok([through, transmittance, weights])
        };
        // What counts is found first; the rest gets no gradient.
        let counts = no_grad(|| -> Result<Tensor, TchError> {
            let [_, transmittance, weights] = optical(&density)?;
            let counts = transmittance.f_gt(FAINT)?.f_logical_and(&weights.f_gt(FAINT)?)?;
            counts.f_reshape([-1])?.f_index_select(0, &kept)
        })?;
        let [through, _, weights] = optical(&density.f_where_self(&counts, &density.f_detach()?)?)?;

        let shaded = counts.f_nonzero()?.f_squeeze_dim(-1)?;
        let at = kept.f_index_select(0, &shaded)?;
        let basis = harmonics(&direction)?.f_index_select(0, &at.f_div_scalar_mode(count, "floor")?)?;
        let input = Tensor::f_cat(&[&raw.f_index_select(0, &shaded)?.f_narrow(1, 1, RAW - 1)?, &basis], -1)?;
        let hidden = input.f_matmul(&self.layers[2])?.f_relu()?.f_matmul(&self.layers[3])?.f_relu()?;
        let colour = hidden.f_matmul(&self.layers[4])?.f_sigmoid()?;
        let weight = weights.f_reshape([-1])?.f_index_select(0, &at)?.f_unsqueeze(-1)?;
        let blank = Tensor::f_zeros([n, 3], (Kind::Float, self.device))?;
        let premultiplied = blank.f_index_add(0, &at.f_div_scalar_mode(count, "floor")?, &weight.f_mul(&colour)?)?;
        let transmittance = through.i((.., count - 1)).f_neg()?.f_exp()?;
        Ok(GridSeen { premultiplied, transmittance, weights, t, leave })
    }

    /// Colour, opacity and depth of each ray, in pieces as large as memory allows.
    pub fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, TorchFieldError> {
        let mut pixels = Vec::with_capacity(rays.len());
        let mut piece = if self.device == Device::Cpu { 1 << 10 } else { 1 << 15 };
        while pixels.len() < rays.len() {
            let end = (pixels.len() + piece).min(rays.len());
            match no_grad(|| self.pixels(&rays[pixels.len()..end])) {
                Ok(more) => pixels.extend(more),
                Err(error) if piece > 64 && nets::is_out_of_memory(&error) => piece /= 2,
                Err(error) => return Err(error.into()),
            }
        }
        Ok(pixels)
    }

    fn pixels(&self, rays: &[Ray]) -> Result<Vec<Pixel>, TchError> {
        let offsets = Tensor::f_full([rays.len() as i64], 0.5, (Kind::Float, self.device))?;
        let seen = self.see(rays, &offsets)?;
        let counts = seen.weights.f_gt(FAINT)?;
        let weights = seen.weights.f_mul(&counts)?;
        let sum = |of: &Tensor| of.f_sum_dim_intlist([1i64].as_slice(), false, None::<Kind>);
        let (weight, distance) = (host(&sum(&weights)?)?, host(&sum(&weights.f_mul(&seen.t)?)?)?);
        let half = seen.weights.f_cumsum(1, None::<Kind>)?.f_ge(0.5)?;
        let before = half.f_logical_not()?.f_sum_dim_intlist([1i64].as_slice(), true, Kind::Int64)?;
        let last = seen.t.size()[1] - 1;
        let is_half = host(&before.f_le(last)?)?;
        let median = host(&seen.t.f_gather(1, &before.f_clamp_max(last)?, false)?)?;
        let (premultiplied, transmittance) = (host(&seen.premultiplied)?, host(&seen.transmittance)?);
        let (side, leave) = (self.bounds.longest_side() as f32, host(&seen.leave)?);
        let pixel = |(i, ray): (usize, &Ray)| {
            let own: [f32; 3] = std::array::from_fn(|c| premultiplied[3 * i + c]);
            let far = if leave[i] > 0.0 { leave[i] * side } else { self.bounds.far as f32 };
            Pixel {
                colour: std::array::from_fn(|c| transmittance[i].mul_add(ray.background[c], own[c])),
                premultiplied: own,
                opacity: 1.0 - transmittance[i],
                depth: if weight[i] > 1e-4 { distance[i] / weight[i] * side } else { far },
                median_depth: if is_half[i] > 0.0 { median[i] * side } else { far },
            }
        };
        Ok(rays.iter().enumerate().map(pixel).collect())
    }
}

impl RayField for TorchGrid {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, Box<dyn std::error::Error + Send + Sync>> {
        Ok(Self::render(self, rays)?)
    }
}

#[cfg(test)]
mod tests {
    use radiance::{Draws, Field, Passes};

    use super::*;

    /// The table and the five layers.
    fn parameters(of: &TorchGrid) -> Vec<Tensor> {
        std::iter::once(&of.table).chain(&of.layers).map(Tensor::shallow_clone).collect()
    }

    fn rays(count: u64, reach: f32) -> Vec<Ray> {
        let ray = |i| {
            let mut draws = Draws::new(3, 1, i);
            let mut around = |reach: f32| [0, 1, 2].map(|_| reach * (2.0 * draws.uniform() - 1.0));
            let (from, to) = (around(1.0), around(reach));
            let length = |v: [f32; 3]| v.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-6);
            let origin = from.map(|x| 4.0 * x / length(from));
            let d: [f32; 3] = std::array::from_fn(|k| to[k] - origin[k]);
            Ray { origin, direction: d.map(|x| x / length(d)), background: [1.0; 3] }
        };
        (0..count).map(ray).collect()
    }

    /// A field whose features spread so far, and its file.
    fn example(architecture: Architecture, bounds: Bounds, spread: f32) -> (Field, std::path::PathBuf) {
        let path = tempfile::tempdir().unwrap().keep().join("field.safetensors");
        Field::new(architecture, bounds, 5).write(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let grow = |b: &[u8; 4]| (f32::from_le_bytes(*b) * spread / 1e-4).to_le_bytes();
        let grid: Vec<u8> = file.tensor("grid").unwrap().data().as_chunks::<4>().0.iter().flat_map(grow).collect();
        let shape = file.tensor("grid").unwrap().shape().to_vec();
        let wide = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, shape, &grid).unwrap();
        let rest = ["network", "occupancy"].map(|name| (name, file.tensor(name).unwrap()));
        std::fs::write(&path, safetensors::serialize([("grid", wide)].into_iter().chain(rest), None).unwrap()).unwrap();
        (Field::read(&path, architecture, bounds).unwrap(), path)
    }

    fn error(ours: &[f32], judge: &[f32]) -> f64 {
        let norm = |of: &mut dyn Iterator<Item = f64>| of.map(|x| x * x).sum::<f64>().sqrt();
        let difference = norm(&mut ours.iter().zip(judge).map(|(a, b)| f64::from(a - b)));
        difference / norm(&mut judge.iter().map(|&b| f64::from(b))).max(1e-12)
    }

    /// Colours and gradients of the hand-written field and of libtorch's autograd, over dense and hashed levels, thin fog and
    /// walls, and the same field on a GPU where there is one.
    #[test]
    fn agrees_with_the_hand_written_field() {
        let bounds = Bounds { min: [-1.0, -0.8, -1.0], max: [1.0, 1.0, 0.7], near: 1.0, far: 9.0, ..Default::default() };
        let mut devices = vec![Device::Cpu];
        devices.extend(nets::device("cuda").ok());
        for (spread, log2_entries, hidden) in [(0.0, 12, 16), (0.3, 12, 32), (3.0, 14, 64)] {
            let architecture = Architecture { finest: 96, log2_entries, hidden, steps: 256, ..Architecture::default() };
            let (field, path) = example(architecture, bounds, spread);
            let rays = rays(300, 1.0);
            let mut passes = Passes::new(&field);
            passes.run(&field, &rays, true);
            let mut table = vec![0.0; field.grid_len()];
            passes.scatter(&field, &mut table);
            let network = passes.network_gradient(&field);
            let own = field.render(&rays);
            for &device in &devices {
                let judge = TorchGrid::read(&path, architecture, bounds, device).unwrap();
                let seen = judge.see(&rays, &Tensor::full([300], 0.5, (Kind::Float, device))).unwrap();
                let background = seen.transmittance.unsqueeze(-1);
                let gradients = Tensor::run_backward(
                    &[(seen.premultiplied + background).sum(Kind::Float)],
                    &parameters(&judge),
                    false,
                    false,
                );
                let flat: Vec<f32> = gradients[1..].iter().flat_map(|g| host(g).unwrap()).collect();
                let said = format!("spread {spread} on {device:?}");
                let (by_table, by_network) = (error(&table, &host(&gradients[0]).unwrap()), error(&network[..flat.len()], &flat));
                assert!(by_table < 1e-4 && by_network < 1e-4, "{said}: gradients {by_table} {by_network}");
                let theirs = judge.render(&rays).unwrap();
                let all = |pixels: &[Pixel], of: &dyn Fn(&Pixel) -> Vec<f32>| pixels.iter().flat_map(of).collect::<Vec<f32>>();
                for (what, of) in [
                    ("colour", &(|p: &Pixel| p.colour.to_vec()) as &dyn Fn(&Pixel) -> Vec<f32>),
                    ("opacity", &|p| vec![p.opacity]),
                    ("depth", &|p| vec![p.depth]),
                    ("median depth", &|p| vec![p.median_depth]),
                ] {
                    let error = error(&all(&own, of), &all(&theirs, of));
                    // A median may fall on the next sample.
                    let tolerance = if what == "median depth" { 5e-3 } else { 1e-4 };
                    assert!(error < tolerance, "{said}: {what} {error}");
                }
            }
        }
    }

    /// What misses the box, runs along its faces, begins inside, has no length or isn't finite.
    #[test]
    fn extreme_rays_are_finite_alike() {
        let bounds = Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.0, far: 1e6, ..Default::default() };
        let architecture = Architecture { finest: 64, log2_entries: 12, hidden: 16, steps: 64, ..Architecture::default() };
        let (field, path) = example(architecture, bounds, 1.0);
        let judge = TorchGrid::read(&path, architecture, bounds, Device::Cpu).unwrap();
        let rays: Vec<Ray> = [
            ([0.0, 0.0, 4.0], [0.0, 0.0, -1.0]),
            ([0.0, 3.0, 4.0], [0.0, 0.0, -1.0]),
            ([1.0, 0.0, 4.0], [0.0, 0.0, -1.0]),
            ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
            ([0.0, 0.0, 4.0], [0.0, 0.0, 1.0]),
            ([0.0, 0.0, 0.5], [0.0, 0.0, 0.0]),
            ([f32::NAN, 0.0, 4.0], [0.0, 0.0, -1.0]),
            ([0.0, 0.0, 4.0], [0.0, f32::INFINITY, -1.0]),
            ([1e30, 0.0, 0.0], [-1.0, 0.0, 0.0]),
        ]
        .map(|(origin, direction)| Ray { origin, direction, background: [0.3, 0.6, 0.9] })
        .to_vec();
        for (i, (ours, theirs)) in field.render(&rays).iter().zip(judge.render(&rays).unwrap()).enumerate() {
            let finite = |p: &Pixel| p.colour.iter().chain(&[p.opacity, p.depth, p.median_depth]).all(|x| x.is_finite());
            assert!(finite(ours) && finite(&theirs), "{i}: {ours:?} {theirs:?}");
            let close = ours.colour.iter().zip(&theirs.colour).all(|(a, b)| (a - b).abs() < 1e-4);
            assert!(close, "{i}: {ours:?} {theirs:?}");
        }
    }
}
