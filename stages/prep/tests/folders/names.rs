//! File names from other machines and programs.

use std::path::Path;

use serde_json::{Value, json};

use super::kit::{
    CAMERA, Case, Expected, SIDE, Scene, case, colmap_line, held_out, left_half, transforms, views,
    write, write_colmap, write_llff, write_mask, write_photograph, write_photographs,
    write_transforms,
};

fn named(folder: &Path, names: &str, files: &str) {
    write_photographs(folder, files, 10);
    write_transforms(folder, &transforms(names, 10));
}

const TEN: &str = "transforms.json (instant-ngp, nerfstudio): 10 photographs";

/// A set made on Windows: backslashes in all names.
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

/// A file whose name has a backslash, next to one in a folder.
fn with_backslash(folder: &Path) {
    write_photograph(&folder.join(r"images\a_0.png"), 0);
    write_photographs(folder, "images/a_#.png", 2);
    write_transforms(folder, &transforms(r"images\a_#.png", 2));
}

fn ambiguous_extension(folder: &Path) {
    named(folder, "images/r_#", "images/r_#.jpg");
    write_photograph(&folder.join("images/r_1.png"), 1);
}

fn ambiguous_case(folder: &Path) {
    named(folder, "images/FRAME_#.png", "images/frame_#.png");
    write_photograph(&folder.join("images/Frame_0.png"), 1);
}

/// Hidden files that macOS and other systems leave in folders.
fn hidden(folder: &Path) {
    write_photographs(folder, "images/IMG_#.png", 10);
    for number in 0..10 {
        write(folder.join(format!("images/._IMG_{number}.png")), "Mac OS X");
    }
    write(folder.join("images/.DS_Store"), "");
    write_llff(folder, &Vec::from_iter(0..10), [2.0, 6.0]);
}

fn colmap(folder: &Path, names: &str, files: &str, count: usize) {
    write_colmap(&folder.join("sparse/0"), CAMERA, names, count);
    write_photographs(&folder.join("images"), files, count);
}

/// Two cameras with the same file names, and a name with two spaces.
fn rig(folder: &Path) {
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

/// Blender's files name images without an extension.
fn blender(folder: &Path, names: &str, files: &str) {
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

fn read(names: &str, notes: &[&'static str]) -> Expected {
    let mut all = vec![TEN];
    all.extend(notes);
    Expected::Scene(held_out(names, 10, &all))
}

pub(crate) fn cases() -> Vec<Case> {
    vec![
        case("ns#874: backslashes", windows, Expected::Scene(windows_scene())),
        case("a backslash in a name wins", with_backslash, {
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
            |folder| named(folder, r"C:\Users\x\scene\images\a_#.png", "images/a_#.png"),
            read(
                "a_#",
                &[
                    r"10 file names found without the first 4 parts of absolute paths (first: C:\Users\x\scene\images\a_0.png is images/a_0.png)",
                ],
            ),
        ),
        case(
            "brush#269: Unix",
            |folder| named(folder, "/home/x/scene/images/a_#.png", "images/a_#.png"),
            read(
                "a_#",
                &[
                    "10 file names found without the first 3 parts of absolute paths (first: /home/x/scene/images/a_0.png is images/a_0.png)",
                ],
            ),
        ),
        case(
            "an absolute path of nothing here",
            |folder| named(folder, "/home/x/b_#.png", "images/a_#.png"),
            Expected::Refused(
                "dataset: DIR/transforms.json: none of the 10 images exists (first missing: /home/x/b_0.png)",
            ),
        ),
        case(
            "a path out of the folder",
            |folder| named(folder, "../data/images/a_#.png", "images/a_#.png"),
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 0 (../data/images/a_0.png): \"../data/images/a_0.png\" is not a path inside the folder",
            ),
        ),
        case(
            "brush PR#539: no extension",
            |folder| named(folder, "images/r_#", "images/r_#.jpg"),
            read(
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
            |folder| named(folder, "images/r_#", "images/r_#.JPEG"),
            read(
                "r_#",
                &[
                    "10 file names found with a different extension (first: images/r_0 is images/r_0.JPEG)",
                ],
            ),
        ),
        case(
            "BlenderNeRF#48: doubled on disk",
            |folder| named(folder, "images/000#.png", "images/000#.png.png"),
            read(
                "000#",
                &[
                    "10 file names found with a different extension (first: images/0000.png is images/0000.png.png)",
                ],
            ),
        ),
        case(
            "doubled in the file",
            |folder| named(folder, "images/000#.jpg.jpg", "images/000#.jpg"),
            read(
                "000#",
                &[
                    "10 file names found with a different extension (first: images/0000.jpg.jpg is images/0000.jpg)",
                ],
            ),
        ),
        case(
            "brush#172: case",
            |folder| named(folder, "images/FRAME_#.png", "images/frame_#.png"),
            read(
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
            |folder| colmap(folder, "A#.JPG", "A#.jpg", 3),
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
            |folder| named(folder, r"D:\set\Images\R_#", "images/r_#.Jpg"),
            read(
                "r_#",
                &[
                    r"10 file names found without the first 2 parts of absolute paths (first: D:\set\Images\R_0 is images/r_0.Jpg)",
                    r"10 file names found with a different extension (first: D:\set\Images\R_0 is images/r_0.Jpg)",
                    r"10 file names found in a different case (first: D:\set\Images\R_0 is images/r_0.Jpg)",
                ],
            ),
        ),
        case("LLFF#36: hidden files", hidden, {
            Expected::Scene(held_out(
                "IMG_#",
                10,
                &["LLFF (poses_bounds.npy): 10 photographs from images"],
            ))
        }),
        case("LFS#810, LFS#1422: spaces and folders", rig, Expected::Scene(rig_scene())),
        case(
            "COLMAP's names from the folder above",
            |folder| colmap(folder, "images/a#.png", "a#.png", 2),
            Expected::Scene(held_out("a#", 2, &["COLMAP: 2 photographs from sparse/0"])),
        ),
        case(
            "Blender as usual",
            |folder| blender(folder, "./train/r_#", "train/r_#.png"),
            Expected::Scene(blender_scene(&[])),
        ),
        case(
            "Blender moved",
            |folder| blender(folder, "/data/lego/train/r_#", "train/r_#.jpg"),
            Expected::Scene(blender_scene(&[
                "3 file names found without the first 2 parts of absolute paths (first: /data/lego/train/r_0 is train/r_0.jpg)",
                "3 file names found with a different extension (first: /data/lego/train/r_0 is train/r_0.jpg)",
            ])),
        ),
        case(
            "Blender without an image",
            |folder| blender(folder, "./train/r_#", "train/x_#.png"),
            Expected::Refused(
                "dataset: DIR/transforms_train.json: frame 0 (./train/r_0): DIR/train/r_0.png not found; remove the frame or restore the file",
            ),
        ),
    ]
}
