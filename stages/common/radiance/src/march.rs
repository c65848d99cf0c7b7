//! Where rays take samples: they march by equal steps, and leap over what is empty.

use crate::occupancy::{EmptyCube, Held, Occupancy, cell_of};
use crate::ray::{FASTEST, MOST_BENT, NormalizedRay, RayMap};
use crate::simd::kernel;
use crate::spec::OCCUPANCY_CELLS as GRID;

/// Where a ray's march stands: the number of its next step; [`DONE`] once it has left the box.
pub(crate) const DONE: u32 = u32::MAX;

/// Rays to march, and how.
#[derive(Clone, Copy, Debug)]
pub(crate) struct March<'a> {
    pub(crate) occupancy: &'a Occupancy,
    pub(crate) rays: &'a [NormalizedRay],
    /// Share of a step by which each ray's samples are shifted.
    pub(crate) offsets: &'a [f32],
    /// Distance between samples, in cube sides.
    pub(crate) step: f32,
    pub(crate) strides: Strides,
}

/// Whether rays take a sample at every step, or one of double length at every other step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strides {
    /// At every step: to render.
    Even,
    /// At every other step in thin cells: to train, where samples of other rays lie in between.
    ByCell,
    /// At every other step: to begin a training, while density is smooth and little is known.
    Double,
}

impl Strides {
    /// Whether samples in a thin cell, or in a dense one, stand for two steps.
    fn are_double_in(self, thin: bool) -> bool {
        match self {
            Self::Even => false,
            Self::ByCell => thin,
            Self::Double => true,
        }
    }
}

/// Samples found by marching, ray by ray.
#[derive(Debug, Default)]
pub(crate) struct Marched {
    /// Where each sample lies along its ray.
    pub(crate) t: Vec<f32>,
    /// How many steps it stands for.
    pub(crate) lengths: Vec<f32>,
    /// Its place in the unit cube.
    pub(crate) positions: Vec<[f32; 3]>,
    /// First sample of each active ray, and the end.
    pub(crate) starts: Vec<usize>,
}

impl Marched {
    #[inline(always)]
    fn push(&mut self, t: f32, length: f32, position: [f32; 3]) {
        self.t.push(t);
        self.lengths.push(length);
        self.positions.push(position);
    }
}

impl EmptyCube {
    /// The t at which a ray leaves the cube, or, where the ray is bent, one at which it is still
    /// inside. At t = `at` the ray is at `position`; `inverse` is 1 over its direction.
    #[inline(always)]
    fn exit(&self, ray: &NormalizedRay, inverse: &[f32; 3], at: f32, position: &[f32; 3]) -> f32 {
        let Self { low, side } = *self;
        if let RayMap::Contracted { radii, .. } = ray.map {
            return self.bent_exit(ray, radii, at, position);
        }
        let mut exit = f32::INFINITY;
        for i in 0..3 {
            let face = low[i] + if ray.direction[i] > 0.0 { side } else { 0 };
            let until = (face as f32 / GRID as f32 - ray.origin[i]) * inverse[i];
            if ray.direction[i] != 0.0 && until < exit {
                exit = until;
            }
        }
        exit
    }

    /// A t at which a bent ray is still inside: bounded by its greatest speed, and by its velocity
    /// at `at` with the most that this changes.
    #[inline(always)]
    fn bent_exit(&self, ray: &NormalizedRay, radii: f32, at: f32, position: &[f32; 3]) -> f32 {
        // A ray takes about a step through half a cell, and goes on by a step anyway.
        if self.side == 1 {
            return at;
        }
        let velocity = ray.contracted_velocity(radii, at);
        let (mut nearest, mut stay) = (f32::INFINITY, f32::INFINITY);
        for i in 0..3 {
            let low = self.low[i] as f32 / GRID as f32;
            let high = (self.low[i] + self.side) as f32 / GRID as f32;
            // Rounding may put a place outside of the unit cube.
            let (below, above) = ((position[i] - low).max(0.0), (high - position[i]).max(0.0));
            nearest = nearest.min(below.min(above));
            let (ahead, behind) = if velocity[i] > 0.0 { (above, below) } else { (below, above) };
            let speed = velocity[i].abs();
            // Roots of v·Δ + a·Δ²/2 = ahead and v·Δ - a·Δ²/2 = -behind.
            let to_ahead =
                2.0 * ahead / (speed + (2.0 * MOST_BENT).mul_add(ahead, speed * speed).sqrt());
            let to_behind = (speed + (2.0 * MOST_BENT).mul_add(behind, speed * speed).sqrt())
                * (1.0 / MOST_BENT);
            // NaN at a face that the ray moves along: there it stays no longer.
            stay = stay.min(to_ahead.max(0.0)).min(to_behind);
        }
        // Rounding of the velocity is less than a thousandth.
        (nearest * (1.0 / FASTEST)).max(stay * 0.999) + at
    }
}

/// Steps of a bent ray whose places are found together, in one vector: their exponentials cost
/// more than all else.
const STEPS_AHEAD: usize = 8;

/// One ray's march.
struct RayMarch<'a> {
    march: &'a March<'a>,
    ray: &'a NormalizedRay,
    offset: f32,
    /// 1 over the ray's direction.
    inverse: [f32; 3],
    /// Behind this t there is nothing.
    until: f32,
}

impl RayMarch<'_> {
    /// The first step at t or behind it. A t that isn't finite has the first step of all.
    #[inline(always)]
    fn step_at(&self, t: f32) -> u32 {
        let step = (t - self.ray.enter).mul_add(1.0 / self.march.step, -self.offset).ceil();
        if step.is_finite() { step as u32 } else { 0 }
    }

    /// Marches on from step `k`, `AHEAD` places at a time; gives the next step.
    #[inline(always)]
    fn run<const AHEAD: usize>(&self, most: usize, mut k: u32, samples: &mut Marched) -> u32 {
        let March { occupancy, step, strides, .. } = *self.march;
        let (ray, offset) = (self.ray, self.offset);
        let mut left = most;
        while left > 0 {
            let first = k;
            let ahead: [f32; AHEAD] = std::array::from_fn(|i| {
                (first as f32 + i as f32 + offset).mul_add(step, ray.enter)
            });
            let places = ray.positions(&ahead);
            while left > 0 && ((k - first) as usize) < AHEAD {
                let at = ahead[(k - first) as usize];
                if at >= self.until {
                    return DONE;
                }
                let p = places.map(|axis| axis[(k - first) as usize]);
                match occupancy.held(cell_of(p)) {
                    Held::Empty(cube) => {
                        // Where the ray leaves what is empty; at least one step on.
                        k = (k + 1).max(self.step_at(cube.exit(ray, &self.inverse, at, &p)));
                        continue;
                    }
                    held if strides.are_double_in(matches!(held, Held::Thin)) => {
                        let middle = (k as f32 + offset + 0.5).mul_add(step, ray.enter);
                        if k & 1 == 0 && middle < ray.leave {
                            samples.push(middle, 2.0, ray.position(middle));
                            left -= 1;
                        }
                    }
                    Held::Thin | Held::Dense => {
                        samples.push(at, 1.0, p);
                        left -= 1;
                    }
                }
                k += 1;
            }
        }
        k
    }
}

kernel! {
    /// Marches on: at most `most` more samples of each of the `active` rays. Step k of a ray lies
    /// at t = enter + (k + offset)·step. An occupied cell gives a sample there; where [`Strides`]
    /// are double, it gives a sample of two steps where k is even, in the middle of both. `next` is
    /// each ray's k, from 0 to [`DONE`].
    pub(crate) fn march<L>(march: &March<'_>, most: usize, active: &[u32], next: &mut [u32],
        samples: &mut Marched) {
        for &r in active {
            samples.starts.push(samples.t.len());
            let (ray, offset) = (march.rays[r as usize], march.offsets[r as usize]);
            let next = &mut next[r as usize];
            let inverse = ray.direction.map(|d| 1.0 / d);
            *next = match ray.map {
                RayMap::Straight { .. } => match march.occupancy.crossing(&ray, &inverse) {
                    None => DONE,
                    Some([from, until]) => {
                        // Without the constant the compiler computes the exponential of bent rays
                        // here, too.
                        let ray = &NormalizedRay { map: RayMap::default(), ..ray };
                        let one = RayMarch { march, ray, offset, inverse, until };
                        one.run::<1>(most, one.step_at(from).max(*next), samples)
                    }
                },
                RayMap::Contracted { .. } => {
                    let until = ray.leave;
                    let one = RayMarch { march, ray: &ray, offset, inverse, until };
                    one.run::<STEPS_AHEAD>(most, *next, samples)
                }
            };
        }
        samples.starts.push(samples.t.len());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occupancy::{Cell, SIDE, corner};
    use counter_rng::CounterRng;

    /// What step k of a ray gives, without leaps: a sample's t and its length.
    fn sample(march: &March<'_>, k: u32) -> Option<(f32, f32)> {
        let March { occupancy, rays: &[ray], step, strides, .. } = *march else {
            panic!("one ray at a time");
        };
        let t = (k as f32 + 0.3).mul_add(step, ray.enter);
        let middle = (k as f32 + 0.3 + 0.5).mul_add(step, ray.enter);
        let c = cell_of(ray.position(t));
        let held = occupancy.cell(c[0] + GRID * (c[1] + GRID * c[2]));
        if held == Cell::Empty || t >= ray.leave {
            None
        } else if strides.are_double_in(held == Cell::Thin) {
            (k.is_multiple_of(2) && middle < ray.leave).then_some((middle, 2.0))
        } else {
            Some((t, 1.0))
        }
    }

    const STRIDES: [Strides; 3] = [Strides::Even, Strides::ByCell, Strides::Double];

    /// All samples of a ray without leaps, and those found by marching in parts, as the renderer
    /// does.
    fn both(occupancy: &Occupancy, ray: NormalizedRay, strides: Strides) -> [Vec<(f32, f32)>; 2] {
        let (mut next, mut found) = ([0], Marched::default());
        let step = 3.0f32.sqrt() / 512.0;
        let march_on = March { occupancy, rays: &[ray], offsets: &[0.3], step, strides };
        while next[0] != DONE {
            march(&march_on, 5, &[0], &mut next, &mut found);
        }
        let expected = (0..2000).filter_map(|k| sample(&march_on, k)).collect();
        [expected, found.t.into_iter().zip(found.lengths).collect()]
    }

    #[test]
    fn skipping_loses_no_sample() {
        let mut occupancy = Occupancy::full();
        occupancy.set(|cell| match cell {
            _ if (cell / 7) % 11 != 0 || cell % GRID <= 40 => Cell::Empty,
            _ if (cell / GRID).is_multiple_of(2) => Cell::Thin,
            _ => Cell::Dense,
        });
        for seed in 0..200 {
            let mut rng = CounterRng::new(1, 2, seed);
            let mut unit = || rng.uniform();
            let origin = [unit(), unit(), unit()];
            let d = [unit() - 0.5, unit() - 0.5, if seed % 5 == 0 { 0.0 } else { unit() - 0.5 }];
            let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
            let direction = d.map(|x| x / length);
            let leave = (0..3)
                .filter(|&i| direction[i] != 0.0)
                .map(|i| {
                    (if direction[i] > 0.0 { 1.0 - origin[i] } else { -origin[i] }) / direction[i]
                })
                .fold(f32::INFINITY, f32::min);
            let ray = NormalizedRay { origin, direction, leave, ..NormalizedRay::default() };
            let [expected, found] = both(&occupancy, ray, STRIDES[seed as usize % 3]);
            // Rounding at a face may move one sample in a thousand across it.
            let missing = expected.iter().filter(|t| !found.contains(t)).count();
            assert!(missing * 100 <= expected.len(), "{missing} of {} lost", expected.len());
            assert!(found.iter().all(|t| expected.contains(t)));
        }
    }

    /// Bent rays leap over empty cells, bricks and blocks of all sizes, and lose no sample.
    #[test]
    fn bent_rays_lose_no_sample() {
        let mut occupancy = Occupancy::full();
        let middle = |cell: usize| corner(cell, GRID).map(|c| (c as f32 + 0.5) / GRID as f32);
        let mut rng = CounterRng::new(3, 0, 0);
        let balls: Vec<[f32; 4]> = (0..40).map(|_| [(); 4].map(|()| rng.uniform())).collect();
        let is_inside = |p: [f32; 3], [x, y, z, size]: [f32; 4]| {
            let away = (p[0] - x).powi(2) + (p[1] - y).powi(2) + (p[2] - z).powi(2);
            away < (0.12 * size).powi(2)
        };
        occupancy.set(|cell| match balls.iter().position(|&b| is_inside(middle(cell), b)) {
            None => Cell::Empty,
            Some(ball) if ball % 3 == 0 => Cell::Thin,
            Some(_) => Cell::Dense,
        });
        let mut samples = 0;
        for seed in 0..600 {
            let ray = bent_ray(seed, [0.5, 1.5, 8.0][seed as usize % 3]);
            let [expected, found] = both(&occupancy, ray, STRIDES[seed as usize % 3]);
            samples += expected.len();
            assert!(expected == found, "{ray:?}: {} and {}", expected.len(), found.len());
        }
        assert!(samples > 5_000, "{samples} samples");
    }

    const AROUND: scene::Bounds = scene::Bounds {
        min: [-1.0; 3],
        max: [1.0; 3],
        near: 0.01,
        far: 500.0,
        space: scene::Space::Contraction,
    };

    /// A ray that passes the centre at a distance of up to `wide` radii; one in four moves along
    /// an axis in planes that bound blocks.
    fn bent_ray(seed: u64, wide: f32) -> NormalizedRay {
        let mut rng = CounterRng::new(4, 0, seed);
        let mut draw = || 2.0 * rng.uniform() - 1.0;
        let (mut origin, mut d) = ([draw(), draw(), draw()].map(|x| wide * x), [draw(); 3]);
        if seed % 4 == 3 {
            (origin, d) = (origin.map(|x| (8.0 * x).round() / 8.0), [0.0; 3]);
            (origin[0], d[0]) = (-3.0, 1.0);
        } else {
            d = [d[0], draw(), draw()];
        }
        let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
        let direction = d.map(|x| x / length);
        crate::ray::clip(&AROUND, &crate::ray::Ray { origin, direction, background: [0.0; 3] })
    }

    /// Bent rays leap far through empty cubes, and never out of them: as far as cells tell.
    #[test]
    fn bent_rays_leap_within_a_cube() {
        let (mut leaps, mut far) = (0, 0);
        for seed in 0..4000 {
            let ray = bent_ray(seed, [0.02, 0.5, 1.5, 8.0][seed as usize / 4 % 4]);
            let mut rng = CounterRng::new(5, 0, seed);
            for side in [SIDE, SIDE * SIDE] {
                let at = (ray.leave - ray.enter).mul_add(rng.uniform(), ray.enter);
                let position = ray.position(at);
                let cube = EmptyCube { low: cell_of(position).map(|c| c / side * side), side };
                let exit = cube.exit(&ray, &[0.0; 3], at, &position).min(ray.leave);
                assert!(exit >= at);
                for i in 0..64 {
                    let t = (exit - at).mul_add(i as f32 / 64.0, at);
                    let cell = cell_of(ray.position(t));
                    let is_inside = (0..3)
                        .all(|axis| (cube.low[axis]..cube.low[axis] + side).contains(&cell[axis]));
                    // A place at a face may lie in either cell, by rounding.
                    let is_at_face = ray.position(t).iter().any(|x| {
                        let cells = x * GRID as f32;
                        (cells - cells.round()).abs() < 1e-4
                    });
                    assert!(
                        is_inside || is_at_face,
                        "{ray:?}: {cell:?} at {t}, not in {:?}",
                        cube.low
                    );
                }
                leaps += 1;
                far += usize::from(exit - at > 0.2 * side as f32 / GRID as f32);
            }
        }
        assert!(3 * far > leaps, "{far} of {leaps} leaps go far");
    }
}
