//! Fuzzes a photograph as PNG, JPEG or EXR; the first byte selects the format.
#![no_main]

use std::sync::LazyLock;

use fuzz::Folder;
use libfuzzer_sys::fuzz_target;

static FOLDERS: LazyLock<[(Folder, &str); 3]> = LazyLock::new(|| {
    ["png", "jpg", "exr"].map(|end| {
        let folder = Folder::new();
        let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
        let text = format!(
            "{{\"camera_angle_x\": 0.7, \"frames\": [{{\"file_path\": \"images/c.{end}\", \"transform_matrix\": {pose}}}]}}"
        );
        folder.write("transforms.json", text.as_bytes());
        (folder, end)
    })
});

fuzz_target!(|data: &[u8]| {
    let Some((which, rest)) = data.split_first() else { return };
    let (folder, end) = &FOLDERS[usize::from(*which) % 3];
    let file = format!("images/c.{end}");
    folder.write(&file, rest);
    folder.read();
    // Stages read images of other stages by these functions.
    if *end == "exr" {
        pixels::read_exr(&folder.path(&file)).ok();
    }
    if *end != "jpg" {
        pixels::read_premultiplied(&folder.path(&file)).ok();
    }
});
