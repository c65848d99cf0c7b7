//! Posed photographs as folders have them. The form is found by looking: [`Dataset::read`] takes
//!
//! * **Blender** (NeRF's synthetic scenes): `transforms_train.json`, `transforms_test.json` if
//!   there are test views, one angle for all, PNG;
//! * **transforms** (instant-ngp, nerfstudio): `transforms.json`, intrinsics for all or for each,
//!   lens distortion, masks;
//! * **LLFF**: `poses_bounds.npy` beside `images` (or `images_4`, `images_8`, …);
//! * **COLMAP**: `sparse/0` and so on, binary or text, beside `images`; of several models the one
//!   with most images.
//!
//! A [`Frame`] has its camera in this project's conventions (OpenGL axes, pixels from the top left
//! corner, scene units) and its lens's distortion; [`Frame::photograph`] reads its image, upright
//! as its poses have it. [`Dataset::undistorted`] has images read as pinhole cameras would have
//! taken them.
//!
//! Units: lengths are those of the poses; pixels count from the stored image's top left corner,
//! whose first pixel has its centre at (0.5, 0.5). Everything a file says is checked: sizes before
//! anything is allocated, paths before anything is opened.
//!
//! ```no_run
//! let set = dataset::Dataset::read("my-photographs".as_ref())?;
//! println!("{}: {} photographs", set.format, set.frames.len());
//! let (image, camera) = (set.frames[0].photograph()?, set.frames[0].camera());
//! # Ok::<(), dataset::DatasetError>(())
//! ```

mod blender;
mod bytes;
mod colmap;
mod found;
mod frame;
mod llff;
mod number;
mod photograph;
mod split;
mod text;
mod transforms;

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use artifact::{counted, printable};

use found::{Found, find, shown};
pub use frame::Frame;
pub use split::Split;

/// Posed photographs.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// How the folder has them.
    pub format: Format,
    /// All of them: in the file's order, or by name where a file has none.
    pub frames: Vec<Frame>,
    /// What the folder itself says of which are for training and which for testing.
    pub split: Option<Split>,
    /// What was found and chosen, a line each, for people.
    pub notes: Vec<String>,
}

/// Forms of folders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `transforms_train.json`, and `transforms_test.json` where some views are for testing.
    Blender,
    /// `transforms.json`.
    Transforms,
    /// `poses_bounds.npy`.
    Llff,
    /// `sparse/N`.
    Colmap,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Blender => "blender",
            Self::Transforms => "transforms",
            Self::Llff => "llff",
            Self::Colmap => "colmap",
        })
    }
}

/// A data set that can't be used.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder has none of the forms.
    #[error(
        "{}: no data set; expected transforms_train.json (Blender), transforms.json (instant-ngp, \
        nerfstudio), poses_bounds.npy \
         (LLFF), or sparse/0 (COLMAP)",
        shown(path)
    )]
    Unknown {
        /// The folder.
        path: PathBuf,
    },
    /// A file can't be read.
    #[error("{}: {source}", shown(path))]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A file can't be where something else stands.
    #[error("{reason}")]
    Place {
        /// What stands where, and what was expected.
        reason: String,
    },
    /// A file isn't of its form.
    #[error("{}: {}", shown(path), printable(reason))]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong, with its place, and what to do.
        reason: String,
    },
    /// Something about one frame.
    #[error("{}: frame {index} ({}): {}", shown(path), printable(file), printable(reason))]
    Frame {
        /// The file that lists the frames.
        path: PathBuf,
        /// The frame, counted from 0.
        index: usize,
        /// What that file calls it.
        file: String,
        /// What is wrong and what to do.
        reason: String,
    },
    /// An image that can't be read.
    #[error("{}", printable(&.0.to_string()))]
    Pixels(pixels::PixelError),
}

// Not its source: whoever prints a chain of errors would print a file's name as it is.
impl From<pixels::PixelError> for DatasetError {
    fn from(error: pixels::PixelError) -> Self {
        Self::Pixels(error)
    }
}

impl DatasetError {
    fn format(path: &Path, reason: impl Into<String>) -> Self {
        Self::Format { path: path.to_path_buf(), reason: reason.into() }
    }
}

impl Dataset {
    /// Reads a folder, whichever form it has. Images are looked at for their size alone.
    pub fn read(folder: &Path) -> Result<Self, DatasetError> {
        // The most explicit form first: a folder often has what its poses were made from, too.
        let mut set = if is_file(&folder.join("transforms_train.json"))? {
            blender::read(folder)?
        } else if is_file(&folder.join("transforms.json"))? {
            transforms::read(folder)?
        } else if is_file(&folder.join("poses_bounds.npy"))? {
            llff::read(folder)?
        } else if let Some(models) = colmap::models(folder) {
            colmap::read(folder, &models)?
        } else {
            return Err(DatasetError::Unknown { path: folder.to_path_buf() });
        };
        set.note_what_is_special();
        for note in &mut set.notes {
            *note = printable(note).into_owned();
        }
        Ok(set)
    }

    /// All frames together, whatever the folder itself says of their use. Blender's training and
    /// test views have the same names: then the one for testing is called `test_NAME`.
    #[must_use]
    pub fn merged(mut self) -> Self {
        let split = self.split.take().unwrap_or_default();
        let mut taken: std::collections::BTreeSet<String> =
            split.train.iter().map(|&i| self.frames[i].name.clone()).collect();
        for &i in &split.test {
            let name = &mut self.frames[i].name;
            while !taken.insert(name.clone()) {
                *name = format!("test_{name}");
            }
        }
        self
    }

    /// Has images read with their lens's distortion undone: resampled to what pinhole cameras would
    /// have taken, of the same size, with a border cut off where the lens saw no more.
    pub fn undistorted(mut self) -> Result<Self, DatasetError> {
        let mut undone = 0;
        for frame in self.frames.iter_mut().filter(|f| !f.taken_with.distortion.is_none()) {
            undone += 1;
            let pinhole = frame.taken_with.pinhole().ok_or_else(|| {
                let reason = format!(
                    "lens distortion {} leaves no pinhole's image; are its coefficients right?",
                    frame.taken_with.distortion
                );
                DatasetError::format(&frame.image, reason)
            })?;
            frame.pinhole = Some(pinhole);
        }
        if undone > 0 {
            self.notes
                .push(format!("lens distortion of {} is undone", counted(undone, "photograph")));
        }
        Ok(self)
    }

    /// Takes all lenses for free of distortion.
    #[must_use]
    pub fn without_distortion(mut self) -> Self {
        let mut ignored = 0;
        for frame in self.frames.iter_mut().filter(|f| !f.taken_with.distortion.is_none()) {
            frame.taken_with.distortion = scene::Distortion::default();
            ignored += 1;
        }
        if ignored > 0 {
            self.notes
                .push(format!("lens distortion of {} is ignored", counted(ignored, "photograph")));
        }
        self
    }

    /// Says what is done to images that aren't all alike, upright and from a pinhole.
    fn note_what_is_special(&mut self) {
        let count = |is: &dyn Fn(&Frame) -> bool| self.frames.iter().filter(|f| is(f)).count();
        let (distorted, turned) =
            (count(&|f| !f.taken_with.distortion.is_none()), count(&|f| f.turned));
        let size = |f: &Frame| (f.taken_with.width, f.taken_with.height);
        let sizes: std::collections::BTreeSet<_> = self.frames.iter().map(size).collect();
        if distorted > 0 {
            let have = if distorted == 1 { "has" } else { "have" };
            self.notes.push(format!("{} {have} lens distortion", counted(distorted, "photograph")));
        }
        if turned > 0 {
            let are = if turned == 1 { "is" } else { "are" };
            self.notes.push(format!(
                "{} {are} turned upright, as EXIF data ask",
                counted(turned, "photograph")
            ));
        }
        if let (Some(first), Some(last), true) = (sizes.first(), sizes.last(), sizes.len() > 1) {
            let text = |(w, h): &(u32, u32)| format!("{w}×{h}");
            self.notes.push(format!(
                "photographs of {} sizes, from {} to {}",
                sizes.len(),
                text(first),
                text(last)
            ));
        }
    }
}

/// Whether a file is there; something else in its place is refused.
fn is_file(path: &Path) -> Result<bool, DatasetError> {
    match find(path, "a file") {
        Found::File => Ok(true),
        Found::Nothing(_) => Ok(false),
        Found::Other(reason) => Err(DatasetError::Place { reason }),
    }
}
