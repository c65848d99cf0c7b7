//! Shared code of the fuzz targets: a data set in a folder, one file of which is the fuzzer's
//! input.

use std::path::{Path, PathBuf};

use dataset::Dataset;
use scene::{Camera, Distortion, Intrinsics, Projection};

/// Width and height of the images, in pixels.
const SIZE: (usize, usize) = (4, 3);

/// Folder of a data set with `images/a.png` and `images/b.png`; in `/dev/shm` if that exists, since
/// a target writes files in every run.
pub struct Folder(tempfile::TempDir);

impl Folder {
    /// Creates a folder with only the images.
    pub fn new() -> Self {
        let memory = Path::new("/dev/shm");
        let dir = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        let folder = Self(dir.expect("a temporary folder"));
        let image = pixels::Rgba8::new(SIZE.0, SIZE.1, vec![128; 4 * SIZE.0 * SIZE.1]);
        for name in ["a", "b"] {
            folder.write(&format!("images/{name}.png"), &pixels::encode_png(&image));
        }
        folder
    }

    /// Returns the path of a file in the folder.
    pub fn path(&self, file: &str) -> PathBuf {
        self.0.path().join(file)
    }

    /// Writes a file in the folder.
    pub fn write(&self, file: &str, bytes: &[u8]) {
        let path = self.path(file);
        std::fs::create_dir_all(path.parent().expect("inside the folder")).expect("a folder");
        std::fs::write(path, bytes).expect("a file");
    }

    /// Reads the data set and its first images. Errors are ignored: only a panic, a hang or
    /// excessive memory is a finding.
    pub fn read(&self) {
        if let Ok(set) = Dataset::read(self.0.path()) {
            // Lenses as `prep` treats them.
            drop(set.clone().with_lens_mask_note());
            if let Ok(undone) = set.clone().undistorted() {
                undone.frames.iter().take(2).for_each(|frame| drop(frame.photograph()));
            }
            for frame in &set.frames {
                let mask = frame.mask.as_ref().map(|mask| &mask.path);
                let files = [Some(&frame.image), mask, frame.depth_file.as_ref()];
                for file in files.into_iter().flatten() {
                    self.check_inside(file);
                }
            }
            for frame in set.frames.iter().take(2) {
                frame.reading_bytes().ok();
                frame.photograph().ok();
                if let Ok(Some(mask)) = frame.mask() {
                    let size = (
                        frame.lens_intrinsics.width as usize,
                        frame.lens_intrinsics.height as usize,
                    );
                    assert_eq!((mask.width, mask.height), size, "a mask has its image's size");
                }
                frame.camera().check().ok();
            }
        }
    }

    /// Fails if a file that the data set names is outside the folder.
    fn check_inside(&self, file: &Path) {
        let found = file.canonicalize().expect("a file that was looked at");
        let folder = self.0.path().canonicalize().expect("the folder");
        assert!(found.starts_with(folder), "{}", found.display());
    }
}

impl Default for Folder {
    fn default() -> Self {
        Self::new()
    }
}

/// Returns a camera at the origin whose lens parameters are read from `bytes`. Bit 0 of `which`
/// selects a fisheye lens; bit 1 selects arbitrary f64 values instead of numbers from -1 to 1.
pub fn lens_camera(which: u8, bytes: &[u8]) -> Camera {
    let mut numbers = bytes.chunks(8).map(|chunk| {
        let mut word = [0; 8];
        word[..chunk.len()].copy_from_slice(chunk);
        let wide = f64::from_le_bytes(word);
        let tame = i64::from_le_bytes(word) as f64 / i64::MAX as f64;
        if which & 2 == 0 { tame } else { wide }
    });
    let mut next = || numbers.next().unwrap_or(0.0);
    let projection = if which & 1 == 0 { Projection::Perspective } else { Projection::Fisheye };
    let radial = [0; 4].map(|_| next());
    let tangential = [0; 2].map(|_| 0.01 * next());
    let denominator = [0; 3].map(|_| next());
    let distortion = Distortion { projection, radial, tangential, denominator };
    let focal = [0; 2].map(|_| 16.0 * (1.1 + next()));
    let [cx, cy] = [16.0, 12.0].map(|middle| middle * (1.0 + next()));
    let intrinsics =
        Intrinsics { width: 32, height: 24, fx: focal[0], fy: focal[1], cx, cy, distortion };
    let camera_to_world = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.]];
    Camera { name: "a".to_owned(), intrinsics, camera_to_world }
}

/// Returns the three files of a binary COLMAP model with two views: the seeds of `seeds.py` without
/// their first byte, which selects the file.
pub fn colmap_model() -> [(&'static str, &'static [u8]); 3] {
    macro_rules! seed {
        ($which:literal) => {
            include_bytes!(concat!(env!("FUZZ_SEEDS"), "/colmap/binary-", $which)).split_at(1).1
        };
    }
    [("cameras.bin", seed!("0")), ("images.bin", seed!("1")), ("points3D.bin", seed!("2"))]
}

/// Returns a `poses_bounds.npy` with two views: the seed of `seeds.py`.
pub fn poses_of_llff() -> &'static [u8] {
    include_bytes!(concat!(env!("FUZZ_SEEDS"), "/llff/two"))
}
