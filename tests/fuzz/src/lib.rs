//! What the targets share: a folder of one data set, in which one file is the fuzzer's.

use std::path::{Path, PathBuf};

use dataset::Dataset;

/// A 4×3 picture, as PNG.
const PICTURE: (usize, usize) = (4, 3);

/// A folder in memory where there is one, with `images/a.png` and `images/b.png`.
pub struct Folder(tempfile::TempDir);

impl Folder {
    /// An empty one, with pictures.
    pub fn new() -> Self {
        let memory = Path::new("/dev/shm");
        let dir = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        let folder = Self(dir.expect("a temporary folder"));
        let picture = pixels::Rgba8::new(PICTURE.0, PICTURE.1, vec![128; 4 * PICTURE.0 * PICTURE.1]);
        for name in ["a", "b"] {
            folder.write(&format!("images/{name}.png"), &pixels::encode_png(&picture));
        }
        folder
    }

    /// Where a file of it lies.
    pub fn path(&self, file: &str) -> PathBuf {
        self.0.path().join(file)
    }

    /// Writes one file.
    pub fn write(&self, file: &str, bytes: &[u8]) {
        let path = self.path(file);
        std::fs::create_dir_all(path.parent().expect("inside the folder")).expect("a folder");
        std::fs::write(path, bytes).expect("a file");
    }

    /// Reads the data set and its first pictures. Errors are what is expected; a panic, a hang or much memory isn't.
    pub fn read(&self) {
        if let Ok(set) = Dataset::read(self.0.path()) {
            for frame in set.frames.iter().take(2) {
                // Nothing that a file names may lie outside the folder.
                let image = frame.image.canonicalize().expect("a picture that was looked at");
                assert!(image.starts_with(self.0.path().canonicalize().expect("the folder")), "{}", image.display());
                frame.photograph().ok();
            }
        }
    }
}

impl Default for Folder {
    fn default() -> Self {
        Self::new()
    }
}

/// A COLMAP model's three files, binary, of two views.
pub fn colmap_model() -> [(&'static str, Vec<u8>); 3] {
    let mut cameras = 1u64.to_le_bytes().to_vec();
    cameras.extend([1u32, 1].map(u32::to_le_bytes).concat());
    cameras.extend([4u64, 3].map(u64::to_le_bytes).concat());
    cameras.extend([5.0f64, 5.0, 2.0, 1.5].map(f64::to_le_bytes).concat());
    let mut images = 2u64.to_le_bytes().to_vec();
    for (id, name) in [(1u32, b"a.png\0"), (2, b"b.png\0")] {
        images.extend(id.to_le_bytes());
        images.extend([1.0f64, 0.0, 0.0, 0.0, 0.1, 0.2, f64::from(id)].map(f64::to_le_bytes).concat());
        images.extend(1u32.to_le_bytes());
        images.extend(name);
        images.extend(1u64.to_le_bytes());
        images.extend([1.0f64, 1.0].map(f64::to_le_bytes).concat());
        images.extend(1u64.to_le_bytes());
    }
    let mut points = 1u64.to_le_bytes().to_vec();
    points.extend(1u64.to_le_bytes());
    points.extend([0.0f64, 0.0, 5.0].map(f64::to_le_bytes).concat());
    points.extend([9u8, 9, 9]);
    points.extend(0.5f64.to_le_bytes());
    points.extend(1u64.to_le_bytes());
    points.extend([1u32, 0].map(u32::to_le_bytes).concat());
    [("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", points)]
}
