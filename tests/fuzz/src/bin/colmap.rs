//! Fuzzes one file of a COLMAP model, binary or text; the first byte selects the file.
#![no_main]

use std::sync::LazyLock;

use fuzz::{Folder, colmap_model};
use libfuzzer_sys::fuzz_target;

static FOLDERS: LazyLock<[Folder; 2]> = LazyLock::new(|| {
    let [binary, text] = [Folder::new(), Folder::new()];
    for (name, bytes) in colmap_model() {
        binary.write(&format!("sparse/0/{name}"), bytes);
    }
    text.write("sparse/0/cameras.txt", b"1 PINHOLE 4 3 5 5 2 1.5\n");
    text.write(
        "sparse/0/images.txt",
        b"1 1 0 0 0 0.1 0.2 1 1 a.png\n\n2 1 0 0 0 0.1 0.2 2 1 b.png\n\n",
    );
    text.write("sparse/0/points3D.txt", b"1 0 0 5 9 9 9 0.5 1 0\n");
    [binary, text]
});

fuzz_target!(|data: &[u8]| {
    let Some((which, rest)) = data.split_first() else { return };
    let (folder, end) = if which & 4 == 0 { (&FOLDERS[0], "bin") } else { (&FOLDERS[1], "txt") };
    let name = ["cameras", "images", "points3D", "images"][usize::from(which & 3)];
    let file = format!("sparse/0/{name}.{end}");
    let before = std::fs::read(folder.path(&file)).expect("a whole model");
    folder.write(&file, rest);
    folder.read();
    folder.write(&file, &before);
});
