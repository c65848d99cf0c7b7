//! Fuzzes a photograph's mask as PNG, JPEG or EXR; the first byte selects the format.
#![no_main]

use std::sync::LazyLock;

use fuzz::Folder;
use libfuzzer_sys::fuzz_target;

static FOLDERS: LazyLock<[(Folder, &str); 3]> = LazyLock::new(|| {
    ["png", "jpg", "exr"].map(|end| {
        let folder = Folder::new();
        let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
        let text = format!(
            "{{\"camera_angle_x\": 0.7, \"frames\": [{{\"file_path\": \"images/a.png\", \"mask_path\": \"images/m.{end}\", \"transform_matrix\": {pose}}}]}}"
        );
        folder.write("transforms.json", text.as_bytes());
        (folder, end)
    })
});

fuzz_target!(|data: &[u8]| {
    let Some((which, rest)) = data.split_first() else { return };
    let (folder, end) = &FOLDERS[usize::from(*which) % 3];
    let file = format!("images/m.{end}");
    folder.write(&file, rest);
    folder.read();
    // Stages read masks of other stages by this function.
    if *end == "png"
        && let Ok(mask) = pixels::Mask::read(&folder.path(&file), (4, 3))
    {
        assert_eq!(mask.resized((2, 2), 1).counts.len(), 4);
    }
});
