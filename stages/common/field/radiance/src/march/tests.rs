use numerics::CounterRng;
use scene::{Bounds, Space};

use super::curved::EmptyCube;
use super::{DONE, March, MarchedSamples, march};
use crate::occupancy::{Cell, Occupancy, cell_at, cell_coordinates};
use crate::ray::{NormalizedRay, Ray, RayMap, clip, contracted_velocity};
use crate::spec::OCCUPANCY_CELLS as GRID;
use crate::spec::Strides;

/// Returns t and length of the sample at step k of a ray, without leaps.
fn sample(march: &March<'_>, k: u32) -> Option<(f32, f32)> {
    let March { occupancy, rays: &[ray], step, strides, .. } = *march else {
        panic!("one ray at a time");
    };
    let t = (k as f32 + 0.3).mul_add(step, ray.enter);
    let middle = (k as f32 + 0.3 + 0.5).mul_add(step, ray.enter);
    let c = cell_at(ray.position(t));
    let cell = occupancy.cell(c[0] + GRID * (c[1] + GRID * c[2]));
    if cell == Cell::Empty || t >= ray.leave {
        None
    } else if strides.are_double_in(cell == Cell::Thin) {
        (k.is_multiple_of(2) && middle < ray.leave).then_some((middle, 2.0))
    } else {
        Some((t, 1.0))
    }
}

const STRIDES: [Strides; 3] = [Strides::Single, Strides::ByCell, Strides::Double];

/// Returns a ray's samples without leaps, and its samples found by marching in parts, as the
/// renderer does.
fn expected_and_found(
    occupancy: &Occupancy,
    ray: NormalizedRay,
    strides: Strides,
) -> [Vec<(f32, f32)>; 2] {
    let (mut next, mut found) = ([0], MarchedSamples::default());
    let step = 3.0f32.sqrt() / 512.0;
    let ray_march = March { occupancy, rays: &[ray], offsets: &[0.3], step, strides };
    while next[0] != DONE {
        march(&ray_march, 5, &[0], &mut next, &mut found);
    }
    let expected = (0..2000).filter_map(|k| sample(&ray_march, k)).collect();
    [expected, found.t.into_iter().zip(found.lengths).collect()]
}

/// Returns a ray from a point in [-3, 3]³ towards a point in or near the scene's cube [-1, 1]³. The
/// direction of two in three rays is 0 along one or two axes.
fn straight_ray(seed: u64) -> NormalizedRay {
    let mut rng = CounterRng::new(1, 2, seed);
    let mut draw = || 2.0 * rng.uniform() - 1.0;
    let half_width = if seed.is_multiple_of(3) { 1.0 } else { 3.0 };
    let origin = [draw(), draw(), draw()].map(|x| half_width * x);
    let mut d: [f32; 3] = std::array::from_fn(|i| 1.2 * draw() - origin[i]);
    d.iter_mut().take(seed as usize / 3 % 3).for_each(|x| *x = 0.0);
    let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
    let cube = Bounds::cube(1.0, 0.1, 9.0);
    let direction = d.map(|x| f64::from(x / length));
    clip(&cube, &Ray { origin: origin.map(f64::from), direction, background: [0.0; 3] })
}

/// Returns oblique planes of thin and dense cells.
fn planes() -> Occupancy {
    let mut occupancy = Occupancy::full();
    occupancy.set(|cell| match cell {
        _ if (cell / 7) % 11 != 0 || cell % GRID <= 40 => Cell::Empty,
        _ if (cell / GRID).is_multiple_of(2) => Cell::Thin,
        _ => Cell::Dense,
    });
    occupancy
}

/// Returns a plate one cell thick at a face of the cube: the occupied extent is thin.
fn plate() -> Occupancy {
    let mut occupancy = Occupancy::full();
    occupancy.set(|cell| match cell_coordinates(cell, GRID) {
        [x, _, 0] if x > 70 => Cell::Dense,
        _ => Cell::Empty,
    });
    occupancy
}

#[test]
fn skipping_loses_no_sample() {
    for (occupancy, rays, min_samples) in
        [(planes(), 600, 1000), (plate(), 2000, 200), (Occupancy::full(), 60, 1000)]
    {
        let (mut samples, mut lost) = (0, 0);
        for (seed, strides) in (0..rays).flat_map(|seed| STRIDES.map(|strides| (seed, strides))) {
            let [expected, found] = expected_and_found(&occupancy, straight_ray(seed), strides);
            samples += expected.len();
            lost += expected.iter().filter(|t| !found.contains(t)).count();
            assert!(found.iter().all(|t| expected.contains(t)), "ray {seed}, {strides:?}");
        }
        assert!(samples > min_samples, "{samples} samples");
        // Rounding at a face may move a sample across it.
        assert!(lost * 1000 <= samples, "{lost} of {samples} lost");
    }
}

#[test]
fn empty_cubes_have_no_samples() {
    let mut occupancy = Occupancy::full();
    occupancy.set(|_| Cell::Empty);
    for seed in 0..100 {
        assert_eq!(
            expected_and_found(&occupancy, straight_ray(seed), Strides::Single),
            [vec![], vec![]]
        );
        assert_eq!(
            expected_and_found(&occupancy, bent_ray(seed, 1.5), Strides::Single),
            [vec![], vec![]]
        );
    }
}

/// Each ray's samples don't depend on the rays in other lanes, of which some miss the cube.
#[test]
fn rays_march_together_as_alone() {
    let misses = Ray { origin: [9.0; 3], direction: [1.0, 0.0, 0.0], background: [0.0; 3] };
    let occupancy = planes();
    for create_ray in [straight_ray, |seed| bent_ray(seed, 1.5)] {
        let mut rays: Vec<NormalizedRay> = (0..100).map(create_ray).collect();
        for index in [0, 7, 99] {
            rays[index] = clip(&Bounds::default(), &misses);
            assert!(rays[index].enter >= rays[index].leave);
        }
        let offsets: Vec<f32> = (0..100).map(|i| i as f32 / 100.0).collect();
        for strides in STRIDES {
            let step = 3.0f32.sqrt() / 512.0;
            let all_rays =
                March { occupancy: &occupancy, rays: &rays, offsets: &offsets, step, strides };
            let (mut next, mut together) = ([0; 100], vec![Vec::new(); 100]);
            let mut found = MarchedSamples::default();
            let mut active: Vec<u32> = (0..100).collect();
            while !active.is_empty() {
                found.starts.clear();
                march(&all_rays, 5, &active, &mut next, &mut found);
                for (&r, range) in active.iter().zip(found.starts.windows(2)) {
                    let samples = range[0]..range[1];
                    let lengths = found.lengths[samples.clone()].iter();
                    let positions = found.positions[samples.clone()].iter();
                    together[r as usize].extend(
                        found.t[samples]
                            .iter()
                            .zip(lengths)
                            .zip(positions)
                            .map(|((&t, &length), &position)| (t, length, position)),
                    );
                }
                active.retain(|&r| next[r as usize] != DONE);
            }
            for (r, together) in together.iter().enumerate() {
                let one_ray = March { rays: &rays[r..=r], offsets: &offsets[r..=r], ..all_rays };
                let (mut next, mut found) = ([0], MarchedSamples::default());
                while next[0] != DONE {
                    march(&one_ray, 9, &[0], &mut next, &mut found);
                }
                let alone =
                    (0..found.t.len()).map(|i| (found.t[i], found.lengths[i], found.positions[i]));
                assert!(together.iter().copied().eq(alone), "ray {r}");
            }
        }
    }
}

/// Curved rays leap over empty cells, bricks and blocks of all sizes, and lose no sample.
#[test]
fn bent_rays_lose_no_sample() {
    let mut occupancy = Occupancy::full();
    let centre = |cell: usize| cell_coordinates(cell, GRID).map(|c| (c as f32 + 0.5) / GRID as f32);
    let mut rng = CounterRng::new(3, 0, 0);
    let balls: Vec<[f32; 4]> = (0..40).map(|_| [(); 4].map(|()| rng.uniform())).collect();
    let is_inside = |p: [f32; 3], [x, y, z, size]: [f32; 4]| {
        let squared_distance = (p[0] - x).powi(2) + (p[1] - y).powi(2) + (p[2] - z).powi(2);
        squared_distance < (0.12 * size).powi(2)
    };
    occupancy.set(|cell| match balls.iter().position(|&b| is_inside(centre(cell), b)) {
        None => Cell::Empty,
        Some(ball) if ball % 3 == 0 => Cell::Thin,
        Some(_) => Cell::Dense,
    });
    let mut samples = 0;
    for seed in 0..600 {
        let ray = bent_ray(seed, [0.5, 1.5, 8.0][seed as usize / 3 % 3]);
        let [expected, found] = expected_and_found(&occupancy, ray, STRIDES[seed as usize % 3]);
        samples += expected.len();
        assert!(expected == found, "{ray:?}: {} and {}", expected.len(), found.len());
    }
    assert!(samples > 5_000, "{samples} samples");
}

const CONTRACTED: Bounds =
    Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.01, far: 500.0, space: Space::Contraction };

/// Returns a ray from a point at most `max_offset` radii from the centre along each axis. One ray
/// in four moves along the x axis, in planes that bound blocks.
fn bent_ray(seed: u64, max_offset: f32) -> NormalizedRay {
    let mut rng = CounterRng::new(4, 0, seed);
    let mut draw = || 2.0 * rng.uniform() - 1.0;
    let (mut origin, mut d) = ([draw(), draw(), draw()].map(|x| max_offset * x), [draw(); 3]);
    if seed % 4 == 3 {
        (origin, d) = (origin.map(|x| (8.0 * x).round() / 8.0), [0.0; 3]);
        (origin[0], d[0]) = (-3.0, 1.0);
    } else {
        d = [d[0], draw(), draw()];
    }
    let length = d.iter().map(|x| x * x).sum::<f32>().sqrt();
    let direction = d.map(|x| f64::from(x / length));
    clip(&CONTRACTED, &Ray { origin: origin.map(f64::from), direction, background: [0.0; 3] })
}

/// Curved rays leap far through empty cubes, and never into cells outside of an empty cube.
#[test]
fn bent_rays_leap_within_a_cube() {
    let (mut leaps, mut far_leaps) = (0, 0);
    for seed in 0..4000 {
        let ray = bent_ray(seed, [0.02, 0.5, 1.5, 8.0][seed as usize / 4 % 4]);
        let RayMap::Contracted { radii, .. } = ray.map else { panic!("{ray:?}") };
        let mut rng = CounterRng::new(5, 0, seed);
        for size in [2, 4] {
            let start = (ray.leave - ray.enter).mul_add(rng.uniform(), ray.enter);
            let position = ray.position(start);
            let (low, side) = (cell_at(position).map(|c| c >> size << size), 1 << size);
            let cube = EmptyCube::around(cell_at(position).map(|c| c as u32), size);
            let velocity = contracted_velocity(ray.origin, ray.direction, radii, start);
            let exit = (start + cube.time_inside(&position, &velocity)).min(ray.leave);
            assert!(exit >= start);
            for i in 0..64 {
                let t = (exit - start).mul_add(i as f32 / 64.0, start);
                let cell = cell_at(ray.position(t));
                let is_inside =
                    (0..3).all(|axis| (low[axis]..low[axis] + side).contains(&cell[axis]));
                // By rounding, a position at a face may be in either cell.
                let is_at_face = ray.position(t).iter().any(|x| {
                    let cells = x * GRID as f32;
                    (cells - cells.round()).abs() < 1e-4
                });
                assert!(is_inside || is_at_face, "{ray:?}: {cell:?} at {t}, not in {low:?}");
            }
            leaps += 1;
            far_leaps += usize::from(exit - start > 0.2 * side as f32 / GRID as f32);
        }
    }
    assert!(3 * far_leaps > leaps, "{far_leaps} of {leaps} leaps go far");
}
