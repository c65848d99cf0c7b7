//! Reduced copies of the photographs, without the photographs themselves.

use std::path::Path;

use serde_json::json;

use super::kit::{
    Case, Expected, FOCAL, SIDE, Scene, case, held_out, photograph, transforms, write_colmap,
    write_image, write_photographs, write_transforms,
};

/// COLMAP's camera of the photographs themselves.
const PHOTOGRAPH_CAMERA: &str = "1 PINHOLE 193 129 200 210 96.5 64.5\n";

fn write_copies(folder: &Path, names: &str, (width, height): (u32, u32), count: usize) {
    for number in 0..count {
        let path = folder.join(names.replace('#', &number.to_string()));
        write_image(&path, &photograph(width, height, number));
    }
}

/// Writes COLMAP's model, and copies by 4 and 8 as PNG. Only one of the copies by 2 exists.
fn write_colmap_copies(folder: &Path) {
    write_colmap(&folder.join("sparse/0"), PHOTOGRAPH_CAMERA, "a#.jpg", 3);
    write_copies(folder, "images_2/a#.png", (97, 65), 1);
    write_copies(folder, "images_4/a#.png", (48, 32), 3);
    write_copies(folder, "images_8/a#.png", (24, 16), 3);
}

/// Scales the cameras to the copies, whose width and height are each rounded.
fn scaled(mut scene: Scene) -> Scene {
    let (x, y) = (48.0 / 193.0, 32.0 / 129.0);
    for view in scene.train.iter_mut().chain(&mut scene.test) {
        view.inside = [48.0, 32.0, 200.0 * x, 210.0 * y, 96.5 * x, 64.5 * y];
    }
    scene
}

fn write_transforms_copies(folder: &Path) {
    let mut list = transforms("images/a#.jpg", 3);
    (list["w"], list["h"]) = (json!(2 * SIDE), json!(2 * SIDE));
    (list["fl_x"], list["fl_y"]) = (json!(2.0 * FOCAL), json!(2.0 * FOCAL));
    (list["cx"], list["cy"]) = (json!(SIDE), json!(SIDE));
    write_transforms(folder, &list);
    write_photographs(folder, "images_2/a#.jpg", 3);
}

pub(crate) fn cases() -> Vec<Case> {
    vec![
        case("ns PR#2860, gsplat#212: COLMAP", write_colmap_copies, {
            Expected::Scene(scaled(held_out(
                "a#",
                3,
                &[
                    "COLMAP: 3 photographs from sparse/0",
                    "3 file names found in images_4, because images is missing or empty (first: a0.jpg is images_4/a0.png)",
                ],
            )))
        }),
        case("transforms.json", write_transforms_copies, {
            Expected::Scene(held_out(
                "a#",
                3,
                &[
                    "transforms.json (instant-ngp, nerfstudio): 3 photographs",
                    "3 file names found in images_2, because images is missing or empty (first: images/a0.jpg is images_2/a0.jpg)",
                ],
            ))
        }),
        case(
            "copies of other photographs",
            |folder| {
                write_colmap(&folder.join("sparse/0"), PHOTOGRAPH_CAMERA, "a#.jpg", 3);
                write_copies(folder, "images_4/b#.png", (48, 32), 3);
            },
            Expected::Refused(
                "dataset: DIR/sparse/0/images.txt: 3 images listed, none found in DIR (first missing: a0.jpg)",
            ),
        ),
    ]
}
