//! Folders that are almost data sets, and data sets that are almost complete.

use std::path::Path;

use serde_json::json;

use super::kit::{
    CAMERA, Case, Expected, Scene, case, colmap_line, held_out, transforms, write, write_colmap,
    write_llff, write_photographs, write_transforms,
};

fn write_colmap_set(folder: &Path, model: &str, images: &str) {
    write_colmap(&folder.join(model), CAMERA, "a#.png", 3);
    write_photographs(&folder.join(images), "a#.png", 3);
}

fn write_nerfstudio_set(folder: &Path) {
    write_photographs(folder, "images/a#.png", 3);
    write_transforms(folder, &transforms("images/a#.png", 3));
}

/// Writes ten photographs and eight poses.
fn write_llff_set(folder: &Path) {
    write_photographs(folder, "images/a#.png", 10);
    write_llff(folder, &[0, 1, 2, 4, 5, 6, 7, 9], [2.0, 6.0]);
}

/// Numbers of the photographs with poses, in COLMAP's order, which isn't sorted.
const COLMAP_ORDER: [usize; 8] = [9, 1, 0, 2, 7, 4, 5, 6];

/// Expects the eight photographs with poses; `source` is the note on the source of their names.
fn paired(source: &'static str) -> Expected {
    let views = |numbers: &[usize]| super::kit::views("a#", numbers.iter().copied());
    let note = "LLFF (poses_bounds.npy): 8 photographs from images";
    Expected::Scene(Scene {
        train: views(&[1, 2, 4, 5, 6, 7, 9]),
        test: views(&[0]),
        notes: vec![note, source],
        further: Vec::new(),
    })
}

fn write_binary_images(folder: &Path) {
    let mut bytes = (COLMAP_ORDER.len() as u64).to_le_bytes().to_vec();
    for number in COLMAP_ORDER {
        bytes.extend((number as u32 + 1).to_le_bytes());
        bytes.extend([1.0f64, 0.0, 0.0, 0.0, 0.0, 0.0, 3.0].iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(1u32.to_le_bytes());
        bytes.extend(format!("a{number}.png\0").bytes());
        bytes.extend(0u64.to_le_bytes());
    }
    write(folder.join("sparse/0/images.bin"), bytes);
}

/// Models in other places than `sparse`, and models whose files are missing.
fn place_cases() -> Vec<Case> {
    vec![
        case(
            "a model next to images",
            |folder| write_colmap_set(folder, "", "images"),
            Expected::Scene(held_out("a#", 3, &["COLMAP: 3 photographs from the folder itself"])),
        ),
        case(
            "a model in another folder",
            |folder| write_colmap_set(folder, "model", "images"),
            Expected::Refused(
                "dataset: DIR: no data set; found a COLMAP model in model; move it to sparse/0",
            ),
        ),
        case(
            "3D Gaussian Splatting's distorted/sparse/0",
            |folder| write_colmap_set(folder, "distorted/sparse/0", "input"),
            Expected::Refused(
                "dataset: DIR: no data set; found a COLMAP model in distorted/sparse/0 and images in input; rename these folders to sparse/0 and images",
            ),
        ),
        case(
            "images in another folder",
            |folder| write_colmap_set(folder, "sparse/0", "photos"),
            Expected::Refused(
                "dataset: DIR/sparse/0/images.txt: 3 images listed, none found in DIR (first missing: a0.png); the image is in photos: rename this folder to images",
            ),
        ),
        case(
            "images in another folder, one level below",
            |folder| write_colmap_set(&folder.join("x"), "sparse/0", "photos"),
            Expected::Refused(
                "dataset: DIR: no data set; found COLMAP (sparse) in DIR/x; give that folder",
            ),
        ),
        case(
            "half a model",
            |folder| {
                write_photographs(folder, "images/a#.png", 10);
                write_binary_images(folder);
            },
            Expected::Refused(
                "dataset: DIR/sparse/0: neither cameras.bin nor cameras.txt found; copy all files \
                of the model",
            ),
        ),
        case(
            "photographs without a camera",
            |folder| {
                write_colmap_set(folder, "sparse/0", "images");
                write_photographs(&folder.join("images"), "a#.png", 5);
                write(folder.join("images/a3.jpg"), "");
            },
            Expected::Scene(held_out(
                "a#",
                3,
                &[
                    "COLMAP: 3 photographs from sparse/0",
                    "warning: 2 of 5 photographs have no camera (first: images/a3.png)",
                ],
            )),
        ),
    ]
}

fn model_cases() -> Vec<Case> {
    vec![
        case(
            "nerfstudio's colmap/sparse/0",
            |folder| write_colmap_set(folder, "colmap/sparse/0", "images"),
            Expected::Scene(held_out("a#", 3, &["COLMAP: 3 photographs from colmap/sparse/0"])),
        ),
        case(
            "3DGS#272: dense/0/sparse",
            |folder| write_colmap_set(folder, "dense/0/sparse", "dense/0/images"),
            Expected::Refused(
                "dataset: DIR: no data set; found COLMAP (sparse) in DIR/dense/0; give that folder",
            ),
        ),
        case(
            "fvdb-reality-capture PR#177, colmap#1902: no second lines",
            |folder| {
                write_photographs(folder, "images/a#.png", 3);
                write(folder.join("sparse/0/cameras.txt"), CAMERA);
                let lines: String =
                    (0..3).map(|number| colmap_line(number, &format!("a{number}.png"))).collect();
                write(folder.join("sparse/0/images.txt"), format!("# list\n{lines}"));
            },
            Expected::Refused(
                "dataset: DIR/sparse/0/images.txt: line 3: expected the points of image 1 (an empty line if there are none)",
            ),
        ),
        case(
            "a camera model of a newer COLMAP",
            |folder| {
                write_colmap(&folder.join("sparse/0"), "1 HOLOGRAM 16 16 20 8 8\n", "a#.png", 3);
                write_photographs(folder, "images/a#.png", 3);
            },
            Expected::Refused(
                "dataset: DIR/sparse/0/cameras.txt: line 1: camera model \"HOLOGRAM\" is unknown (from a newer COLMAP?); undistort with colmap image_undistorter",
            ),
        ),
        case(
            "colmap#3570, colmap PR#4470: model 99",
            |folder| {
                let mut bytes = 1u64.to_le_bytes().to_vec();
                bytes.extend([1u32.to_le_bytes(), 99u32.to_le_bytes()].concat());
                bytes.extend([16u64.to_le_bytes(); 6].concat());
                write(folder.join("sparse/0/cameras.bin"), bytes);
                write_binary_images(folder);
            },
            Expected::Refused(
                "dataset: DIR/sparse/0/cameras.bin: byte 32: camera 1 has unknown model 99 (from a newer COLMAP?); undistort with colmap image_undistorter",
            ),
        ),
    ]
}

fn llff_cases() -> Vec<Case> {
    vec![
        case(
            "LLFF#69: fewer poses than photographs",
            write_llff_set,
            Expected::Refused(
                "dataset: DIR/poses_bounds.npy: 8 poses for 10 images in images/; counts must match, or view_imgs.txt must list the images that have poses",
            ),
        ),
        case(
            "colmap#1487: paired by view_imgs.txt",
            |folder| {
                write_llff_set(folder);
                let names: String = COLMAP_ORDER.iter().map(|i| format!("a{i}.png\r\n")).collect();
                write(folder.join("view_imgs.txt"), names);
            },
            paired("photographs with poses are listed by view_imgs.txt"),
        ),
        case(
            "nerf_pl#33: paired by COLMAP's model",
            |folder| {
                write_llff_set(folder);
                write_binary_images(folder);
            },
            paired("photographs with poses are listed by COLMAP's model in sparse"),
        ),
        case(
            "DSNeRF#101: bounds of other views",
            |folder| {
                write_photographs(folder, "images/a#.png", 2);
                write_llff(folder, &[0, 1], [-12.3, 85.1]);
            },
            Expected::Refused(
                "dataset: DIR/poses_bounds.npy: frame 0 (a0): bounds -12.3 and 85.1, expected 0 < near < far; LLFF's imgs2poses confuses views if COLMAP registered them in another order than that of their names: rerun COLMAP on images sorted by name, or use COLMAP's model without poses_bounds.npy",
            ),
        ),
    ]
}

fn name_cases() -> Vec<Case> {
    vec![
        case(
            "brush#41: transform_train.json",
            |folder| write(folder.join("transform_train.json"), "{}"),
            Expected::Refused(
                "dataset: DIR: no data set; found transform_train.json; did you mean transforms_train.json?",
            ),
        ),
        case(
            "test views alone",
            |folder| write(folder.join("transforms_test.json"), "{}"),
            Expected::Refused(
                "dataset: DIR: no data set; found transforms_test.json, but no transforms_train.json with the training views",
            ),
        ),
        case(
            "transform_test.json next to the training views",
            |folder| {
                write_nerfstudio_set(folder);
                std::fs::rename(
                    folder.join("transforms.json"),
                    folder.join("transforms_train.json"),
                )
                .unwrap();
                write(folder.join("transform_test.json"), "{}");
            },
            Expected::Scene(held_out(
                "a#",
                3,
                &[
                    "Blender format: 3 views, no test views",
                    "warning: found transform_test.json, which is not read; did you mean transforms_test.json?",
                ],
            )),
        ),
        case(
            "a single sub-folder",
            |folder| write_nerfstudio_set(&folder.join("scene")),
            Expected::Refused(
                "dataset: DIR: no data set; found transforms.json (instant-ngp, nerfstudio) in DIR/scene; give that folder",
            ),
        ),
        case(
            "several data sets",
            |folder| {
                for name in ["a", "b", "c", "d"] {
                    write_nerfstudio_set(&folder.join(name));
                }
            },
            Expected::Refused(
                "dataset: DIR: no data set; found transforms.json (instant-ngp, nerfstudio) in DIR/a, transforms.json (instant-ngp, nerfstudio) in DIR/b, transforms.json (instant-ngp, nerfstudio) in DIR/c and 1 more; give one of these folders",
            ),
        ),
        case(
            "openmask3d#16: Polycam",
            |folder| {
                write(folder.join("keyframes/cameras/1.json"), "{}");
                write(folder.join("keyframes/images/1.jpg"), "");
            },
            Expected::Refused(
                "dataset: DIR: no data set; found a Polycam export (DIR/keyframes/cameras), which is not supported; convert: ns-process-data polycam --data 'DIR' --output-dir 'DIR-nerfstudio'",
            ),
        ),
        case(
            "Metashape",
            |folder| {
                write(folder.join("images/1.jpg"), "");
                write(folder.join("cameras.xml"), "<?xml?>\n<document version=\"2\"><chunk/>");
            },
            Expected::Refused(
                "dataset: DIR: no data set; found a Metashape export (DIR/cameras.xml), which is not supported; convert: ns-process-data metashape --xml 'DIR/cameras.xml' --data 'DIR/images' --output-dir 'DIR-nerfstudio'",
            ),
        ),
        case(
            "RealityCapture",
            |folder| {
                write(folder.join("c.csv"), "#cameras 2\n#name,x,y,alt,heading,pitch,roll,f\n");
            },
            Expected::Refused(
                "dataset: DIR: no data set; found a RealityCapture export (DIR/c.csv), which is not supported; convert: ns-process-data realitycapture --csv 'DIR/c.csv' --data 'DIR' --output-dir 'DIR-nerfstudio'",
            ),
        ),
        case(
            "Record3D",
            |folder| {
                write(folder.join("x/EXR_RGBD/metadata.json"), "{}");
                write(folder.join("x/EXR_RGBD/rgb/0.jpg"), "");
            },
            Expected::Refused(
                "dataset: DIR: no data set; found a Record3D export (DIR/x/EXR_RGBD), which is not supported; convert: ns-process-data record3d --data 'DIR/x/EXR_RGBD' --output-dir 'DIR/x/EXR_RGBD-nerfstudio'",
            ),
        ),
    ]
}

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = vec![case(
        "depth images that are missing, or PNG",
        |folder| {
            let mut list = transforms("images/a#.png", 3);
            list["frames"][0]["depth_file_path"] = json!("images/a0.png");
            list["frames"][1]["depth_file_path"] = json!("depth/a1.png");
            write_photographs(folder, "images/a#.png", 3);
            write_transforms(folder, &list);
        },
        Expected::Scene(held_out(
            "a#",
            3,
            &[
                "transforms.json (instant-ngp, nerfstudio): 3 photographs",
                "2 depth images are not used (depth_file_path, first: images/a0.png); only EXR depth is",
            ],
        )),
    )];
    cases.extend(place_cases());
    cases.extend(model_cases());
    cases.extend(llff_cases());
    cases.extend(name_cases());
    cases
}
