//! Fuzzes `poses_bounds.npy`: the NumPy format and LLFF's array in it.
#![no_main]

use std::sync::LazyLock;

use fuzz::Folder;
use libfuzzer_sys::fuzz_target;

static FOLDER: LazyLock<Folder> = LazyLock::new(Folder::new);

fuzz_target!(|data: &[u8]| {
    FOLDER.write("poses_bounds.npy", data);
    FOLDER.read();
});
