use std::ops::Range;
use std::path::Path;

use glam::DVec3;
use numerics::CounterRng;
use radiance::spec::MIN_TOTAL_WEIGHT;
use radiance::{Pixel, Ray, RayField, RenderError};
use rayon::prelude::*;
use scene::{Bounds, Space};
use tch::{Device, Kind, TchError, Tensor, no_grad};

use crate::architecture::MlpArchitecture;
use crate::composite::{Composite, composite};
use crate::error::TorchFieldError;
use crate::network::{MlpNetwork, encode};
use crate::ray_tensors::{RayTensors, columns, matrix, to_host};
use crate::sampling::{importance, midpoints, stratified};
use crate::step::run_in_pieces;

/// The paper's field: a coarse network, whose sample weights determine the samples of a fine
/// network. Directions are in world space.
///
/// In a box, positions are in [`MlpFrame`], and rays start at `near` and end at `far` of the
/// bounds. In NDC and in a contraction, positions are in the unit cube, scaled to -1..1. There,
/// samples are evenly spaced in the cube, as in the paper for forward-facing scenes.
#[derive(Debug)]
pub struct Mlp {
    pub(crate) architecture: MlpArchitecture,
    pub(crate) bounds: Bounds,
    pub(crate) coarse: MlpNetwork,
    pub(crate) fine: MlpNetwork,
    pub(crate) device: Device,
}

/// Random numbers of a training step's n rays. Without them the coarse samples are evenly spaced,
/// and the fine ones are at evenly spaced quantiles of the coarse weights.
#[derive(Debug)]
pub(crate) struct SampleDraws {
    /// Positions of coarse samples, in 0..1: n × coarse samples.
    pub(crate) coarse: Tensor,
    /// Quantiles of fine samples, in 0..1: n × fine samples.
    pub(crate) fine: Tensor,
    /// Noise on raw densities: n × coarse samples, and n × (coarse + fine) samples.
    pub(crate) noise: Option<[Tensor; 2]>,
}

/// Coordinate frame of the networks' positions in a box: origin and unit of length in world space.
/// Distances t along a ray have the same unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct MlpFrame {
    origin: DVec3,
    pub(crate) unit: f64,
}

impl MlpFrame {
    /// Returns a world position in this frame, computed in f64 and then rounded to f32.
    pub(crate) fn position_of(&self, point: DVec3) -> [f32; 3] {
        ((point - self.origin) / self.unit).as_vec3().to_array()
    }
}

/// Rays as tensors (n × 3 each).
#[derive(Debug)]
pub(crate) struct Batch {
    pub(crate) origin: Tensor,
    pub(crate) direction: Tensor,
    pub(crate) background: Tensor,
    /// Rays in the unit cube, unless the field's space is a box.
    pub(crate) maps: Option<RayTensors>,
}

/// Composites of both networks along n rays.
#[derive(Debug)]
pub(crate) struct MlpForward {
    pub(crate) coarse: Composite,
    pub(crate) fine: Composite,
    /// Distances of the fine network's samples in scene units: n × (coarse + fine) samples.
    pub(crate) distances: Tensor,
}

/// Streams of random numbers.
const STRATIFIED: u64 = 201;
const IMPORTANCE: u64 = 202;
const NOISE: u64 = 203;

impl SampleDraws {
    /// Draws the random numbers of rays `first..first + n`, counted over the training run.
    /// `noise_std` is the standard deviation of the noise on raw densities.
    pub(crate) fn new(
        field: &Mlp,
        seed: u64,
        first: u64,
        n: usize,
        noise_std: f64,
    ) -> Result<Self, TchError> {
        let coarse = field.architecture.coarse_samples as usize;
        let fine = field.architecture.fine_samples as usize;
        let (rays, device) = (first..first + n as u64, field.device);
        let noise = if noise_std > 0.0 {
            let all = draw_rows(seed, NOISE, rays.clone(), 2 * coarse + fine, device, |rng| {
                (noise_std * rng.normal()) as f32
            })?;
            Some([
                all.f_narrow(1, 0, coarse as i64)?,
                all.f_narrow(1, coarse as i64, (coarse + fine) as i64)?,
            ])
        } else {
            None
        };
        Ok(Self {
            coarse: draw_rows(seed, STRATIFIED, rays.clone(), coarse, device, CounterRng::uniform)?,
            fine: draw_rows(seed, IMPORTANCE, rays, fine, device, CounterRng::uniform)?,
            noise,
        })
    }
}

/// Draws a row of `width` numbers for each ray from the ray's own generator.
fn draw_rows(
    seed: u64,
    stream: u64,
    rays: Range<u64>,
    width: usize,
    device: Device,
    draw: impl Fn(&mut CounterRng) -> f32,
) -> Result<Tensor, TchError> {
    let n = rays.end - rays.start;
    let mut values = Vec::with_capacity(n as usize * width);
    for ray in rays {
        let mut rng = CounterRng::new(seed, stream, ray);
        values.extend((0..width).map(|_| draw(&mut rng)));
    }
    matrix(&values, [n as i64, width as i64], device)
}

impl Batch {
    /// Converts rays to a field's frame and device.
    pub(crate) fn new(rays: &[Ray], field: &Mlp) -> Result<Self, TchError> {
        let frame = field.frame();
        let Mlp { bounds, device, .. } = *field;
        Ok(Self {
            origin: columns(rays, device, |r| frame.position_of(r.origin.into()))?,
            direction: columns(rays, device, |r| r.direction.map(|x| x as f32))?,
            background: columns(rays, device, |r| r.background)?,
            maps: (bounds.space != Space::Box)
                .then(|| RayTensors::new(&bounds, rays, device))
                .transpose()?,
        })
    }
}

impl Mlp {
    /// Creates an untrained field with random weights.
    pub fn new(
        architecture: MlpArchitecture,
        bounds: Bounds,
        seed: u64,
        device: Device,
    ) -> Result<Self, TorchFieldError> {
        let coarse = MlpNetwork::new(architecture, seed, 0, device)?;
        let fine = MlpNetwork::new(architecture, seed, 1, device)?;
        Ok(Self { architecture, bounds, coarse, fine, device })
    }

    /// Reads a file that [`Mlp::write`] wrote, or that `scripts/convert-checkpoint.py` converted
    /// from checkpoints of the reference implementation.
    pub fn read(
        path: &Path,
        architecture: MlpArchitecture,
        bounds: Bounds,
        device: Device,
    ) -> Result<Self, TorchFieldError> {
        architecture.check().map_err(|error| TorchFieldError::Format {
            path: path.to_path_buf(),
            reason: error.to_string(),
        })?;
        let weights = nets::Weights::read(path)?;
        let coarse = read_network(&weights, "coarse", path, architecture, device)?;
        let fine = read_network(&weights, "fine", path, architecture, device)?;
        Ok(Self { architecture, bounds, coarse, fine, device })
    }

    /// Writes both networks as safetensors: `coarse.NAME` and `fine.NAME`, with the layer names of
    /// the reference implementation.
    pub fn write(&self, path: &Path) -> Result<(), TorchFieldError> {
        Ok(nets::write(path, &self.named_parameters())?)
    }

    /// Returns all parameters with their names.
    pub(crate) fn named_parameters(&self) -> Vec<(String, Tensor)> {
        let mut all = Vec::new();
        for (prefix, network) in [("coarse", &self.coarse), ("fine", &self.fine)] {
            for (i, (name, _)) in MlpNetwork::parameter_shapes(&self.architecture).enumerate() {
                all.push((format!("{prefix}.{name}"), network.parameters[i].shallow_clone()));
            }
        }
        all
    }

    /// Averages every parameter with that of a file of a field of the same architecture, in place.
    pub fn average_with(&self, path: &Path) -> Result<(), TorchFieldError> {
        let other = Self::read(path, self.architecture, self.bounds, self.device)?;
        no_grad(|| {
            for (mut own, other) in self.parameters().zip(other.parameters()) {
                own.f_copy_(&own.f_add(&other)?.f_mul_scalar(0.5)?)?;
            }
            Ok(())
        })
    }

    /// Returns the number of weights in both networks.
    pub fn parameter_count(&self) -> usize {
        self.parameters().map(|p| p.numel()).sum()
    }

    /// Returns handles to the parameters of both networks, in the order of
    /// [`Mlp::named_parameters`].
    pub(crate) fn parameters(&self) -> impl Iterator<Item = Tensor> {
        self.coarse.parameters.iter().chain(&self.fine.parameters).map(Tensor::shallow_clone)
    }

    /// Returns another handle to the same networks, for another thread.
    pub(crate) fn shallow_clone(&self) -> Self {
        Self { coarse: self.coarse.shallow_clone(), fine: self.fine.shallow_clone(), ..*self }
    }

    /// Returns the frame of positions, which only fields in a box use.
    pub(crate) fn frame(&self) -> MlpFrame {
        if self.architecture.scaled_positions {
            MlpFrame { origin: self.bounds.middle(), unit: self.bounds.unit() }
        } else {
            MlpFrame { origin: DVec3::ZERO, unit: 1.0 }
        }
    }

    /// Evaluates both networks along rays and composites their samples.
    pub(crate) fn forward(
        &self,
        batch: &Batch,
        draws: Option<&SampleDraws>,
    ) -> Result<MlpForward, TchError> {
        let n = batch.origin.size()[0];
        let unit = self.frame().unit;
        let (near, far) = match &batch.maps {
            None => {
                let options = (batch.origin.kind(), self.device);
                (
                    Tensor::f_full([n, 1], self.bounds.near / unit, options)?,
                    Tensor::f_full([n, 1], self.bounds.far / unit, options)?,
                )
            }
            Some(maps) => (maps.enter.shallow_clone(), maps.leave.shallow_clone()),
        };
        let count = i64::from(self.architecture.coarse_samples);
        let direction = encode(&batch.direction, self.architecture.direction_frequencies)?;
        let noise = draws.and_then(|d| d.noise.as_ref());

        let t = stratified(&near, &far, count, draws.map(|d| &d.coarse))?;
        let coarse = self.composite(&self.coarse, batch, &direction, &t, noise.map(|n| &n[0]))?;
        let fine_count = i64::from(self.architecture.fine_samples);
        let quantiles = match draws {
            Some(draws) => draws.fine.shallow_clone(),
            None => Tensor::f_linspace(0, 1, fine_count, (t.kind(), self.device))?
                .f_expand([n, fine_count], false)?
                .f_contiguous()?,
        };
        let inner = coarse.weights.f_detach()?.f_narrow(1, 1, count - 2)?;
        let finer = importance(&midpoints(&t)?, &inner, &quantiles)?;
        let t = Tensor::f_cat(&[&t, &finer], 1)?.f_sort(1, false)?.0;
        let fine = self.composite(&self.fine, batch, &direction, &t, noise.map(|n| &n[1]))?;
        let distances = match &batch.maps {
            None => t.f_mul_scalar(unit)?,
            Some(maps) => maps.distances(&t)?,
        };
        Ok(MlpForward { coarse, fine, distances })
    }

    /// Evaluates one network at t (n × m) and composites the samples.
    fn composite(
        &self,
        network: &MlpNetwork,
        batch: &Batch,
        direction: &Tensor,
        t: &Tensor,
        noise: Option<&Tensor>,
    ) -> Result<Composite, TchError> {
        let (n, m) = (t.size()[0], t.size()[1]);
        let positions = match &batch.maps {
            None => t
                .f_unsqueeze(-1)?
                .f_mul(&batch.direction.f_unsqueeze(1)?)?
                .f_add(&batch.origin.f_unsqueeze(1)?)?,
            Some(maps) => maps.positions(t)?.f_mul_scalar(2.0)?.f_sub_scalar(1.0)?,
        };
        let positions = positions.f_reshape([n * m, 3])?;
        let code = encode(&positions, self.architecture.position_frequencies)?;
        let width = direction.size()[1];
        let directions =
            direction.f_unsqueeze(1)?.f_expand([n, m, width], false)?.f_reshape([n * m, width])?;
        let (colour, raw) = network.forward(&code, &directions)?;
        let mut raw = raw.f_reshape([n, m])?;
        if let Some(noise) = noise {
            raw = raw.f_add(noise)?;
        }
        composite(t, &colour.f_reshape([n, m, 3])?, &raw, &batch.background)
    }

    /// Renders colour, opacity and depth of each ray. The CPU renders in parallel, with results
    /// independent of the number of threads. A GPU renders pieces, which get smaller after running
    /// out of memory.
    pub fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, TorchFieldError> {
        const CPU_RAYS: usize = 32;
        const GPU_RAYS: usize = 1 << 14;
        if self.device == Device::Cpu {
            let pieces: Vec<(Self, &[Ray])> =
                rays.chunks(CPU_RAYS).map(|rays| (self.shallow_clone(), rays)).collect();
            let rendered: Result<Vec<_>, TchError> =
                pieces.into_par_iter().map(|(field, rays)| field.render_piece(rays)).collect();
            return Ok(rendered?.concat());
        }
        let pieces =
            run_in_pieces(rays.len(), GPU_RAYS, CPU_RAYS, |range| self.render_piece(&rays[range]))?;
        Ok(pieces.concat())
    }

    fn render_piece(&self, rays: &[Ray]) -> Result<Vec<Pixel>, TchError> {
        let mut usable_rays = rays.to_vec();
        for ray in &mut usable_rays {
            if !ray.is_usable() {
                *ray = Ray { background: ray.background, ..Ray::default() };
            }
        }
        let batch = Batch::new(&usable_rays, self)?;
        let hits = batch.maps.as_ref().map(|maps| to_host(&maps.hits()?)).transpose()?;
        let [colour, premultiplied, weights, t] =
            no_grad(|| -> Result<[Vec<f32>; 4], TchError> {
                let MlpForward { fine, distances, .. } = self.forward(&batch, None)?;
                Ok([
                    to_host(&fine.colour)?,
                    to_host(&fine.premultiplied)?,
                    to_host(&fine.weights)?,
                    to_host(&distances)?,
                ])
            })?;
        let samples = weights.len() / rays.len().max(1);
        let far = self.bounds.far as f32;
        let pixels = rays.iter().enumerate().map(|(i, ray)| {
            if !ray.is_usable() || hits.as_ref().is_some_and(|hits| hits[i] <= 0.0) {
                return Pixel {
                    colour: ray.background,
                    depth: far,
                    median_depth: far,
                    ..Pixel::default()
                };
            }
            let (weights, t) = (&weights[i * samples..][..samples], &t[i * samples..][..samples]);
            let opacity: f32 = weights.iter().sum();
            let distance: f32 = (0..samples).map(|k| weights[k] * t[k]).sum();
            let mut transmittance = 1.0;
            let median = (0..samples).find(|&k| {
                transmittance -= weights[k];
                transmittance <= 0.5
            });
            Pixel {
                colour: std::array::from_fn(|c| colour[3 * i + c]),
                premultiplied: std::array::from_fn(|c| premultiplied[3 * i + c]),
                opacity: opacity.clamp(0.0, 1.0),
                depth: if opacity > MIN_TOTAL_WEIGHT { distance / opacity } else { far },
                median_depth: median.map_or(far, |k| t[k]),
            }
        });
        Ok(pixels.collect())
    }
}

impl RayField for Mlp {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        Self::render(self, rays).map_err(|e| RenderError::Backend(e.to_string()))
    }
}

/// Reads one of a file's networks, whose weights must be finite.
fn read_network(
    weights: &nets::Weights,
    prefix: &str,
    path: &Path,
    architecture: MlpArchitecture,
    device: Device,
) -> Result<MlpNetwork, TorchFieldError> {
    let network = MlpNetwork::read(architecture, |name, shape| {
        let name = format!("{prefix}.{name}");
        let tensor = weights.tensor(&name, shape)?;
        if tensor.f_isfinite()?.f_all()?.f_int64_value(&[])? == 0 {
            let reason = format!("tensor {name} is not finite");
            return Err(TorchFieldError::Format { path: path.to_path_buf(), reason });
        }
        Ok(tensor)
    })?;
    Ok(network.to(device, Kind::Float)?)
}

#[cfg(test)]
mod tests {
    use radiance::clip;
    use scene::Frustum;

    use super::*;

    /// In NDC and in a contraction, rays are sampled between their intersections with the cube,
    /// more densely near the camera. A ray that misses the cube renders its background.
    #[test]
    fn rays_are_sampled_inside_the_cube() {
        let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]];
        let frustum =
            Frustum { camera_to_world: pose, min: [-0.5; 2], max: [0.5; 2], near: 2.0, far: 90.0 };
        let architecture = MlpArchitecture {
            layers: 5,
            hidden_dim: 16,
            coarse_samples: 16,
            fine_samples: 8,
            ..MlpArchitecture::default()
        };
        let ray =
            |origin, direction: [f64; 3]| Ray { origin, direction, background: [0.1, 0.2, 0.3] };
        let rays =
            [ray([0.0, 0.0, 4.0], [0.0, 0.0, -1.0]), ray([0.2, -0.1, 4.1], [0.28, 0.0, -0.96])];
        for space in [Space::Ndc(frustum), Space::Contraction] {
            let bounds = Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.5, far: 90.0, space };
            let field = Mlp::new(architecture, bounds, 3, Device::Cpu).unwrap();
            let output =
                no_grad(|| field.forward(&Batch::new(&rays, &field).unwrap(), None)).unwrap();
            for (i, distances) in to_host(&output.distances).unwrap().chunks_exact(24).enumerate() {
                let ray = clip(&bounds, &rays[i]);
                let ends = [ray.distance(ray.enter), ray.distance(ray.leave)];
                let close = |a: f32, b: f32| (a / b - 1.0).abs() < 2e-3;
                assert!(
                    close(distances[0], ends[0]) && close(distances[23], ends[1]),
                    "{distances:?} {ends:?}"
                );
                assert!(
                    distances.is_sorted() && distances[12] < 0.5 * (ends[0] + ends[1]),
                    "{distances:?}"
                );
            }
            let pixels = field.render(&rays).unwrap();
            assert!(
                pixels
                    .iter()
                    .all(|p| (0.5..91.0).contains(&p.depth)
                        && p.colour.iter().all(|c| c.is_finite()))
            );
        }
        let bounds = Bounds {
            min: [-1.0; 3],
            max: [1.0; 3],
            near: 0.5,
            far: 90.0,
            space: Space::Ndc(frustum),
        };
        let field = Mlp::new(architecture, bounds, 3, Device::Cpu).unwrap();
        let away = field.render(&[ray([0.0, 0.0, 4.0], [0.0, 0.0, 1.0])]).unwrap()[0];
        assert_eq!((away.colour, away.opacity), ([0.1, 0.2, 0.3], 0.0));
    }

    /// In a box, a field with scaled positions renders the same at any position and scale of the
    /// scene. A field without them, like the reference implementation's, depends on both.
    #[test]
    fn scaled_positions_move_with_the_scene() {
        let utm = DVec3::new(500_000.0, 4_649_776.0, 120.0);
        let render = |scaled_positions, shift: DVec3, scale: f64| {
            let architecture = MlpArchitecture {
                scaled_positions,
                layers: 5,
                hidden_dim: 16,
                ..MlpArchitecture::default()
            };
            let bounds = Bounds {
                min: [-1.25 * scale; 3],
                max: [1.25 * scale; 3],
                near: 2.0 * scale,
                far: 6.0 * scale,
                ..Bounds::default()
            };
            let origin = (scale * DVec3::new(0.25, 0.5, 4.0) + shift).to_array();
            let rays = [Ray { origin, direction: [0.0, 0.0, -1.0], background: [1.0; 3] }];
            let field = Mlp::new(architecture, bounds.moved(shift), 3, Device::Cpu).unwrap();
            let pixel = field.render(&rays).unwrap()[0];
            let [r, g, b] = pixel.colour.map(f64::from);
            [r, g, b, f64::from(pixel.opacity), f64::from(pixel.depth) / scale]
        };
        let difference = |a: [f64; 5], b: [f64; 5]| {
            a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        let expected = render(true, DVec3::ZERO, 1.0);
        assert!(
            difference(expected, render(false, DVec3::ZERO, 1.0)) < 1e-6,
            "a unit of 1 at the origin"
        );
        for (shift, scale) in [(utm, 1.0), (DVec3::ZERO, 1024.0), (DVec3::ZERO, 1.0 / 65_536.0)] {
            assert!(difference(expected, render(true, shift, scale)) < 1e-5, "{shift} {scale}");
            assert!(difference(expected, render(false, shift, scale)) > 1e-3, "{shift} {scale}");
        }
    }

    /// Every parameter of both networks is the mean of the two fields' parameters.
    #[test]
    fn fields_are_averaged() {
        let architecture =
            MlpArchitecture { layers: 5, hidden_dim: 16, ..MlpArchitecture::default() };
        let [a, b, mean] = [3, 4, 3].map(|seed| {
            Mlp::new(architecture, Bounds::cube(1.0, 2.0, 6.0), seed, Device::Cpu).unwrap()
        });
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("field.safetensors");
        b.write(&path).unwrap();
        mean.average_with(&path).unwrap();
        for ((mean, a), b) in mean.parameters().zip(a.parameters()).zip(b.parameters()) {
            let (mean, a, b) =
                (to_host(&mean).unwrap(), to_host(&a).unwrap(), to_host(&b).unwrap());
            assert!(
                mean.iter()
                    .zip(a.iter().zip(&b))
                    .all(|(m, (a, b))| (m - 0.5 * (a + b)).abs() < 1e-6)
            );
        }
    }
}
