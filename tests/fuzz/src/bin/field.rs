//! Fuzzes the weights of a field, a safetensors file.
#![no_main]

use std::sync::LazyLock;

use fuzz::Folder;
use libfuzzer_sys::fuzz_target;
use radiance::{Architecture, Field};
use scene::Bounds;

static FOLDER: LazyLock<Folder> = LazyLock::new(Folder::new);

fuzz_target!(|data: &[u8]| {
    FOLDER.write("field.safetensors", data);
    let architecture = Architecture {
        n_levels: 1,
        base_resolution: 2,
        max_resolution: 2,
        log2_hashmap_size: 8,
        hidden_dim: 16,
        ..Architecture::default()
    };
    let bounds = Bounds::cube(1.0, 1.0, 5.0);
    Field::read(&FOLDER.path("field.safetensors"), architecture, bounds).ok();
});
