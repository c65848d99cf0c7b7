//! Baking a field into a volume of voxels. A voxel has the opacity of a step of its own length, its
//! mean colour in the directions of the cameras that see it, and the colour's view dependence.

use glam::DVec3;
use radiance::{PointField, PointSamples, RenderError};
use rayon::prelude::*;
use scene::{Bounds, Camera};
use stage::Progress;

use crate::bricks::{BRICK_SIDE, Bricks, VOXELS, grid_index, grid_position};
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
    /// Display-encoded sRGB at the mean logit over the directions of cameras that see the voxel.
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

/// Bakes the mean of an ensemble's fields into the voxels that cameras see.
pub(crate) struct Baker<'a> {
    pub(crate) sources: &'a [Box<dyn PointField>],
    pub(crate) bounds: &'a Bounds,
    pub(crate) cameras: &'a [Camera],
    pub(crate) resolution: usize,
}

impl Baker<'_> {
    /// Returns the maximum number of bricks.
    pub(crate) fn max_bricks(&self) -> u64 {
        (self.resolution / BRICK_SIDE).pow(3) as u64
    }

    /// Returns the bricks in which some source may have density.
    pub(crate) fn bricks(&self, progress: &Progress) -> Result<Bricks, RenderError> {
        let side = self.resolution / BRICK_SIDE;
        let min_density = -(-MIN_OPACITY).ln_1p() * self.resolution as f32;
        let is_kept: Vec<bool> = (0..side * side * side)
            .into_par_iter()
            .map(|i| {
                progress.add(1);
                let brick = grid_position(i, side);
                let low = brick.map(|c| (c * BRICK_SIDE) as f32 / self.resolution as f32);
                // The upper corner itself belongs to the next brick.
                let high =
                    brick.map(|c| ((c + 1) * BRICK_SIDE) as f32 / self.resolution as f32 - 1e-6);
                if !is_reachable(self.bounds, low, high) {
                    return Ok(false);
                }
                for source in self.sources {
                    if source.may_have_density(low, high, min_density)? {
                        return Ok(true);
                    }
                }
                Ok(false)
            })
            .collect::<Result<_, RenderError>>()?;
        Ok(Bricks::new(self.resolution, |position| is_kept[grid_index(position, side)]))
    }

    /// Returns the number of progress steps of baking.
    pub(crate) fn steps(&self, bricks: &Bricks) -> u64 {
        (2 * bricks.len() + self.cameras.len()) as u64
    }

    /// Computes the voxels' opacities and the cameras that see each voxel.
    pub(crate) fn shape(&self, bricks: Bricks, progress: &Progress) -> Result<Shape, RenderError> {
        let mut opacity = vec![0.0; bricks.len() * VOXELS];
        let parts = opacity.par_chunks_mut(VOXELS).zip(&bricks.positions);
        parts.try_for_each(|(opacity, &brick)| {
            progress.add(1);
            self.add_opacities(brick, opacity)
        })?;
        let seen = visible_from(&bricks, &opacity, (self.cameras, self.bounds), progress);
        Ok(Shape { seen: spread_to_neighbours(&bricks, &seen), bricks, opacity })
    }

    /// Adds the sources' mean opacity to each value of `opacity`, which has a value for each voxel
    /// of a brick.
    fn add_opacities(&self, brick: [usize; 3], opacity: &mut [f32]) -> Result<(), RenderError> {
        let positions = sample_positions(brick, 0..VOXELS, self.resolution);
        let weight = 1.0 / self.sources.len() as f32;
        for source in self.sources {
            let densities = source.densities(&positions)?;
            for (opacity, densities) in opacity.iter_mut().zip(voxels_of(&densities)) {
                *opacity += weight * opacity_of(densities, self.resolution);
            }
        }
        Ok(())
    }

    /// Computes the colours of the visible voxels.
    pub(crate) fn volume(&self, shape: &Shape, progress: &Progress) -> Result<Volume, RenderError> {
        let bricks = &shape.bricks;
        let voxels: Vec<Vec<Voxel>> = (0..bricks.len())
            .into_par_iter()
            .map(|brick| {
                progress.add(1);
                let own = brick * VOXELS..(brick + 1) * VOXELS;
                let visible: Vec<usize> = own.filter(|&v| shape.is_visible(v)).collect();
                let shaded = self.shade_brick(bricks.positions[brick], &visible, &shape.seen)?;
                let voxels = visible.into_iter().zip(shaded).map(|(voxel, shaded)| Voxel {
                    position: bricks.voxel_position(voxel).map(|c| c as u16),
                    opacity: shape.opacity[voxel],
                    colour: shaded.colour,
                    view: shaded.view,
                });
                Ok(voxels.collect())
            })
            .collect::<Result<_, RenderError>>()?;
        Ok(Volume { resolution: self.resolution, voxels: voxels.concat() })
    }

    /// Computes colour and view dependence of some of a brick's voxels: the mean over sources,
    /// weighted by opacity.
    fn shade_brick(
        &self,
        brick: [usize; 3],
        voxels: &[usize],
        seen: &[u64],
    ) -> Result<Vec<Shaded>, RenderError> {
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
            let samples = source.samples(&positions)?;
            let shaded = shade(source.as_ref(), &samples, &directions, self.resolution)?;
            let voxels = shaded.into_iter().zip(voxels_of(&samples.densities)).enumerate();
            for (i, (shaded, densities)) in voxels {
                let opacity = opacity_of(densities, self.resolution);
                for c in 0..3 {
                    means[i].colour[c] += opacity * shaded.colour[c];
                }
                for k in 0..COEFFICIENTS {
                    means[i].view[k] += opacity * shaded.view[k];
                }
                weights[i] += opacity;
            }
        }
        for (mean, weight) in means.iter_mut().zip(weights) {
            mean.colour = mean.colour.map(|c| c / weight);
            mean.view = mean.view.map(|v| v / weight);
        }
        Ok(means)
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
    let corner = brick.map(|c| c * BRICK_SIDE);
    voxels
        .flat_map(|voxel| {
            let own = grid_position(voxel % VOXELS, BRICK_SIDE);
            (0..SAMPLES_PER_VOXEL).map(move |i| {
                let sub = grid_position(i, SAMPLES_PER_SIDE);
                std::array::from_fn(|axis| {
                    let within = (sub[axis] as f32 + 0.5) / SAMPLES_PER_SIDE as f32;
                    ((corner[axis] + own[axis]) as f32 + within) / resolution as f32
                })
            })
        })
        .collect()
}

/// Splits values of samples by voxel.
fn voxels_of<T>(samples: &[T]) -> impl Iterator<Item = &[T; SAMPLES_PER_VOXEL]> {
    samples.as_chunks().0.iter()
}

/// Computes a voxel's opacity from its samples: the mean over columns along an axis, for the axis
/// that stops most light. A mean over positions would let light through a wall thinner than the
/// voxel.
fn opacity_of(densities: &[f32; SAMPLES_PER_VOXEL], resolution: usize) -> f32 {
    let length = 1.0 / (SAMPLES_PER_SIDE * resolution) as f32;
    (0..3).map(|axis| stopped_along(axis, densities, length)).fold(0.0, f32::max)
}

/// Returns the share of light along an axis that a voxel's samples stop, each over `length`.
fn stopped_along(axis: u32, densities: &[f32; SAMPLES_PER_VOXEL], length: f32) -> f32 {
    let step = SAMPLES_PER_SIDE.pow(axis);
    let columns = (0..SAMPLES_PER_VOXEL).filter(|i| (i / step).is_multiple_of(SAMPLES_PER_SIDE));
    let stopped: f32 = columns
        .map(|first| {
            let depth: f32 = (0..SAMPLES_PER_SIDE).map(|k| densities[first + k * step]).sum();
            -(-depth * length).exp_m1()
        })
        .sum();
    stopped / (SAMPLES_PER_SIDE * SAMPLES_PER_SIDE) as f32
}

/// Adds to each voxel the cameras that see its neighbours, so that surfaces have no holes when they
/// are viewed from between the cameras.
fn spread_to_neighbours(bricks: &Bricks, seen: &[u64]) -> Vec<u64> {
    let last = bricks.resolution - 1;
    (0..seen.len())
        .into_par_iter()
        .map(|voxel| {
            let position = bricks.voxel_position(voxel);
            let [x, y, z] = position.map(|c| c.saturating_sub(1)..=(c + 1).min(last));
            let mut all = 0;
            for k in z {
                for j in y.clone() {
                    for i in x.clone() {
                        all |= bricks.voxel_index([i, j, k]).map_or(0, |v| seen[v]);
                    }
                }
            }
            all
        })
        .collect()
}

/// Computes mean colour and view dependence of each voxel from its samples and directions.
fn shade(
    source: &dyn PointField,
    samples: &PointSamples,
    directions: &[Vec<[f32; 3]>],
    resolution: usize,
) -> Result<Vec<Shaded>, RenderError> {
    // Samples are weighted by the light that they stop.
    let stopped = |density: &f32| -(-density / resolution as f32).exp_m1();
    let weights: Vec<f32> = samples.densities.iter().map(stopped).collect();
    let scales: Vec<f32> =
        voxels_of(&weights).map(|weights| 1.0 / weights.iter().sum::<f32>().max(1e-9)).collect();
    let width = samples.view_features.len() / weights.len().max(1);
    let mut features = vec![0.0; directions.len() * width];
    for (voxel, mean) in features.chunks_exact_mut(width.max(1)).enumerate() {
        for sample in voxel * SAMPLES_PER_VOXEL..(voxel + 1) * SAMPLES_PER_VOXEL {
            let weight = scales[voxel] * weights[sample];
            for (sum, feature) in mean.iter_mut().zip(&samples.view_features[sample * width..]) {
                *sum += weight * feature;
            }
        }
    }
    let view_colours = source.view_colours(&features, directions)?;
    let raw_colours = voxels_of(&samples.raw_colours).zip(voxels_of(&weights)).zip(scales);
    let shaded = raw_colours.zip(directions.iter().zip(&view_colours));
    Ok(shaded
        .map(|(((raw_colours, weights), scale), (directions, view_colours))| {
            let (mean, view) = fit(directions, view_colours);
            let colour = std::array::from_fn(|c| {
                let samples = raw_colours.iter().zip(weights);
                let light =
                    |(raw, weight): (&[f32; 3], &f32)| weight / (1.0 + (-raw[c] - mean[c]).exp());
                scale * samples.map(light).sum::<f32>()
            });
            Shaded { colour, view }
        })
        .collect())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use radiance::{spec::VIEW_FEATURES, spherical_harmonics};
    use scene::Intrinsics;

    pub(crate) fn bake(balls: Vec<Ball>, resolution: usize) -> Volume {
        let sources: Vec<Box<dyn PointField>> =
            balls.into_iter().map(|ball| Box::new(ball) as _).collect();
        let (bounds, cameras) = (bounds(), cameras());
        let baker = Baker { sources: &sources, bounds: &bounds, cameras: &cameras, resolution };
        let progress = Progress::silent();
        let bricks = baker.bricks(&progress).unwrap();
        baker.volume(&baker.shape(bricks, &progress).unwrap(), &progress).unwrap()
    }

    /// A solid ball in the middle of the cube, red to the right, whose green grows with the
    /// direction's z.
    pub(crate) struct Ball {
        pub(crate) radius: f32,
        pub(crate) density: f32,
    }

    impl PointField for Ball {
        fn may_have_density(
            &self,
            _low: [f32; 3],
            _high: [f32; 3],
            _min_density: f32,
        ) -> Result<bool, RenderError> {
            Ok(true)
        }

        fn densities(&self, points: &[[f32; 3]]) -> Result<Vec<f32>, RenderError> {
            let away = |p: &[f32; 3]| p.map(|c| (c - 0.5).powi(2)).iter().sum::<f32>().sqrt();
            let density = |p| if away(p) < self.radius { self.density } else { 0.0 };
            Ok(points.iter().map(density).collect())
        }

        fn samples(&self, points: &[[f32; 3]]) -> Result<PointSamples, RenderError> {
            let red = |p: &[f32; 3]| if p[0] > 0.5 { 2.0 } else { -2.0 };
            let mut row = [0.0; VIEW_FEATURES];
            row[0] = 1.0;
            Ok(PointSamples {
                densities: self.densities(points)?,
                raw_colours: points.iter().map(|p| [red(p), 0.0, 0.0]).collect(),
                view_features: row.repeat(points.len()),
            })
        }

        fn view_colours(
            &self,
            features: &[f32],
            directions: &[Vec<[f32; 3]>],
        ) -> Result<Vec<Vec<[f32; 3]>>, RenderError> {
            let rows = features.chunks(VIEW_FEATURES).zip(directions);
            let colours = |row: &[f32], directions: &[[f32; 3]]| {
                directions.iter().map(|d| [0.0, row[0] * d[2], 0.5]).collect()
            };
            Ok(rows.map(|(row, directions)| colours(row, directions)).collect())
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
        let volume = bake(vec![ball], 64);
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
        // For the top voxel, which all cameras see, the logit of green in a camera's direction is
        // the direction's z.
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

    fn wall(along: usize, k: usize) -> [f32; SAMPLES_PER_VOXEL] {
        std::array::from_fn(|i| {
            let is_in = i / SAMPLES_PER_SIDE.pow(along as u32) % SAMPLES_PER_SIDE == k;
            if is_in { 5e3 } else { 0.0 }
        })
    }

    /// A wall thinner than a voxel has its full opacity at any position in the voxel.
    #[test]
    fn thin_walls_are_opaque() {
        for (along, k) in [(0, 0), (1, 1), (2, 0)] {
            let opacity = opacity_of(&wall(along, k), 256);
            let expected = 1.0 - (-5e3f32 / 512.0).exp();
            assert!((opacity - expected).abs() < 1e-5, "{opacity} {expected}");
        }
        assert_eq!(opacity_of(&[0.0; SAMPLES_PER_VOXEL], 256), 0.0);
    }

    fn baked_with(threads: usize) -> Volume {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let balls =
            || vec![Ball { radius: 0.3, density: 50.0 }, Ball { radius: 0.25, density: 900.0 }];
        pool.install(|| bake(balls(), 48))
    }

    #[test]
    fn threads_change_nothing() {
        let alone = baked_with(1);
        assert!(alone == baked_with(3) && !alone.voxels.is_empty());
    }
}
