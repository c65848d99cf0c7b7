//! Plain f64 implementation of the field, for tests of the fused f32 passes.

use numerics::CounterRng;
use scene::Bounds;

use crate::architecture::Architecture;
use crate::chunk::{Chunk, Roulette};
use crate::field::Field;
use crate::grid::Level;
use crate::march::{March, MarchedSamples, march};
use crate::math::spherical_harmonics;
use crate::mlp::Layer;
use crate::occupancy::Cell;
use crate::passes::Passes;
use crate::ray::{NormalizedRay, Ray, clip};
use crate::regularisers::{Regularisers, background_likeness};
use crate::shading::RayGradients;
use crate::spec::Strides;
use crate::spec::{
    BRICK, DENSITY_OUTPUTS, FEATURES, FIRST_RAW_COLOUR, FIRST_VIEW_FEATURE, HASH_FACTORS,
    VIEW_INPUTS,
};

/// Field with f64 parameters, as a reference for the fused passes.
pub(crate) struct Judge<'a> {
    pub(crate) field: &'a Field,
    pub(crate) grid: Vec<f64>,
    pub(crate) network: Vec<f64>,
}

fn colour_of(outputs: &[f64], view_colour: &[f64]) -> [f64; 3] {
    [0, 1, 2].map(|c| 1.0 / (1.0 + (-outputs[FIRST_RAW_COLOUR + c] - view_colour[c]).exp()))
}

impl Judge<'_> {
    fn interpolate(&self, level: &Level, p: [f64; 3]) -> [f64; FEATURES] {
        let at: [f64; 3] =
            std::array::from_fn(|i| p[i].clamp(0.0, 1.0) * f64::from(level.resolution[i]));
        let cell: [u32; 3] = std::array::from_fn(|i| (at[i] as u32).min(level.resolution[i] - 1));
        let mut sum = [0.0; FEATURES];
        for corner in 0..8u32 {
            let d = [corner & 1, corner >> 1 & 1, corner >> 2];
            let v: [u32; 3] = std::array::from_fn(|i| cell[i] + d[i]);
            let w: f64 = (0..3)
                .map(|i| {
                    let f = at[i] - f64::from(cell[i]);
                    if d[i] == 1 { f } else { 1.0 - f }
                })
                .product();
            let [across, down, _] = level.resolution.map(|n| n / 2 + 1);
            let [x, y, z] = v.map(|n| n / 2);
            let brick = if level.hashed {
                (x ^ y.wrapping_mul(HASH_FACTORS[0]) ^ z.wrapping_mul(HASH_FACTORS[1])) as usize
                    % (level.entries / BRICK)
            } else {
                (x + across * (y + down * z)) as usize
            };
            let index = BRICK * brick + (v[0] % 2 + 2 * (v[1] % 2) + 4 * (v[2] % 2)) as usize;
            for k in 0..FEATURES {
                sum[k] += w * self.grid[level.offset + index * FEATURES + k];
            }
        }
        sum
    }

    fn layer(&self, layer: Layer, x: &[f64], relu: bool) -> Vec<f64> {
        let w = &self.network[layer.range()];
        (0..layer.outputs)
            .map(|j| {
                let sum: f64 = (0..layer.inputs).map(|i| w[i * layer.outputs + j] * x[i]).sum();
                if relu { sum.max(0.0) } else { sum }
            })
            .collect()
    }

    /// Outputs of the density network.
    fn density(&self, p: [f64; 3]) -> Vec<f64> {
        let features: Vec<f64> =
            self.field.levels.iter().flat_map(|l| self.interpolate(l, p)).collect();
        let [first, second] = self.field.layers.density;
        self.layer(second, &self.layer(first, &features, true), false)
    }

    /// Returns a ray's view colour from its composited outputs.
    fn view_colour(&self, composited: &[f64], direction: [f32; 3]) -> Vec<f64> {
        let features = composited[FIRST_VIEW_FEATURE..].iter().copied();
        let input: Vec<f64> =
            features.chain(spherical_harmonics(direction).map(f64::from)).collect();
        assert_eq!((composited.len(), input.len()), (DENSITY_OUTPUTS, VIEW_INPUTS));
        let [first, second, third] = self.field.layers.view;
        self.layer(third, &self.layer(second, &self.layer(first, &input, true), true), false)
    }

    /// Returns weight and colour of each coloured sample, and the ray's transmittance. Other
    /// samples attenuate light but have no colour, as in the fused pass.
    fn shaded(&self, ray: &Ray, samples: &[Sample]) -> (Vec<(f64, [f64; 3])>, f64) {
        let step = f64::from(self.field.march_step());
        let (mut optical_depth, mut counted) = (0.0f64, Vec::new());
        let mut composited = vec![0.0; DENSITY_OUTPUTS];
        for sample in samples {
            let outputs = self.density(sample.position.map(f64::from));
            let tau = outputs[0].exp() * step * f64::from(sample.length);
            if sample.is_coloured {
                let weight = (-optical_depth).exp() * -(-tau).exp_m1();
                composited.iter_mut().zip(&outputs).for_each(|(sum, value)| *sum += weight * value);
                counted.push((weight, outputs));
            }
            optical_depth += tau;
        }
        let view_colour = self.view_colour(&composited, ray.direction.map(|x| x as f32));
        (
            counted
                .iter()
                .map(|(weight, outputs)| (*weight, colour_of(outputs, &view_colour)))
                .collect(),
            (-optical_depth).exp(),
        )
    }

    /// Returns the colour of a ray over its background.
    pub(crate) fn ray_colour(&self, ray: &Ray, samples: &[Sample]) -> [f64; 3] {
        let (shaded, transmittance) = self.shaded(ray, samples);
        let sum = |c: usize| shaded.iter().map(|(weight, colour)| weight * colour[c]).sum::<f64>();
        std::array::from_fn(|c| transmittance.mul_add(f64::from(ray.background[c]), sum(c)))
    }
}

/// A sample of a ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    position: [f32; 3],
    /// Number of steps that the sample represents.
    length: f32,
    /// True if the sample has a colour and a gradient.
    is_coloured: bool,
}

/// Returns all samples of each ray; each ray is marched alone, by a single call.
pub(crate) fn samples(
    field: &Field,
    rays: &[NormalizedRay],
    offsets: &[f32],
    strides: Strides,
) -> Vec<Vec<Sample>> {
    let rays_alone = rays.iter().zip(offsets).map(|(&ray, &offset)| {
        let mut marched = MarchedSamples::default();
        let one = March {
            occupancy: &field.occupancy,
            rays: &[ray],
            offsets: &[offset],
            step: field.march_step(),
            strides,
        };
        march(&one, 9999, &[0], &mut [0], &mut marched);
        let samples = marched.positions.into_iter().zip(marched.lengths);
        samples.map(|(position, length)| Sample { position, length, is_coloured: true }).collect()
    });
    rays_alone.collect()
}

/// Returns the gradients of the grid and of the networks by the fused backward pass, and the number
/// of samples with a gradient.
fn fused_gradients(
    field: &Field,
    chunk: &mut Chunk,
    upstream: RayGradients<'_>,
    roulette: Roulette,
) -> (Vec<f32>, Vec<f32>, usize) {
    let mut passes = Passes::new(field);
    std::mem::swap(&mut passes.chunk, chunk);
    passes.backward(field, upstream, roulette);
    passes.scatter(field);
    std::mem::swap(&mut passes.chunk, chunk);
    let samples = passes.feature_gradients.positions.len();
    (passes.grid_gradient(field), passes.network_gradient().to_vec(), samples)
}

pub(crate) fn example() -> (Field, Vec<Ray>) {
    let architecture = Architecture {
        n_levels: 5,
        base_resolution: 4,
        max_resolution: 48,
        finest_z: 20,
        log2_hashmap_size: 9,
        hidden_dim: 16,
        march_steps: 24,
    };
    let mut field = Field::new(
        architecture,
        Bounds { min: [-1.0; 3], max: [1.0, 1.2, 1.0], near: 0.5, far: 9.0, ..Default::default() },
        3,
    );
    let mut rng = CounterRng::new(8, 8, 8);
    // Features of the size that training reaches, and density high enough that every sample counts.
    field.grid.iter_mut().for_each(|g| *g = rng.uniform() - 0.5);
    field.occupancy.set(|cell| if cell / 40 % 3 == 0 { Cell::Thin } else { Cell::Dense });
    let rays = (0..20)
        .map(|_| {
            let mut unit = || 2.0 * rng.uniform() - 1.0;
            let target = [0.6 * unit(), 0.6 * unit(), 0.6 * unit()];
            let origin = [3.0 * unit(), 3.0, 2.0 * unit()];
            let d: [f32; 3] = std::array::from_fn(|i| target[i] - origin[i]);
            let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
            let direction = d.map(|x| f64::from(x / length));
            Ray { origin: origin.map(f64::from), direction, background: [0.9, 0.5, 0.2] }
        })
        .collect();
    (field, rays)
}

fn wide_likeness(colour: &[f64; 3], background: [f32; 3]) -> f64 {
    f64::from(background_likeness(colour.map(|c| c as f32), background))
}

#[test]
fn fused_passes_equal_the_plain_ones() {
    let (field, mut rays) = example();
    let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
    let mut chunk = Chunk::default();
    chunk.forward(&field, &clipped, &[0.5; 20], Strides::ByCell);
    let mut samples = samples(&field, &clipped, &[0.5; 20], Strides::ByCell);
    for (all, kept) in samples.iter_mut().zip(chunk.kept_positions()) {
        all.iter_mut().for_each(|sample| sample.is_coloured = kept.contains(&sample.position));
    }
    let of_length = |length: f32| {
        samples.iter().flatten().filter(|s| s.length == length && s.is_coloured).count()
    };
    assert!(
        of_length(1.0) > 100 && of_length(2.0) > 20,
        "{} and {}",
        of_length(1.0),
        of_length(2.0)
    );
    let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
    let mut judge = Judge { field: &field, grid: wide(&field.grid), network: wide(&field.network) };
    // Each ray's background is like one of its samples.
    for (i, ray) in rays.iter_mut().enumerate() {
        let (shaded, _) = judge.shaded(ray, &samples[i]);
        if let Some((_, colour)) = shaded.get(shaded.len() / 2) {
            ray.background = colour.map(|c| c as f32 + 0.02);
        }
    }

    // The loss is Σ g·C plus the floater loss; the random g are the gradients with respect to the
    // rays' colours C. The floater loss has no gradient with respect to sample colours and
    // transmittance, so likenesses are computed once and stay constant.
    let regularisers = Regularisers { distortion: 0.0, floater_loss: 0.3 };
    let likenesses: Vec<Vec<f64>> = (0..rays.len())
        .map(|i| {
            let (shaded, through) = judge.shaded(&rays[i], &samples[i]);
            shaded
                .iter()
                .map(|(_, colour)| through * wide_likeness(colour, rays[i].background))
                .collect()
        })
        .collect();
    let like = likenesses.iter().flatten().filter(|l| **l > 0.0).count();
    println!("{like} samples of {} pass for the background", likenesses.iter().flatten().count());
    assert!(like > 20);
    let mut rng = CounterRng::new(1, 1, 1);
    let g: Vec<[f32; 3]> = rays.iter().map(|_| [0, 1, 2].map(|_| rng.uniform() - 0.5)).collect();
    let loss = |judge: &Judge<'_>| -> f64 {
        let dot = |i: usize| -> f64 {
            let (shaded, _) = judge.shaded(&rays[i], &samples[i]);
            let floaters: f64 = shaded
                .iter()
                .zip(&likenesses[i])
                .map(|((weight, _), background_likeness)| weight * background_likeness)
                .sum();
            let colour = judge.ray_colour(&rays[i], &samples[i]);
            colour.iter().zip(&g[i]).map(|(c, g)| c * f64::from(*g)).sum::<f64>()
                + regularisers.floater_loss * floaters
        };
        (0..rays.len()).map(dot).sum()
    };
    for (i, sum) in chunk.sums.iter().enumerate() {
        let exact = judge.ray_colour(&rays[i], &samples[i]);
        for c in 0..3 {
            let ours = f64::from(sum.transmittance.mul_add(rays[i].background[c], sum.colour[c]));
            assert!((ours - exact[c]).abs() < 2e-6, "ray {i}: {ours} {}", exact[c]);
        }
    }

    let backgrounds: Vec<[f32; 3]> = rays.iter().map(|r| r.background).collect();
    let upstream = RayGradients { colours: &g, backgrounds: &backgrounds, regularisers };
    let (grid, network, _) = fused_gradients(&field, &mut chunk, upstream, Roulette::default());

    let mut difference = |which: usize, index: usize| {
        const H: f64 = 1e-6;
        let mut at = |by: f64| {
            (if which == 0 { &mut judge.grid } else { &mut judge.network })[index] += by;
            loss(&judge)
        };
        let (up, down) = (at(H), at(-2.0 * H));
        at(H);
        (up - down) / (2.0 * H)
    };
    for (which, gradients) in [(0, &grid), (1, &network)] {
        let (mut error, mut norm, mut checked) = (0.0, 0.0, 0);
        let stride = gradients.iter().filter(|g| **g != 0.0).count() / 150 + 1;
        for (i, &gradient) in
            gradients.iter().enumerate().filter(|(_, g)| **g != 0.0).step_by(stride)
        {
            let exact = difference(which, i);
            error += (f64::from(gradient) - exact).powi(2);
            norm += exact.powi(2);
            checked += 1;
        }
        assert!(
            checked > 50 && error.sqrt() < 1e-5 * norm.sqrt(),
            "{which}: {} of {}, {checked} checked",
            error.sqrt(),
            norm.sqrt()
        );
    }
}

fn drawn_gradients(
    field: &Field,
    clipped: &[NormalizedRay],
    upstream: RayGradients<'_>,
    roulette: Roulette,
) -> (Vec<f32>, Vec<f32>, usize) {
    let mut chunk = Chunk::default();
    chunk.forward(field, clipped, &[0.5; 20], Strides::ByCell);
    fused_gradients(field, &mut chunk, upstream, roulette)
}

/// Samples with short gradients are drawn, and the mean over evenly spaced draws is the gradient of
/// all of them.
#[test]
fn roulette_keeps_the_expected_gradient() {
    let (field, rays) = example();
    let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
    let mut rng = CounterRng::new(2, 1, 1);
    let colours: Vec<[f32; 3]> =
        rays.iter().map(|_| [0, 1, 2].map(|_| rng.uniform() - 0.5)).collect();
    let backgrounds = [[0.5; 3]; 20];
    let upstream = RayGradients {
        colours: &colours,
        backgrounds: &backgrounds,
        regularisers: Regularisers::default(),
    };
    let (all_grid, all_network, all) =
        drawn_gradients(&field, &clipped, upstream, Roulette::default());
    let all_gradients: Vec<f64> =
        all_grid.iter().chain(&all_network).map(|&g| f64::from(g)).collect();
    const DRAWS: usize = 400;
    let (mut mean, mut kept) = (vec![0.0f64; all_gradients.len()], 0);
    for draw in 0..DRAWS {
        let draw = (draw as f32 + 0.5) / DRAWS as f32;
        let (grid, network, chosen) =
            drawn_gradients(&field, &clipped, upstream, Roulette { limit: 1.0, draw });
        kept += chosen;
        mean.iter_mut()
            .zip(grid.iter().chain(&network))
            .for_each(|(sum, &g)| *sum += f64::from(g) / DRAWS as f64);
    }
    let norm = |of: &mut dyn Iterator<Item = f64>| of.map(|x| x * x).sum::<f64>().sqrt();
    let error = norm(&mut mean.iter().zip(&all_gradients).map(|(a, b)| a - b))
        / norm(&mut all_gradients.iter().copied());
    let share = kept as f64 / (DRAWS * all) as f64;
    println!("{share} of {all} samples are kept; the mean gradient is off by {error}");
    assert!((0.1..0.8).contains(&share) && error < 0.01, "{share} {error}");
}

/// A ray that stops early has the colour of the whole ray, up to the share of light that was
/// left.
#[test]
fn stopping_early_loses_no_more_than_the_light_that_was_left() {
    let (mut field, rays) = example();
    // Dense: most rays are dark after a few samples.
    let [_, second] = field.layers.density;
    field.network[second.range()].iter_mut().step_by(second.outputs).for_each(|w| *w = 6.0);
    let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
    let mut chunk = Chunk::default();
    chunk.forward(&field, &clipped, &[0.5; 20], Strides::Single);
    let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
    let judge = Judge { field: &field, grid: wide(&field.grid), network: wide(&field.network) };
    let samples = samples(&field, &clipped, &[0.5; 20], Strides::Single);
    let mut stopped = 0;
    for (r, sum) in chunk.sums.iter().enumerate() {
        stopped += usize::from(sum.transmittance < 1e-4);
        let exact = judge.ray_colour(&rays[r], &samples[r]);
        for c in 0..3 {
            let ours = f64::from(sum.transmittance.mul_add(rays[r].background[c], sum.colour[c]));
            assert!((ours - exact[c]).abs() < 1e-3, "ray {r}: {ours} {}", exact[c]);
        }
    }
    assert!(stopped > 5, "{stopped} rays ended in the dark");
}

fn outcome(field: &Field, rays: &[Ray]) -> Vec<u32> {
    let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
    let mut chunk = Chunk::default();
    chunk.forward(field, &clipped, &[0.25; 20], Strides::ByCell);
    let mut bits: Vec<u32> = chunk.sums.iter().flat_map(|s| s.colour.map(f32::to_bits)).collect();
    let regularisers = Regularisers { distortion: 0.2, floater_loss: 0.3 };
    let upstream = RayGradients {
        colours: &[[0.3, -0.2, 0.1]; 20],
        backgrounds: &[[0.5; 3]; 20],
        regularisers,
    };
    let roulette = Roulette { limit: 1.0, draw: 0.7 };
    let (grid, network, _) = fused_gradients(field, &mut chunk, upstream, roulette);
    bits.extend(grid.iter().chain(&network).map(|x| x.to_bits()));
    bits
}

#[test]
fn every_family_renders_and_trains_to_equal_bits() {
    use numerics::simd::test_every_family;
    let (field, rays) = example();
    let best = outcome(&field, &rays);
    test_every_family(|family| {
        assert!(outcome(&field, &rays) == best, "{family:?} gives other bits");
    });
}

#[test]
fn extremes_stay_finite() {
    for raw in [-1e30f32, -50.0, 0.0, 50.0, 1e30] {
        for scale in [1e-6f64, 1.0, 1e6] {
            let architecture = Architecture {
                n_levels: 2,
                base_resolution: 2,
                max_resolution: 4,
                log2_hashmap_size: 8,
                hidden_dim: 16,
                march_steps: 64,
                ..Architecture::default()
            };
            let mut field = Field::new(
                architecture,
                Bounds {
                    min: [-scale; 3],
                    max: [scale; 3],
                    near: 0.1 * scale,
                    far: 20.0 * scale,
                    ..Default::default()
                },
                3,
            );
            field.grid.fill(1.0);
            field.network.fill(raw / 1e3);
            let directions = [
                [0.0, 0.0, -1.0],
                [0.0, 1.0, 0.0],
                [0.0; 3],
                [f64::NAN, 0.0, 1.0],
                [0.577, 0.577, 0.577],
            ];
            let rays: Vec<Ray> = directions
                .iter()
                .map(|&direction| Ray {
                    origin: [0.0, 0.0, 4.0 * scale],
                    direction,
                    background: [1.0; 3],
                })
                .collect();
            for (pixel, ray) in field.render(&rays).iter().zip(&rays) {
                let numbers = [
                    pixel.colour[0],
                    pixel.colour[1],
                    pixel.colour[2],
                    pixel.opacity,
                    pixel.depth,
                    pixel.median_depth,
                ];
                assert!(numbers.iter().all(|x| x.is_finite()), "{raw} {scale} {ray:?}: {pixel:?}");
                assert!((0.0..=1.0).contains(&pixel.opacity));
                if pixel.opacity == 0.0 {
                    assert!(pixel.depth > 0.0, "no surface: the far end, {pixel:?}");
                }
            }
        }
    }
}
