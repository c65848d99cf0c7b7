//! Fuzzes file names in a data set: the lines of the input are names in a `transforms.json`, in
//! COLMAP's list of images, or in LLFF's list of views. The first byte selects the list.
#![no_main]

use std::sync::LazyLock;

use fuzz::{Folder, poses_of_llff};
use libfuzzer_sys::fuzz_target;
use serde_json::json;

/// One folder per data set format, with files whose names are easily confused.
static FOLDERS: LazyLock<[Folder; 3]> = LazyLock::new(|| {
    let folders = [Folder::new(), Folder::new(), Folder::new()];
    for folder in &folders {
        let image = std::fs::read(folder.path("images/a.png")).expect("an image");
        for file in [
            "images/a.png.png",
            "images/A.PNG",
            "images/c.JPG",
            "images/d",
            "images/.e.png",
            "images/dynamic_mask_b.png",
            "images/x/b.png",
            "images\\b.png",
            "images_2/a.jpg",
            "images_4/f.png",
            "masks/a.png",
            "masks/b.png.png",
            "Masks/x/b.png",
            "a_mask.png",
            "home/images/a.png",
        ] {
            folder.write(file, &image);
        }
    }
    folders[1].write("sparse/0/cameras.txt", b"1 PINHOLE 4 3 5 5 2 1.5\n");
    folders[2].write("poses_bounds.npy", poses_of_llff());
    folders
});

/// Returns a `transforms.json`. Lines before the first empty line are frames: image, mask and depth
/// image, separated by tabs. The next three paragraphs are the lists of file names by split.
fn transforms(text: &str) -> String {
    let pose = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]);
    let mut lists = text.split("\n\n");
    let frames: Vec<_> = lists
        .next()
        .unwrap_or_default()
        .lines()
        .map(|line| {
            let mut names = line.split('\t');
            json!({"file_path": names.next(), "transform_matrix": pose, "mask_path": names.next(),
                "depth_file_path": names.next()})
        })
        .collect();
    let mut list = || lists.next().map(|names| names.lines().collect::<Vec<_>>());
    json!({"fl_x": 5, "frames": frames, "train_filenames": list(), "val_filenames": list(),
        "test_filenames": list()})
    .to_string()
}

fuzz_target!(|data: &[u8]| {
    let Some((which, data)) = data.split_first() else { return };
    let Ok(text) = std::str::from_utf8(data) else { return };
    let which = usize::from(*which) % 3;
    let folder = &FOLDERS[which];
    match which {
        0 => folder.write("transforms.json", transforms(text).as_bytes()),
        1 => {
            let images: String = text
                .lines()
                .enumerate()
                .map(|(i, name)| format!("{} 1 0 0 0 0 0.1 {i} 1 {name}\n\n", i + 1))
                .collect();
            folder.write("sparse/0/images.txt", images.as_bytes());
        }
        _ => folder.write("view_imgs.txt", data),
    }
    folder.read();
});
