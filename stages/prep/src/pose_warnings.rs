use artifact::counted;
use glam::DVec3;
use scene::{Camera, Intrinsics, length};

use crate::error::SamePose;

/// Cameras that are so many times as far from the middle of all as half of them are, at least, are
/// far off. One that is doubles the box as often as that; walks through a room have 2 to 5.
const FAR_OFF_RATIO: f64 = 20.0;
/// Fewer cameras say too little of where the others stand.
const LEAST_CAMERAS: usize = 4;
/// A principal point farther from the middle of the image, as a share of its length, is far from
/// it. Real lenses have a hundredth.
const OFF_CENTRE_SHARE: f64 = 0.2;
/// Relative errors of coordinates in double precision, which were computed by a few operations, and
/// of coordinates that all fit into single precision.
const DOUBLE_ERROR: f64 = 8.0 * f64::EPSILON;
const SINGLE_ERROR: f64 = f32::EPSILON as f64;
/// Cameras whose centres are known to less than this share of their distance from each other have
/// poses too coarse for a sharp field: a thousandth is a pixel or so.
const COARSE_SHARE: f64 = 1e-3;

/// Refuses training views that were all taken by the same camera at the same place: whatever they
/// show, it isn't one scene seen from several sides.
pub(crate) fn check(training: &[Camera]) -> Result<(), SamePose> {
    match training {
        [first, others @ ..]
            if !others.is_empty()
                && others.iter().all(|c| c.camera_to_world == first.camera_to_world) =>
        {
            Err(SamePose { views: training.len() })
        }
        _ => Ok(()),
    }
}

/// What looks wrong about cameras, a line each.
pub(crate) fn warnings(training: &[Camera], test: &[Camera]) -> Vec<String> {
    let mut found = Vec::new();
    if training.len() == 1 {
        found.push(
            "there is 1 training view: nothing tells how far anything is; add views from \
            other sides"
                .to_owned(),
        );
    }
    found.extend(one_place(training));
    let named = |kind: &'static str| move |camera| Named { camera, kind };
    let all: Vec<Named> =
        training.iter().map(named("training")).chain(test.iter().map(named("test"))).collect();
    found.extend(far_off(&all));
    found.extend(off_centre(&all));
    found
}

/// A camera, and what its view is for.
#[derive(Clone, Copy)]
struct Named<'a> {
    camera: &'a Camera,
    kind: &'static str,
}

impl std::fmt::Display for Named<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} view {}", self.kind, self.camera.name)
    }
}

/// Cameras in one place, up to rounding, and cameras whose centres are rounded too coarsely: poses
/// of a georeferenced scene in single precision.
fn one_place(cameras: &[Camera]) -> Option<String> {
    let [first, others @ ..] = cameras else { return None };
    let distances = others.iter().map(|camera| camera.centre().distance(first.centre()));
    let (apart, error) = (distances.fold(0.0, f64::max), rounding_error(cameras));
    if others.is_empty() || error < COARSE_SHARE * apart {
        return None;
    }
    let count = cameras.len();
    Some(if apart <= error {
        format!(
            "all {count} training cameras stand in one place: nothing tells how far anything is"
        )
    } else {
        format!(
            "the {count} training cameras stand up to {} units apart, but their centres are known \
            only to {}: subtract an offset from all centres before they are rounded",
            length(apart, 3),
            length(error, 3)
        )
    })
}

/// Returns the error of the cameras' coordinates that follows from their number format.
fn rounding_error(cameras: &[Camera]) -> f64 {
    let coordinates = || cameras.iter().flat_map(|camera| camera.centre().to_array());
    let are_single = coordinates().all(|x| f64::from(x as f32) == x);
    let largest = coordinates().fold(0.0, |largest: f64, x| largest.max(x.abs()));
    largest * if are_single { SINGLE_ERROR } else { DOUBLE_ERROR }
}

/// Cameras far away from the others, by the medians: those hold whatever a few cameras do.
fn far_off(all: &[Named]) -> Option<String> {
    let centres: Vec<DVec3> = all.iter().map(|named| named.camera.centre()).collect();
    let middle = DVec3::from([0, 1, 2].map(|i| median(centres.iter().map(|centre| centre[i]))));
    let away: Vec<f64> = centres.iter().map(|centre| centre.distance(middle)).collect();
    let usual = median(away.iter().copied());
    if all.len() < LEAST_CAMERAS || usual <= 0.0 {
        return None;
    }
    let far: Vec<usize> = (0..all.len()).filter(|&i| away[i] > FAR_OFF_RATIO * usual).collect();
    let more = if far.len() > 1 { format!(" (and {} more)", far.len() - 1) } else { String::new() };
    far.first().map(|&first| {
        format!(
            "{} is {:.0} times as far from the middle of all cameras as half of them{more}; is its \
            pose right? The scene's bounds follow from all poses",
            all[first],
            away[first] / usual
        )
    })
}

/// The middle of some numbers in order; 0 of none.
fn median(of: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = of.collect();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

/// Principal points far from the middles of images: commonly numbers for images of another size.
fn off_centre(all: &[Named]) -> Option<String> {
    let off: Vec<&Named> = all.iter().filter(|n| is_off_centre(&n.camera.intrinsics)).collect();
    let first = off.first()?;
    let k = &first.camera.intrinsics;
    Some(format!(
        "{} of {} have a principal point far from the middle, first {first}: ({:.1}, {:.1}) in \
        {}×{} pixels; are cx, cy, w and h for one size?",
        off.len(),
        counted(all.len(), "view"),
        k.cx,
        k.cy,
        k.width,
        k.height
    ))
}

fn is_off_centre(k: &Intrinsics) -> bool {
    let off = |at: f64, length: u32| (at / f64::from(length) - 0.5).abs() > OFF_CENTRE_SHARE;
    off(k.cx, k.width) || off(k.cy, k.height)
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use scene::{Intrinsics, pose_of};

    use super::*;

    fn camera(name: &str, turn: f64, centre: [f64; 3]) -> Camera {
        let r = DMat3::from_rotation_z(turn);
        let intrinsics = Intrinsics::from_angle_x(32, 24, 0.69);
        Camera { name: name.into(), intrinsics, camera_to_world: pose_of(r, centre.into()) }
    }

    fn on_ring(i: u32, scale: f64, middle: f64) -> Camera {
        let angle = f64::from(i);
        camera(
            &format!("r_{i}"),
            angle,
            [middle + 4.0 * scale * angle.cos(), 4.0 * scale * angle.sin(), scale],
        )
    }

    /// Around something, at any scale and anywhere.
    fn ring(count: u32, scale: f64, middle: f64) -> Vec<Camera> {
        (0..count).map(|i| on_ring(i, scale, middle)).collect()
    }

    #[test]
    fn ordinary_cameras_are_nothing_to_warn_of() {
        for (scale, middle) in [(1.0, 0.0), (1e-3, 0.0), (100.0, 4e5)] {
            let mut training = ring(30, scale, middle);
            // One that looks from farther away, and a lens that isn't quite centred.
            training.push(camera("overview", 0.0, [middle, 0.0, 30.0 * scale]));
            training[0].intrinsics.cx += 3.0;
            assert_eq!(warnings(&training, &ring(7, 1.1 * scale, middle)), Vec::<String>::new());
            assert_eq!(check(&training), Ok(()));
        }
        assert_eq!(warnings(&ring(2, 1.0, 0.0), &ring(1, 1.0, 0.0)), Vec::<String>::new());
    }

    /// Captures of a table and of a town in UTM and ECEF coordinates: nothing is wrong with them,
    /// unless they were written in single precision.
    #[test]
    fn georeferenced_cameras_are_known_as_well_as_their_numbers_say() {
        let (utm, ecef) = ([500_000.0, 4_649_776.0, 120.0], [4_027_893.75, 307_045.6, 4_919_474.9]);
        for offset in [utm, ecef] {
            for (scale, words) in [
                (0.025, "all 8 training cameras stand in one place"),
                (10.0, "units apart, but their centres are known only to 0.5"),
            ] {
                let mut there: Vec<Camera> =
                    ring(8, scale, 0.0).iter().map(|c| c.moved(offset.into())).collect();
                assert_eq!(warnings(&there, &[]), Vec::<String>::new(), "{scale}");
                for number in there.iter_mut().flat_map(|c| c.camera_to_world.as_flattened_mut()) {
                    *number = f64::from(*number as f32);
                }
                let found = warnings(&there, &[]).join("; ");
                assert!(found.contains(words), "{scale}: {found}");
            }
        }
    }

    #[test]
    fn published_scenes_are_nothing_to_warn_of() {
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
                set.split.clone().unwrap_or_else(|| dataset::Split::hold_out(set.frames.len(), 8));
            let cameras =
                |of: &[usize]| of.iter().map(|&i| set.frames[i].camera()).collect::<Vec<_>>();
            let (training, test) = (cameras(&split.train), cameras(&split.test));
            assert_eq!(
                (check(&training), warnings(&training, &test)),
                (Ok(()), Vec::new()),
                "{scene}"
            );
        }
    }

    #[test]
    fn one_pose_for_all_views_is_refused() {
        let same = vec![camera("a", 0.3, [0.0, 1.0, 4.0]); 8];
        let message = check(&same).unwrap_err().to_string();
        assert!(message.starts_with("all 8 training views have the same pose"), "{message}");
        assert_eq!((check(&same[..1]), check(&[])), (Ok(()), Ok(())));
    }

    #[track_caller]
    fn assert_one_warning(training: &[Camera], test: &[Camera], words: &str) {
        let found = warnings(training, test);
        assert!(found.len() == 1 && found[0].contains(words), "{words}: {found:?}");
    }

    #[test]
    fn what_looks_wrong_is_said_once() {
        assert_one_warning(
            &ring(1, 1.0, 0.0),
            &ring(3, 1.0, 0.0),
            "there is 1 training view: nothing tells how far",
        );
        let turning: Vec<Camera> =
            (0..5).map(|i| camera("t", f64::from(i), [3.0, 1.0, 4.0])).collect();
        assert_one_warning(&turning, &[], "all 5 training cameras stand in one place");
        let utm = DVec3::new(500_000.0, 4_649_776.0, 120.0);
        let there: Vec<Camera> = turning.iter().map(|camera| camera.moved(utm)).collect();
        assert_one_warning(&there, &[], "all 5 training cameras stand in one place");
        let mut far = ring(8, 1.0, 0.0);
        far[5].camera_to_world[0][3] = 1e6;
        assert_one_warning(&far, &ring(3, 1.0, 0.0), "training view r_5 is 3");
        far[6].camera_to_world[0][3] = -1e6;
        assert_one_warning(
            &far,
            &ring(3, 1.0, 0.0),
            "as half of them (and 1 more); is its pose right?",
        );
        let mut far = ring(3, 1.0, 0.0);
        far[0].camera_to_world[1][3] = 500.0;
        assert_one_warning(&ring(8, 1.0, 0.0), &far, "test view r_0 is ");
        // Numbers for 32×24 pixels, taken for ones for 64×48.
        let mut shrunk = ring(6, 1.0, 0.0);
        shrunk[2..].iter_mut().for_each(|c| (c.intrinsics.cx, c.intrinsics.cy) = (8.0, 6.0));
        assert_one_warning(
            &shrunk,
            &ring(2, 1.0, 0.0),
            "4 of 8 views have a principal point far from the middle, first training view r_2: \
            (8.0, 6.0) in 32×24",
        );
    }
}
