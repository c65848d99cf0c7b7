use artifact::counted;
use glam::DVec3;
use scene::{Camera, Intrinsics};

use crate::error::SamePose;

/// Cameras that are so many times as far from the middle of all as half of them are, at least, are
/// far off. One that is doubles the box as often as that; walks through a room have 2 to 5.
const FAR_OFF_RATIO: f64 = 20.0;
/// Fewer cameras say too little of where the others stand.
const LEAST_CAMERAS: usize = 4;
/// A principal point farther from the middle of the image, as a share of its length, is far from
/// it. Real lenses have a hundredth.
const OFF_CENTRE_SHARE: f64 = 0.2;
/// Centres nearer to each other than this share of their distance from the origin are one place:
/// they were the same before they were rounded.
const ONE_PLACE_SHARE: f64 = 1e-7;

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
    } else if stand_in_one_place(training) {
        let count = training.len();
        found.push(format!(
            "all {count} training cameras stand in one place: nothing tells how far anything is"
        ));
    }
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

fn stand_in_one_place(cameras: &[Camera]) -> bool {
    let Some(first) = cameras.first().map(Camera::centre) else { return false };
    cameras.iter().all(|camera| camera.centre().distance(first) <= ONE_PLACE_SHARE * first.length())
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
