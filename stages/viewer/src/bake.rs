//! A field as a volume of voxels. A voxel has the opacity of a step as long as itself, the mean
//! colour it shows to the cameras that see it, and how this colour changes with the direction.

use glam::DVec3;
use radiance::{PointSample, spec::VIEW_FEATURES};
use rayon::prelude::*;
use scene::{Bounds, Camera};
use stage::Progress;

use crate::bricks::{Bricks, SIDE, VOXELS};
use crate::source::Source;
use crate::view::{NUMBERS, fit};
use crate::visibility::seen_by;

/// Places along a voxel's side at which the field is asked.
const PLACES_PER_SIDE: usize = 2;
/// Places of a voxel.
const PLACES_PER_VOXEL: usize = PLACES_PER_SIDE * PLACES_PER_SIDE * PLACES_PER_SIDE;
/// Directions at most for which a voxel's colour is fitted.
const MOST_DIRECTIONS: usize = 16;
/// Opacity below which a voxel is empty: less than half a step of a byte.
const LEAST_OPACITY: f32 = 0.5 / 255.0;

/// A baked field.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Volume {
    pub(crate) resolution: usize,
    pub(crate) voxels: Vec<Voxel>,
}

/// A voxel that some camera sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Voxel {
    pub(crate) place: [u16; 3],
    /// Share of the light that a step of a voxel's length stops.
    pub(crate) opacity: f32,
    /// Display-encoded sRGB, the mean over the directions it is seen from.
    pub(crate) colour: [f32; 3],
    /// What is added to the colour's logit, by direction: see [`crate::view`].
    pub(crate) view: [f32; NUMBERS],
}

/// Voxels of some bricks: their opacities, and the cameras that see them as bits. They have no
/// colours yet.
pub(crate) struct Shape {
    bricks: Bricks,
    opacity: Vec<f32>,
    seen: Vec<u64>,
}

impl Shape {
    /// Bytes that [`Baker::shape`] needs for some bricks.
    pub(crate) fn memory_need(bricks: &Bricks) -> u64 {
        // An opacity, cameras that see the voxel, and cameras that see its neighbours.
        const BYTES_PER_VOXEL: usize = size_of::<f32>() + 2 * size_of::<u64>();
        (BYTES_PER_VOXEL * VOXELS * bricks.len()) as u64
    }

    /// Bytes that [`Baker::volume`] needs: visible voxels, twice while they are collected.
    pub(crate) fn volume_memory_need(&self) -> u64 {
        let count = (0..self.seen.len()).into_par_iter().filter(|&voxel| self.keeps(voxel)).count();
        (2 * size_of::<Voxel>() * count) as u64
    }

    /// True if a voxel is visible.
    fn keeps(&self, voxel: usize) -> bool {
        self.opacity[voxel] >= LEAST_OPACITY && self.seen[voxel] != 0
    }
}

/// Bakes sources, whose mean is shown, as far as cameras see them.
pub(crate) struct Baker<'a, S> {
    pub(crate) sources: &'a [S],
    pub(crate) bounds: &'a Bounds,
    pub(crate) cameras: &'a [Camera],
    pub(crate) resolution: usize,
}

impl<S: Source> Baker<'_, S> {
    /// Returns the bricks in which a source may have something.
    pub(crate) fn bricks(&self) -> Bricks {
        Bricks::new(self.resolution, |brick| {
            let corner =
                |more: usize| brick.map(|c| ((c + more) * SIDE) as f32 / self.resolution as f32);
            // The upper corner itself belongs to the next brick.
            let high = corner(1).map(|c| c - 1e-6);
            self.sources.iter().any(|source| source.may_hold(corner(0), high))
        })
    }

    /// Steps of progress that baking takes.
    pub(crate) fn steps(&self, bricks: &Bricks) -> u64 {
        (2 * bricks.len() + self.cameras.len()) as u64
    }

    /// Finds the voxels' opacities and the cameras that see them.
    pub(crate) fn shape(&self, bricks: Bricks, progress: &Progress) -> Shape {
        let opacity: Vec<f32> = bricks
            .places()
            .par_iter()
            .flat_map_iter(|&brick| {
                progress.add(1);
                opacities(self.sources, brick, self.resolution)
            })
            .collect();
        let seen = seen_by(&bricks, &opacity, (self.cameras, self.bounds), progress);
        Shape { seen: with_neighbours(&bricks, &seen), bricks, opacity }
    }

    /// Finds the colours of the visible voxels.
    pub(crate) fn volume(&self, shape: &Shape, progress: &Progress) -> Volume {
        let bricks = &shape.bricks;
        let voxels = (0..bricks.len())
            .into_par_iter()
            .flat_map_iter(|slot| {
                progress.add(1);
                let wanted: Vec<usize> =
                    (slot * VOXELS..(slot + 1) * VOXELS).filter(|&v| shape.keeps(v)).collect();
                let found = self.of_brick(bricks.places()[slot], &wanted, &shape.seen);
                let voxels = wanted.into_iter().zip(found).map(|(v, (colour, view))| Voxel {
                    place: bricks.place_of(v).map(|c| c as u16),
                    opacity: shape.opacity[v],
                    colour,
                    view,
                });
                voxels.collect::<Vec<_>>()
            })
            .collect();
        Volume { resolution: self.resolution, voxels }
    }

    /// Colour and view dependence of some of a brick's voxels; each source counts as much as it is
    /// opaque.
    fn of_brick(
        &self,
        brick: [usize; 3],
        voxels: &[usize],
        seen: &[u64],
    ) -> Vec<([f32; 3], [f32; NUMBERS])> {
        let places = places(brick, voxels.iter().copied(), self.resolution);
        let directions: Vec<Vec<[f32; 3]>> = voxels
            .iter()
            .zip(places.chunks_exact(PLACES_PER_VOXEL))
            .map(|(&voxel, places)| self.directions(places[PLACES_PER_VOXEL / 2], seen[voxel]))
            .collect();
        let mut sums = vec![([0.0f32; 3], [0.0f32; NUMBERS], 0.0f32); voxels.len()];
        for source in self.sources {
            let samples = source.sample(&places);
            let voxels = samples.chunks_exact(PLACES_PER_VOXEL).zip(&directions);
            for ((samples, directions), (colour, view, weight)) in voxels.zip(&mut sums) {
                let own = opacity_of(samples, self.resolution);
                let (c, v) = shade(source, samples, directions, self.resolution);
                colour.iter_mut().zip(c).for_each(|(sum, c)| *sum += own * c);
                view.iter_mut().zip(v).for_each(|(sum, v)| *sum += own * v);
                *weight += own;
            }
        }
        sums.into_iter()
            .map(|(colour, view, weight)| (colour.map(|c| c / weight), view.map(|v| v / weight)))
            .collect()
    }

    /// Directions from some of the cameras that see a place to it, unit length in the world.
    fn directions(&self, place: [f32; 3], seen: u64) -> Vec<[f32; 3]> {
        let point = in_box(self.bounds, DVec3::from(place.map(f64::from)));
        let seeing: Vec<&Camera> = self
            .cameras
            .iter()
            .enumerate()
            .filter(|(i, _)| seen >> i & 1 == 1)
            .map(|c| c.1)
            .collect();
        let count = seeing.len().min(MOST_DIRECTIONS);
        (0..count)
            .filter_map(|k| (point - seeing[k * seeing.len() / count].centre()).try_normalize())
            .map(|direction| direction.as_vec3().to_array())
            .collect()
    }
}

/// The places at which a brick's voxels are looked at: voxel by voxel, x fastest.
fn places(
    brick: [usize; 3],
    voxels: impl Iterator<Item = usize>,
    resolution: usize,
) -> Vec<[f32; 3]> {
    let corner = brick.map(|c| c * SIDE);
    voxels
        .flat_map(|voxel| {
            let own = [voxel % SIDE, voxel / SIDE % SIDE, voxel / (SIDE * SIDE) % SIDE];
            (0..PLACES_PER_VOXEL).map(move |i| {
                let sub = [
                    i % PLACES_PER_SIDE,
                    i / PLACES_PER_SIDE % PLACES_PER_SIDE,
                    i / (PLACES_PER_SIDE * PLACES_PER_SIDE),
                ];
                std::array::from_fn(|axis| {
                    let within = (sub[axis] as f32 + 0.5) / PLACES_PER_SIDE as f32;
                    ((corner[axis] + own[axis]) as f32 + within) / resolution as f32
                })
            })
        })
        .collect()
}

/// Opacity of each of a brick's voxels, the mean over sources.
fn opacities<S: Source>(sources: &[S], brick: [usize; 3], resolution: usize) -> Vec<f32> {
    let places = places(brick, 0..VOXELS, resolution);
    let share = 1.0 / sources.len() as f32;
    let mut opacity = vec![0.0; VOXELS];
    for source in sources {
        let samples = source.sample(&places);
        for (sum, samples) in opacity.iter_mut().zip(samples.chunks_exact(PLACES_PER_VOXEL)) {
            *sum += share * opacity_of(samples, resolution);
        }
    }
    opacity
}

/// Opacity of a voxel, of the samples in it: light that crosses it along an axis is stopped by what
/// lies one behind the other. Of the three axes the one counts that stops most, so that a thin wall
/// lets nothing through.
fn opacity_of(samples: &[PointSample], resolution: usize) -> f32 {
    let length = 1.0 / (PLACES_PER_SIDE * resolution) as f32;
    (0..3).map(|axis| stopped_along(axis, samples, length)).fold(0.0, f32::max)
}

/// Share of the light along an axis that a voxel's samples stop, each over a length.
fn stopped_along(axis: u32, samples: &[PointSample], length: f32) -> f32 {
    let step = PLACES_PER_SIDE.pow(axis);
    let columns = (0..PLACES_PER_VOXEL).filter(|i| (i / step).is_multiple_of(PLACES_PER_SIDE));
    let stopped: f32 = columns
        .map(|first| {
            let depth: f32 = (0..PLACES_PER_SIDE).map(|k| samples[first + k * step].density).sum();
            -(-depth * length).exp_m1()
        })
        .sum();
    stopped / (PLACES_PER_SIDE * PLACES_PER_SIDE) as f32
}

/// Cameras of each voxel and of those around it: what one sees of a voxel's neighbour it sees of
/// the voxel from a little aside.
fn with_neighbours(bricks: &Bricks, seen: &[u64]) -> Vec<u64> {
    let last = bricks.resolution - 1;
    let around = |c: usize| c.saturating_sub(1)..=(c + 1).min(last);
    (0..seen.len())
        .into_par_iter()
        .map(|voxel| {
            let [x, y, z] = bricks.place_of(voxel);
            let mut all = 0;
            for k in around(z) {
                for j in around(y) {
                    for i in around(x) {
                        all |= bricks.voxel([i, j, k]).map_or(0, |v| seen[v]);
                    }
                }
            }
            all
        })
        .collect()
}

/// Mean colour of a voxel's samples, and how it changes with the direction.
fn shade<S: Source>(
    source: &S,
    samples: &[PointSample],
    directions: &[[f32; 3]],
    resolution: usize,
) -> ([f32; 3], [f32; NUMBERS]) {
    // What stops no light has no colour.
    let weights: Vec<f32> =
        samples.iter().map(|s| -(-s.density / resolution as f32).exp_m1()).collect();
    let share = 1.0 / weights.iter().sum::<f32>().max(1e-9);
    let features: [f32; VIEW_FEATURES] = std::array::from_fn(|f| {
        share * samples.iter().zip(&weights).map(|(s, w)| w * s.view_features[f]).sum::<f32>()
    });
    let (mean, view) = fit(directions, &source.view_colours(&features, directions));
    let colour = std::array::from_fn(|c| {
        let colour = |s: &PointSample| 1.0 / (1.0 + (-s.raw_colour[c] - mean[c]).exp());
        share * samples.iter().zip(&weights).map(|(s, w)| w * colour(s)).sum::<f32>()
    });
    (colour, view)
}

/// The world point at a place of the unit cube of a box.
pub(crate) fn in_box(bounds: &Bounds, place: DVec3) -> DVec3 {
    DVec3::from(bounds.min) + bounds.longest_side() * place
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use radiance::spherical_harmonics;
    use scene::Intrinsics;

    pub(crate) fn bake<S: Source>(
        sources: &[S],
        bounds: &Bounds,
        cameras: &[Camera],
        resolution: usize,
    ) -> Volume {
        let baker = Baker { sources, bounds, cameras, resolution };
        let progress = Progress::silent();
        baker.volume(&baker.shape(baker.bricks(), &progress), &progress)
    }

    /// A solid ball in the middle of the cube, red to the right, whose green grows with the
    /// direction's z.
    pub(crate) struct Ball {
        pub(crate) radius: f32,
        pub(crate) density: f32,
    }

    fn ball_sample(ball: &Ball, p: &[f32; 3]) -> PointSample {
        let away = p.map(|c| (c - 0.5).powi(2)).iter().sum::<f32>().sqrt();
        let mut view_features = [0.0; VIEW_FEATURES];
        view_features[0] = 1.0;
        PointSample {
            density: if away < ball.radius { ball.density } else { 0.0 },
            raw_colour: [if p[0] > 0.5 { 2.0 } else { -2.0 }, 0.0, 0.0],
            view_features,
        }
    }

    impl Source for Ball {
        fn may_hold(&self, _low: [f32; 3], _high: [f32; 3]) -> bool {
            true
        }

        fn sample(&self, places: &[[f32; 3]]) -> Vec<PointSample> {
            places.iter().map(|p| ball_sample(self, p)).collect()
        }

        fn view_colours(
            &self,
            features: &[f32; VIEW_FEATURES],
            directions: &[[f32; 3]],
        ) -> Vec<[f32; 3]> {
            directions.iter().map(|d| [0.0, features[0] * d[2], 0.5]).collect()
        }
    }

    pub(crate) fn bounds() -> Bounds {
        Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.0, far: 9.0, ..Bounds::default() }
    }

    fn camera((x, y): (f64, f64)) -> Camera {
        let back = DVec3::new(x, y, 1.0).normalize();
        let right = DVec3::Y.cross(back).normalize();
        let above = back.cross(right);
        let row = |i: usize| [right[i], above[i], back[i], 4.0 * back[i]];
        Camera {
            name: format!("{x} {y}"),
            intrinsics: Intrinsics::from_angle_x(64, 64, 0.6),
            camera_to_world: [row(0), row(1), row(2)],
        }
    }

    /// Cameras on the side of +z that look at the middle.
    pub(crate) fn cameras() -> Vec<Camera> {
        [(0.0, 0.0), (0.5, 0.1), (-0.4, 0.3), (0.1, -0.6), (-0.7, -0.7)].map(camera).into()
    }

    /// The ball's front is kept, opaque and coloured as it is seen; its back and its inside aren't.
    #[test]
    fn a_ball_is_baked_where_cameras_see_it() {
        let ball = Ball { radius: 0.3, density: 1e4 };
        let volume = bake(&[ball], &bounds(), &cameras(), 64);
        let middle = |v: &Voxel| v.place.map(|c| (f32::from(c) + 0.5) / 64.0 - 0.5);
        let away = |v: &Voxel| middle(v).iter().map(|c| c * c).sum::<f32>().sqrt();
        assert!(volume.voxels.len() > 1000);
        for voxel in &volume.voxels {
            let (away, [x, _, z]) = (away(voxel), middle(voxel));
            assert!((0.3 - 5.5 / 64.0..0.3 + 1.0 / 64.0).contains(&away), "{voxel:?} is hidden");
            assert!(z > -0.27, "{voxel:?} is behind");
            if away < 0.3 - 1.0 / 64.0 {
                assert!(voxel.opacity > 0.99, "{voxel:?}");
            }
            let red = 1.0 / (1.0 + if x > 0.0 { -2.0f32 } else { 2.0 }.exp());
            let blue = 1.0 / (1.0 + (-0.5f32).exp());
            assert!(x.abs() < 0.01 || (voxel.colour[0] - red).abs() < 1e-3, "{voxel:?}");
            assert!((voxel.colour[2] - blue).abs() < 1e-3, "{voxel:?}");
        }
        // Straight from above, where all cameras look: green is that of the direction.
        let top = volume.voxels.iter().find(|v| v.place == [32, 32, 50]).unwrap();
        let logit = |c: f32| (c / (1.0 - c)).ln();
        for camera in cameras() {
            let direction = camera.forward().as_vec3().to_array();
            let basis = spherical_harmonics(direction);
            let green: f32 = (0..9).map(|i| top.view[9 + i] * basis[i]).sum();
            let found = logit(top.colour[1]) + green;
            assert!((found - direction[2]).abs() < 0.05, "{found} {direction:?}");
        }
    }

    fn wall(along: usize, k: usize) -> Vec<PointSample> {
        (0..PLACES_PER_VOXEL)
            .map(|i| {
                let is_in = i / PLACES_PER_SIDE.pow(along as u32) % PLACES_PER_SIDE == k;
                PointSample { density: if is_in { 5e3 } else { 0.0 }, ..PointSample::default() }
            })
            .collect()
    }

    /// A wall thinner than a voxel is as opaque as it is, wherever in the voxel it lies.
    #[test]
    fn thin_walls_are_opaque() {
        for (along, k) in [(0, 0), (1, 1), (2, 0)] {
            let opacity = opacity_of(&wall(along, k), 256);
            let expected = 1.0 - (-5e3f32 / 512.0).exp();
            assert!((opacity - expected).abs() < 1e-5, "{opacity} {expected}");
        }
        assert_eq!(opacity_of(&[PointSample::default(); PLACES_PER_VOXEL], 256), 0.0);
    }

    fn baked_with(threads: usize) -> Volume {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let balls = [Ball { radius: 0.3, density: 50.0 }, Ball { radius: 0.25, density: 900.0 }];
        pool.install(|| bake(&balls, &bounds(), &cameras(), 48))
    }

    #[test]
    fn threads_change_nothing() {
        let alone = baked_with(1);
        assert!(alone == baked_with(3) && !alone.voxels.is_empty());
    }
}
