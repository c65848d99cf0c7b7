//! Cases of masks in all supported conventions.

use std::path::Path;

use serde_json::{Value, json};

use super::kit::{
    CAMERA, Case, Expected, SIDE, Scene, case, held_out, left_half, transforms, write_colmap,
    write_image, write_llff, write_mask, write_photograph, write_photographs, write_transforms,
};

fn right_half(x: u32, y: u32) -> bool {
    !left_half(x, y)
}

fn write_colmap_photographs(folder: &Path, names: &str, count: usize) {
    write_colmap(&folder.join("sparse/0"), CAMERA, names, count);
    write_photographs(&folder.join("images"), names, count);
}

fn write_masks(folder: &Path, names: &str, numbers: impl IntoIterator<Item = usize>) {
    for number in numbers {
        let path = folder.join(names.replace('#', &number.to_string()));
        write_mask(&path, (SIDE, SIDE), left_half);
    }
}

/// Writes `transforms.json` with three frames, and masks for the first and the last.
fn write_masked_frames(folder: &Path, size: (u32, u32), counts: fn(u32, u32) -> bool) {
    write_photographs(folder, "images/a#.png", 3);
    let mut content: Value = transforms("images/a#.png", 3);
    for number in [0, 2] {
        write_mask(&folder.join(format!("masks/m{number}.png")), size, counts);
        content["frames"][number]["mask_path"] = json!(format!("masks/m{number}.png"));
    }
    write_transforms(folder, &content);
}

/// Writes masks of values 0 and 1, as programs save arrays of labels.
fn write_masks_of_labels(folder: &Path) {
    write_masked_frames(folder, (SIDE, SIDE), left_half);
    for number in [0, 2] {
        let path = folder.join(format!("masks/m{number}.png"));
        let mut mask = pixels::read_png(&path).unwrap();
        mask.data.chunks_exact_mut(4).flat_map(|p| &mut p[..3]).for_each(|v| *v /= 255);
        write_image(&path, &mask);
    }
}

/// Returns the scene with masks for the views with the given pose numbers.
fn masked(mut scene: Scene, numbers: &[usize], counts: fn(u32, u32) -> bool) -> Expected {
    for view in scene.train.iter_mut().chain(&mut scene.test) {
        if numbers.contains(&view.pose) {
            view.mask = Some(counts);
        }
    }
    Expected::Scene(scene)
}

const COLMAP_NOTE: &str = "COLMAP: 10 photographs from sparse/0";
const TRANSFORMS_NOTE: &str = "transforms.json (instant-ngp, nerfstudio): 3 photographs";
const LISTED_NOTE: &str = "2 of 3 views have masks (2 by mask_path, where black is excluded)";

fn colmap_cases() -> Vec<Case> {
    vec![
        case(
            "LFS#1612: masks/NAME.png",
            |folder| {
                write_colmap_photographs(folder, "a#.jpg", 10);
                write_masks(folder, "masks/a#.png", 3..6);
            },
            masked(
                held_out(
                    "a#",
                    10,
                    &[
                        COLMAP_NOTE,
                        "3 of 10 views have masks (3 by masks/NAME.png, where black is excluded)",
                    ],
                ),
                &[3, 4, 5],
                left_half,
            ),
        ),
        case(
            "ns PR#2115: masks/NAME.EXT.png, in folders",
            |folder| {
                write_colmap_photographs(folder, "x/a#.JPG", 10);
                write_masks(folder, "masks/x/a#.JPG.png", 0..10);
            },
            masked(
                held_out(
                    "a#",
                    10,
                    &[
                        COLMAP_NOTE,
                        "10 of 10 views have masks (10 by masks/NAME.EXT.png, where black is excluded)",
                    ],
                ),
                &Vec::from_iter(0..10),
                left_half,
            ),
        ),
        case(
            "both conventions for one photograph",
            |folder| {
                write_colmap_photographs(folder, "a#.jpg", 2);
                write_masks(folder, "masks/a#.png", [1]);
                write_masks(folder, "masks/a#.jpg.png", [1]);
            },
            Expected::Refused(
                "dataset: DIR/images/a1.jpg: masks/a1.jpg.png and masks/a1.png both match \"masks/a1.png\"; remove one of the two, or name it exactly",
            ),
        ),
        case(
            "masks of other names",
            |folder| {
                write_colmap_photographs(folder, "a#.jpg", 10);
                write_masks(folder, "masks/b#.png", 0..2);
                write_masks(folder, "segmentation/a#.png", 0..1);
            },
            Expected::Scene(held_out(
                "a#",
                10,
                &[
                    COLMAP_NOTE,
                    "warning: 2 unused files in masks look like masks (first: masks/b0.png); the mask of a photograph NAME.EXT must be called masks/NAME.png or masks/NAME.EXT.png",
                    "warning: 1 unused file in segmentation looks like a mask (first: segmentation/a0.png); the mask of a photograph NAME.EXT must be called masks/NAME.png or masks/NAME.EXT.png",
                ],
            )),
        ),
    ]
}

fn llff_cases() -> Vec<Case> {
    vec![
        case(
            "LLFF with masks",
            |folder| {
                write_photographs(folder, "images/a#.png", 9);
                write_llff(folder, &Vec::from_iter(0..9), [2.0, 6.0]);
                write_masks(folder, "masks/A#.png", [1]);
            },
            masked(
                held_out(
                    "a#",
                    9,
                    &[
                        "LLFF (poses_bounds.npy): 9 photographs from images",
                        "1 of 9 views has a mask (1 by masks/NAME.png, where black is excluded)",
                    ],
                ),
                &[1],
                left_half,
            ),
        ),
        case(
            "LLFF with instant-ngp's masks",
            |folder| {
                write_photographs(folder, "images/a#.png", 9);
                write_llff(folder, &Vec::from_iter(0..9), [2.0, 6.0]);
                write_masks(folder, "images/dynamic_mask_a#.png", 0..9);
            },
            masked(
                held_out(
                    "a#",
                    9,
                    &[
                        "LLFF (poses_bounds.npy): 9 photographs from images",
                        "9 of 9 views have masks (9 by dynamic_mask_NAME.png, where white is excluded)",
                    ],
                ),
                &Vec::from_iter(0..9),
                right_half,
            ),
        ),
    ]
}

fn transforms_cases() -> Vec<Case> {
    vec![
        case(
            "mask_path",
            |folder| write_masked_frames(folder, (SIDE, SIDE), left_half),
            masked(held_out("a#", 3, &[TRANSFORMS_NOTE, LISTED_NOTE]), &[0, 2], left_half),
        ),
        case(
            "masks of values 0 and 1",
            write_masks_of_labels,
            masked(held_out("a#", 3, &[TRANSFORMS_NOTE, LISTED_NOTE]), &[0, 2], left_half),
        ),
        case(
            "masks of every pixel",
            |folder| write_masked_frames(folder, (SIDE, SIDE), |_, _| false),
            {
                let mut scene = held_out("a#", 3, &[TRANSFORMS_NOTE, LISTED_NOTE]);
                scene.further = vec![
                    "warning: masks exclude every pixel of 2 views (first: frame a0); check the masks, or remove the photographs",
                ];
                masked(scene, &[0, 2], |_, _| false)
            },
        ),
        case(
            "ns#2020, ns#3659: masks of another size",
            |folder| write_masked_frames(folder, (SIDE / 2, SIDE / 2), |x, _| x < SIDE / 4),
            masked(
                held_out(
                    "a#",
                    3,
                    &[
                        TRANSFORMS_NOTE,
                        LISTED_NOTE,
                        "2 masks differ from the photograph in size; resampled by nearest neighbour (first: masks/m0.png: 8×8 for 16×16)",
                    ],
                ),
                &[0, 2],
                left_half,
            ),
        ),
        case(
            "masks of another shape",
            |folder| write_masked_frames(folder, (2, SIDE), |x, _| x < 1),
            masked(
                held_out(
                    "a#",
                    3,
                    &[
                        TRANSFORMS_NOTE,
                        LISTED_NOTE,
                        "warning: 2 masks differ from the photograph in aspect ratio; resampled by nearest neighbour (first: masks/m0.png: 2×16 for 16×16)",
                    ],
                ),
                &[0, 2],
                left_half,
            ),
        ),
        case(
            "ngp#1049, ns#1052: white is masked away",
            |folder| {
                write_photographs(folder, "images/a#.png", 3);
                write_transforms(folder, &transforms("images/a#.png", 3));
                write_masks(folder, "images/dynamic_mask_a#.png", 0..2);
                write_photograph(&folder.join("images/b_mask.png"), 9);
            },
            masked(
                held_out(
                    "a#",
                    3,
                    &[
                        TRANSFORMS_NOTE,
                        "2 of 3 views have masks (2 by dynamic_mask_NAME.png, where white is excluded)",
                        "warning: 1 unused file in images looks like a mask (first: images/b_mask.png); list masks as mask_path of their frames",
                    ],
                ),
                &[0, 1],
                right_half,
            ),
        ),
        case(
            "masks that no frame names",
            |folder| {
                write_photographs(folder, "images/a#.png", 3);
                write_transforms(folder, &transforms("images/a#.png", 3));
                write_masks(folder, "masks/a#.png", 0..3);
            },
            Expected::Scene(held_out(
                "a#",
                3,
                &[
                    TRANSFORMS_NOTE,
                    "warning: 3 unused files in masks look like masks (first: masks/a0.png); list masks as mask_path of their frames",
                ],
            )),
        ),
        case(
            "a mask that is missing",
            |folder| {
                write_photographs(folder, "images/a#.png", 3);
                let mut content = transforms("images/a#.png", 3);
                content["frames"][1]["mask_path"] = json!("masks/a1.png");
                write_transforms(folder, &content);
            },
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 1 (images/a1.png): DIR/masks/a1.png not found; restore or rename the file, or remove its entry",
            ),
        ),
    ]
}

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = colmap_cases();
    cases.extend(llff_cases());
    cases.extend(transforms_cases());
    cases
}
