//! Reads folders of posed photographs. [`Dataset::read`] recognises a folder's [`Format`] by its
//! files, in the order of `Format::ALL`.
//!
//! A new format needs a module with its reader; in `format`, a variant of [`Format`], its place in
//! `Format::ALL`, its title, file and properties; in this file, the call of its reader, and its
//! recognition unless a file identifies the format. Readers share the modules `frame`,
//! `photograph`, `text` and `lookup`, which finds files. `masks` finds masks next to images;
//! `nearby` and `conversion` explain why a folder is no data set. [`Border`] classifies the border
//! of an image.
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
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod blender;
mod border;
mod colmap;
mod conversion;
mod dataset;
mod entry;
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
mod photograph;
mod split;
mod text;
mod transforms;
mod unsupported;
mod unused_masks;

use std::path::Path;

use anyhow::bail;
use artifact::printable;

pub use border::{Border, plain_background};
pub use dataset::Dataset;
pub use error::DatasetError;
use file_status::{is_file, path_text};
pub use format::Format;
use format::expected_files;
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
        Ok(Self::read_recognised(folder)?)
    }

    fn read_recognised(folder: &Path) -> anyhow::Result<Self> {
        let mut set = match recognise_format(folder)? {
            Format::Blender => blender::read(folder),
            Format::Transforms => transforms::read(folder),
            Format::Llff => llff::read(folder),
            Format::Colmap => colmap::read(folder),
        }?;
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
fn recognise_format(folder: &Path) -> anyhow::Result<Format> {
    if let Some(format) = find_format(folder)? {
        return Ok(format);
    }
    let path = path_text(folder);
    if let Some(finding) = find_nearby(folder) {
        bail!("{path}: no data set; {finding}");
    }
    let expected = expected_files();
    bail!(DatasetError::Unrecognised(format!("{path}: no data set; expected {expected}")))
}

/// Returns the first format that a folder has, if any.
fn find_format(folder: &Path) -> anyhow::Result<Option<Format>> {
    for format in Format::ALL {
        let is_found = match format.file() {
            Some(file) => is_file(&folder.join(file))?,
            None => !colmap::find_models(folder)?.is_empty(),
        };
        if is_found {
            return Ok(Some(format));
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_folder_is_refused_with_the_known_formats() {
        let message = Dataset::read("/nowhere".as_ref()).unwrap_err().to_string();
        let expected = "/nowhere: no data set; expected Blender (transforms_train.json), ";
        assert!(message.starts_with(expected), "{message}");
        assert!(message.contains("COLMAP (sparse)"), "{message}");
    }
}
