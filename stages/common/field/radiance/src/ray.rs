use glam::DVec3;
use scene::{Bounds, CameraRay, Frustum, Space};

use crate::math::exp;

/// Ray in scene units, in double precision since scenes may be far from the origin. [`clip`] maps
/// the ray to the unit cube before it rounds to single precision.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Ray {
    /// Start of the ray.
    pub origin: [f64; 3],
    /// Unit direction; a direction that is 0 or not finite renders the background.
    pub direction: [f64; 3],
    /// Background colour, display-encoded sRGB.
    pub background: [f32; 3],
}

impl Ray {
    /// Creates a ray from a camera's ray and a background.
    pub fn new(ray: &CameraRay, background: [f32; 3]) -> Self {
        let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
        Self { origin, direction, background }
    }

    /// True if the ray has a direction, and all its numbers are finite.
    pub fn is_usable(&self) -> bool {
        let numbers = self.origin.iter().chain(&self.direction);
        self.direction != [0.0; 3] && numbers.into_iter().all(|x| x.is_finite())
    }

    /// Returns the direction in single precision.
    fn view_direction(&self) -> [f32; 3] {
        self.direction.map(|x| x as f32)
    }
}

/// Ray in the unit cube with a parameter t: in a box and in NDC the distance along the ray in cube
/// sides, in a contraction see [`RayMap::Contracted`].
#[derive(Clone, Copy, Debug, Default)]
pub struct NormalizedRay {
    /// Position at t = 0.
    pub origin: [f32; 3],
    /// Direction of increasing t.
    pub direction: [f32; 3],
    /// Parameter at which the ray enters the cube; the ray misses if `enter >= leave`.
    pub enter: f32,
    /// Parameter at which the ray leaves the cube.
    pub leave: f32,
    /// Map from t to position and distance.
    pub map: RayMap,
    /// Unit direction in the world, on which colours depend in every space.
    pub view: [f32; 3],
}

/// Map from a ray's parameter t to its position in the unit cube and its distance in scene units.
#[derive(Clone, Copy, Debug)]
pub enum RayMap {
    /// Box or NDC: position origin + t·direction, distance start + t·scale / (1 - t·perspective). A
    /// perspective map keeps lines straight; along a line it is a Möbius map. In a box
    /// `perspective` is 0. The divisor is computed as end + (leave - t)·perspective: a far end at a
    /// million near depths would cancel it.
    Straight {
        /// Distance at t = 0, in scene units.
        start: f32,
        /// Derivative of the distance at t = 0.
        scale: f32,
        /// Inverse of the t at which the distance becomes infinite; 0 in a box.
        perspective: f32,
        /// Divisor at the parameter at which the ray leaves the cube; 1 in a box.
        end: f32,
    },
    /// Contraction: `origin` is the ray's point nearest to the centre, in ball radii. The point at
    /// t is `radii`·sinh(4t) from `origin`, so steps grow as fast as the contraction shrinks them.
    /// The distance is start + scale·sinh(4t).
    Contracted {
        /// Distance of the point nearest to the centre, in scene units.
        start: f32,
        /// Scene units per sinh(4t).
        scale: f32,
        /// Ball radii per sinh(4t).
        radii: f32,
    },
}

impl Default for RayMap {
    fn default() -> Self {
        Self::Straight { start: 0.0, scale: 1.0, perspective: 0.0, end: 1.0 }
    }
}

/// Maximum speed of a contracted ray in cube sides per unit of t, approached by rays that pass far
/// from the centre.
pub const MAX_SPEED: f32 = 2.0;

/// Maximum change of a contracted ray's velocity per unit of t, reached just outside the ball by a
/// ray through the centre.
pub(crate) const MAX_ACCELERATION: f32 = 12.0;

/// Returns sinh(4t). Near 0 the absolute error is that of a difference of two numbers near 1, as
/// large as a position's.
#[inline(always)]
fn sinh4(t: f32) -> f32 {
    let e = exp(4.0 * t);
    0.5 * (e - 1.0 / e)
}

/// Returns a contracted ray's point at distance `along` from the one nearest to the centre, and the
/// point's distance from the centre, all in ball radii.
#[inline(always)]
fn uncontracted_point(origin: [f32; 3], direction: [f32; 3], along: f32) -> ([f32; 3], f32) {
    let u: [f32; 3] = std::array::from_fn(|i| direction[i].mul_add(along, origin[i]));
    (u, u.iter().map(|x| x * x).sum::<f32>().sqrt())
}

/// Returns the position of a contracted ray in the unit cube at t.
#[inline(always)]
pub(crate) fn contracted_position(
    origin: [f32; 3],
    direction: [f32; 3],
    radii: f32,
    t: f32,
) -> [f32; 3] {
    let (u, length) = uncontracted_point(origin, direction, radii * sinh4(t));
    let factor = if length > 1.0 { (2.0 - 1.0 / length) / length } else { 1.0 };
    u.map(|x| (0.25 * factor).mul_add(x, 0.5))
}

/// Returns the derivative of [`contracted_position`] with respect to t. Both the inside and the
/// outside of the ball are computed, so that a loop vectorises.
#[inline(always)]
pub(crate) fn contracted_velocity(
    origin: [f32; 3],
    direction: [f32; 3],
    radii: f32,
    t: f32,
) -> [f32; 3] {
    let e = exp(4.0 * t);
    let half = 0.5 * radii;
    // `speed` is a quarter of the derivative of `along`, since the cube is four radii wide.
    let (along, speed) = (half * (e - 1.0 / e), half * (e + 1.0 / e));
    let (u, length) = uncontracted_point(origin, direction, along);
    // The contraction is h(r)·u with h = (2 - 1/r) / r, and dr/d(along) = along / r.
    let inverse = 1.0 / length;
    let factor = (2.0 - inverse) * inverse;
    let change = 2.0 * (inverse - 1.0) * inverse * inverse * (along * inverse);
    std::array::from_fn(|i| {
        let outside = speed * change.mul_add(u[i], factor * direction[i]);
        if length <= 1.0 { speed * direction[i] } else { outside }
    })
}

impl NormalizedRay {
    /// Returns the position in the unit cube at t.
    #[inline(always)]
    pub fn position(&self, t: f32) -> [f32; 3] {
        match self.map {
            RayMap::Straight { .. } => {
                std::array::from_fn(|i| self.direction[i].mul_add(t, self.origin[i]))
            }
            RayMap::Contracted { radii, .. } => {
                contracted_position(self.origin, self.direction, radii, t)
            }
        }
    }

    /// Returns `radii` of a contracted ray; 0 for a straight ray.
    #[inline(always)]
    pub(crate) fn radii(&self) -> f32 {
        match self.map {
            RayMap::Straight { .. } => 0.0,
            RayMap::Contracted { radii, .. } => radii,
        }
    }

    /// Returns the distance at t, in scene units.
    #[inline(always)]
    pub fn distance(&self, t: f32) -> f32 {
        match self.map {
            RayMap::Straight { start, scale, perspective, end } => {
                t * scale / perspective.mul_add(self.leave - t, end) + start
            }
            RayMap::Contracted { start, scale, .. } => scale.mul_add(sinh4(t), start),
        }
    }

    /// Creates a ray that misses the cube.
    fn miss(ray: &Ray) -> Self {
        Self { view: ray.view_direction(), ..Self::default() }
    }
}

/// Clips a ray to the field's space and range of distances. Computed in f64, so that scenes of 1e-6
/// or 1e6 units, and georeferenced ones, lose no precision.
pub fn clip(bounds: &Bounds, ray: &Ray) -> NormalizedRay {
    if !ray.is_usable() {
        return NormalizedRay::miss(ray);
    }
    let (origin, direction) = (DVec3::from(ray.origin), DVec3::from(ray.direction));
    let clipped = match &bounds.space {
        Space::Box => clip_to_box(bounds, origin, direction),
        Space::Ndc(frustum) => clip_to_frustum(frustum, bounds.near, origin, direction),
        Space::Contraction => Some(clip_to_contraction(bounds, origin, direction)),
    };
    clipped.map_or(NormalizedRay::miss(ray), |clipped| NormalizedRay {
        view: ray.view_direction(),
        ..clipped
    })
}

/// Maximum distance of a ray's origin from the box it enters, in box sides; farther rays start
/// where they enter. In single precision, positions along a ray from this distance are exact to a
/// millionth of a side (`stability_tests.rs`).
const MAX_ORIGIN_DISTANCE: f64 = 16.0;

fn clip_to_box(bounds: &Bounds, origin: DVec3, direction: DVec3) -> Option<NormalizedRay> {
    let side = bounds.longest_side();
    let origin = (origin - DVec3::from(bounds.min)) / side;
    let extent = (DVec3::from(bounds.max) - DVec3::from(bounds.min)) / side;
    // A point is inside of a face if offset + slope·t >= 0.
    let faces =
        (0..3).flat_map(|i| [(origin[i], direction[i]), (extent[i] - origin[i], -direction[i])]);
    let (enter, leave) = clip_to_halfspaces(faces, [bounds.near / side, bounds.far / side])?;
    let start = if enter > MAX_ORIGIN_DISTANCE { enter } else { 0.0 };
    Some(NormalizedRay {
        origin: (origin + start * direction).as_vec3().to_array(),
        direction: direction.as_vec3().to_array(),
        enter: (enter - start) as f32,
        leave: (leave - start) as f32,
        map: RayMap::Straight {
            start: (start * side) as f32,
            scale: side as f32,
            perspective: 0.0,
            end: 1.0,
        },
        view: [0.0; 3],
    })
}

/// Clips a ray to the frustum, beyond `near`. The range's far end isn't needed: the frustum's far
/// plane takes its place.
fn clip_to_frustum(
    frustum: &Frustum,
    near: f64,
    origin: DVec3,
    direction: DVec3,
) -> Option<NormalizedRay> {
    let (o, d) = (frustum.to_camera(origin), frustum.rotate_to_camera(direction));
    let depths = [(o.z - frustum.near, d.z), (frustum.far - o.z, -d.z)];
    let sides = (0..2).flat_map(|i| {
        let (low, high) = (frustum.min[i], frustum.max[i]);
        [(o[i] - low * o.z, d[i] - low * d.z), (high * o.z - o[i], high * d.z - d[i])]
    });
    let planes = depths.into_iter().chain(sides);
    let (enter, leave) = clip_to_halfspaces(planes, [near, f64::INFINITY])?;
    let (from, to) = (o + enter * d, o + leave * d);
    let (start, end) = (frustum.to_cube(from), frustum.to_cube(to));
    let length = (end - start).length();
    // A ray that no plane ends has no finite length.
    if !length.is_finite() || length <= 0.0 {
        return None;
    }
    // With x = distance - enter, t is a projective function of x: t = c·x / (from.z + x·d.z).
    // Solved for x: x = t·(from.z / c) / (1 - t·(d.z / c)). c follows from t = length at the far
    // end.
    let c = length * to.z / (leave - enter);
    Some(NormalizedRay {
        origin: start.as_vec3().to_array(),
        direction: ((end - start) / length).as_vec3().to_array(),
        enter: 0.0,
        leave: length as f32,
        map: RayMap::Straight {
            start: enter as f32,
            scale: (from.z / c) as f32,
            perspective: (d.z / c) as f32,
            end: (from.z / to.z) as f32,
        },
        view: [0.0; 3],
    })
}

fn clip_to_contraction(bounds: &Bounds, origin: DVec3, direction: DVec3) -> NormalizedRay {
    let radius = 0.5 * bounds.longest_side();
    let from = (origin - bounds.middle()) / radius;
    let to_nearest = -from.dot(direction);
    let nearest = from + to_nearest * direction;
    let radii = nearest.length().max(1.0);
    let [enter, leave] = [bounds.near, bounds.far]
        .map(|distance| 0.25 * ((distance / radius - to_nearest) / radii).asinh());
    NormalizedRay {
        origin: nearest.as_vec3().to_array(),
        direction: direction.as_vec3().to_array(),
        enter: enter as f32,
        leave: leave as f32,
        map: RayMap::Contracted {
            start: (to_nearest * radius) as f32,
            scale: (radii * radius) as f32,
            radii: radii as f32,
        },
        view: [0.0; 3],
    }
}

/// Clips a range of x to where all functions offset + slope·x are at least 0; returns `None` if
/// nothing is left.
fn clip_to_halfspaces(
    functions: impl Iterator<Item = (f64, f64)>,
    [mut low, mut high]: [f64; 2],
) -> Option<(f64, f64)> {
    for (offset, slope) in functions {
        if slope > 0.0 {
            low = low.max(-offset / slope);
        } else if slope < 0.0 {
            high = high.min(-offset / slope);
        } else if offset < 0.0 {
            return None;
        }
    }
    (low < high).then_some((low, high))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: [f64; 3], direction: [f64; 3]) -> Ray {
        Ray { origin, direction, background: [1.0; 3] }
    }

    #[test]
    fn rays_hit_or_miss_the_box() {
        for scale in [1e-6, 1.0, 1e6f64] {
            let s = scale as f32;
            let bounds = Bounds {
                min: [-scale; 3],
                max: [scale; 3],
                near: 0.0,
                far: 100.0 * scale,
                ..Default::default()
            };
            let hit = clip(&bounds, &ray([0., 0., 4. * scale], [0., 0., -1.]));
            assert!((hit.enter - 1.5).abs() < 1e-5 && (hit.leave - 2.5).abs() < 1e-5, "{hit:?}");
            assert!((hit.distance(hit.enter) - 3.0 * s).abs() < 1e-5 * s);
            // A ray that starts inside.
            assert_eq!(clip(&bounds, &ray([0.; 3], [1., 0., 0.])).enter, 0.0);
            // Rays next to the box, parallel to a face, away from it, of length zero, and with NaN.
            for (o, d) in [
                ([0., 3., 4.], [0., 0., -1.]),
                ([2., 0., 0.], [0., 1., 0.]),
                ([0., 0., 4.], [0., 0., 1.]),
                ([0.; 3], [0.; 3]),
                ([0.; 3], [f64::NAN, 0., 1.]),
            ] {
                let miss = clip(&bounds, &ray(o.map(|x| x * scale), d));
                assert!(miss.enter >= miss.leave, "{o:?} {d:?}: {miss:?}");
            }
        }
    }

    /// Moving a scene doesn't change its rays in the unit cube.
    #[test]
    fn normalized_rays_do_not_depend_on_the_scenes_position() {
        let rotation = glam::DMat3::from_axis_angle(unit([0.3, 1.0, -0.2]), 0.4);
        let centre = DVec3::new(0.1, -0.4, 3.2);
        let frustum = Frustum {
            camera_to_world: scene::pose_of(rotation, centre),
            min: [-0.9, -0.6],
            max: [0.8, 0.7],
            near: 0.8,
            far: 50.0,
        };
        let (utm, ecef) = (
            DVec3::new(500_000.0, 4_649_776.0, 120.0),
            DVec3::new(4_027_893.7, 307_045.6, 4_919_474.9),
        );
        for space in [Space::Box, Space::Ndc(frustum), Space::Contraction] {
            let original = Bounds { min: [-1.1; 3], max: [1.1; 3], near: 0.1, far: 90.0, space };
            for (shift, tolerance) in [(utm, 1e-6), (ecef, 1e-6), (DVec3::splat(1024.0), 1e-7)] {
                let moved = original.moved(shift);
                for k in 0..200 {
                    let mut rng = numerics::CounterRng::new(5, 1, k);
                    let mut draw = || f64::from(rng.uniform()) - 0.5;
                    let direction =
                        (-rotation.z_axis + 0.8 * DVec3::new(draw(), draw(), draw())).normalize();
                    let origin = centre + DVec3::new(draw(), draw(), draw());
                    let cast = |bounds: &Bounds, origin: DVec3| {
                        clip(bounds, &ray(origin.to_array(), direction.to_array()))
                    };
                    let (a, b) = (cast(&original, origin), cast(&moved, origin + shift));
                    assert_eq!(a.enter < a.leave, b.enter < b.leave);
                    let components = |r: &NormalizedRay| {
                        [&r.origin[..], &r.direction, &r.view, &[r.enter, r.leave]].concat()
                    };
                    for (a, b) in components(&a).into_iter().zip(components(&b)) {
                        assert!((a - b).abs() <= tolerance * a.abs().max(1.0), "{space:?} {a} {b}");
                    }
                }
            }
        }
    }

    fn unit(v: [f64; 3]) -> DVec3 {
        DVec3::from(v).normalize()
    }

    /// Maps a world point to the unit cube by the contraction, in double precision.
    fn contract(scale: f64, p: DVec3) -> DVec3 {
        let u = p / scale;
        let u = if u.length() > 1.0 { (2.0 - 1.0 / u.length()) * u.normalize() } else { u };
        0.25 * u + 0.5
    }

    /// The position at t is that of the world point at the ray's distance at t. All positions are
    /// in the cube, and the distance never decreases with t.
    #[test]
    fn positions_and_distances_agree_in_ndc_and_contraction() {
        let rotation = glam::DMat3::from_axis_angle(unit([0.3, 1.0, -0.2]), 0.4);
        for scale in [1e-4, 1.0, 1e4f64] {
            let centre = scale * DVec3::new(0.1, 0.2, 0.3);
            let frustum = Frustum {
                camera_to_world: scene::pose_of(rotation, centre),
                min: [-0.9, -0.6],
                max: [0.8, 0.7],
                near: 0.8 * scale,
                far: 50.0 * scale,
            };
            let (near, far) = (0.1 * scale, 90.0 * scale);
            let bounds = |space| Bounds { min: [-scale; 3], max: [scale; 3], near, far, space };
            let mut hits = [0; 2];
            for k in 0..200 {
                let mut rng = numerics::CounterRng::new(5, 0, k);
                let mut draw = || f64::from(rng.uniform()) - 0.5;
                let origin = centre + scale * DVec3::new(draw(), draw(), draw());
                let direction =
                    (-rotation.z_axis + 0.8 * DVec3::new(draw(), draw(), draw())).normalize();
                let ray = ray(origin.to_array(), direction.to_array());
                for (i, space) in [Space::Ndc(frustum), Space::Contraction].into_iter().enumerate()
                {
                    let clipped = clip(&bounds(space), &ray);
                    if clipped.enter >= clipped.leave {
                        continue;
                    }
                    hits[i] += 1;
                    let mut previous = f64::from(clipped.distance(clipped.enter)) - 1e-5 * scale;
                    for j in 0..=20 {
                        let t = clipped.enter + (clipped.leave - clipped.enter) * j as f32 / 20.0;
                        let (p, distance) = (clipped.position(t), f64::from(clipped.distance(t)));
                        let world = origin + distance * direction;
                        let expected = match space {
                            Space::Ndc(_) => frustum.to_cube(frustum.to_camera(world)),
                            _ => contract(scale, world),
                        };
                        let error = (DVec3::from(p.map(f64::from)) - expected).length();
                        assert!(error < 2e-5, "{space:?} {j}: {p:?} {expected} at {distance}");
                        assert!(p.iter().all(|x| (-1e-5..1.00001).contains(x)), "{p:?}");
                        assert!(distance >= previous, "{distance} after {previous}");
                        previous = distance;
                    }
                }
            }
            assert!(hits[0] > 100 && hits[1] == 200, "{hits:?}");
        }
    }

    /// Distances in NDC grow up to the far plane, however far it is.
    #[test]
    fn distances_reach_any_far_plane() {
        let camera_to_world = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.]];
        for far in [1e1, 1e5, 1e7, 1e9, 1e18] {
            let frustum =
                Frustum { camera_to_world, min: [-0.6; 2], max: [0.6; 2], near: 1.0, far };
            let space = Space::Ndc(frustum);
            let bounds = Bounds { min: [-1.0; 3], max: [1.0; 3], near: 1.0, far, space };
            for slope in [-0.2, 0.0, 0.1] {
                let direction = unit([slope, 0.5 * slope, -1.0]);
                let clipped = clip(&bounds, &ray([0.0; 3], direction.to_array()));
                let end = f64::from(clipped.distance(clipped.leave)) * -direction.z;
                assert!((end / far - 1.0).abs() < 1e-5, "{end} at far = {far}");
                let mut previous = 0.0;
                for j in 0..=1000 {
                    let distance = clipped.distance(clipped.leave * j as f32 / 1000.0);
                    assert!(distance > previous, "{distance} after {previous}, far = {far}");
                    previous = distance;
                }
            }
        }
    }

    /// A contracted ray's speed is at most [`MAX_SPEED`] and its acceleration at most
    /// [`MAX_ACCELERATION`]: leaping relies on both. The velocity is the derivative of the
    /// position.
    #[test]
    fn contracted_rays_keep_their_speed_limits() {
        let bounds = Bounds {
            min: [-1.0; 3],
            max: [1.0; 3],
            near: 0.0,
            far: 1e4,
            space: Space::Contraction,
        };
        let distance =
            |a: [f32; 3], b: [f32; 3]| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>().sqrt();
        let mut max_acceleration: f32 = 0.0;
        for k in 0..300 {
            let mut rng = numerics::CounterRng::new(6, 0, k);
            let mut draw = || 2.0 * f64::from(rng.uniform()) - 1.0;
            let extent = [0.5, 3.0, 40.0, 0.0][k as usize % 4];
            let origin = [extent * draw(), extent * draw(), extent * draw()];
            let direction = unit([draw(), draw(), draw()]).to_array();
            let clipped = clip(&bounds, &ray(origin, direction));
            let RayMap::Contracted { radii, .. } = clipped.map else {
                panic!("the space is contracted");
            };
            let step = 2e-3;
            let mut t = clipped.enter;
            while t + step < clipped.leave {
                let [a, b] = [t, t + step].map(|t| clipped.position(t));
                assert!(distance(a, b) < MAX_SPEED * step + 1e-6, "at {t} of {clipped:?}");
                let [before, after] = [t, t + step]
                    .map(|t| contracted_velocity(clipped.origin, clipped.direction, radii, t));
                let measured: [f32; 3] = std::array::from_fn(|i| (b[i] - a[i]) / step);
                let middle = std::array::from_fn(|i| 0.5 * (before[i] + after[i]));
                assert!(distance(measured, middle) < 0.01, "{measured:?} {middle:?} at {t}");
                let acceleration = distance(before, after) / step;
                assert!(
                    acceleration < MAX_ACCELERATION + 0.01,
                    "{acceleration} at {t} of {clipped:?}"
                );
                max_acceleration = max_acceleration.max(acceleration);
                t += step;
            }
        }
        assert!(max_acceleration > 11.0, "{max_acceleration} is far below its bound");
    }
}
