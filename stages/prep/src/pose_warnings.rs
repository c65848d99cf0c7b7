//! Checks of implausible poses (docs/design/030).

use artifact::format_count;
use glam::DVec3;
use scene::{Camera, Intrinsics, format_length};

/// Distance of an outlier camera from the centre, relative to the median distance. For
/// photographs from a walk through a room, it is 2 to 5; the threshold is chosen by hand.
pub(crate) const MIN_OUTLIER_RATIO: f64 = 20.0;
/// Minimum number of cameras whose median distance is meaningful; chosen by hand.
pub(crate) const MIN_CAMERAS: usize = 4;
/// Maximum offset of a plausible principal point from the image centre, relative to the image side.
/// For real lenses, it is about 0.01; the threshold is chosen by hand.
const MAX_PRINCIPAL_POINT_OFFSET: f64 = 0.2;
/// Relative error of coordinates after a few operations in double precision.
const DOUBLE_ERROR: f64 = 8.0 * f64::EPSILON;
/// Relative error of coordinates that were rounded to single precision.
const SINGLE_ERROR: f64 = f32::EPSILON as f64;
/// Maximum rounding error of camera centres at which a field is sharp, relative to the largest
/// distance from the first camera: 0.001 is about one pixel.
const MAX_POSITION_ERROR: f64 = 1e-3;

/// Returns whether several views all have the same pose, so that the poses are unusable.
pub(crate) fn have_equal_poses(training: &[Camera]) -> bool {
    let [first, others @ ..] = training else { return false };
    !others.is_empty() && others.iter().all(|c| c.camera_to_world == first.camera_to_world)
}

/// Returns a warning for each implausible property of the cameras.
pub(crate) fn warnings(training: &[Camera], test: &[Camera]) -> Vec<String> {
    let mut found = Vec::new();
    if training.len() == 1 {
        found.push(
            "there is only 1 training view: depth cannot be estimated; add views from other \
            directions"
                .to_owned(),
        );
    }
    found.extend(unresolved_positions(training));
    // Cameras with names for messages.
    let mut all: Vec<(String, &Camera)> = Vec::new();
    for (cameras, split) in [(training, "training"), (test, "test")] {
        all.extend(cameras.iter().map(|camera| (format!("{split} view {}", camera.name), camera)));
    }
    found.extend(outliers(&all));
    found.extend(off_centre(&all));
    found
}

/// Detects cameras whose centres differ by rounding errors only, and cameras whose centres are
/// rounded too coarsely, such as georeferenced poses in single precision.
fn unresolved_positions(cameras: &[Camera]) -> Option<String> {
    let [first, others @ ..] = cameras else { return None };
    let distances = others.iter().map(|camera| camera.centre().distance(first.centre()));
    let (extent, error) = (distances.fold(0.0, f64::max), rounding_error(cameras));
    if others.is_empty() || error < MAX_POSITION_ERROR * extent {
        return None;
    }
    let count = cameras.len();
    Some(if extent <= error {
        format!(
            "all {count} training cameras are at the same position: depth cannot be estimated; \
            take photographs from several positions"
        )
    } else {
        format!(
            "the {count} training cameras are up to {} units apart, but their centres are rounded \
            to {}: subtract the first centre from all centres before rounding",
            format_length(extent, 3),
            format_length(error, 3)
        )
    })
}

/// Returns the error of the cameras' coordinates that follows from their number format.
fn rounding_error(cameras: &[Camera]) -> f64 {
    let coordinates: Vec<f64> =
        cameras.iter().flat_map(|camera| camera.centre().to_array()).collect();
    let are_single = coordinates.iter().all(|x| f64::from(*x as f32) == *x);
    let largest = coordinates.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
    largest * if are_single { SINGLE_ERROR } else { DOUBLE_ERROR }
}

/// Detects cameras far from the others. Medians, unlike means, are insensitive to a few outliers.
fn outliers(all: &[(String, &Camera)]) -> Option<String> {
    let centres: Vec<DVec3> = all.iter().map(|(_, camera)| camera.centre()).collect();
    let middle = DVec3::from([0, 1, 2].map(|i| median(centres.iter().map(|centre| centre[i]))));
    let distances: Vec<f64> = centres.iter().map(|centre| centre.distance(middle)).collect();
    let usual = median(distances.iter().copied());
    if all.len() < MIN_CAMERAS || usual <= 0.0 {
        return None;
    }
    let far: Vec<usize> =
        (0..all.len()).filter(|&i| distances[i] > MIN_OUTLIER_RATIO * usual).collect();
    let first = *far.first()?;
    let more = if far.len() > 1 { format!(" (and {} more)", far.len() - 1) } else { String::new() };
    Some(format!(
        "{} is {:.0} times as far from the middle of all cameras as usual{more}; check its pose",
        all[first].0,
        distances[first] / usual
    ))
}

/// Returns the upper median; 0 for no values.
pub(crate) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

/// Detects principal points far from the image centre: usually intrinsics for another image size.
fn off_centre(all: &[(String, &Camera)]) -> Option<String> {
    let off: Vec<&(String, &Camera)> =
        all.iter().filter(|(_, camera)| is_off_centre(&camera.intrinsics)).collect();
    let (first, camera) = off.first()?;
    let k = &camera.intrinsics;
    Some(format!(
        "{} of {} have a principal point far from the image centre (first: {first} with \
        ({:.1}, {:.1}) in {}×{} pixels); check that cx and cy belong to this size",
        off.len(),
        format_count(all.len(), "view"),
        k.cx,
        k.cy,
        k.width,
        k.height
    ))
}

fn is_off_centre(k: &Intrinsics) -> bool {
    [(k.cx, k.width), (k.cy, k.height)]
        .iter()
        .any(|(c, side)| (c / f64::from(*side) - 0.5).abs() > MAX_PRINCIPAL_POINT_OFFSET)
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use scene::{Intrinsics, pose_of};

    use super::*;
    use crate::pose_conventions::convention_warning;

    fn camera(name: &str, angle: f64, centre: [f64; 3]) -> Camera {
        let rotation = DMat3::from_rotation_z(angle);
        let intrinsics = Intrinsics::from_angle_x(32, 24, 0.69);
        Camera { name: name.into(), intrinsics, camera_to_world: pose_of(rotation, centre.into()) }
    }

    fn on_ring(i: u32, scale: f64, middle: f64) -> Camera {
        let angle = f64::from(i);
        camera(
            &format!("r_{i}"),
            angle,
            [middle + 4.0 * scale * angle.cos(), 4.0 * scale * angle.sin(), scale],
        )
    }

    /// Returns cameras on a circle of radius 4 · `scale` around x = `middle`.
    fn ring(count: u32, scale: f64, middle: f64) -> Vec<Camera> {
        (0..count).map(|i| on_ring(i, scale, middle)).collect()
    }

    #[test]
    fn ordinary_cameras_cause_no_warning() {
        for (scale, middle) in [(1.0, 0.0), (1e-3, 0.0), (100.0, 4e5)] {
            let mut training = ring(30, scale, middle);
            // A camera farther away, and a principal point slightly off the image centre.
            training.push(camera("overview", 0.0, [middle, 0.0, 30.0 * scale]));
            training[0].intrinsics.cx += 3.0;
            assert_eq!(warnings(&training, &ring(7, 1.1 * scale, middle)), Vec::<String>::new());
            assert!(!have_equal_poses(&training));
        }
        assert_eq!(warnings(&ring(2, 1.0, 0.0), &ring(1, 1.0, 0.0)), Vec::<String>::new());
    }

    /// Captures of a table and of a town in UTM and ECEF coordinates are unusable only if they were
    /// written in single precision.
    #[test]
    fn georeferenced_cameras_cause_warnings_only_in_single_precision() {
        let (utm, ecef) = ([500_000.0, 4_649_776.0, 120.0], [4_027_893.75, 307_045.6, 4_919_474.9]);
        for offset in [utm, ecef] {
            for (scale, expected) in [
                (0.025, "all 8 training cameras are at the same position"),
                (10.0, "units apart, but their centres are rounded to 0.5"),
            ] {
                let mut moved: Vec<Camera> =
                    ring(8, scale, 0.0).iter().map(|c| c.moved(offset.into())).collect();
                assert_eq!(warnings(&moved, &[]), Vec::<String>::new(), "{scale}");
                for number in moved.iter_mut().flat_map(|c| c.camera_to_world.as_flattened_mut()) {
                    *number = f64::from(*number as f32);
                }
                let found = warnings(&moved, &[]).join("; ");
                assert!(found.contains(expected), "{scale}: {found}");
            }
        }
    }

    #[test]
    fn published_scenes_cause_no_warning() {
        let data = std::env::var("NERF_SR_DATA").map_or_else(
            |_| std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"),
            std::path::PathBuf::from,
        );
        for scene in ["nerf_synthetic/lego", "nerf_synthetic/chair", "nerf_llff_data/fern"] {
            let folder = data.join(scene);
            if !folder.is_dir() {
                eprintln!("skipped: no data ({} is not there; set NERF_SR_DATA)", folder.display());
                continue;
            }
            let set = dataset::Dataset::read(&folder).unwrap();
            let split =
                set.split.clone().unwrap_or_else(|| dataset::Split::hold_out(set.frames.len()));
            let cameras =
                |views: &[usize]| views.iter().map(|&i| set.frames[i].camera()).collect::<Vec<_>>();
            let (training, test) = (cameras(&split.train), cameras(&split.test));
            assert_eq!(
                (
                    have_equal_poses(&training),
                    warnings(&training, &test),
                    convention_warning(&training)
                ),
                (false, Vec::new(), None),
                "{scene}"
            );
        }
    }

    #[test]
    fn one_pose_for_all_views_is_found() {
        let same = vec![camera("a", 0.3, [0.0, 1.0, 4.0]); 8];
        assert!(have_equal_poses(&same) && !have_equal_poses(&same[..1]));
        assert!(!have_equal_poses(&[]));
    }

    #[track_caller]
    fn assert_one_warning(training: &[Camera], test: &[Camera], expected: &str) {
        let found = warnings(training, test);
        assert!(found.len() == 1 && found[0].contains(expected), "{expected}: {found:?}");
    }

    #[test]
    fn each_problem_causes_one_warning() {
        assert_one_warning(
            &ring(1, 1.0, 0.0),
            &ring(3, 1.0, 0.0),
            "there is only 1 training view: depth cannot be estimated",
        );
        let turning: Vec<Camera> =
            (0..5).map(|i| camera("t", f64::from(i), [3.0, 1.0, 4.0])).collect();
        assert_one_warning(&turning, &[], "all 5 training cameras are at the same position");
        let utm = DVec3::new(500_000.0, 4_649_776.0, 120.0);
        let moved: Vec<Camera> = turning.iter().map(|camera| camera.moved(utm)).collect();
        assert_one_warning(&moved, &[], "all 5 training cameras are at the same position");
        let mut far = ring(8, 1.0, 0.0);
        far[5].camera_to_world[0][3] = 1e6;
        assert_one_warning(&far, &ring(3, 1.0, 0.0), "training view r_5 is 3");
        far[6].camera_to_world[0][3] = -1e6;
        assert_one_warning(&far, &ring(3, 1.0, 0.0), "as usual (and 1 more); check its pose");
        let mut far = ring(3, 1.0, 0.0);
        far[0].camera_to_world[1][3] = 500.0;
        assert_one_warning(&ring(8, 1.0, 0.0), &far, "test view r_0 is ");
        // Intrinsics for 32×24 pixels, scaled as if they were for 64×48.
        let mut shrunk = ring(6, 1.0, 0.0);
        shrunk[2..].iter_mut().for_each(|c| (c.intrinsics.cx, c.intrinsics.cy) = (8.0, 6.0));
        assert_one_warning(
            &shrunk,
            &ring(2, 1.0, 0.0),
            "4 of 8 views have a principal point far from the image centre (first: training view \
            r_2 with (8.0, 6.0) in 32×24",
        );
    }
}
