//! Pose refinement: moves cameras until what a field renders meets their photographs.
//!
//! * [`Pyramid`]: a photograph at its own and at smaller sizes, with the pixels of each that say
//!   where it was taken from.
//! * [`refine`]: one camera, at one size, by Gauss and Newton with Levenberg's and Marquardt's
//!   damping.
//! * [`Moved`]: how far cameras have gone, in words for a log; [`photometric_error`]: whether that
//!   was for the better.
//! * [`take_back_common_motion`]: what all cameras share is the scene's motion, and nothing that
//!   photographs could tell.
//!
//! A photograph's own gradient says how each of its pixels would change if what it shows moved in
//! the image, and the rendered depth how that moves with the camera (Lucas and Kanade 1981; the
//! template's gradient, as in Baker and Matthews 2004). So a step takes one rendering of some
//! thousand pixels, and any field will do that renders colour and depth: nothing is differentiated
//! but photographs.
//!
//! Lengths are in scene units, angles in radians, camera axes as `scene` has them (x right, y up,
//! looking along -z).
//!
//! ```
//! use poses::{Pyramid, Refinement, refine};
//! use pixels::Image;
//! use radiance::{Architecture, Field, RenderError};
//! use scene::{Bounds, Camera, Intrinsics};
//! let (min, max) = ([-1.0; 3], [1.0; 3]);
//! let bounds = Bounds { min, max, near: 2.0, far: 6.0, ..Default::default() };
//! let field = Field::new(Architecture::default(), bounds, 7);
//! let intrinsics = Intrinsics::from_angle_x(16, 16, 0.69);
//! let camera_to_world = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]];
//! let camera = Camera { name: "r_0".into(), intrinsics, camera_to_world };
//! let photograph = Image::new(16, 16, 3, vec![0.5; 16 * 16 * 3]);
//! let pyramid = Pyramid::new(&photograph, 2);
//! let refined = refine(&field, &camera, &pyramid, 0, &Default::default()).unwrap();
//! let Refinement { camera: found, before, after, .. } = refined;
//! // A grey wall says nothing of where it was seen from.
//! assert!(found == camera && before == after);
//! ```

mod cast;
mod huber;
mod normal_matrix;
mod photometric;
mod pyramid;

use std::fmt;

use glam::{DMat3, DQuat, DVec3};
use radiance::{Ray, RayField, RenderError};
use scene::{Camera, length, pose_of};

use crate::cast::cast;
use crate::huber::{HUBER_ERROR, huber};
use crate::normal_matrix::NormalMatrix;
use crate::pyramid::{PyramidLevel, Telling};

pub use photometric::{Shot, photometric_error};
pub use pyramid::Pyramid;

/// How to refine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Renderings at most: one to begin with, and one for each step tried.
    pub renderings: u32,
    /// What is behind the scene.
    pub background: f32,
    /// What the photograph's channels are multiplied by to have the field's exposure.
    pub exposure: [f32; 3],
}

impl Default for Options {
    fn default() -> Self {
        Self { renderings: 6, background: 1.0, exposure: [1.0; 3] }
    }
}

/// A camera that was moved.
#[derive(Clone, Debug, PartialEq)]
pub struct Refinement {
    /// Where it is now.
    pub camera: Camera,
    /// Mean robust error of the pixels looked at, where it was: Huber's, of colours.
    pub before: f64,
    /// The same where it is.
    pub after: f64,
    /// Middle depth of what is seen from where it is, in scene units; none where nothing is.
    pub depth: Option<f64>,
}

/// Moves a camera, whose intrinsics have any size, to where a pyramid's level is met best. It stays
/// where that says too little, and never ends where it is met worse.
pub fn refine(
    field: &dyn RayField,
    camera: &Camera,
    pyramid: &Pyramid,
    level: u32,
    options: &Options,
) -> Result<Refinement, RenderError> {
    let level = &pyramid.levels[(level as usize).min(pyramid.levels.len() - 1)];
    let start = Equations::of(field, camera, level, options)?;
    let before = start.error;
    let (mut best, mut equations, mut damping) = (camera.clone(), start, FIRST_DAMPING);
    for _ in 1..options.renderings {
        let Some(motion) = equations.solve(damping) else { break };
        let moved = motion.applied_to(&best);
        let there = Equations::of(field, &moved, level, options)?;
        if there.error < equations.error {
            (best, equations, damping) = (moved, there, damping / 4.0);
        } else {
            damping *= 16.0;
        }
    }
    Ok(Refinement { camera: best, before, after: equations.error, depth: equations.depth })
}

/// Fewer pixels say nothing.
const LEAST_PIXELS: usize = 24;
/// Damping of the first step, as a share of the equations' own diagonal.
const FIRST_DAMPING: f64 = 1e-3;
/// Of a pixel that stops less, no place is known. It is low since edges that are still soft have to
/// pull from both sides: their inner halves alone would make everything too large, and cameras back
/// away.
const LEAST_PLACE_OPACITY: f32 = 0.02;

/// Least squares for a small motion of the camera, linear about where it is.
struct Equations {
    matrix: NormalMatrix,
    /// Right-hand sides of turning and shifting.
    right: [DVec3; 2],
    /// Middle depth of what is seen, where anything is.
    depth: Option<f64>,
    /// Unit of translation: that depth, so that turning and moving weigh alike.
    unit: f64,
    error: f64,
    pixels: usize,
}

impl Equations {
    fn of(
        field: &dyn RayField,
        camera: &Camera,
        level: &PyramidLevel,
        options: &Options,
    ) -> Result<Self, RenderError> {
        let camera = camera.resized(level.width as u32, level.height as u32);
        let cast = |pixel: &Telling| cast(&camera, pixel.centre(), options.background);
        let rays: Vec<Ray> = level.telling.iter().map(|pixel| cast(pixel).1).collect();
        let rendered = field.render(&rays)?;
        let depths: Vec<Option<f64>> = (level.telling.iter().zip(&rendered))
            .map(|(pixel, seen)| {
                let distance = if seen.opacity > 0.5 { seen.median_depth } else { seen.depth };
                let depth = f64::from(distance) * camera.depth_per_distance(&cast(pixel).0);
                (seen.opacity > LEAST_PLACE_OPACITY && depth.is_finite() && depth > 0.0)
                    .then_some(depth)
            })
            .collect();
        let mut sorted: Vec<f64> = depths.iter().flatten().copied().collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let depth = sorted.get(sorted.len() / 2).copied();
        let unit = depth.unwrap_or(1.0);
        let mut sums = Self {
            matrix: NormalMatrix::ZERO,
            right: [DVec3::ZERO; 2],
            depth,
            unit,
            error: 0.0,
            pixels: 0,
        };
        for ((pixel, seen), depth) in level.telling.iter().zip(&rendered).zip(&depths) {
            let errors = [0, 1, 2]
                .map(|c| f64::from(pixel.colour[c] * options.exposure[c] - seen.colour[c]));
            sums.error += errors.iter().map(|e| huber(*e)).sum::<f64>();
            let Some(depth) = *depth else { continue };
            sums.pixels += 1;
            let motion = image_motion(&camera, pixel.centre(), depth, unit);
            for (c, error) in errors.into_iter().enumerate() {
                let [right, down] = pixel.gradient[c].map(|g| f64::from(g * options.exposure[c]));
                // What is seen would have to move by the opposite of the error over the gradient.
                let row = [0, 1].map(|part| -(motion[0][part] * right + motion[1][part] * down));
                let weight =
                    if error.abs() > HUBER_ERROR { HUBER_ERROR / error.abs() } else { 1.0 };
                sums.matrix.add(weight, row);
                for (sum, part) in sums.right.iter_mut().zip(row) {
                    *sum += weight * error * part;
                }
            }
        }
        sums.error /= (3 * level.telling.len()).max(1) as f64;
        Ok(sums)
    }

    /// The motion that they ask for; none where they say too little.
    fn solve(&self, damping: f64) -> Option<Motion> {
        if self.pixels < LEAST_PIXELS || !self.error.is_finite() {
            return None;
        }
        let [turn, shift] = self.matrix.damped(damping).solve(self.right)?;
        Some(Motion { turn, shift: self.unit * shift })
    }
}

/// How far what is seen at an image position moves to the right and down when the camera turns
/// about its axes and shifts along them, by a radian and by so many scene units. Of both: turning,
/// then shifting.
fn image_motion(camera: &Camera, [u, v]: [f64; 2], depth: f64, unit: f64) -> [[DVec3; 2]; 2] {
    let k = &camera.intrinsics;
    let [u, v] = k.undistort([u, v]);
    let (x, y) = ((u - k.cx) / k.fx, -(v - k.cy) / k.fy);
    let [by_x, by_y] = k.distortion.derivative([x, -y]);
    let place = depth * DVec3::new(x, y, -1.0);
    // Of a point in camera space, on the plane of depth 1.
    let along_x = DVec3::new(1.0, 0.0, x) / depth;
    let along_y = DVec3::new(0.0, -1.0, -y) / depth;
    let right = k.fx * (by_x[0] * along_x + by_x[1] * along_y);
    let down = k.fy * (by_y[0] * along_x + by_y[1] * along_y);
    // In camera space a point goes the other way: by place × turn, and by -shift.
    [right, down].map(|along| [along.cross(place), -unit * along])
}

/// A motion of a camera in its own axes.
#[derive(Clone, Copy, Debug)]
struct Motion {
    /// Axis times angle.
    turn: DVec3,
    shift: DVec3,
}

impl Motion {
    fn applied_to(&self, camera: &Camera) -> Camera {
        let turned = rotation(camera) * DQuat::from_scaled_axis(self.turn);
        placed(camera, turned, camera.centre() + camera.rotation() * self.shift)
    }
}

fn rotation(camera: &Camera) -> DQuat {
    DQuat::from_mat3(&camera.rotation()).normalize()
}

/// The camera with another pose.
fn placed(camera: &Camera, rotation: DQuat, centre: DVec3) -> Camera {
    let axes = DMat3::from_quat(rotation.normalize());
    Camera { camera_to_world: pose_of(axes, centre), ..camera.clone() }
}

/// A camera before and after.
#[derive(Clone, Copy, Debug)]
pub struct CameraMove<'a> {
    /// Where it was; its pixels are the photograph's.
    pub from: &'a Camera,
    /// Where it is.
    pub to: &'a Camera,
    /// Middle depth of what it sees, in scene units, where anything is known of it.
    pub depth: Option<f64>,
}

/// How far cameras have moved, in the mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moved {
    /// Angle by which they have turned, in radians.
    pub angle: f64,
    /// Distance of their centres from where they were, in scene units.
    pub distance: f64,
    /// How far that moves what they see across their photographs, in pixels.
    pub pixels: f64,
}

/// Poses that are known at all are commonly right to within these.
const FAR_TURN_DEGREES: f64 = 1.0;
const FAR_PIXELS: f64 = 3.0;

impl Moved {
    /// Over all cameras.
    pub fn between<'a>(steps: impl Iterator<Item = CameraMove<'a>>) -> Self {
        let (mut count, mut sum) = (0.0f64, Self { angle: 0.0, distance: 0.0, pixels: 0.0 });
        for CameraMove { from, to, depth } in steps {
            count += 1.0;
            let distance = from.centre().distance(to.centre());
            sum.angle += rotation(from).angle_between(rotation(to));
            sum.distance += distance;
            sum.pixels += depth.map_or(0.0, |depth| from.intrinsics.fx * distance / depth);
        }
        let count = count.max(1.0);
        Self {
            angle: sum.angle / count,
            distance: sum.distance / count,
            pixels: sum.pixels / count,
        }
    }

    /// Whether that is farther than given poses are commonly off: by more than 1°, or by more than
    /// 3 pixels of the photographs.
    pub fn is_far(&self) -> bool {
        self.angle.to_degrees() > FAR_TURN_DEGREES || self.pixels > FAR_PIXELS
    }
}

impl fmt::Display for Moved {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { angle, distance, pixels } = self;
        write!(
            f,
            "turned by {:.3}° and moved by {} ({pixels:.1} LR pixels) in the mean",
            angle.to_degrees(),
            length(*distance, 4)
        )
    }
}

/// Moves all cameras back together so that in the mean they have neither turned nor shifted nor
/// spread from where they were: a motion that all share could as well be the scene's, which would
/// leave its bounds, and test views would miss it.
pub fn take_back_common_motion(cameras: &mut [Camera], were: &[Camera]) {
    let share = 1.0 / cameras.len().max(1) as f64;
    let turns = cameras.iter().zip(were).map(|(camera, was)| {
        let turn = rotation(camera) * rotation(was).inverse();
        // The shorter way round.
        (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis()
    });
    let back = DQuat::from_scaled_axis(-share * turns.sum::<DVec3>());
    let middle = |cameras: &[Camera]| share * cameras.iter().map(Camera::centre).sum::<DVec3>();
    let (now, before) = (middle(cameras), middle(were));
    let (wide, was_wide) = (spread(cameras, now), spread(were, before));
    let narrower = if wide > 0.0 && was_wide > 0.0 { (was_wide / wide).sqrt() } else { 1.0 };
    for camera in cameras {
        *camera = placed(
            camera,
            back * rotation(camera),
            before + narrower * (back * (camera.centre() - now)),
        );
    }
}

/// How far cameras are from a place: the sum of squares.
fn spread(cameras: &[Camera], place: DVec3) -> f64 {
    cameras.iter().map(|c| c.centre().distance_squared(place)).sum::<f64>()
}

#[cfg(test)]
mod tests;
