//! Cases of file names from other machines and programs.

use std::path::Path;

use serde_json::{Value, json};

use super::kit::{
    CAMERA, Case, Expected, SIDE, Scene, case, colmap_line, held_out, left_half, transforms, views,
    write, write_colmap, write_llff, write_mask, write_photograph, write_photographs,
    write_transforms,
};

/// Writes ten photographs named `files`, and `transforms.json` with `names`.
fn write_frames(folder: &Path, names: &str, files: &str) {
    write_photographs(folder, files, 10);
    write_transforms(folder, &transforms(names, 10));
}

const TEN_PHOTOGRAPHS: &str = "transforms.json (instant-ngp, nerfstudio): 10 photographs";

/// Writes a data set from Windows: backslashes in all names.
fn windows(folder: &Path) {
    write_photographs(folder, "images/a_#.png", 3);
    let mut list = transforms(r"images\a_#.png", 3);
    for (number, frame) in list["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
        write_mask(&folder.join(format!("masks/m_{number}.png")), (SIDE, SIDE), left_half);
        frame["mask_path"] = json!(format!(r"masks\m_{number}.png"));
    }
    list["train_filenames"] = json!([r"images\a_1.png", r"images\a_2.png"]);
    list["test_filenames"] = json!([r"images\a_0.png"]);
    write_transforms(folder, &list);
}

fn windows_scene() -> Scene {
    let mut scene = Scene {
        train: views("a_#", 1..3),
        test: views("a_#", 0..1),
        notes: vec![
            "transforms.json (instant-ngp, nerfstudio): 3 photographs",
            r"6 file names found with slashes instead of backslashes (first: images\a_0.png is images/a_0.png)",
            "3 of 3 views have masks (3 by mask_path, where black is excluded)",
        ],
        further: Vec::new(),
    };
    for view in scene.train.iter_mut().chain(&mut scene.test) {
        view.mask = Some(left_half);
    }
    scene
}

/// Writes a file whose name contains a backslash, next to a folder with two other files.
fn backslash_in_a_name(folder: &Path) {
    write_photograph(&folder.join(r"images\a_0.png"), 0);
    write_photographs(folder, "images/a_#.png", 2);
    write_transforms(folder, &transforms(r"images\a_#.png", 2));
}

fn ambiguous_extension(folder: &Path) {
    write_frames(folder, "images/r_#", "images/r_#.jpg");
    write_photograph(&folder.join("images/r_1.png"), 1);
}

fn ambiguous_case(folder: &Path) {
    write_frames(folder, "images/FRAME_#.png", "images/frame_#.png");
    write_photograph(&folder.join("images/Frame_0.png"), 1);
}

/// Writes photographs and the hidden files that macOS leaves next to them.
fn hidden_files(folder: &Path) {
    write_photographs(folder, "images/IMG_#.png", 10);
    for number in 0..10 {
        write(folder.join(format!("images/._IMG_{number}.png")), "Mac OS X");
    }
    write(folder.join("images/.DS_Store"), "");
    write_llff(folder, &Vec::from_iter(0..10), [2.0, 6.0]);
}

/// Writes photographs named `files`, and COLMAP's model with `names`.
fn write_model(folder: &Path, names: &str, files: &str, count: usize) {
    write_colmap(&folder.join("sparse/0"), CAMERA, names, count);
    write_photographs(&folder.join("images"), files, count);
}

/// Writes photographs of two cameras with equal file names, and one with two spaces in its name.
fn camera_rig(folder: &Path) {
    let mut images = String::new();
    for (number, name) in ["back/1.jpg", "front/1.jpg", "front/A DJI  (2).png"].iter().enumerate() {
        images += &colmap_line(number, name);
        images += "\n";
        write_photograph(&folder.join("images").join(name), number);
    }
    write(folder.join("sparse/0/cameras.txt"), CAMERA);
    write(folder.join("sparse/0/images.txt"), images);
}

fn rig_scene() -> Scene {
    let mut scene = held_out("#", 3, &["COLMAP: 3 photographs from sparse/0"]);
    scene.test[0].name = "back_1".to_owned();
    scene.train[0].name = "front_1".to_owned();
    scene.train[1].name = "front_A DJI  (2)".to_owned();
    scene
}

/// Writes photographs named `files`, and Blender's two lists with `names`.
fn write_blender(folder: &Path, names: &str, files: &str) {
    let mut list: Value = transforms(names, 2);
    write_photographs(folder, files, 3);
    write(folder.join("transforms_train.json"), list.to_string());
    list["frames"] = json!([transforms(names, 3)["frames"][2]]);
    write(folder.join("transforms_test.json"), list.to_string());
}

fn blender_scene(notes: &[&'static str]) -> Scene {
    let mut all = vec!["Blender format: 2 training views, 1 test view"];
    all.extend(notes);
    Scene { train: views("r_#", 0..2), test: views("r_#", 2..3), notes: all, ..Scene::default() }
}

/// Returns the scene of ten views with the given names and notes.
fn ten_views(names: &str, notes: &[&'static str]) -> Expected {
    let mut all = vec![TEN_PHOTOGRAPHS];
    all.extend(notes);
    Expected::Scene(held_out(names, 10, &all))
}

pub(crate) fn cases() -> Vec<Case> {
    vec![
        case("ns#874: backslashes", windows, Expected::Scene(windows_scene())),
        case("a backslash in a name wins", backslash_in_a_name, {
            let mut scene = held_out(
                "a_#",
                2,
                &[
                    "transforms.json (instant-ngp, nerfstudio): 2 photographs",
                    r"1 file name found with slashes instead of backslashes (first: images\a_1.png is images/a_1.png)",
                ],
            );
            scene.test[0].name = r"images\a_0".to_owned();
            Expected::Scene(scene)
        }),
        case(
            "brush#269: Windows",
            |folder| write_frames(folder, r"C:\Users\x\scene\images\a_#.png", "images/a_#.png"),
            ten_views(
                "a_#",
                &[
                    r"10 file names found without the first 4 parts of their paths (first: C:\Users\x\scene\images\a_0.png is images/a_0.png)",
                ],
            ),
        ),
        case(
            "brush#269: Unix",
            |folder| write_frames(folder, "/home/x/scene/images/a_#.png", "images/a_#.png"),
            ten_views(
                "a_#",
                &[
                    "10 file names found without the first 3 parts of their paths (first: /home/x/scene/images/a_0.png is images/a_0.png)",
                ],
            ),
        ),
        case(
            "an absolute path of nothing here",
            |folder| write_frames(folder, "/home/x/b_#.png", "images/a_#.png"),
            Expected::Refused(
                "dataset: DIR/transforms.json: 10 images listed, none found (first missing: /home/x/b_0.png)",
            ),
        ),
        case(
            "a path out of the folder",
            |folder| write_frames(folder, "../data/images/a_#.png", "images/a_#.png"),
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 0 (../data/images/a_0.png): \"../data/images/a_0.png\" is not a path inside the folder; name a file in the folder, or move the list of names to the folder above, and give that folder",
            ),
        ),
        case(
            "brush PR#539: no extension",
            |folder| write_frames(folder, "images/r_#", "images/r_#.jpg"),
            ten_views(
                "r_#",
                &[
                    "10 file names found with a different extension (first: images/r_0 is images/r_0.jpg)",
                ],
            ),
        ),
        case(
            "brush PR#539: two files",
            ambiguous_extension,
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 1 (images/r_1): images/r_1.jpg and images/r_1.png both match \"images/r_1\"; remove one of the two, or name it exactly",
            ),
        ),
        case(
            "text2room#7: upper case",
            |folder| write_frames(folder, "images/r_#", "images/r_#.JPEG"),
            ten_views(
                "r_#",
                &[
                    "10 file names found with a different extension (first: images/r_0 is images/r_0.JPEG)",
                ],
            ),
        ),
        case(
            "BlenderNeRF#48: doubled on disk",
            |folder| write_frames(folder, "images/000#.png", "images/000#.png.png"),
            ten_views(
                "000#",
                &[
                    "10 file names found with a different extension (first: images/0000.png is images/0000.png.png)",
                ],
            ),
        ),
        case(
            "doubled in the file",
            |folder| write_frames(folder, "images/000#.jpg.jpg", "images/000#.jpg"),
            ten_views(
                "000#",
                &[
                    "10 file names found with a different extension (first: images/0000.jpg.jpg is images/0000.jpg)",
                ],
            ),
        ),
        case(
            "brush#172: case",
            |folder| write_frames(folder, "images/FRAME_#.png", "images/frame_#.png"),
            ten_views(
                "frame_#",
                &[
                    "10 file names found in a different case (first: images/FRAME_0.png is images/frame_0.png)",
                ],
            ),
        ),
        case(
            "brush#172: two files",
            ambiguous_case,
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 0 (images/FRAME_0.png): images/Frame_0.png and images/frame_0.png both match \"images/FRAME_0.png\"; remove one of the two, or name it exactly",
            ),
        ),
        case(
            "brush#172: COLMAP",
            |folder| write_model(folder, "A#.JPG", "A#.jpg", 3),
            Expected::Scene(held_out(
                "A#",
                3,
                &[
                    "COLMAP: 3 photographs from sparse/0",
                    "3 file names found in a different case (first: A0.JPG is images/A0.jpg)",
                ],
            )),
        ),
        case(
            "everything at once",
            |folder| write_frames(folder, r"D:\set\Images\R_#", "images/r_#.Jpg"),
            ten_views(
                "r_#",
                &[
                    r"10 file names found without the first 2 parts of their paths (first: D:\set\Images\R_0 is images/r_0.Jpg)",
                    r"10 file names found with a different extension (first: D:\set\Images\R_0 is images/r_0.Jpg)",
                    r"10 file names found in a different case (first: D:\set\Images\R_0 is images/r_0.Jpg)",
                ],
            ),
        ),
        case("LLFF#36: hidden files", hidden_files, {
            Expected::Scene(held_out(
                "IMG_#",
                10,
                &["LLFF (poses_bounds.npy): 10 photographs from images"],
            ))
        }),
        case("LFS#810, LFS#1422: spaces and folders", camera_rig, Expected::Scene(rig_scene())),
        case(
            "COLMAP's names from the folder above",
            |folder| write_model(folder, "images/a#.png", "a#.png", 2),
            Expected::Scene(held_out("a#", 2, &["COLMAP: 2 photographs from sparse/0"])),
        ),
        case(
            "Blender as usual",
            |folder| write_blender(folder, "./train/r_#", "train/r_#.png"),
            Expected::Scene(blender_scene(&[])),
        ),
        case(
            "Blender moved",
            |folder| write_blender(folder, "/data/lego/train/r_#", "train/r_#.jpg"),
            Expected::Scene(blender_scene(&[
                "3 file names found without the first 2 parts of their paths (first: /data/lego/train/r_0 is train/r_0.jpg)",
                "3 file names found with a different extension (first: /data/lego/train/r_0 is train/r_0.jpg)",
            ])),
        ),
        case(
            "Blender without an image",
            |folder| write_blender(folder, "./train/r_#", "train/x_#.png"),
            Expected::Refused(
                "dataset: DIR/transforms_train.json: frame 0 (./train/r_0): DIR/train/r_0.png not found; restore or rename the file, or remove its entry",
            ),
        ),
    ]
}
