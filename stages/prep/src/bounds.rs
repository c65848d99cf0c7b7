//! A scene's extent and space, from cameras and depths (docs/design/004, 035).

use glam::{DMat3, DVec3};
use scene::{
    Bounds, Camera, CameraRay, Frustum, Space, common_direction, pose_of, power_of_two_floor,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::pose_warnings::{MIN_OUTLIER_RATIO, median};

/// Space of a field's unit cube.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SpaceKind {
    /// A box around the region that the cameras face, for bounded scenes.
    Box,
    /// Normalised device coordinates, for forward-facing photographs: distant parts get less
    /// detail.
    Ndc,
    /// The box and, ever coarser with distance, everything around it, for cameras inside the scene.
    Contraction,
}

/// Reason against NDC for views without depths.
const DEPTHS_MISSING: &str = "parameter space: ndc requires the depth range of each view, which \
    the data set lacks; give near and far, or choose box";
/// Reason against NDC for fisheye lenses.
const FISHEYE_REFUSED: &str = "parameter space: ndc cannot contain the view of a fisheye lens; \
    choose box or contraction, or lens: undo";
/// Reason against NDC for cameras whose directions differ too much for a common frustum.
const NOT_FORWARD: &str =
    "parameter space: ndc requires cameras that face one direction; choose box or contraction";

/// Minimum distance of points from the box's centre, relative to half the box's side, above which
/// the space becomes the contraction (design note 004).
const MIN_CONTRACTION_DISTANCE: f64 = 2.5;

/// Camera with its depth range [nearest, farthest], if known.
pub(crate) type CameraDepths = (Camera, Option<[f64; 2]>);

/// Returns the scene's bounds, around the training views; `others` are test views, which the space
/// must suit, too.
///
/// Without a requested `kind` the space is NDC if all cameras face one direction and their depths
/// are known, the contraction if known depths reach far outside the box, otherwise the box. If the
/// scene is unbounded (opaque background) and depths are unknown, a box might not contain the
/// scene. Then depths are guessed if the cameras face one direction; otherwise the space is the
/// contraction.
///
/// All is computed relative to a point near the cameras: sums of large coordinates would lose the
/// digits in which cameras differ.
pub(crate) fn scene_bounds(
    training: &[CameraDepths],
    others: &[CameraDepths],
    is_unbounded: bool,
    kind: Option<SpaceKind>,
) -> Result<Bounds, &'static str> {
    let origin = near_point(training);
    if origin == DVec3::ZERO {
        return bounds_near_origin(training, others, is_unbounded, kind);
    }
    let (training, others) = (moved(training, -origin), moved(others, -origin));
    let bounds = bounds_near_origin(&training, &others, is_unbounded, kind)?;
    // `train-ss` rounds bounds in any case. These are rounded before the shift, which loses digits.
    let anchor = training.first().map_or(DVec3::ZERO, |(camera, _)| camera.centre());
    Ok(bounds.rounded(anchor).moved(origin))
}

fn moved(views: &[CameraDepths], offset: DVec3) -> Vec<CameraDepths> {
    views.iter().map(|(camera, depths)| (camera.moved(offset), *depths)).collect()
}

/// Step of [`near_point`], relative to the scene's extent (docs/design/004). A scene within half a
/// step of the origin isn't moved: f64 has at least ten digits of its extent there.
const NEAR_POINT_STEP: f64 = 1024.0;

/// Returns a point near the cameras, a multiple of a step much larger than the scene's known
/// extent, so that scenes around the origin get the origin.
fn near_point(views: &[CameraDepths]) -> DVec3 {
    let Some(first) = views.first().map(|(camera, _)| camera.centre()) else { return DVec3::ZERO };
    let mut extent = 0.0f64;
    for (camera, depths) in views {
        let farthest = depths.map_or(0.0, |[_, farthest]| farthest);
        extent = extent.max(camera.centre().distance(first)).max(farthest);
    }
    let step = NEAR_POINT_STEP * power_of_two_floor(extent);
    let point = (first / step).round() * step;
    // For cameras at one position without known depths, the step is 0.
    if point.is_finite() { point } else { DVec3::ZERO }
}

/// [`scene_bounds`] of a scene near the origin.
fn bounds_near_origin(
    training: &[CameraDepths],
    others: &[CameraDepths],
    is_unbounded: bool,
    kind: Option<SpaceKind>,
) -> Result<Bounds, &'static str> {
    let boxed = box_bounds(training);
    let has_unknown_extent = is_unbounded && training.iter().any(|(_, depths)| depths.is_none());
    let guessed = if has_unknown_extent { guess_depths(training) } else { None };
    match kind {
        Some(SpaceKind::Box) => Ok(boxed),
        Some(SpaceKind::Ndc) => ndc_bounds(training, others, guessed),
        Some(SpaceKind::Contraction) => Ok(contracted_bounds(boxed, training)),
        None => Ok(match ndc_bounds(training, others, guessed) {
            Ok(bounds) => bounds,
            Err(_) if has_unknown_extent || reaches_beyond(&boxed, training) => {
                contracted_bounds(boxed, training)
            }
            Err(_) => boxed,
        }),
    }
}

fn ndc_bounds(
    training: &[CameraDepths],
    others: &[CameraDepths],
    guessed: Option<[f64; 2]>,
) -> Result<Bounds, &'static str> {
    let mut all: Vec<CameraDepths> = Vec::with_capacity(training.len() + others.len());
    for (camera, depths) in training.iter().chain(others) {
        if camera.intrinsics.distortion.is_fisheye() {
            return Err(FISHEYE_REFUSED);
        }
        all.push((camera.clone(), depths.or(guessed)));
    }
    let space = Space::Ndc(frustum(&all)?);
    Ok(Bounds { space, ..frusta_bounds(&all).ok_or(NOT_FORWARD)? })
}

/// Guessed nearest and farthest depth, relative to the distance of the cameras' focus
/// (docs/design/035).
const GUESSED_DEPTH_FACTORS: [f64; 2] = [0.25, 50.0];

/// Guesses the depth range of cameras that face one direction. The range is relative to the point
/// where the cameras' axes cross or, for parallel axes, to four times the cameras' extent
/// (docs/design/035). A near end that is too near costs detail but cuts nothing off. `None` for
/// cameras that face several directions or are at one position.
fn guess_depths(views: &[CameraDepths]) -> Option<[f64; 2]> {
    let cameras: Vec<&Camera> = views.iter().map(|(camera, _)| camera).collect();
    let forward = common_direction(cameras.iter().copied())?;
    let centre = mean(views, Camera::centre);
    let extent = 2.0 * cameras.iter().map(|c| (c.centre() - centre).length()).fold(0.0, f64::max);
    let focus = crossing_point(&cameras, MIN_FOCUS_DETERMINANT)
        .map(|point| (point - centre).dot(forward))
        .filter(|distance| *distance > extent);
    let distance = focus.unwrap_or(4.0 * extent);
    (distance > 0.0).then(|| GUESSED_DEPTH_FACTORS.map(|factor| factor * distance))
}

/// Returns the NDC frustum that contains all views, from their mean centre.
fn frustum(views: &[CameraDepths]) -> Result<Frustum, &'static str> {
    let forward = common_direction(views.iter().map(|(c, _)| c)).ok_or(NOT_FORWARD)?;
    let up = mean(views, |c| c.rotation().y_axis);
    let right = forward.cross(up).try_normalize().ok_or(NOT_FORWARD)?;
    let (up, centre) = (right.cross(forward), mean(views, Camera::centre));
    let mut frustum = Frustum {
        camera_to_world: pose_of(DMat3::from_cols(right, up, -forward), centre),
        min: [f64::INFINITY; 2],
        max: [f64::NEG_INFINITY; 2],
        near: f64::INFINITY,
        far: 0.0,
    };
    for (camera, depths) in views {
        let [nearest, farthest] = depths.ok_or(DEPTHS_MISSING)?;
        // Known depths are those of matched points, but surfaces may be nearer or much farther. The
        // factors are chosen by hand.
        for corner in extreme_points(camera, [0.9 * nearest, 2.0 * farthest]) {
            let p = frustum.to_camera(corner);
            if p.z <= 0.0 {
                return Err(NOT_FORWARD);
            }
            for (i, slope) in [p.x / p.z, p.y / p.z].into_iter().enumerate() {
                frustum.min[i] = frustum.min[i].min(slope);
                frustum.max[i] = frustum.max[i].max(slope);
            }
            frustum.near = frustum.near.min(p.z);
            frustum.far = frustum.far.max(p.z);
        }
    }
    if frustum.is_valid() { Ok(frustum) } else { Err(NOT_FORWARD) }
}

fn mean(views: &[CameraDepths], vector: fn(&Camera) -> DVec3) -> DVec3 {
    views.iter().map(|(camera, _)| vector(camera)).sum::<DVec3>() / views.len().max(1) as f64
}

/// True if most views have known depths far outside the box.
fn reaches_beyond(bounds: &Bounds, views: &[CameraDepths]) -> bool {
    let centre = bounds.middle();
    let reach = MIN_CONTRACTION_DISTANCE * 0.5 * bounds.longest_side();
    let far = views.iter().filter(|(camera, depths)| {
        depths.is_some_and(|[_, farthest]| farthest > (camera.centre() - centre).length() + reach)
    });
    2 * far.count() > views.len()
}

/// Extends a box to the contraction, with near and far wide enough for all known depths, by factors
/// chosen by hand. If most cameras face away from the box's centre, the box reaches twice as far as
/// the cameras, so that it contains what is near them (docs/design/035).
fn contracted_bounds(boxed: Bounds, views: &[CameraDepths]) -> Bounds {
    let centre = boxed.middle();
    let outward = views.iter().filter(|(c, _)| c.forward().dot(c.centre() - centre) > 0.0);
    let faces_outward = 2 * outward.count() > views.len();
    let camera_distance =
        views.iter().map(|(camera, _)| (camera.centre() - centre).length()).fold(0.0, f64::max);
    let half_side = 0.5 * boxed.longest_side();
    let radius = if faces_outward { half_side.max(2.0 * camera_distance) } else { half_side };
    let known = views.iter().filter_map(|(_, depths)| *depths);
    let near = known.clone().map(|d| 0.5 * d[0]).fold(0.05 * radius, f64::min);
    let far = known.map(|d| 10.0 * d[1]).fold(100.0 * radius, f64::max);
    let contracted = Bounds { near, far, space: Space::Contraction, ..boxed };
    if !faces_outward {
        return contracted;
    }
    let half = DVec3::splat(radius);
    let (min, max) = ((centre - half).to_array(), (centre + half).to_array());
    Bounds { min, max, ..contracted }
}

/// Number of cells along each side of the sampling grid over a fisheye image; chosen by hand.
const FISHEYE_GRID_CELLS: u32 = 16;

/// Returns points that bound a camera's view between two depths. For a fisheye lens, the depths are
/// distances along rays, and extreme points may be anywhere in the image.
fn extreme_points(camera: &Camera, depths: [f64; 2]) -> Vec<DVec3> {
    let k = &camera.intrinsics;
    let mut points = Vec::new();
    if !k.distortion.is_fisheye() {
        for [x, y] in k.border() {
            let ray: CameraRay = camera.ray(x, y);
            points.extend(depths.map(|depth| ray.at(depth / camera.depth_per_distance(&ray))));
        }
        return points;
    }
    for row in 0..=FISHEYE_GRID_CELLS {
        for column in 0..=FISHEYE_GRID_CELLS {
            let x = f64::from(column * k.width) / f64::from(FISHEYE_GRID_CELLS);
            let y = f64::from(row * k.height) / f64::from(FISHEYE_GRID_CELLS);
            let ray = camera.ray(x, y);
            points.extend(depths.map(|distance| ray.at(distance)));
        }
    }
    points
}

/// Minimum determinant of [`crossing_point`] for the centre of a box; chosen by hand.
pub(crate) const MIN_CENTRE_DETERMINANT: f64 = 1e-3;
/// Minimum determinant of [`crossing_point`] for the focus of cameras that face one direction,
/// whose axes are nearly parallel; chosen by hand.
const MIN_FOCUS_DETERMINANT: f64 = 1e-9;

/// Returns a box around the region that all cameras face, from the cameras alone if possible.
///
/// The centre is the point nearest to all optical axes; the half side is the half width of the
/// widest view at that distance, so that a scene that fits into its views fits into the box. Views
/// [`MIN_OUTLIER_RATIO`] times as wide as the median, of which `prep` warns, don't count: in a box
/// as wide as theirs the scene would be a few cells large (docs/results/stability.md). If the axes
/// don't cross (one view, a forward-facing row), the box surrounds the views between their known
/// depths or, without depths, a point at distance 4 before the mean camera, the convention of the
/// Blender scenes.
fn box_bounds(views: &[CameraDepths]) -> Bounds {
    let cameras: Vec<&Camera> = views.iter().map(|(camera, _)| camera).collect();
    let centre = if let Some(crossing) = crossing_point(&cameras, MIN_CENTRE_DETERMINANT) {
        crossing
    } else if let Some(bounds) = frusta_bounds(views) {
        return bounds;
    } else {
        let forward = mean(views, Camera::forward).normalize_or(DVec3::NEG_Z);
        mean(views, Camera::centre) + 4.0 * forward
    };
    let widths: Vec<f64> = cameras.iter().map(|camera| half_width(camera, centre)).collect();
    let limit = MIN_OUTLIER_RATIO * median(widths.iter().copied());
    let widest = widths.into_iter().filter(|width| *width <= limit).fold(0.0, f64::max);
    // A twentieth more, for silhouettes that touch the image border.
    let half = if widest > 0.0 { 1.05 * widest } else { UNKNOWN_HALF_SIDE };
    let (min, max) = (centre - DVec3::splat(half), centre + DVec3::splat(half));
    let (near, far) = ray_range(min, max, &cameras);
    Bounds { min: min.to_array(), max: max.to_array(), near, far, space: Space::Box }
}

/// Half side of the box around cameras at one position, from which no depth follows; chosen by
/// hand.
const UNKNOWN_HALF_SIDE: f64 = 1.0;

/// Maximum slope of a fisheye view's border from which a box's size is computed: 45° from the axis.
/// Larger slopes would yield boxes that contain the cameras (docs/design/005).
const MAX_FISHEYE_SLOPE: f64 = 1.0;

/// Returns half the longer side of a camera's view at the distance of `point`.
fn half_width(camera: &Camera, point: DVec3) -> f64 {
    let k = &camera.intrinsics;
    let [x, y] = [0.5 * f64::from(k.width) / k.fx, 0.5 * f64::from(k.height) / k.fy];
    let slope = if k.distortion.is_fisheye() {
        let [right, bottom] = [[x, 0.0], [0.0, y]].map(|border| k.distortion.undistort(border));
        right[0].max(bottom[1]).min(MAX_FISHEYE_SLOPE)
    } else {
        x.max(y)
    };
    (camera.centre() - point).length() * slope
}

/// Returns the point nearest to all optical axes in the least-squares sense, if they cross well
/// enough: the determinant of the mean projection is 0 for parallel axes and 8/27 for axes from all
/// sides.
pub(crate) fn crossing_point(cameras: &[&Camera], min_determinant: f64) -> Option<DVec3> {
    let (mut matrix, mut rhs) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let d = camera.forward();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        matrix += across;
        rhs += across * camera.centre();
    }
    let mean_matrix = matrix * (1.0 / cameras.len().max(1) as f64);
    (mean_matrix.determinant() > min_determinant).then(|| matrix.inverse() * rhs)
}

/// Returns a box around all views between their depths, with a margin of a tenth. `None` if a
/// view's depths are unknown, or the box is invalid.
fn frusta_bounds(views: &[CameraDepths]) -> Option<Bounds> {
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (mut near, mut far) = (f64::INFINITY, 0.0f64);
    for (camera, depths) in views {
        let [nearest, farthest] = (*depths)?;
        near = near.min(0.9 * nearest);
        for corner in extreme_points(camera, [0.9 * nearest, 1.1 * farthest]) {
            (min, max) = (min.min(corner), max.max(corner));
            far = far.max((corner - camera.centre()).length());
        }
    }
    let bounds = Bounds { min: min.to_array(), max: max.to_array(), near, far, space: Space::Box };
    bounds.is_valid().then_some(bounds)
}

/// Returns the distances of a box's nearest and farthest point over all cameras.
fn ray_range(min: DVec3, max: DVec3, cameras: &[&Camera]) -> (f64, f64) {
    let (mut near, mut far) = (f64::INFINITY, 0.0f64);
    for camera in cameras {
        let c = camera.centre();
        near = near.min((c - c.clamp(min, max)).length());
        far = far.max((c - min).abs().max((c - max).abs()).length());
    }
    // Cameras inside the box skip a sliver, chosen by hand: no surface is on the lens.
    (near.max(1e-3 * far), far)
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Intrinsics;

    fn looking_at(from: DVec3, target: DVec3) -> Camera {
        Camera {
            name: "c".into(),
            intrinsics: Intrinsics::from_angle_x(100, 100, 0.69),
            camera_to_world: scene::looking_at(from, target, DVec3::Z),
        }
    }

    fn circle(target: DVec3, distance: f64) -> Vec<Camera> {
        (0..12)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::FRAC_PI_6;
                looking_at(
                    target + distance * DVec3::new(a.cos(), a.sin(), 0.4).normalize(),
                    target,
                )
            })
            .collect()
    }

    #[test]
    fn the_box_surrounds_the_common_view_at_any_scale() {
        for scale in [1e-6, 1.0, 1e6] {
            let target = scale * DVec3::new(0.5, -0.3, 0.2);
            let bounds = box_bounds(&sights(&circle(target, 4.0 * scale), None));
            let centre = 0.5 * (DVec3::from(bounds.min) + DVec3::from(bounds.max));
            assert!((centre - target).length() < 1e-6 * scale, "{bounds:?}");
            let half = 0.5 * (bounds.max[0] - bounds.min[0]) / scale;
            assert!((1.4..1.7).contains(&half), "{half}");
            assert!(bounds.near / scale > 1.0 && bounds.far / scale < 7.5, "{bounds:?}");
        }
    }

    #[test]
    fn one_camera_has_a_box_too() {
        let bounds = box_bounds(&[(looking_at(DVec3::new(4.0, 0.0, 0.5), DVec3::ZERO), None)]);
        assert!(bounds.near > 0.0 && bounds.far > bounds.near && bounds.far.is_finite());
    }

    #[test]
    fn a_camera_far_away_does_not_enlarge_the_box() {
        let ring = circle(DVec3::ZERO, 4.0);
        let far = looking_at(DVec3::new(0.0, 400.0, 50.0), DVec3::ZERO);
        let [alone, joined] = [ring.clone(), [ring, vec![far]].concat()]
            .map(|cameras| box_bounds(&sights(&cameras, None)));
        let ratios = [joined.longest_side() / alone.longest_side(), joined.near / alone.near];
        assert!(ratios.iter().all(|ratio| (ratio - 1.0).abs() < 1e-6), "{alone:?} {joined:?}");
        assert!(joined.far > 400.0, "{joined:?}");
    }

    /// Points that a camera observes between its depths are in the box, and between near and far.
    #[test]
    fn the_box_contains_the_view_of_a_row_of_cameras() {
        let row: Vec<Camera> = (0..5)
            .map(|i| {
                let from = DVec3::new(0.2 * f64::from(i), 0.0, 0.0);
                looking_at(from, from + DVec3::Y)
            })
            .collect();
        let bounds = box_bounds(&sights(&row, Some([2.0, 10.0])));
        for camera in &row {
            for (x, y) in [(0.0, 0.0), (100.0, 50.0), (50.0, 100.0), (50.0, 50.0)] {
                let ray = camera.ray(x, y);
                for depth in [2.0, 5.0, 10.0] {
                    let distance = depth / camera.depth_per_distance(&ray);
                    let p = ray.at(distance).to_array();
                    assert!(
                        (0..3).all(|i| (bounds.min[i]..=bounds.max[i]).contains(&p[i])),
                        "{p:?} {bounds:?}"
                    );
                    assert!((bounds.near..=bounds.far).contains(&distance));
                }
            }
        }
        assert!(bounds.max[1] < 11.1 && bounds.min[1] > 1.5, "{bounds:?}");
        let unknown = box_bounds(&sights(&row, None));
        assert!(unknown.is_valid() && unknown != bounds);
    }

    fn sights(cameras: &[Camera], depths: Option<[f64; 2]>) -> Vec<CameraDepths> {
        cameras.iter().map(|c| (c.clone(), depths)).collect()
    }

    /// Points that a camera observes between its depths are in the frustum's cube, at any scale.
    #[test]
    fn cameras_that_face_one_direction_get_ndc() {
        for scale in [1e-3, 1.0, 1e3] {
            let row: Vec<Camera> = (0..5)
                .map(|i| {
                    looking_at(
                        scale * DVec3::new(0.2 * f64::from(i), 0.0, 0.1),
                        scale * DVec3::new(0.4, 6.0, 0.0),
                    )
                })
                .collect();
            let bounds = scene_bounds(
                &sights(&row[1..], Some([2.0 * scale, 10.0 * scale])),
                &sights(&row[..1], Some([2.0 * scale, 9.0 * scale])),
                false,
                None,
            );
            let bounds = bounds.unwrap();
            let Space::Ndc(frustum) = bounds.space else { panic!("{bounds:?}") };
            assert!(
                bounds.is_valid() && frustum.near > 1.5 * scale && frustum.far < 21.0 * scale,
                "{frustum:?}"
            );
            for camera in &row {
                for corner in extreme_points(camera, [2.0 * scale, 15.0 * scale]) {
                    let p = frustum.to_cube(frustum.to_camera(corner)).to_array();
                    assert!(p.iter().all(|x| (-1e-9..=1.0 + 1e-9).contains(x)), "{p:?}");
                }
            }
        }
    }

    /// Returns scenes of every space, and whether they are unbounded: cameras that face inwards,
    /// outwards, and forwards without and with depths.
    fn scenes() -> [(Vec<CameraDepths>, bool); 4] {
        let ring = circle(DVec3::new(0.5, -0.3, 0.2), 4.0);
        let outwards = ring.iter().map(|c| looking_at(c.centre(), 2.0 * c.centre()));
        [
            (sights(&ring, None), false),
            (sights(&outwards.collect::<Vec<_>>(), None), true),
            (sights(&(0..5).map(|i| meeting(1.0, i)).collect::<Vec<_>>(), None), true),
            (
                sights(&(0..5).map(|i| parallel(1.0, i)).collect::<Vec<_>>(), Some([2.0, 10.0])),
                false,
            ),
        ]
    }

    /// Moves a camera's centre to a multiple of 2⁻²⁰, so that large shifts are exact.
    fn on_grid(camera: &Camera) -> Camera {
        let grid = 1_048_576.0;
        camera.moved((grid * camera.centre()).round() / grid - camera.centre())
    }

    /// Returns the rounded bounds of a scene that is shifted and then scaled.
    fn bounds_at(sights: &[CameraDepths], is_unbounded: bool, shift: DVec3, scale: f64) -> Bounds {
        let moved = |(camera, depths): &CameraDepths| {
            let centre = on_grid(camera).centre();
            let moved = on_grid(camera).moved(scale * (centre + shift) - centre);
            (moved, depths.map(|depths| depths.map(|depth| scale * depth)))
        };
        let all: Vec<CameraDepths> = sights.iter().map(moved).collect();
        scene_bounds(&all, &all[..1], is_unbounded, None).unwrap().rounded(all[0].0.centre())
    }

    fn scaled(bounds: Bounds, factor: f64) -> Bounds {
        let corner = |corner: [f64; 3]| corner.map(|x| factor * x);
        let space = match bounds.space {
            Space::Ndc(f) => Space::Ndc(Frustum {
                camera_to_world: pose_of(
                    DMat3::from_cols_array_2d(
                        &[0, 1, 2].map(|c| f.camera_to_world.map(|row| row[c])),
                    ),
                    factor * f.centre(),
                ),
                near: factor * f.near,
                far: factor * f.far,
                ..f
            }),
            other => other,
        };
        let (near, far) = (factor * bounds.near, factor * bounds.far);
        Bounds { min: corner(bounds.min), max: corner(bounds.max), near, far, space }
    }

    /// Rounded bounds move and scale with a scene, to the last bit: rays in the unit cube don't
    /// depend on the scene's position.
    #[test]
    fn bounds_move_and_scale_with_the_scene() {
        for (sights, is_unbounded) in scenes() {
            let here = bounds_at(&sights, is_unbounded, DVec3::ZERO, 1.0);
            for shift in [
                DVec3::new(500_000.0, 4_649_776.0, 120.0),
                DVec3::new(4_027_893.75, 307_045.625, 4_919_474.875),
                DVec3::new(-7.25, 300.0, 1024.0),
            ] {
                assert_eq!(
                    bounds_at(&sights, is_unbounded, shift, 1.0),
                    here.moved(shift),
                    "{shift}"
                );
            }
            for scale in [1.0 / 131_072.0, 0.5, 65_536.0] {
                let there = bounds_at(&sights, is_unbounded, DVec3::ZERO, scale);
                assert_eq!(there, scaled(here, scale), "{scale}");
            }
        }
    }

    #[test]
    fn scenes_around_the_origin_are_relative_to_the_origin() {
        for (sights, _) in scenes() {
            assert_eq!(near_point(&sights), DVec3::ZERO);
        }
        assert_eq!(near_point(&sights(&[parallel(1.0, 0)], None)), DVec3::ZERO);
        assert_eq!(near_point(&[]), DVec3::ZERO);
    }

    #[test]
    fn the_space_follows_from_the_depths_or_the_given_kind() {
        let ring = circle(DVec3::ZERO, 4.0);
        let chosen =
            |depths, kind| scene_bounds(&sights(&ring, depths), &[], false, kind).map(|b| b.space);
        assert_eq!(chosen(None, None), Ok(Space::Box));
        assert_eq!(chosen(Some([3.0, 5.0]), None), Ok(Space::Box));
        assert_eq!(chosen(Some([3.0, 40.0]), None), Ok(Space::Contraction));
        assert_eq!(chosen(Some([3.0, 40.0]), Some(SpaceKind::Box)), Ok(Space::Box));
        assert_eq!(chosen(None, Some(SpaceKind::Contraction)), Ok(Space::Contraction));
        assert_eq!(chosen(Some([3.0, 5.0]), Some(SpaceKind::Ndc)), Err(NOT_FORWARD));
        let single = [looking_at(DVec3::Y, DVec3::ZERO)];
        assert_eq!(
            scene_bounds(&sights(&single, None), &[], false, Some(SpaceKind::Ndc)),
            Err(DEPTHS_MISSING)
        );
        assert_eq!(
            scene_bounds(&sights(&single, None), &[], false, None).map(|b| b.space),
            Ok(Space::Box)
        );
    }

    /// Replaces the camera's lens by an equidistant one whose view is `degrees` wide.
    fn fisheye(camera: &Camera, degrees: f64) -> Camera {
        let focal = 100.0 / degrees.to_radians();
        let distortion = scene::Distortion::fisheye([0.0; 4]);
        let intrinsics = Intrinsics { fx: focal, fy: focal, distortion, ..camera.intrinsics };
        Camera { intrinsics, ..camera.clone() }
    }

    /// The points that a fisheye camera observes between two distances are part of a spherical
    /// shell, which no frustum contains.
    #[test]
    fn fisheye_cameras_have_a_box_or_a_contraction() {
        let row: Vec<Camera> = (0..5).map(|i| fisheye(&parallel(1.0, i), 160.0)).collect();
        let seen = sights(&row, Some([2.0, 10.0]));
        let bounds = box_bounds(&seen);
        for camera in &row {
            for (x, y) in [(0.0, 0.0), (3.0, 50.0), (51.0, 97.0), (50.0, 50.0), (70.0, 20.0)] {
                for distance in [2.0, 5.0, 10.0] {
                    let p = camera.ray(x, y).at(distance).to_array();
                    assert!((0..3).all(|i| (bounds.min[i]..=bounds.max[i]).contains(&p[i])));
                }
            }
        }
        assert!(bounds.longest_side() < 24.0 && bounds.far < 11.1, "{bounds:?}");
        assert_eq!(scene_bounds(&seen, &[], false, Some(SpaceKind::Ndc)), Err(FISHEYE_REFUSED));
        let known = scene_bounds(&seen, &[], false, None).unwrap();
        assert_eq!(known.space, Space::Box);
        let unknown = scene_bounds(&sights(&row, None), &[], true, None).unwrap();
        assert_eq!(unknown.space, Space::Contraction);
        // Test views are checked, too.
        let pinholes: Vec<Camera> = (0..5).map(|i| parallel(1.0, i)).collect();
        let test_views = sights(&row[..1], Some([2.0, 10.0]));
        assert_eq!(
            scene_bounds(
                &sights(&pinholes, Some([2.0, 10.0])),
                &test_views,
                false,
                Some(SpaceKind::Ndc)
            ),
            Err(FISHEYE_REFUSED)
        );
        // A box around the region that the cameras face doesn't contain the cameras, however wide
        // their angle of view is.
        for (degrees, half) in [(60.0, 1.05 * 4.0 * f64::to_radians(30.0).tan()), (180.0, 4.2)] {
            let pinholes = circle(DVec3::ZERO, 4.0);
            let ring: Vec<Camera> = pinholes.iter().map(|c| fisheye(c, degrees)).collect();
            let found = 0.5 * box_bounds(&sights(&ring, None)).longest_side();
            assert!((found - half).abs() < 1e-9, "{degrees}: {found}");
        }
    }

    fn parallel(scale: f64, i: u32) -> Camera {
        looking_at(
            scale * DVec3::new(0.2 * f64::from(i), 0.0, 0.0),
            scale * DVec3::new(0.2 * f64::from(i), 9.0, 0.0),
        )
    }

    fn meeting(scale: f64, i: u32) -> Camera {
        looking_at(
            scale * DVec3::new(0.2 * f64::from(i) - 0.4, 0.0, 0.0),
            scale * DVec3::new(0.0, 6.0, 0.0),
        )
    }

    /// If depths are unknown and the scene is unbounded, the cameras determine the space.
    #[test]
    fn an_unbounded_scene_is_not_in_a_box() {
        for scale in [1e-3, 1.0, 1e3] {
            let ring = circle(DVec3::ZERO, 4.0 * scale);
            let around = scene_bounds(&sights(&ring, None), &[], true, None).unwrap();
            assert_eq!(around.space, Space::Contraction);
            let half = 0.5 * around.longest_side() / scale;
            assert!(
                (1.4..1.7).contains(&half)
                    && around.far > 100.0 * scale
                    && around.near < 0.1 * scale,
                "{around:?}"
            );
            // Known depths determine the space.
            let known =
                scene_bounds(&sights(&ring, Some([3.0 * scale, 5.0 * scale])), &[], true, None)
                    .unwrap();
            assert_eq!(known.space, Space::Box);
            // Cameras that face outwards: a room.
            let outwards: Vec<Camera> =
                ring.iter().map(|c| looking_at(c.centre(), 2.0 * c.centre())).collect();
            let room = scene_bounds(&sights(&outwards, None), &[], true, None).unwrap();
            assert_eq!(room.space, Space::Contraction);
            assert!((7.9..8.5).contains(&(0.5 * room.longest_side() / scale)), "{room:?}");
            // Cameras that face forwards: parallel axes, and axes that meet at a distance of 6.
            let forward: [(Vec<Camera>, f64); 2] = [
                ((0..5).map(|i| parallel(scale, i)).collect(), 3.2),
                ((0..5).map(|i| meeting(scale, i)).collect(), 6.0),
            ];
            for (cameras, distance) in forward {
                let bounds = scene_bounds(
                    &sights(&cameras, None),
                    &sights(&cameras[1..2], None),
                    true,
                    None,
                )
                .unwrap();
                let Space::Ndc(frustum) = bounds.space else { panic!("{bounds:?}") };
                assert!(
                    frustum.near < 0.3 * distance * scale && frustum.near > 0.1 * distance * scale,
                    "{frustum:?}"
                );
                assert!(frustum.far > 40.0 * distance * scale && bounds.is_valid(), "{frustum:?}");
            }
            // One camera alone determines no distance.
            assert_eq!(
                scene_bounds(&sights(&ring[..1], None), &[], true, None).unwrap().space,
                Space::Contraction
            );
        }
    }
}
