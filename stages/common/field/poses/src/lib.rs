//! Pose refinement: moves cameras until renders of a field match their photographs
//! (docs/design/025).
//!
//! * [`Pyramid`]: a photograph at its own and at smaller sizes, with the informative pixels of
//!   each.
//! * [`refine`]: refines one camera at one size by Gauss-Newton steps with Levenberg-Marquardt
//!   damping.
//! * [`MeanMotion`]: mean motion of cameras, for a log; [`photometric_error`]: quality of poses.
//! * [`remove_common_motion`]: removes the motion that all cameras share, which photographs can't
//!   distinguish from a motion of the scene.
//!
//! A photograph's gradient is the derivative of each pixel with respect to its position in the
//! image; the rendered depth gives the derivative of this position with respect to the camera's
//! motion (Lucas and Kanade 1981; the gradient is that of the template, as in Baker and Matthews
//! 2004). A step renders a few thousand pixels and needs no derivative of the field, so any field
//! that renders colour and depth is sufficient.
//!
//! Lengths are in scene units, angles in radians; camera axes are those of `scene` (x right, y up,
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
//! // A grey wall has no gradient.
//! assert!(found == camera && before == after);
//! ```

mod normal_matrix;
mod photometric;
mod pyramid;

use std::fmt;

use glam::{DMat3, DQuat, DVec3};
use radiance::{Pixel, RayField, RenderError};
use scene::{Camera, format_length, pose_of};

use crate::normal_matrix::{HUBER_THRESHOLD, NormalMatrix, huber};
use crate::pyramid::{InformativePixel, PyramidLevel, pixel_rays};

pub use photometric::{PosedPhotograph, photometric_error};
pub use pyramid::Pyramid;

/// Options of [`refine`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Maximum number of renders: one at the start, then one per step tried.
    pub max_renders: u32,
    /// Grey level of the background.
    pub background: f32,
    /// Factor per channel from the photograph's exposure to the field's.
    pub exposure: [f32; 3],
}

impl Default for Options {
    fn default() -> Self {
        Self { max_renders: 6, background: 1.0, exposure: [1.0; 3] }
    }
}

/// Result of [`refine`].
#[derive(Clone, Debug, PartialEq)]
pub struct Refinement {
    /// Refined camera.
    pub camera: Camera,
    /// Mean Huber error of colours before refinement.
    pub before: f64,
    /// Mean Huber error of colours after refinement.
    pub after: f64,
    /// Median depth in the refined view, in scene units; `None` if no pixel has a depth.
    pub depth: Option<f64>,
}

/// Moves a camera to the pose with the least error at a pyramid's level. The camera's
/// intrinsics may be of another image size. The camera is unchanged if too few informative pixels
/// have a depth, and the error never grows.
pub fn refine(
    field: &dyn RayField,
    camera: &Camera,
    pyramid: &Pyramid,
    level: u32,
    options: &Options,
) -> Result<Refinement, RenderError> {
    let level = &pyramid.levels[(level as usize).min(pyramid.levels.len() - 1)];
    let start = Equations::linearised(field, camera, level, options)?;
    let before = start.error;
    let (mut best, mut equations, mut damping) = (camera.clone(), start, FIRST_DAMPING);
    for _ in 1..options.max_renders {
        let Some(motion) = equations.solve(damping) else { break };
        let moved = apply_motion(&best, motion);
        let next = Equations::linearised(field, &moved, level, options)?;
        if next.error < equations.error {
            (best, equations, damping) = (moved, next, damping / 4.0);
        } else {
            damping *= 16.0;
        }
    }
    Ok(Refinement { camera: best, before, after: equations.error, depth: equations.depth })
}

/// Minimum number of pixels with a depth; chosen by hand.
const MIN_PIXELS: usize = 24;
/// Damping of the first step, relative to the equations' diagonal; chosen by hand.
const FIRST_DAMPING: f64 = 1e-3;
/// Minimum opacity of a pixel whose depth is used. Pixels on both sides of a blurred edge are
/// needed: with only the opaque side, cameras moved back by 6 % of their distance
/// (docs/design/025).
const MIN_DEPTH_OPACITY: f32 = 0.02;

/// Least-squares equations of a small camera motion, linearised at the current pose.
struct Equations {
    matrix: NormalMatrix,
    /// Right-hand sides of rotation and translation.
    right_sides: [DVec3; 2],
    /// Median depth of the pixels, if any has one.
    depth: Option<f64>,
    /// Unit of translation: the median depth, so that rotation and translation have equal weight.
    unit: f64,
    /// Mean Huber error of colours.
    error: f64,
    /// Number of pixels with a depth.
    pixels: usize,
}

impl Equations {
    fn linearised(
        field: &dyn RayField,
        camera: &Camera,
        level: &PyramidLevel,
        options: &Options,
    ) -> Result<Self, RenderError> {
        let camera = camera.resized(level.width as u32, level.height as u32);
        let (camera_rays, rays) = pixel_rays(&camera, &level.pixels, options.background);
        let renders = field.render(&rays)?;
        let depths: Vec<Option<f64>> = (0..renders.len())
            .map(|i| trusted_depth(&renders[i], camera.depth_per_distance(&camera_rays[i])))
            .collect();
        let mut sorted: Vec<f64> = depths.iter().flatten().copied().collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let depth = sorted.get(sorted.len() / 2).copied();
        let mut equations = Self {
            matrix: NormalMatrix::ZERO,
            right_sides: [DVec3::ZERO; 2],
            depth,
            unit: depth.unwrap_or(1.0),
            error: 0.0,
            pixels: 0,
        };
        for (i, pixel) in level.pixels.iter().enumerate() {
            equations.add_pixel(&camera, pixel, renders[i].colour, depths[i], options.exposure);
        }
        equations.error /= (3 * level.pixels.len()).max(1) as f64;
        Ok(equations)
    }

    /// Adds a pixel's error and, if it has a depth, its rows.
    fn add_pixel(
        &mut self,
        camera: &Camera,
        pixel: &InformativePixel,
        rendered: [f32; 3],
        depth: Option<f64>,
        exposure: [f32; 3],
    ) {
        let errors = [0, 1, 2].map(|c| f64::from(pixel.colour[c] * exposure[c] - rendered[c]));
        self.error += errors.iter().map(|e| huber(*e)).sum::<f64>();
        let Some(depth) = depth else { return };
        self.pixels += 1;
        let motion = image_motion(camera, pixel.centre(), depth, self.unit);
        for (c, error) in errors.into_iter().enumerate() {
            let [right, down] = pixel.gradient[c].map(|g| f64::from(g * exposure[c]));
            // The surface's image must move by -error / gradient to remove the error.
            let row = [0, 1].map(|part| -(motion[0][part] * right + motion[1][part] * down));
            let weight =
                if error.abs() > HUBER_THRESHOLD { HUBER_THRESHOLD / error.abs() } else { 1.0 };
            self.matrix.add(weight, row);
            for (part, row) in row.into_iter().enumerate() {
                self.right_sides[part] += weight * error * row;
            }
        }
    }

    /// Returns the motion that minimises the error; `None` if too few pixels have a depth.
    fn solve(&self, damping: f64) -> Option<Motion> {
        if self.pixels < MIN_PIXELS || !self.error.is_finite() {
            return None;
        }
        let [rotation, translation] = self.matrix.damped(damping).solve(self.right_sides)?;
        Some(Motion { rotation, translation: self.unit * translation })
    }
}

/// Returns a pixel's z-depth: the median depth above an opacity of 0.5, otherwise the expected
/// depth. `None` if the opacity is too small or the depth isn't positive and finite.
fn trusted_depth(render: &Pixel, depth_per_distance: f64) -> Option<f64> {
    let distance = if render.opacity > 0.5 { render.median_depth } else { render.depth };
    let depth = f64::from(distance) * depth_per_distance;
    (render.opacity > MIN_DEPTH_OPACITY && depth.is_finite() && depth > 0.0).then_some(depth)
}

/// Returns the derivatives of an image position of given depth, to the right and down, by the
/// camera's rotation about its axes (in radians) and translation along them (in `unit`s).
fn image_motion(camera: &Camera, [u, v]: [f64; 2], depth: f64, unit: f64) -> [[DVec3; 2]; 2] {
    let k = &camera.intrinsics;
    let [u, v] = k.undistort([u, v]);
    let (x, y) = ((u - k.cx) / k.fx, -(v - k.cy) / k.fy);
    let [by_x, by_y] = k.distortion.jacobian([x, -y]);
    let point = depth * DVec3::new(x, y, -1.0);
    // Derivatives of the position on the plane of depth 1 by the point in camera space.
    let along_x = DVec3::new(1.0, 0.0, x) / depth;
    let along_y = DVec3::new(0.0, -1.0, -y) / depth;
    let right = k.fx * (by_x[0] * along_x + by_x[1] * along_y);
    let down = k.fy * (by_y[0] * along_x + by_y[1] * along_y);
    // In camera space the point moves the other way: by point × rotation, and by -translation.
    [right, down].map(|along| [along.cross(point), -unit * along])
}

/// Motion of a camera in its own axes.
#[derive(Clone, Copy, Debug)]
struct Motion {
    /// Axis times angle, in radians.
    rotation: DVec3,
    /// Shift of the camera's centre, in scene units.
    translation: DVec3,
}

/// Returns a camera after a motion.
fn apply_motion(camera: &Camera, motion: Motion) -> Camera {
    let rotated = rotation(camera) * DQuat::from_scaled_axis(motion.rotation);
    with_pose(camera, rotated, camera.centre() + camera.rotation() * motion.translation)
}

fn rotation(camera: &Camera) -> DQuat {
    DQuat::from_mat3(&camera.rotation()).normalize()
}

/// Returns the camera with another pose.
fn with_pose(camera: &Camera, rotation: DQuat, centre: DVec3) -> Camera {
    let axes = DMat3::from_quat(rotation.normalize());
    Camera { camera_to_world: pose_of(axes, centre), ..camera.clone() }
}

/// A camera before and after a motion.
#[derive(Clone, Copy, Debug)]
pub struct CameraMotion<'a> {
    /// Camera before the motion, of the photograph's size.
    pub from: &'a Camera,
    /// Camera after the motion.
    pub to: &'a Camera,
    /// Median depth of the camera's view, in scene units, if known.
    pub depth: Option<f64>,
}

/// Mean motion of cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeanMotion {
    /// Mean angle of rotation, in radians.
    pub angle: f64,
    /// Mean distance between old and new centre, in scene units.
    pub distance: f64,
    /// Mean motion in the photographs caused by the distance, in pixels.
    pub pixels: f64,
}

/// Mean rotation in degrees above which given poses are doubtful; chosen by hand.
const MAX_TRUSTED_ANGLE_DEGREES: f64 = 1.0;
/// Mean motion in pixels above which given poses are doubtful; chosen by hand.
const MAX_TRUSTED_PIXELS: f64 = 3.0;

impl MeanMotion {
    /// Computes the mean over all cameras; 0 if there are none.
    pub fn of_cameras<'a>(motions: impl Iterator<Item = CameraMotion<'a>>) -> Self {
        let mut count = 0.0f64;
        let mut sum = Self { angle: 0.0, distance: 0.0, pixels: 0.0 };
        for CameraMotion { from, to, depth } in motions {
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

    /// Returns whether the motion exceeds the usual error of given poses: 1°, or 3 pixels of the
    /// photographs.
    pub fn exceeds_usual_error(&self) -> bool {
        self.angle.to_degrees() > MAX_TRUSTED_ANGLE_DEGREES || self.pixels > MAX_TRUSTED_PIXELS
    }
}

impl fmt::Display for MeanMotion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { angle, distance, pixels } = self;
        write!(
            f,
            "turned by {:.3}° and moved by {} ({pixels:.1} pixels of the photographs) on average",
            angle.to_degrees(),
            format_length(*distance, 4)
        )
    }
}

/// Removes the mean rotation, translation and scaling of all cameras relative to `before`. A motion
/// that all cameras share would move the scene out of its bounds, and test views would no longer
/// match their cameras.
pub fn remove_common_motion(cameras: &mut [Camera], before: &[Camera]) {
    let share = 1.0 / cameras.len().max(1) as f64;
    let rotations = cameras.iter().zip(before).map(|(camera, before)| {
        let relative = rotation(camera) * rotation(before).inverse();
        // q and -q are the same rotation; the one with the smaller angle is used.
        (if relative.w < 0.0 { -relative } else { relative }).to_scaled_axis()
    });
    let inverse = DQuat::from_scaled_axis(-share * rotations.sum::<DVec3>());
    let [centre, centre_before] = [&*cameras, before]
        .map(|cameras| share * cameras.iter().map(Camera::centre).sum::<DVec3>());
    let spread = squared_distances(cameras, centre);
    let spread_before = squared_distances(before, centre_before);
    let scale =
        if spread > 0.0 && spread_before > 0.0 { (spread_before / spread).sqrt() } else { 1.0 };
    for camera in cameras {
        let offset = scale * (inverse * (camera.centre() - centre));
        *camera = with_pose(camera, inverse * rotation(camera), centre_before + offset);
    }
}

/// Returns the sum of the cameras' squared distances from a point.
fn squared_distances(cameras: &[Camera], point: DVec3) -> f64 {
    cameras.iter().map(|c| c.centre().distance_squared(point)).sum::<f64>()
}

#[cfg(test)]
mod tests;
