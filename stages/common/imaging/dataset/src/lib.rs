//! Reads folders of posed photographs. [`Dataset::read`] recognises a folder's [`Format`] by its
//! files, in the order of `Format::ALL`.
//!
//! A new format needs a module with its reader; in `format`, a variant of [`Format`], its place in
//! `Format::ALL` and its description; in this file, the call of its reader, and its recognition
//! unless a file identifies the format. Readers share the modules `frame`, `photograph`, `text` and
//! `lookup`, which finds files. `masks` finds masks next to images; `nearby` and `conversion`
//! explain why a folder is no data set.
//!
//! A [`Frame`] has its camera in this project's conventions (OpenGL axes, pixels from the top left
//! corner, scene units) with lens distortion; [`Frame::photograph`] reads the image, and turns it
//! as EXIF requires only if the camera's width and height are those of the turned image. After
//! [`Dataset::undistorted`], images are read with lens distortion removed.
//!
//! Scene units are those of the poses; pixel coordinates start at the top left corner of the image
//! as read, so that the first pixel's centre is (0.5, 0.5). All content of files is checked: sizes
//! before allocations, paths before files are opened.
//!
//! ```no_run
//! let set = dataset::Dataset::read("my-photographs".as_ref())?;
//! println!("{}: {} photographs", set.format, set.frames.len());
//! let (image, camera) = (set.frames[0].photograph()?, set.frames[0].camera());
//! # Ok::<(), dataset::DatasetError>(())
//! ```

mod blender;
mod colmap;
mod conversion;
mod dataset;
mod error;
mod file_status;
mod format;
mod frame;
mod frame_file;
mod huffman;
mod jpeg;
mod lens_entry;
mod llff;
mod lookup;
mod masks;
mod nearby;
mod npy;
mod number;
mod photograph;
mod split;
mod text;
mod transforms;
mod unsupported;
mod unused_masks;

use std::path::Path;

use artifact::printable;

pub use dataset::Dataset;
pub use error::DatasetError;
use error::Problem;
use file_status::is_file;
pub use format::Format;
pub use frame::{Frame, Turn};
use masks::add_masks;
pub use masks::{MaskFile, MaskKind};
use nearby::find_nearby;
pub use photograph::{Clipping, is_image_name};
pub use split::Split;
pub use unsupported::{is_unsupported_name, unsupported_summary};

impl Dataset {
    /// Reads a folder in any format. Of the images only the headers are read.
    pub fn read(folder: &Path) -> Result<Self, DatasetError> {
        let mut set = read_format(recognise_format(folder)?, folder)?;
        add_masks(folder, &mut set)?;
        set.remove_scales();
        set.add_image_notes();
        for note in &mut set.notes {
            *note = printable(note).into_owned();
        }
        Ok(set)
    }
}

/// Returns the first format that a folder has; fails if it has none.
fn recognise_format(folder: &Path) -> Result<Format, DatasetError> {
    let format = find_format(folder)?.ok_or_else(|| Problem::Unrecognised {
        path: folder.to_path_buf(),
        finding: find_nearby(folder),
    })?;
    Ok(format)
}

/// Returns the first format that a folder has, if any.
fn find_format(folder: &Path) -> Result<Option<Format>, DatasetError> {
    for format in Format::ALL {
        if has_format(format, folder)? {
            return Ok(Some(format));
        }
    }
    Ok(None)
}

/// Returns whether a folder has a format.
fn has_format(format: Format, folder: &Path) -> Result<bool, DatasetError> {
    match format.file() {
        Some(file) => is_file(&folder.join(file)),
        None => Ok(!colmap::find_models(folder)?.is_empty()),
    }
}

/// Reads a folder of a format.
fn read_format(format: Format, folder: &Path) -> Result<Dataset, DatasetError> {
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
    fn an_unknown_folder_is_refused_with_the_known_formats() {
        let message = Dataset::read("/nowhere".as_ref()).unwrap_err().to_string();
        let expected = "/nowhere: no data set; expected transforms_train.json (Blender), ";
        assert!(message.starts_with(expected), "{message}");
        assert!(message.contains("sparse/0 (COLMAP)"), "{message}");
    }
}
