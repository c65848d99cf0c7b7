//! Fuzzes a JPEG photograph.
#![no_main]

use std::sync::LazyLock;

use fuzz::Folder;
use libfuzzer_sys::fuzz_target;

static FOLDER: LazyLock<Folder> = LazyLock::new(|| {
    let folder = Folder::new();
    let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
    let text = format!(
        "{{\"camera_angle_x\": 0.7, \"frames\": [{{\"file_path\": \"images/c.jpg\", \"transform_matrix\": {pose}}}]}}"
    );
    folder.write("transforms.json", text.as_bytes());
    folder
});

fuzz_target!(|jpeg: &[u8]| {
    FOLDER.write("images/c.jpg", jpeg);
    FOLDER.read();
});
