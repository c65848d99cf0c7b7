//! The same field written plainly in f64: the judge of the fused f32 passes. Tests only.

use counter_rng::CounterRng;
use scene::Bounds;

use crate::chunk::{Chunk, FeatureGradients};
use crate::composite::{Regularisers, likeness};
use crate::field::{Architecture, COLOUR_INPUTS, DENSITY_OUTPUTS, Field};
use crate::grid::{FEATURES, Level, scatter};
use crate::mlp::{Layer, drain_lanes};
use crate::occupancy::march;
use crate::ray::{Ray, clip};
use crate::simd::LANES;
use crate::spherical::spherical_harmonics;

/// Parameters in f64.
struct Judge<'a> {
    field: &'a Field,
    grid: Vec<f64>,
    network: Vec<f64>,
}

impl Judge<'_> {
    fn interpolate(&self, level: &Level, p: [f64; 3]) -> [f64; FEATURES] {
        let at: [f64; 3] = std::array::from_fn(|i| p[i].clamp(0.0, 1.0) * f64::from(level.resolution[i]));
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
            let [across, down, _] = level.resolution.map(|n| n + 1);
            let index = if level.hashed {
                (v[0] ^ v[1].wrapping_mul(2_654_435_761) ^ v[2].wrapping_mul(805_459_861)) as usize % level.entries
            } else {
                (v[0] + across * (v[1] + down * v[2])) as usize
            };
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

    /// Raw density and the colour network's share of the inputs.
    fn density(&self, p: [f64; 3]) -> Vec<f64> {
        let features: Vec<f64> = self.field.levels.iter().flat_map(|l| self.interpolate(l, p)).collect();
        let [first, second] = self.field.layers.density;
        self.layer(second, &self.layer(first, &features, true), false)
    }

    fn colour(&self, density: &[f64], direction: [f32; 3]) -> [f64; 3] {
        let input: Vec<f64> = density[1..].iter().copied().chain(spherical_harmonics(direction).map(f64::from)).collect();
        assert_eq!((density.len(), input.len()), (DENSITY_OUTPUTS, COLOUR_INPUTS));
        let [first, second, third] = self.field.layers.colour;
        let raw = self.layer(third, &self.layer(second, &self.layer(first, &input, true), true), false);
        [0, 1, 2].map(|c| 1.0 / (1.0 + (-raw[c]).exp()))
    }

    /// Weight and colour of a ray's samples, and the light that comes through; samples that aren't `kept` are dark, as in the fused pass.
    fn shaded(&self, ray: &Ray, samples: &[[f32; 3]], kept: &[bool]) -> (Vec<(f64, [f64; 3])>, f64) {
        let step = f64::from(self.field.step());
        let (mut depth, mut shaded) = (0.0f64, Vec::new());
        for (p, kept) in samples.iter().zip(kept) {
            let density = self.density(p.map(f64::from));
            let tau = density[0].exp() * step;
            if *kept {
                shaded.push(((-depth).exp() * -(-tau).exp_m1(), self.colour(&density, ray.direction)));
            }
            depth += tau;
        }
        (shaded, (-depth).exp())
    }

    /// Colour of a ray over its background.
    fn ray(&self, ray: &Ray, samples: &[[f32; 3]], kept: &[bool]) -> [f64; 3] {
        let (shaded, transmittance) = self.shaded(ray, samples, kept);
        let sum = |c: usize| shaded.iter().map(|(weight, colour)| weight * colour[c]).sum::<f64>();
        std::array::from_fn(|c| transmittance.mul_add(f64::from(ray.background[c]), sum(c)))
    }
}

fn example() -> (Field, Vec<Ray>) {
    let architecture = Architecture { levels: 5, coarsest: 4, finest: 48, finest_z: 20, log2_entries: 9, hidden: 16, steps: 24 };
    let mut field =
        Field::new(architecture, Bounds { min: [-1.0; 3], max: [1.0, 1.2, 1.0], near: 0.5, far: 9.0, ..Default::default() }, 3);
    let mut rng = CounterRng::new(8, 8, 8);
    // Features of the size that training reaches, and density high enough that every sample counts.
    field.grid.iter_mut().for_each(|g| *g = rng.uniform() - 0.5);
    let rays = (0..20)
        .map(|_| {
            let mut unit = || 2.0 * rng.uniform() - 1.0;
            let target = [0.6 * unit(), 0.6 * unit(), 0.6 * unit()];
            let origin = [3.0 * unit(), 3.0, 2.0 * unit()];
            let d: [f32; 3] = std::array::from_fn(|i| target[i] - origin[i]);
            let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
            Ray { origin, direction: d.map(|x| x / length), background: [0.9, 0.5, 0.2] }
        })
        .collect();
    (field, rays)
}

#[test]
fn fused_passes_equal_the_plain_ones() {
    let (field, mut rays) = example();
    let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
    let mut chunk = Chunk::default();
    chunk.forward(&field, &clipped, &[0.5; 20]);
    // All samples of each ray, marched at once.
    let samples: Vec<Vec<[f32; 3]>> = (0..rays.len())
        .map(|r| {
            let mut positions = Vec::new();
            let (step, mut next) = (field.step(), vec![0; rays.len()]);
            let one = [r as u32];
            march(&field.occupancy, &clipped, &[0.5; 20], step, 999, &one, &mut next, &mut vec![], &mut positions, &mut vec![]);
            positions
        })
        .collect();
    let kept: Vec<Vec<bool>> =
        samples.iter().zip(chunk.kept_positions()).map(|(all, kept)| all.iter().map(|p| kept.contains(p)).collect()).collect();
    assert!(samples.iter().map(Vec::len).sum::<usize>() > 100);
    let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
    let mut judge = Judge { field: &field, grid: wide(&field.grid), network: wide(&field.network) };
    // Each ray's background is like one of its samples.
    for (i, ray) in rays.iter_mut().enumerate() {
        let (shaded, _) = judge.shaded(ray, &samples[i], &kept[i]);
        if let Some((_, colour)) = shaded.get(shaded.len() / 2) {
            ray.background = colour.map(|c| c as f32 + 0.02);
        }
    }

    // The loss is Σ g·C with random g, so that its gradient by the colours is g; and the floater loss, where neither likeness
    // to the background nor what comes through to it is learnt from.
    let regularisers = Regularisers { floater_loss: 0.3, ..Regularisers::default() };
    let likenesses: Vec<Vec<f64>> = (0..rays.len())
        .map(|i| {
            let (shaded, through) = judge.shaded(&rays[i], &samples[i], &kept[i]);
            let like = |colour: &[f64; 3]| f64::from(likeness(colour.map(|c| c as f32), rays[i].background));
            shaded.iter().map(|(_, colour)| through * like(colour)).collect()
        })
        .collect();
    let like = likenesses.iter().flatten().filter(|l| **l > 0.0).count();
    println!("{like} samples of {} pass for the background", likenesses.iter().flatten().count());
    assert!(like > 20);
    let mut rng = CounterRng::new(1, 1, 1);
    let g: Vec<[f32; 3]> = rays.iter().map(|_| [0, 1, 2].map(|_| rng.uniform() - 0.5)).collect();
    let loss = |judge: &Judge<'_>| -> f64 {
        let dot = |i: usize| -> f64 {
            let (shaded, _) = judge.shaded(&rays[i], &samples[i], &kept[i]);
            let floaters: f64 = shaded.iter().zip(&likenesses[i]).map(|((weight, _), likeness)| weight * likeness).sum();
            let colour = judge.ray(&rays[i], &samples[i], &kept[i]);
            colour.iter().zip(&g[i]).map(|(c, g)| c * f64::from(*g)).sum::<f64>()
                + f64::from(regularisers.floater_loss) * floaters
        };
        (0..rays.len()).map(dot).sum()
    };
    for (i, sum) in chunk.sums.iter().enumerate() {
        let exact = judge.ray(&rays[i], &samples[i], &kept[i]);
        for c in 0..3 {
            let ours = f64::from(sum.transmittance.mul_add(rays[i].background[c], sum.colour[c]));
            assert!((ours - exact[c]).abs() < 2e-6, "ray {i}: {ours} {}", exact[c]);
        }
    }

    let mut transposed = vec![0.0; field.network.len()];
    field.layers.all().iter().for_each(|l| l.transpose(&field.network, &mut transposed));
    let mut lanes = vec![0.0; field.network.len() * LANES];
    let mut features = FeatureGradients::default();
    let backgrounds: Vec<[f32; 3]> = rays.iter().map(|r| r.background).collect();
    chunk.backward(&field, &transposed, &g, &backgrounds, regularisers, &mut lanes, &mut features);
    let mut network = vec![0.0; field.network.len()];
    drain_lanes(&mut lanes, &mut network);
    let mut grid = vec![0.0f32; field.grid.len()];
    for (level, gradients) in field.levels.iter().zip(&features.levels) {
        scatter(level, &mut grid[level.range()], &mut vec![0; level.blocks()], &features.positions, gradients);
    }

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
        for (i, &gradient) in gradients.iter().enumerate().filter(|(_, g)| **g != 0.0).step_by(stride) {
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

/// Rays that end where it is dark see what the whole rays would, but for the share of light that was left.
#[test]
fn stopping_early_loses_no_more_than_the_light_that_was_left() {
    let (mut field, rays) = example();
    // Dense: most rays are dark after a few samples.
    let [_, second] = field.layers.density;
    field.network[second.range()].iter_mut().step_by(second.outputs).for_each(|w| *w = 6.0);
    let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
    let mut chunk = Chunk::default();
    chunk.forward(&field, &clipped, &[0.5; 20]);
    let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
    let judge = Judge { field: &field, grid: wide(&field.grid), network: wide(&field.network) };
    let mut stopped = 0;
    for (r, sum) in chunk.sums.iter().enumerate() {
        let (mut positions, mut next) = (Vec::new(), vec![0; rays.len()]);
        let one = [r as u32];
        march(
            &field.occupancy,
            &clipped,
            &[0.5; 20],
            field.step(),
            999,
            &one,
            &mut next,
            &mut vec![],
            &mut positions,
            &mut vec![],
        );
        stopped += usize::from(sum.transmittance < 1e-4);
        let exact = judge.ray(&rays[r], &positions, &vec![true; positions.len()]);
        for c in 0..3 {
            let ours = f64::from(sum.transmittance.mul_add(rays[r].background[c], sum.colour[c]));
            assert!((ours - exact[c]).abs() < 1e-3, "ray {r}: {ours} {}", exact[c]);
        }
    }
    assert!(stopped > 5, "{stopped} rays ended in the dark");
}

#[test]
fn every_family_renders_and_trains_to_equal_bits() {
    use crate::simd::{Family, set_family};
    let (field, rays) = example();
    let outcome = || {
        let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
        let mut chunk = Chunk::default();
        chunk.forward(&field, &clipped, &[0.25; 20]);
        let mut bits: Vec<u32> = chunk.sums.iter().flat_map(|s| s.colour.map(f32::to_bits)).collect();
        let mut lanes = vec![0.0; field.network.len() * LANES];
        let mut features = FeatureGradients::default();
        let backgrounds = vec![[0.5; 3]; rays.len()];
        let regularisers = Regularisers { distortion: 0.2, floater_loss: 0.3 };
        chunk.backward(
            &field,
            &field.network,
            &vec![[0.3, -0.2, 0.1]; rays.len()],
            &backgrounds,
            regularisers,
            &mut lanes,
            &mut features,
        );
        bits.extend(lanes.iter().map(|x| x.to_bits()));
        for (level, gradients) in field.levels.iter().zip(&features.levels) {
            let mut grid = vec![0.0f32; level.entries * FEATURES];
            scatter(level, &mut grid, &mut vec![0; level.blocks()], &features.positions, gradients);
            bits.extend(grid.iter().map(|x| x.to_bits()));
        }
        bits
    };
    let best = outcome();
    for family in [Family::Avx512, Family::Avx2, Family::Portable] {
        set_family(family);
        assert!(outcome() == best, "{family:?} gives other bits");
    }
    [Family::Portable, Family::Avx2, Family::Avx512].into_iter().for_each(set_family);
}

#[test]
fn extremes_stay_finite() {
    for raw in [-1e30f32, -50.0, 0.0, 50.0, 1e30] {
        for scale in [1e-6f64, 1.0, 1e6] {
            let architecture = Architecture {
                levels: 2,
                coarsest: 2,
                finest: 4,
                log2_entries: 8,
                hidden: 16,
                steps: 64,
                ..Architecture::default()
            };
            let mut field = Field::new(
                architecture,
                Bounds { min: [-scale; 3], max: [scale; 3], near: 0.1 * scale, far: 20.0 * scale, ..Default::default() },
                3,
            );
            field.grid.fill(1.0);
            field.network.fill(raw / 1e3);
            let s = scale as f32;
            let directions = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [0.0; 3], [f32::NAN, 0.0, 1.0], [0.577, 0.577, 0.577]];
            let rays: Vec<Ray> = directions
                .iter()
                .map(|&direction| Ray { origin: [0.0, 0.0, 4.0 * s], direction, background: [1.0; 3] })
                .collect();
            for (pixel, ray) in field.render(&rays).iter().zip(&rays) {
                let numbers = [pixel.colour[0], pixel.colour[1], pixel.colour[2], pixel.opacity, pixel.depth, pixel.median_depth];
                assert!(numbers.iter().all(|x| x.is_finite()), "{raw} {scale} {ray:?}: {pixel:?}");
                assert!((0.0..=1.0).contains(&pixel.opacity));
                if pixel.opacity == 0.0 {
                    assert!(pixel.depth > 0.0, "no surface: the far end, {pixel:?}");
                }
            }
        }
    }
}
