//! Reads folders of posed photographs. [`Dataset::read`] recognises a folder's [`Format`] by the
//! folder's files; `FORMS` lists which format goes first.
//!
//! A new form is a module with its reader and, in this file, a variant of [`Format`] and an entry
//! of `FORMS`. What readers share is in `found`, `frame`, `photograph` and `text`.
//!
//! A [`Frame`] has its camera in this project's conventions (OpenGL axes, pixels from the top left
//! corner, scene units) and its lens's distortion; [`Frame::photograph`] reads the
//! image, and turns it as EXIF asks only where the camera's width and height require this. After
//! [`Dataset::undistorted`], images are read with the lens distortion removed.
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
mod npy;
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
    /// NeRF's synthetic scenes: `transforms_train.json`, `transforms_test.json` if there are test
    /// views, one angle for all, PNG.
    Blender,
    /// instant-ngp's and nerfstudio's: `transforms.json`, intrinsics for all or for each, lens
    /// distortion, masks.
    Transforms,
    /// LLFF's: `poses_bounds.npy` beside `images` (or `images_4`, `images_8`, …).
    Llff,
    /// COLMAP's: `sparse/0` and so on, binary or text, beside `images`; of several models the one
    /// with most images.
    Colmap,
}

/// What is known of a form.
struct Form {
    format: Format,
    /// As `Display` has it.
    name: &'static str,
    /// What a folder that has it is called.
    title: &'static str,
    /// What a folder that has none should have.
    sign: &'static str,
    is_benchmark: bool,
    is_present: fn(&Path) -> Result<bool, DatasetError>,
    read: fn(&Path) -> Result<Dataset, DatasetError>,
}

/// The most explicit first: a folder often has what its poses were made from, too.
const FORMS: &[Form] = &[
    Form {
        format: Format::Blender,
        name: "blender",
        title: "Blender's form (transforms_train.json)",
        sign: "transforms_train.json (Blender)",
        is_benchmark: true,
        is_present: |folder| is_file(&folder.join("transforms_train.json")),
        read: blender::read,
    },
    Form {
        format: Format::Transforms,
        name: "transforms",
        title: "transforms.json (instant-ngp, nerfstudio)",
        sign: "transforms.json (instant-ngp, nerfstudio)",
        is_benchmark: false,
        is_present: |folder| is_file(&folder.join("transforms.json")),
        read: transforms::read,
    },
    Form {
        format: Format::Llff,
        name: "llff",
        title: "LLFF (poses_bounds.npy)",
        sign: "poses_bounds.npy (LLFF)",
        is_benchmark: true,
        is_present: |folder| is_file(&folder.join("poses_bounds.npy")),
        read: llff::read,
    },
    Form {
        format: Format::Colmap,
        name: "colmap",
        title: "COLMAP (sparse)",
        sign: "sparse/0 (COLMAP)",
        is_benchmark: false,
        is_present: |folder| Ok(!colmap::models(folder).is_empty()),
        read: colmap::read,
    },
];

impl Format {
    /// What to call it, with what it is found by: `COLMAP (sparse)`.
    pub fn title(self) -> &'static str {
        self.form().title
    }

    /// Whether benchmarks' scenes come so, whose images are HR truth rather than LR photographs.
    pub fn is_benchmark(self) -> bool {
        self.form().is_benchmark
    }

    fn form(self) -> &'static Form {
        FORMS.iter().find(|form| form.format == self).expect("each format has an entry")
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.form().name)
    }
}

/// What a folder should have one of, in words.
fn signs() -> String {
    let signs: Vec<&str> = FORMS.iter().map(|form| form.sign).collect();
    match signs.split_last() {
        Some((last, others)) => format!("{}, or {last}", others.join(", ")),
        None => String::new(),
    }
}

/// A data set that can't be used.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder has none of the forms.
    #[error("{}: no data set; expected {}", shown(path), signs())]
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

    fn frame(path: &Path, index: usize, file: &str, reason: String) -> Self {
        Self::Frame { path: path.to_path_buf(), index, file: file.to_owned(), reason }
    }
}

impl Dataset {
    /// Reads a folder, whichever form it has. Images are looked at for their size alone.
    pub fn read(folder: &Path) -> Result<Self, DatasetError> {
        let mut set = (form_of(folder)?.read)(folder)?;
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

/// The first form that a folder has.
fn form_of(folder: &Path) -> Result<&'static Form, DatasetError> {
    for form in FORMS {
        if (form.is_present)(folder)? {
            return Ok(form);
        }
    }
    Err(DatasetError::Unknown { path: folder.to_path_buf() })
}

/// Whether a file is there; something else in its place is refused.
fn is_file(path: &Path) -> Result<bool, DatasetError> {
    match find(path, "a file") {
        Found::File => Ok(true),
        Found::Nothing(_) => Ok(false),
        Found::Other(reason) => Err(DatasetError::Place { reason }),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn forms_differ_and_a_folder_of_none_is_told_them() {
        let names: BTreeSet<String> = FORMS.iter().map(|form| form.format.to_string()).collect();
        assert_eq!(names.len(), FORMS.len());
        let message = Dataset::read("/nowhere".as_ref()).unwrap_err().to_string();
        let words = "/nowhere: no data set; expected transforms_train.json (Blender), ";
        assert!(message.starts_with(words), "{message}");
        assert!(FORMS.iter().all(|form| message.contains(form.sign)), "{message}");
    }
}
