//! Reads folders of posed photographs. [`Dataset::read`] recognises a folder's [`Format`] by the
//! folder's files; `Format::ALL` lists which format goes first.
//!
//! A new form is a module with its reader; in `format`, a variant of [`Format`], its place in
//! `Format::ALL` and its description; in this file, how it is recognised and read. Readers find
//! files by `lookup`, and share `frame`, `photograph` and `text`; `masks` finds masks next to
//! images, `nearby` explains folders that are no data set.
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
mod clipping;
mod colmap;
mod colmap_camera;
mod dataset;
mod error;
mod file_reason;
mod format;
mod found;
mod frame;
mod frame_file;
mod frame_reason;
mod huffman;
mod jpeg;
mod lens_entry;
mod llff;
mod lookup;
mod mask_file;
mod masks;
mod misplaced;
mod nearby;
mod npy;
mod number;
mod photograph;
mod reach;
mod split;
mod split_lists;
mod text;
mod transforms;
mod turn;
mod unread;
mod unused_masks;

use std::path::Path;

use artifact::printable;

pub use clipping::Clipping;
pub use dataset::Dataset;
pub use error::DatasetError;
pub use file_reason::{FileReason, ImageFolder};
pub use format::Format;
use found::is_file;
pub use frame::Frame;
pub use frame_reason::FrameReason;
pub use lookup::LookupError;
pub use mask_file::{MaskFile, MaskKind};
use masks::add_masks;
pub use misplaced::Misplaced;
pub use nearby::Nearby;
pub use npy::ArrayReason;
pub use photograph::is_image_name;
pub use split::Split;
pub use turn::Turn;
pub use unread::{is_unread_name, unread_images};

impl Dataset {
    /// Reads a folder, whichever form it has. Images are looked at for their size alone.
    pub fn read(folder: &Path) -> Result<Self, DatasetError> {
        let mut set = read_as(format_of(folder)?, folder)?;
        add_masks(folder, &mut set)?;
        set.remove_scales();
        set.note_what_is_special();
        for note in &mut set.notes {
            *note = printable(note).into_owned();
        }
        Ok(set)
    }
}

/// Returns the first form that a folder has.
fn format_of(folder: &Path) -> Result<Format, DatasetError> {
    present_format(folder)?.ok_or_else(|| DatasetError::Unknown {
        path: folder.to_path_buf(),
        nearby: Nearby::of(folder),
    })
}

/// Returns the first form that a folder has, if any.
fn present_format(folder: &Path) -> Result<Option<Format>, DatasetError> {
    for format in Format::ALL {
        if is_present(format, folder)? {
            return Ok(Some(format));
        }
    }
    Ok(None)
}

/// Whether a folder has a form.
fn is_present(format: Format, folder: &Path) -> Result<bool, DatasetError> {
    match format {
        Format::Blender => is_file(&folder.join("transforms_train.json")),
        Format::Transforms => is_file(&folder.join("transforms.json")),
        Format::Llff => is_file(&folder.join("poses_bounds.npy")),
        Format::Colmap => Ok(!colmap::models(folder)?.is_empty()),
    }
}

/// Reads a folder of a form.
fn read_as(format: Format, folder: &Path) -> Result<Dataset, DatasetError> {
    match format {
        Format::Blender => blender::read(folder),
        Format::Transforms => transforms::read(folder),
        Format::Llff => llff::read(folder),
        Format::Colmap => colmap::read(folder),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_of_no_form_is_told_them() {
        let message = Dataset::read("/nowhere".as_ref()).unwrap_err().to_string();
        let words = "/nowhere: no data set; expected transforms_train.json (Blender), ";
        assert!(message.starts_with(words), "{message}");
        assert!(message.contains("sparse/0 (COLMAP)"), "{message}");
    }
}
