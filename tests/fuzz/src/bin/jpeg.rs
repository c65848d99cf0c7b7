//! Fuzzes a JPEG photograph, complete and truncated; the first byte is the truncated length in
//! units of 1/256. A truncated file must be refused or have the pixels of the complete one.
#![no_main]

use std::sync::LazyLock;

use dataset::Dataset;
use fuzz::Folder;
use libfuzzer_sys::fuzz_target;
use pixels::Rgba8;

static FOLDER: LazyLock<Folder> = LazyLock::new(|| {
    let folder = Folder::new();
    let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
    let text = format!(
        "{{\"camera_angle_x\": 0.7, \"frames\": [{{\"file_path\": \"images/c.jpg\", \"transform_matrix\": {pose}}}]}}"
    );
    folder.write("transforms.json", text.as_bytes());
    folder
});

fn photograph(jpeg: &[u8]) -> Option<Rgba8> {
    FOLDER.write("images/c.jpg", jpeg);
    FOLDER.read();
    Dataset::read(&FOLDER.path("")).ok()?.frames[0].photograph().ok()
}

fuzz_target!(|data: &[u8]| {
    let Some((cut, jpeg)) = data.split_first() else { return };
    let end = jpeg.len() * usize::from(*cut) / 256;
    if let (Some(whole), Some(short)) = (photograph(jpeg), photograph(&jpeg[..end])) {
        assert!(whole == short, "a JPEG that is cut short has other pixels");
    }
});
