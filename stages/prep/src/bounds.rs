use glam::{DMat3, DVec3};
use scene::{
    Bounds, Camera, CameraRay, Frustum, Space, common_direction, pose_of, power_of_two_below,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Spaces a field can have, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SpaceKind {
    /// A box around what the cameras look at: scenes that end.
    Box,
    /// Normalised device coordinates: forward-facing photographs, whose far parts need less detail.
    Ndc,
    /// The box, and all around it, ever coarser with the distance: cameras among what they see.
    Contraction,
}

/// A space that can't be had.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SpaceError {
    /// Nothing says how near the scene comes.
    #[error(
        "parameter space: ndc needs to know how near and far each view sees, and the data set \
        doesn't say; give near and far, or choose box"
    )]
    NoDepths,
    /// Lenses that see more than a frustum holds.
    #[error(
        "parameter space: ndc can't hold what a fisheye lens sees; choose box or contraction, or \
        lens: undo"
    )]
    Fisheye,
    /// Cameras that look every way.
    #[error("parameter space: ndc needs cameras that look one way; choose box or contraction")]
    NotForward,
}

/// What lies so many box halves from the box's middle needs more than a box.
const MOST_BOX_HALVES: f64 = 2.5;

/// A posed view, and between which depths it sees anything, where that is known.
pub type SeenDepths = (Camera, Option<[f64; 2]>);

/// Where the scene is, and the space that suits it. It is NDC where all cameras look one way and
/// the depths they see are known, the contraction where something is known to lie far outside the
/// box, else the box. Where images say that the scene goes on behind what is looked at (`goes_on`)
/// and depths aren't known, no box is known to hold it: depths are guessed where cameras look one
/// way, and elsewhere it is the contraction. A `kind` that is given is taken. The box is that of
/// the training views; `others` are cameras that will look, too.
///
/// Far from the origin everything is computed from a point near the cameras: sums of large
/// coordinates lose the digits in which cameras differ.
pub fn place(
    training: &[SeenDepths],
    others: &[SeenDepths],
    goes_on: bool,
    kind: Option<SpaceKind>,
) -> Result<Bounds, SpaceError> {
    let origin = near_point(training);
    if origin == DVec3::ZERO {
        return place_near_origin(training, others, goes_on, kind);
    }
    let (training, others) = (moved(training, -origin), moved(others, -origin));
    let bounds = place_near_origin(&training, &others, goes_on, kind)?;
    // Rounded as training rounds them, while there are digits left to round.
    let anchor = training.first().map_or(DVec3::ZERO, |(camera, _)| camera.centre());
    Ok(bounds.rounded(anchor).moved(origin))
}

fn moved(sights: &[SeenDepths], by: DVec3) -> Vec<SeenDepths> {
    sights.iter().map(|(camera, depths)| (camera.moved(by), *depths)).collect()
}

/// Step of [`near_point`] over a scene's extent. Up to half of it from the origin, f64 keeps ten
/// digits of the extent.
const NEAR_POINT_STEP: f64 = 1024.0;

/// Returns a point near the cameras, a multiple of a step much larger than what is known of the
/// scene: the origin itself for scenes around it.
fn near_point(sights: &[SeenDepths]) -> DVec3 {
    let Some(first) = sights.first().map(|(camera, _)| camera.centre()) else { return DVec3::ZERO };
    let mut extent = 0.0f64;
    for (camera, depths) in sights {
        let farthest = depths.map_or(0.0, |[_, farthest]| farthest);
        extent = extent.max(camera.centre().distance(first)).max(farthest);
    }
    let step = NEAR_POINT_STEP * power_of_two_below(extent);
    let point = (first / step).round() * step;
    // Cameras in one place have no extent, and need none.
    if point.is_finite() { point } else { DVec3::ZERO }
}

/// As [`place`], for scenes near the origin.
fn place_near_origin(
    training: &[SeenDepths],
    others: &[SeenDepths],
    goes_on: bool,
    kind: Option<SpaceKind>,
) -> Result<Bounds, SpaceError> {
    let boxed = bounds_of(training);
    let goes_on_unseen = goes_on && training.iter().any(|(_, depths)| depths.is_none());
    let guessed = if goes_on_unseen { guessed_depths(training) } else { None };
    match kind {
        Some(SpaceKind::Box) => Ok(boxed),
        Some(SpaceKind::Ndc) => in_ndc(training, others, guessed),
        Some(SpaceKind::Contraction) => Ok(contracted(boxed, training)),
        None => Ok(match in_ndc(training, others, guessed) {
            Ok(bounds) => bounds,
            Err(_) if goes_on_unseen || reaches_beyond(&boxed, training) => {
                contracted(boxed, training)
            }
            Err(_) => boxed,
        }),
    }
}

fn in_ndc(
    training: &[SeenDepths],
    others: &[SeenDepths],
    guessed: Option<[f64; 2]>,
) -> Result<Bounds, SpaceError> {
    let known = |(camera, depths): &SeenDepths| (camera.clone(), depths.or(guessed));
    let all: Vec<SeenDepths> = training.iter().chain(others).map(known).collect();
    if all.iter().any(|(camera, _)| camera.intrinsics.distortion.is_fisheye()) {
        return Err(SpaceError::Fisheye);
    }
    let space = Space::Ndc(frustum(&all)?);
    Ok(Bounds { space, ..around_frusta(&all).ok_or(SpaceError::NoDepths)? })
}

/// Share of the distance to what cameras look at before which nothing is taken to lie, and how many
/// times as far they see.
const GUESSED_DEPTH_FACTORS: [f64; 2] = [0.25, 50.0];

/// Depths that cameras which look one way may see, by the cameras alone: around the point that they
/// look at, or where their axes are parallel, around a place four times as far away as they stand
/// apart. Too near a guess costs detail and loses nothing. `None` where they look every way, or
/// stand in one place.
fn guessed_depths(sights: &[SeenDepths]) -> Option<[f64; 2]> {
    let cameras: Vec<&Camera> = sights.iter().map(|(camera, _)| camera).collect();
    let forward = common_direction(cameras.iter().copied())?;
    let mean = cameras.iter().map(|c| c.centre()).sum::<DVec3>() / cameras.len().max(1) as f64;
    let apart = 2.0 * cameras.iter().map(|c| (c.centre() - mean).length()).fold(0.0, f64::max);
    let focus = crossing(&cameras, LEAST_DETERMINANT)
        .map(|point| (point - mean).dot(forward))
        .filter(|distance| *distance > apart);
    let distance = focus.unwrap_or(4.0 * apart);
    (distance > 0.0).then(|| GUESSED_DEPTH_FACTORS.map(|factor| factor * distance))
}

/// What all cameras see, from the middle of them: the frustum of NDC.
fn frustum(sights: &[SeenDepths]) -> Result<Frustum, SpaceError> {
    let forward = common_direction(sights.iter().map(|(c, _)| c)).ok_or(SpaceError::NotForward)?;
    let up = mean(sights, |c| c.rotation().y_axis);
    let right = forward.cross(up).try_normalize().ok_or(SpaceError::NotForward)?;
    let (up, centre) = (right.cross(forward), mean(sights, Camera::centre));
    let mut frustum = Frustum {
        camera_to_world: pose_of(DMat3::from_cols(right, up, -forward), centre),
        min: [f64::INFINITY; 2],
        max: [f64::NEG_INFINITY; 2],
        near: f64::INFINITY,
        far: 0.0,
    };
    for (camera, depths) in sights {
        let [nearest, farthest] = depths.ok_or(SpaceError::NoDepths)?;
        // Known depths are those of points that were found; twice as far may be more.
        for corner in border(camera, [0.9 * nearest, 2.0 * farthest]) {
            let p = frustum.to_camera(corner);
            if p.z <= 0.0 {
                return Err(SpaceError::NotForward);
            }
            for (i, slope) in [p.x / p.z, p.y / p.z].into_iter().enumerate() {
                (frustum.min[i], frustum.max[i]) =
                    (frustum.min[i].min(slope), frustum.max[i].max(slope));
            }
            (frustum.near, frustum.far) = (frustum.near.min(p.z), frustum.far.max(p.z));
        }
    }
    if frustum.is_valid() { Ok(frustum) } else { Err(SpaceError::NotForward) }
}

fn mean(sights: &[SeenDepths], of: fn(&Camera) -> DVec3) -> DVec3 {
    sights.iter().map(|(camera, _)| of(camera)).sum::<DVec3>() / sights.len().max(1) as f64
}

/// Whether more lies outside the box than a box can hold.
fn reaches_beyond(bounds: &Bounds, sights: &[SeenDepths]) -> bool {
    let centre = 0.5 * (DVec3::from(bounds.min) + DVec3::from(bounds.max));
    let reach = MOST_BOX_HALVES * 0.5 * bounds.longest_side();
    let far = sights.iter().filter(|(camera, depths)| {
        depths.is_some_and(|[_, farthest]| farthest > (camera.centre() - centre).length() + reach)
    });
    2 * far.count() > sights.len()
}

/// The same box with all around it: from where the nearest view sees something to far beyond the
/// farthest. Where cameras look outwards, away from the box's middle, it reaches twice as far as
/// they stand: to what is near them.
fn contracted(boxed: Bounds, sights: &[SeenDepths]) -> Bounds {
    let centre = 0.5 * (DVec3::from(boxed.min) + DVec3::from(boxed.max));
    let outwards = |(camera, _): &&SeenDepths| camera.forward().dot(camera.centre() - centre) > 0.0;
    let looks_out = 2 * sights.iter().filter(outwards).count() > sights.len();
    let stands =
        sights.iter().map(|(camera, _)| (camera.centre() - centre).length()).fold(0.0, f64::max);
    let radius = (0.5 * boxed.longest_side()).max(if looks_out { 2.0 * stands } else { 0.0 });
    let half = if looks_out {
        DVec3::splat(radius)
    } else {
        0.5 * (DVec3::from(boxed.max) - DVec3::from(boxed.min))
    };
    let known = sights.iter().filter_map(|(_, depths)| *depths);
    let near = known.clone().map(|d| 0.5 * d[0]).fold(0.05 * radius, f64::min);
    let far = known.map(|d| 10.0 * d[1]).fold(100.0 * radius, f64::max);
    let (min, max) = if looks_out {
        ((centre - half).to_array(), (centre + half).to_array())
    } else {
        (boxed.min, boxed.max)
    };
    Bounds { min, max, near, far, space: Space::Contraction }
}

/// Places along each side of a grid over a fisheye image.
const FISHEYE_PLACES: u32 = 16;

/// Returns points on the border of what a camera sees between two depths. A fisheye camera sees a
/// part of a ball between two distances, whose border is everywhere in the image.
fn border(camera: &Camera, depths: [f64; 2]) -> Vec<DVec3> {
    let k = &camera.intrinsics;
    if !k.distortion.is_fisheye() {
        let rays = k.border().map(|[x, y]| camera.ray(x, y));
        let points =
            |ray: CameraRay| depths.map(|depth| ray.at(depth / camera.depth_per_distance(&ray)));
        return rays.flat_map(points).collect();
    }
    let at = |place: u32, size: u32| f64::from(place * size) / f64::from(FISHEYE_PLACES);
    let mut points = Vec::new();
    for row in 0..=FISHEYE_PLACES {
        for column in 0..=FISHEYE_PLACES {
            let ray = camera.ray(at(column, k.width), at(row, k.height));
            points.extend(depths.map(|distance| ray.at(distance)));
        }
    }
    points
}

/// A box around what all cameras look at, from the cameras alone where they say enough.
///
/// The centre is the point nearest to all optical axes; the box reaches as far as the widest camera
/// sees at that distance, so that a scene which fits into its views fits into the box. Cameras that
/// look past each other (one view, a forward-facing row) leave the centre open along their axes.
/// Then the box is around all that they see between the nearest and the farthest depth that is
/// known of each; where nothing is known, it is put at distance 4 of the mean camera, the Blender
/// scenes' habit.
fn bounds_of(sights: &[SeenDepths]) -> Bounds {
    let cameras: Vec<&Camera> = sights.iter().map(|(camera, _)| camera).collect();
    let centre = if let Some(crossing) = crossing(&cameras, 1e-3) {
        crossing
    } else if let Some(bounds) = around_frusta(sights) {
        return bounds;
    } else {
        let forward = mean(sights, Camera::forward).normalize_or(DVec3::NEG_Z);
        mean(sights, Camera::centre) + 4.0 * forward
    };
    let widest = cameras.iter().map(|camera| half_width(camera, centre)).fold(0.0, f64::max);
    // A twentieth more: silhouettes that touch the border.
    let half = 1.05 * widest.max(f64::MIN_POSITIVE.sqrt());
    let box_only = Bounds {
        min: (centre - DVec3::splat(half)).to_array(),
        max: (centre + DVec3::splat(half)).to_array(),
        near: 0.0,
        far: 0.0,
        space: Space::Box,
    };
    with_range(box_only, cameras)
}

/// Largest slope of a fisheye view's border that a box follows: 45° from the axis. Farther out, a
/// box around what the cameras look at would hold the cameras.
const MAX_FISHEYE_SLOPE: f64 = 1.0;

/// Half the longer side of what a camera sees as far away as a place.
fn half_width(camera: &Camera, place: DVec3) -> f64 {
    let k = &camera.intrinsics;
    let [x, y] = [0.5 * f64::from(k.width) / k.fx, 0.5 * f64::from(k.height) / k.fy];
    let slope = if k.distortion.is_fisheye() {
        let [across, down] = [[x, 0.0], [0.0, y]].map(|at| k.distortion.undistort(at));
        across[0].max(down[1]).min(MAX_FISHEYE_SLOPE)
    } else {
        x.max(y)
    };
    (camera.centre() - place).length() * slope
}

/// The determinant of axes that say nothing of where they cross.
const LEAST_DETERMINANT: f64 = 1e-9;

/// The point nearest to all optical axes, where they cross well enough: the determinant is 0 for
/// parallel axes and 8/27 for axes from all sides.
fn crossing(cameras: &[&Camera], least: f64) -> Option<DVec3> {
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for camera in cameras {
        let d = camera.forward();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += across;
        right += across * camera.centre();
    }
    let mean = normal * (1.0 / cameras.len().max(1) as f64);
    (mean.determinant() > least).then(|| normal.inverse() * right)
}

/// A box around what each camera sees between its depths, a tenth more to either side. `None` where
/// a camera has none.
fn around_frusta(sights: &[SeenDepths]) -> Option<Bounds> {
    let (mut min, mut max) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (mut near, mut far) = (f64::INFINITY, 0.0f64);
    for (camera, depths) in sights {
        let [nearest, farthest] = (*depths)?;
        near = near.min(0.9 * nearest);
        for corner in border(camera, [0.9 * nearest, 1.1 * farthest]) {
            (min, max) = (min.min(corner), max.max(corner));
            far = far.max((corner - camera.centre()).length());
        }
    }
    let bounds = Bounds { min: min.to_array(), max: max.to_array(), near, far, space: Space::Box };
    bounds.is_valid().then_some(bounds)
}

/// The same box with near and far from its nearest and farthest point over all cameras.
pub(crate) fn with_range<'a>(
    bounds: Bounds,
    cameras: impl IntoIterator<Item = &'a Camera>,
) -> Bounds {
    let (min, max) = (DVec3::from(bounds.min), DVec3::from(bounds.max));
    let (mut near, mut far) = (f64::INFINITY, 0.0f64);
    for camera in cameras {
        let c = camera.centre();
        near = near.min((c - c.clamp(min, max)).length());
        far = far.max((c - min).abs().max((c - max).abs()).length());
    }
    // Inside the box a sliver is left out: a surface on the lens is never meant.
    Bounds { near: near.max(1e-3 * far), far, ..bounds }
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
    fn the_box_is_around_what_all_cameras_see_at_any_scale() {
        for scale in [1e-6, 1.0, 1e6] {
            let target = scale * DVec3::new(0.5, -0.3, 0.2);
            let bounds = bounds_of(&sights(&circle(target, 4.0 * scale), None));
            let centre = 0.5 * (DVec3::from(bounds.min) + DVec3::from(bounds.max));
            assert!((centre - target).length() < 1e-6 * scale, "{bounds:?}");
            let half = 0.5 * (bounds.max[0] - bounds.min[0]) / scale;
            assert!((1.4..1.7).contains(&half), "{half}");
            assert!(bounds.near / scale > 1.0 && bounds.far / scale < 7.5, "{bounds:?}");
        }
    }

    #[test]
    fn one_camera_has_a_box_too() {
        let bounds = bounds_of(&[(looking_at(DVec3::new(4.0, 0.0, 0.5), DVec3::ZERO), None)]);
        assert!(bounds.near > 0.0 && bounds.far > bounds.near && bounds.far.is_finite());
    }

    /// Whatever a camera of a row sees between its depths lies in the box, and between near and
    /// far.
    #[test]
    fn a_row_of_cameras_has_what_it_sees() {
        let row: Vec<Camera> = (0..5)
            .map(|i| {
                let from = DVec3::new(0.2 * f64::from(i), 0.0, 0.0);
                looking_at(from, from + DVec3::Y)
            })
            .collect();
        let bounds = bounds_of(&sights(&row, Some([2.0, 10.0])));
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
        let unknown = bounds_of(&sights(&row, None));
        assert!(unknown.is_valid() && unknown != bounds);
    }

    fn sights(cameras: &[Camera], depths: Option<[f64; 2]>) -> Vec<SeenDepths> {
        cameras.iter().map(|c| (c.clone(), depths)).collect()
    }

    /// What each camera sees between its depths lies in the frustum's cube, whatever the world's
    /// scale.
    #[test]
    fn cameras_that_look_one_way_get_ndc() {
        for scale in [1e-3, 1.0, 1e3] {
            let row: Vec<Camera> = (0..5)
                .map(|i| {
                    looking_at(
                        scale * DVec3::new(0.2 * f64::from(i), 0.0, 0.1),
                        scale * DVec3::new(0.4, 6.0, 0.0),
                    )
                })
                .collect();
            let bounds = place(
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
                for corner in border(camera, [2.0 * scale, 15.0 * scale]) {
                    let p = frustum.to_cube(frustum.to_camera(corner)).to_array();
                    assert!(p.iter().all(|x| (-1e-9..=1.0 + 1e-9).contains(x)), "{p:?}");
                }
            }
        }
    }

    /// Cameras around, forward without and with depths, and outwards: a scene of each space.
    fn scenes() -> [(Vec<SeenDepths>, bool); 4] {
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

    /// A camera whose centre is a multiple of 2⁻²⁰, so that large shifts are exact.
    fn on_grid(camera: &Camera) -> Camera {
        let grid = 1_048_576.0;
        camera.moved((grid * camera.centre()).round() / grid - camera.centre())
    }

    fn placed(sights: &[SeenDepths], goes_on: bool, shift: DVec3, scale: f64) -> Bounds {
        let moved = |(camera, depths): &SeenDepths| {
            let centre = on_grid(camera).centre();
            let moved = on_grid(camera).moved(scale * (centre + shift) - centre);
            (moved, depths.map(|depths| depths.map(|depth| scale * depth)))
        };
        let all: Vec<SeenDepths> = sights.iter().map(moved).collect();
        place(&all, &all[..1], goes_on, None).unwrap().rounded(all[0].0.centre())
    }

    fn scaled(bounds: Bounds, by: f64) -> Bounds {
        let corner = |corner: [f64; 3]| corner.map(|x| by * x);
        let space = match bounds.space {
            Space::Ndc(f) => Space::Ndc(Frustum {
                camera_to_world: pose_of(
                    DMat3::from_cols_array_2d(
                        &[0, 1, 2].map(|c| f.camera_to_world.map(|row| row[c])),
                    ),
                    by * f.centre(),
                ),
                near: by * f.near,
                far: by * f.far,
                ..f
            }),
            other => other,
        };
        let (near, far) = (by * bounds.near, by * bounds.far);
        Bounds { min: corner(bounds.min), max: corner(bounds.max), near, far, space }
    }

    /// Rounded bounds move with a scene, and grow with it, to the last bit: rays in the unit cube
    /// don't know where the scene lies.
    #[test]
    fn bounds_move_with_the_scene() {
        for (sights, goes_on) in scenes() {
            let here = placed(&sights, goes_on, DVec3::ZERO, 1.0);
            for shift in [
                DVec3::new(500_000.0, 4_649_776.0, 120.0),
                DVec3::new(4_027_893.75, 307_045.625, 4_919_474.875),
                DVec3::new(-7.25, 300.0, 1024.0),
            ] {
                assert_eq!(placed(&sights, goes_on, shift, 1.0), here.moved(shift), "{shift}");
            }
            for scale in [1.0 / 131_072.0, 0.5, 65_536.0] {
                let there = placed(&sights, goes_on, DVec3::ZERO, scale);
                assert_eq!(there, scaled(here, scale), "{scale}");
            }
        }
    }

    #[test]
    fn scenes_around_the_origin_are_computed_from_there() {
        for (sights, _) in scenes() {
            assert_eq!(near_point(&sights), DVec3::ZERO);
        }
        assert_eq!(near_point(&sights(&[parallel(1.0, 0)], None)), DVec3::ZERO);
        assert_eq!(near_point(&[]), DVec3::ZERO);
    }

    #[test]
    fn the_space_is_what_the_cameras_see() {
        let ring = circle(DVec3::ZERO, 4.0);
        let chosen =
            |depths, kind| place(&sights(&ring, depths), &[], false, kind).map(|b| b.space);
        assert_eq!(chosen(None, None), Ok(Space::Box));
        assert_eq!(chosen(Some([3.0, 5.0]), None), Ok(Space::Box));
        assert_eq!(chosen(Some([3.0, 40.0]), None), Ok(Space::Contraction));
        assert_eq!(chosen(Some([3.0, 40.0]), Some(SpaceKind::Box)), Ok(Space::Box));
        assert_eq!(chosen(None, Some(SpaceKind::Contraction)), Ok(Space::Contraction));
        assert_eq!(chosen(Some([3.0, 5.0]), Some(SpaceKind::Ndc)), Err(SpaceError::NotForward));
        let one = [looking_at(DVec3::Y, DVec3::ZERO)];
        assert_eq!(
            place(&sights(&one, None), &[], false, Some(SpaceKind::Ndc)),
            Err(SpaceError::NoDepths)
        );
        assert_eq!(place(&sights(&one, None), &[], false, None).map(|b| b.space), Ok(Space::Box));
    }

    /// The camera behind an equidistant lens that sees so many degrees across.
    fn fisheye(camera: &Camera, degrees: f64) -> Camera {
        let focal = 100.0 / degrees.to_radians();
        let distortion = scene::Distortion::fisheye([0.0; 4]);
        let intrinsics = Intrinsics { fx: focal, fy: focal, distortion, ..camera.intrinsics };
        Camera { intrinsics, ..camera.clone() }
    }

    /// Between two distances a fisheye camera sees a part of a ball, which no frustum holds.
    #[test]
    fn fisheye_cameras_have_a_box_or_a_contraction() {
        let row: Vec<Camera> = (0..5).map(|i| fisheye(&parallel(1.0, i), 160.0)).collect();
        let seen = sights(&row, Some([2.0, 10.0]));
        let bounds = bounds_of(&seen);
        for camera in &row {
            for (x, y) in [(0.0, 0.0), (3.0, 50.0), (51.0, 97.0), (50.0, 50.0), (70.0, 20.0)] {
                for distance in [2.0, 5.0, 10.0] {
                    let p = camera.ray(x, y).at(distance).to_array();
                    assert!((0..3).all(|i| (bounds.min[i]..=bounds.max[i]).contains(&p[i])));
                }
            }
        }
        assert!(bounds.longest_side() < 24.0 && bounds.far < 11.1, "{bounds:?}");
        assert_eq!(place(&seen, &[], false, Some(SpaceKind::Ndc)), Err(SpaceError::Fisheye));
        let known = place(&seen, &[], false, None).unwrap();
        assert_eq!(known.space, Space::Box);
        let unknown = place(&sights(&row, None), &[], true, None).unwrap();
        assert_eq!(unknown.space, Space::Contraction);
        // Test views count, too.
        let pinholes: Vec<Camera> = (0..5).map(|i| parallel(1.0, i)).collect();
        let others = sights(&row[..1], Some([2.0, 10.0]));
        assert_eq!(
            place(&sights(&pinholes, Some([2.0, 10.0])), &others, false, Some(SpaceKind::Ndc)),
            Err(SpaceError::Fisheye)
        );
        // The box around what they look at doesn't hold them, however wide their view is.
        for (degrees, half) in [(60.0, 1.05 * 4.0 * f64::to_radians(30.0).tan()), (180.0, 4.2)] {
            let around = circle(DVec3::ZERO, 4.0);
            let ring: Vec<Camera> = around.iter().map(|c| fisheye(c, degrees)).collect();
            let found = 0.5 * bounds_of(&sights(&ring, None)).longest_side();
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

    /// Without any depth: where images say that the scene goes on, cameras say how.
    #[test]
    fn a_scene_that_goes_on_is_in_no_box() {
        for scale in [1e-3, 1.0, 1e3] {
            let ring = circle(DVec3::ZERO, 4.0 * scale);
            let around = place(&sights(&ring, None), &[], true, None).unwrap();
            assert_eq!(around.space, Space::Contraction);
            let half = 0.5 * around.longest_side() / scale;
            assert!(
                (1.4..1.7).contains(&half)
                    && around.far > 100.0 * scale
                    && around.near < 0.1 * scale,
                "{around:?}"
            );
            // Where depths are known they decide.
            let known =
                place(&sights(&ring, Some([3.0 * scale, 5.0 * scale])), &[], true, None).unwrap();
            assert_eq!(known.space, Space::Box);
            // From within: a room.
            let outwards: Vec<Camera> =
                ring.iter().map(|c| looking_at(c.centre(), 2.0 * c.centre())).collect();
            let room = place(&sights(&outwards, None), &[], true, None).unwrap();
            assert_eq!(room.space, Space::Contraction);
            assert!((7.9..8.5).contains(&(0.5 * room.longest_side() / scale)), "{room:?}");
            // Forward: parallel axes, and axes that meet at a distance of 6.
            let forward: [(Vec<Camera>, f64); 2] = [
                ((0..5).map(|i| parallel(scale, i)).collect(), 3.2),
                ((0..5).map(|i| meeting(scale, i)).collect(), 6.0),
            ];
            for (cameras, distance) in forward {
                let seen =
                    place(&sights(&cameras, None), &sights(&cameras[1..2], None), true, None)
                        .unwrap();
                let Space::Ndc(frustum) = seen.space else { panic!("{seen:?}") };
                assert!(
                    frustum.near < 0.3 * distance * scale && frustum.near > 0.1 * distance * scale,
                    "{frustum:?}"
                );
                assert!(frustum.far > 40.0 * distance * scale && seen.is_valid(), "{frustum:?}");
            }
            // One camera says nothing of how far anything is.
            assert_eq!(
                place(&sights(&ring[..1], None), &[], true, None).unwrap().space,
                Space::Contraction
            );
        }
    }
}
