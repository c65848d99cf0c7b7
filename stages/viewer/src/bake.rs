//! Baking a field into a volume of voxels. A voxel has the opacity of a step of its own length, its
//! mean colour in the directions of the cameras that see it, and the colour's view dependence.

use glam::DVec3;
use radiance::{Field, PointSample, spec::VIEW_FEATURES};
use rayon::prelude::*;
use scene::{Bounds, Camera};
use stage::Progress;

use crate::bricks::{Bricks, SIDE, VOXELS};
use crate::space::{is_reachable, to_world};
use crate::view::{COEFFICIENTS, fit};
use crate::visibility::visible_from;

/// Samples along each side of a voxel (docs/design/042).
const SAMPLES_PER_SIDE: usize = 2;
/// Samples in a voxel.
const SAMPLES_PER_VOXEL: usize = SAMPLES_PER_SIDE * SAMPLES_PER_SIDE * SAMPLES_PER_SIDE;
/// Maximum number of directions to which a voxel's colour is fitted; chosen by hand.
const MAX_DIRECTIONS: usize = 16;
/// Minimum opacity of a stored voxel: a smaller one rounds to byte 0.
const MIN_OPACITY: f32 = 0.5 / 255.0;

/// Field that is baked, a trait for tests. Positions are those of the unit cube.
pub(crate) trait Source: Sync {
    /// True if density is possible between two corners.
    fn has_occupied_cell(&self, low: [f32; 3], high: [f32; 3]) -> bool;
    /// Evaluates density, raw colour and view features at some positions.
    fn sample(&self, positions: &[[f32; 3]]) -> Vec<PointSample>;
    /// Evaluates the view network's raw colours for view features and some directions.
    fn view_colours(
        &self,
        features: &[f32; VIEW_FEATURES],
        directions: &[[f32; 3]],
    ) -> Vec<[f32; 3]>;
}

impl Source for Field {
    fn has_occupied_cell(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        Self::has_occupied_cell(self, low, high)
    }

    fn sample(&self, positions: &[[f32; 3]]) -> Vec<PointSample> {
        self.sample_points(positions)
    }

    fn view_colours(
        &self,
        features: &[f32; VIEW_FEATURES],
        directions: &[[f32; 3]],
    ) -> Vec<[f32; 3]> {
        Self::view_colours(self, features, directions)
    }
}

/// A baked field.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Volume {
    /// Voxels along each side of the unit cube.
    pub(crate) resolution: usize,
    pub(crate) voxels: Vec<Voxel>,
}

/// A visible voxel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Voxel {
    pub(crate) position: [u16; 3],
    /// Share of the light that a step of a voxel's length stops.
    pub(crate) opacity: f32,
    /// Display-encoded sRGB, the mean over the directions of cameras that see the voxel.
    pub(crate) colour: [f32; 3],
    /// View dependence of the colour's logit: see [`crate::view`].
    pub(crate) view: [f32; COEFFICIENTS],
}

/// Voxels of some bricks without colours: opacities, and bits of the cameras that see each voxel.
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
        let count =
            (0..self.seen.len()).into_par_iter().filter(|&voxel| self.is_visible(voxel)).count();
        (2 * size_of::<Voxel>() * count) as u64
    }

    /// True if a voxel is visible.
    fn is_visible(&self, voxel: usize) -> bool {
        self.opacity[voxel] >= MIN_OPACITY && self.seen[voxel] != 0
    }
}

/// Bakes the mean of some sources where cameras see it.
pub(crate) struct Baker<'a, S> {
    pub(crate) sources: &'a [S],
    pub(crate) bounds: &'a Bounds,
    pub(crate) cameras: &'a [Camera],
    pub(crate) resolution: usize,
}

impl<S: Source> Baker<'_, S> {
    /// Returns the bricks in which some source may have density.
    pub(crate) fn bricks(&self) -> Bricks {
        Bricks::new(self.resolution, |brick| {
            let low = brick.map(|c| (c * SIDE) as f32 / self.resolution as f32);
            // The upper corner itself belongs to the next brick.
            let high = brick.map(|c| ((c + 1) * SIDE) as f32 / self.resolution as f32 - 1e-6);
            is_reachable(self.bounds, low, high)
                && self.sources.iter().any(|source| source.has_occupied_cell(low, high))
        })
    }

    /// Returns the number of progress steps of baking.
    pub(crate) fn steps(&self, bricks: &Bricks) -> u64 {
        (2 * bricks.len() + self.cameras.len()) as u64
    }

    /// Computes the voxels' opacities and the cameras that see each voxel.
    pub(crate) fn shape(&self, bricks: Bricks, progress: &Progress) -> Shape {
        let opacity: Vec<f32> = bricks
            .positions()
            .par_iter()
            .flat_map_iter(|&brick| {
                progress.add(1);
                opacities(self.sources, brick, self.resolution)
            })
            .collect();
        let seen = visible_from(&bricks, &opacity, (self.cameras, self.bounds), progress);
        Shape { seen: spread_to_neighbours(&bricks, &seen), bricks, opacity }
    }

    /// Computes the colours of the visible voxels.
    pub(crate) fn volume(&self, shape: &Shape, progress: &Progress) -> Volume {
        let bricks = &shape.bricks;
        let voxels = (0..bricks.len())
            .into_par_iter()
            .flat_map_iter(|slot| {
                progress.add(1);
                let visible: Vec<usize> =
                    (slot * VOXELS..(slot + 1) * VOXELS).filter(|&v| shape.is_visible(v)).collect();
                let shaded = self.shade_brick(bricks.positions()[slot], &visible, &shape.seen);
                let voxels = visible.into_iter().zip(shaded).map(|(voxel, shaded)| Voxel {
                    position: bricks.position(voxel).map(|c| c as u16),
                    opacity: shape.opacity[voxel],
                    colour: shaded.colour,
                    view: shaded.view,
                });
                voxels.collect::<Vec<_>>()
            })
            .collect();
        Volume { resolution: self.resolution, voxels }
    }

    /// Computes colour and view dependence of some of a brick's voxels: the mean over sources,
    /// weighted by opacity.
    fn shade_brick(&self, brick: [usize; 3], voxels: &[usize], seen: &[u64]) -> Vec<Shaded> {
        let positions = sample_positions(brick, voxels.iter().copied(), self.resolution);
        let mut directions = Vec::with_capacity(voxels.len());
        for (i, &voxel) in voxels.iter().enumerate() {
            // No sample is at the voxel's centre; any of them is near enough for directions.
            let position = positions[i * SAMPLES_PER_VOXEL + SAMPLES_PER_VOXEL / 2];
            directions.push(self.directions(position, seen[voxel]));
        }
        let mut means = vec![Shaded { colour: [0.0; 3], view: [0.0; COEFFICIENTS] }; voxels.len()];
        let mut weights = vec![0.0f32; voxels.len()];
        for source in self.sources {
            let samples = source.sample(&positions);
            for (i, samples) in samples.chunks_exact(SAMPLES_PER_VOXEL).enumerate() {
                let opacity = opacity_of(samples, self.resolution);
                let shaded = shade(source, samples, &directions[i], self.resolution);
                for c in 0..3 {
                    means[i].colour[c] += opacity * shaded.colour[c];
                }
                for k in 0..COEFFICIENTS {
                    means[i].view[k] += opacity * shaded.view[k];
                }
                weights[i] += opacity;
            }
        }
        for (i, mean) in means.iter_mut().enumerate() {
            mean.colour = mean.colour.map(|c| c / weights[i]);
            mean.view = mean.view.map(|v| v / weights[i]);
        }
        means
    }

    /// Returns unit world directions to a position from some of the cameras that see it.
    fn directions(&self, position: [f32; 3], seen: u64) -> Vec<[f32; 3]> {
        let point = to_world(self.bounds, DVec3::from(position.map(f64::from)));
        let cameras = self.cameras.iter().enumerate();
        let seeing: Vec<&Camera> =
            cameras.filter(|(i, _)| seen >> i & 1 == 1).map(|(_, camera)| camera).collect();
        let count = seeing.len().min(MAX_DIRECTIONS);
        (0..count)
            .filter_map(|k| (point - seeing[k * seeing.len() / count].centre()).try_normalize())
            .map(|direction| direction.as_vec3().to_array())
            .collect()
    }
}

/// Colour and view dependence of a voxel, as in [`Voxel`].
#[derive(Clone)]
struct Shaded {
    colour: [f32; 3],
    view: [f32; COEFFICIENTS],
}

/// Returns the positions at which a brick's voxels are sampled: voxel by voxel, x fastest.
fn sample_positions(
    brick: [usize; 3],
    voxels: impl Iterator<Item = usize>,
    resolution: usize,
) -> Vec<[f32; 3]> {
    let corner = brick.map(|c| c * SIDE);
    voxels
        .flat_map(|voxel| {
            let own = [voxel % SIDE, voxel / SIDE % SIDE, voxel / (SIDE * SIDE) % SIDE];
            (0..SAMPLES_PER_VOXEL).map(move |i| {
                let sub = [
                    i % SAMPLES_PER_SIDE,
                    i / SAMPLES_PER_SIDE % SAMPLES_PER_SIDE,
                    i / (SAMPLES_PER_SIDE * SAMPLES_PER_SIDE),
                ];
                std::array::from_fn(|axis| {
                    let within = (sub[axis] as f32 + 0.5) / SAMPLES_PER_SIDE as f32;
                    ((corner[axis] + own[axis]) as f32 + within) / resolution as f32
                })
            })
        })
        .collect()
}

/// Returns the opacity of each of a brick's voxels, the mean over sources.
fn opacities<S: Source>(sources: &[S], brick: [usize; 3], resolution: usize) -> Vec<f32> {
    let positions = sample_positions(brick, 0..VOXELS, resolution);
    let weight = 1.0 / sources.len() as f32;
    let mut opacity = vec![0.0; VOXELS];
    for source in sources {
        let samples = source.sample(&positions);
        for (i, samples) in samples.chunks_exact(SAMPLES_PER_VOXEL).enumerate() {
            opacity[i] += weight * opacity_of(samples, resolution);
        }
    }
    opacity
}

/// Computes a voxel's opacity from its samples: the mean over columns along an axis, for the axis
/// that stops most light. A mean over positions would let light through a wall thinner than the
/// voxel.
fn opacity_of(samples: &[PointSample], resolution: usize) -> f32 {
    let length = 1.0 / (SAMPLES_PER_SIDE * resolution) as f32;
    (0..3).map(|axis| stopped_along(axis, samples, length)).fold(0.0, f32::max)
}

/// Returns the share of light along an axis that a voxel's samples stop, each over `length`.
fn stopped_along(axis: u32, samples: &[PointSample], length: f32) -> f32 {
    let step = SAMPLES_PER_SIDE.pow(axis);
    let columns = (0..SAMPLES_PER_VOXEL).filter(|i| (i / step).is_multiple_of(SAMPLES_PER_SIDE));
    let stopped: f32 = columns
        .map(|first| {
            let depth: f32 = (0..SAMPLES_PER_SIDE).map(|k| samples[first + k * step].density).sum();
            -(-depth * length).exp_m1()
        })
        .sum();
    stopped / (SAMPLES_PER_SIDE * SAMPLES_PER_SIDE) as f32
}

/// Adds to each voxel the cameras that see its neighbours, so that no holes appear between the
/// cameras' positions.
fn spread_to_neighbours(bricks: &Bricks, seen: &[u64]) -> Vec<u64> {
    let last = bricks.resolution - 1;
    (0..seen.len())
        .into_par_iter()
        .map(|voxel| {
            let [x, y, z] = bricks.position(voxel).map(|c| c.saturating_sub(1)..=(c + 1).min(last));
            let mut all = 0;
            for k in z {
                for j in y.clone() {
                    for i in x.clone() {
                        all |= bricks.voxel([i, j, k]).map_or(0, |v| seen[v]);
                    }
                }
            }
            all
        })
        .collect()
}

/// Computes mean colour and view dependence of a voxel's samples.
fn shade<S: Source>(
    source: &S,
    samples: &[PointSample],
    directions: &[[f32; 3]],
    resolution: usize,
) -> Shaded {
    // Samples are weighted by the light that they stop.
    let weights: Vec<f32> =
        samples.iter().map(|s| -(-s.density / resolution as f32).exp_m1()).collect();
    let scale = 1.0 / weights.iter().sum::<f32>().max(1e-9);
    let features: [f32; VIEW_FEATURES] = std::array::from_fn(|f| {
        scale * samples.iter().zip(&weights).map(|(s, w)| w * s.view_features[f]).sum::<f32>()
    });
    let (mean, view) = fit(directions, &source.view_colours(&features, directions));
    let colour = std::array::from_fn(|c| {
        let mut sum = 0.0;
        for (sample, weight) in samples.iter().zip(&weights) {
            sum += weight * (1.0 / (1.0 + (-sample.raw_colour[c] - mean[c]).exp()));
        }
        scale * sum
    });
    Shaded { colour, view }
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
        fn has_occupied_cell(&self, _low: [f32; 3], _high: [f32; 3]) -> bool {
            true
        }

        fn sample(&self, positions: &[[f32; 3]]) -> Vec<PointSample> {
            positions.iter().map(|p| ball_sample(self, p)).collect()
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
        Bounds::cube(1.0, 0.0, 9.0)
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

    /// The ball's front is stored, opaque and in its visible colours; its back and inside aren't.
    #[test]
    fn a_ball_is_baked_where_cameras_see_it() {
        let ball = Ball { radius: 0.3, density: 1e4 };
        let volume = bake(&[ball], &bounds(), &cameras(), 64);
        let middle = |v: &Voxel| v.position.map(|c| (f32::from(c) + 0.5) / 64.0 - 0.5);
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
        let top = volume.voxels.iter().find(|v| v.position == [32, 32, 50]).unwrap();
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
        (0..SAMPLES_PER_VOXEL)
            .map(|i| {
                let is_in = i / SAMPLES_PER_SIDE.pow(along as u32) % SAMPLES_PER_SIDE == k;
                PointSample { density: if is_in { 5e3 } else { 0.0 }, ..PointSample::default() }
            })
            .collect()
    }

    /// A wall thinner than a voxel has its full opacity at any position in the voxel.
    #[test]
    fn thin_walls_are_opaque() {
        for (along, k) in [(0, 0), (1, 1), (2, 0)] {
            let opacity = opacity_of(&wall(along, k), 256);
            let expected = 1.0 - (-5e3f32 / 512.0).exp();
            assert!((opacity - expected).abs() < 1e-5, "{opacity} {expected}");
        }
        assert_eq!(opacity_of(&[PointSample::default(); SAMPLES_PER_VOXEL], 256), 0.0);
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
