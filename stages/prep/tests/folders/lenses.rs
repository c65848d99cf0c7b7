//! Cases of lens models in `transforms.json` and in COLMAP's files.

use std::path::Path;

use serde_json::{Value, json};

use super::kit::{
    Case, Expected, Scene, case, held_out, transforms, write, write_colmap, write_photographs,
    write_transforms,
};

/// Writes three photographs and their `transforms.json` with further entries.
fn write_frames(folder: &Path, entries: &Value) {
    let mut list = transforms("a#.png", 3);
    for (name, value) in entries.as_object().unwrap() {
        list[name] = value.clone();
    }
    write_transforms(folder, &list);
    write_photographs(folder, "a#.png", 3);
}

/// Writes three photographs and COLMAP's model of them with one camera.
fn write_model(folder: &Path, camera: &str) {
    write_colmap(&folder.join("sparse/0"), camera, "a#.png", 3);
    write_photographs(&folder.join("images"), "a#.png", 3);
}

/// Returns a scene of three views with the given notes and lens.
fn with_lens(notes: &[&'static str], lens: &Value) -> Scene {
    let mut scene = held_out("a#", 3, notes);
    for view in scene.train.iter_mut().chain(&mut scene.test) {
        view.lens = lens.clone();
    }
    scene
}

const TRANSFORMS_NOTE: &str = "transforms.json (instant-ngp, nerfstudio): 3 photographs";
const COLMAP_NOTE: &str = "COLMAP: 3 photographs from sparse/0";
const DISTORTION_NOTE: &str = "3 photographs have lens distortion";
const FISHEYE_NOTE: &str = "3 photographs were taken with a fisheye lens";

fn perspective_cases() -> Vec<Case> {
    let tangential = json!([0.001, -0.002]);
    vec![
        case(
            "ns PR#3131, ns#3118: Brown's k4",
            |folder| {
                let k = json!({"camera_model": "OPENCV", "k1": 0.1, "k2": -0.02, "k3": 0.003,
                    "k4": -0.0004, "p1": 0.001, "p2": -0.002});
                write_frames(folder, &k);
            },
            Expected::Scene(with_lens(
                &[TRANSFORMS_NOTE, DISTORTION_NOTE],
                &json!({"radial": [0.1, -0.02, 0.003, -0.0004], "tangential": tangential}),
            )),
        ),
        case(
            "gsplat PR#1039: FULL_OPENCV without rational terms",
            |folder| {
                let camera = "1 FULL_OPENCV 16 16 20 20 8 8 0.1 -0.02 0.001 -0.002 0.003 0 0 0\n";
                write_model(folder, camera);
            },
            Expected::Scene(with_lens(
                &[COLMAP_NOTE, DISTORTION_NOTE],
                &json!({"radial": [0.1, -0.02, 0.003], "tangential": tangential}),
            )),
        ),
        case(
            "gsplat PR#1039: FULL_OPENCV",
            |folder| {
                let camera = "1 FULL_OPENCV 16 16 20 20 8 8 0.1 -0.02 0.001 -0.002 0.003 0.2 -0.1 \
                    0.05\n";
                write_model(folder, camera);
            },
            Expected::Scene(with_lens(
                &[COLMAP_NOTE, DISTORTION_NOTE],
                &json!({"radial": [0.1, -0.02, 0.003], "tangential": tangential,
                    "denominator": [0.2, -0.1, 0.05]}),
            )),
        ),
        case(
            "gsplat#794: SIMPLE_RADIAL, k is the fourth parameter",
            |folder| write_model(folder, "1 SIMPLE_RADIAL 16 16 20 8 8 -0.05\n"),
            Expected::Scene(with_lens(
                &[COLMAP_NOTE, DISTORTION_NOTE],
                &json!({"radial": [-0.05, 0.0, 0.0], "tangential": [0.0, 0.0]}),
            )),
        ),
    ]
}

/// Returns whether a pixel is less than 89° from the axis of a fisheye lens of 200°.
fn is_visible(x: u32, y: u32) -> bool {
    let [x, y] = [x, y].map(|v| f64::from(v) - 7.5);
    x.hypot(y) / 4.5 < f64::to_radians(89.0)
}

fn fisheye_cases() -> Vec<Case> {
    let lens = |radial: &[f64]| json!({"projection": "fisheye", "radial": radial, "tangential": [0.0, 0.0]});
    let radial = [-0.02, 0.006, -0.003, 0.0005];
    let expected = |notes: &[&'static str]| Expected::Scene(with_lens(notes, &lens(&radial)));
    vec![
        case(
            "OPENCV_FISHEYE in transforms.json",
            |folder| {
                let k = json!({"camera_model": "OPENCV_FISHEYE", "k1": -0.02, "k2": 0.006,
                    "k3": -0.003, "k4": 0.0005});
                write_frames(folder, &k);
            },
            expected(&[TRANSFORMS_NOTE, FISHEYE_NOTE]),
        ),
        case(
            "is_fisheye",
            |folder| {
                let k = json!({"is_fisheye": true, "k1": -0.02, "k2": 0.006, "k3": -0.003,
                    "k4": 0.0005, "p1": 0, "p2": 0});
                write_frames(folder, &k);
            },
            expected(&[TRANSFORMS_NOTE, FISHEYE_NOTE]),
        ),
        case(
            "OPENCV_FISHEYE of COLMAP",
            |folder| {
                write_model(folder, "1 OPENCV_FISHEYE 16 16 20 20 8 8 -0.02 0.006 -0.003 0.0005\n");
            },
            expected(&[COLMAP_NOTE, FISHEYE_NOTE]),
        ),
        case(
            "SIMPLE_RADIAL_FISHEYE of COLMAP",
            |folder| write_model(folder, "1 SIMPLE_RADIAL_FISHEYE 16 16 20 8 8 0.01\n"),
            Expected::Scene(with_lens(&[COLMAP_NOTE, FISHEYE_NOTE], &lens(&[0.01, 0.0, 0.0]))),
        ),
        case(
            "RADIAL_FISHEYE of COLMAP",
            |folder| write_model(folder, "1 RADIAL_FISHEYE 16 16 20 8 8 0.01 -0.02\n"),
            Expected::Scene(with_lens(&[COLMAP_NOTE, FISHEYE_NOTE], &lens(&[0.01, -0.02, 0.0]))),
        ),
        case(
            "a fisheye lens of 200°",
            |folder| write_frames(folder, &json!({"is_fisheye": true, "fl_x": 4.5, "fl_y": 4.5})),
            {
                let notes = [
                    TRANSFORMS_NOTE,
                    FISHEYE_NOTE,
                    "300 pixels of 3 photographs are more than 89° from the axis of a fisheye lens \
                    and are masked",
                ];
                let mut scene = with_lens(&notes, &lens(&[0.0, 0.0, 0.0]));
                for view in scene.train.iter_mut().chain(&mut scene.test) {
                    view.inside = [16.0, 16.0, 4.5, 4.5, 8.0, 8.0];
                    view.mask = Some(is_visible);
                }
                Expected::Scene(scene)
            },
        ),
    ]
}

fn refused_cases() -> Vec<Case> {
    vec![
        case(
            "colmap#3570, colmap PR#4470: a newer COLMAP's model",
            |folder| {
                write_model(folder, "1 PINHOLE 16 16 20 20 8 8\n");
                let numbers: [u8; 32] = std::array::from_fn(|i| match i {
                    0 | 8 => 1,
                    12 => 11,
                    16 | 24 => 16,
                    _ => 0,
                });
                write(folder.join("sparse/0/cameras.bin"), [&numbers[..], &[0; 128]].concat());
            },
            Expected::Refused(
                "dataset: DIR/sparse/0/cameras.bin: byte 32: camera 1 has unknown model \
                11 (from a newer COLMAP?); undistort with colmap image_undistorter",
            ),
        ),
        case(
            "a model of COLMAP that isn't read",
            |folder| write_model(folder, "1 FOV 16 16 20 20 8 8 0.9\n"),
            Expected::Refused(
                "dataset: DIR/sparse/0/cameras.txt: line 1: camera model FOV is not supported; \
                undistort with colmap image_undistorter",
            ),
        ),
        case(
            "a newer COLMAP's name",
            |folder| write_model(folder, "1 EUCM 16 16 20 20 8 8 0.6 1.1\n"),
            Expected::Refused(
                "dataset: DIR/sparse/0/cameras.txt: line 1: camera model \"EUCM\" is unknown \
                (from a newer COLMAP?); undistort with colmap image_undistorter",
            ),
        ),
        case(
            "nerfstudio's spherical images",
            |folder| write_frames(folder, &json!({"camera_model": "EQUIRECTANGULAR"})),
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 0 (a0.png): camera_model \"EQUIRECTANGULAR\" \
                is not supported; cut the panoramas into views and estimate their cameras: \
                ns-process-data images --camera-type equirectangular",
            ),
        ),
        case(
            "a fisheye lens that folds",
            |folder| {
                let k = json!({"is_fisheye": true, "fl_x": 9, "fl_y": 9, "k1": -0.3});
                write_frames(folder, &k);
            },
            Expected::Refused(
                "dataset: frame a0: lens distortion (fisheye, k1 -0.3) \
                is not invertible within the image; check its coefficients (parameter lens: undo \
                keeps the valid part of the image)",
            ),
        ),
    ]
}

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = perspective_cases();
    cases.extend(fisheye_cases());
    cases.extend(refused_cases());
    cases
}
