use std::path::Path;

use crate::error::PixelError;
use crate::exr_file::{COLOUR_CHANNELS, read_exr};
use crate::image_buffer::Image;
use crate::png_file::read_png;

/// Reads a view's image as RGBA with premultiplied alpha: a PNG has straight alpha or none, an EXR
/// premultiplied alpha in its channels R, G, B, A.
pub fn read_premultiplied(path: &Path) -> Result<Image, PixelError> {
    if path.extension().is_none_or(|e| e != "exr") {
        return Ok(Image::premultiplied(&read_png(path)?));
    }
    let image = read_exr(path)?.with_finite(&COLOUR_CHANNELS, path)?;
    image.premultiplied().ok_or_else(|| {
        let reason = "channels R, G, B and A are expected".to_owned();
        PixelError::Format { path: path.to_path_buf(), reason }
    })
}
