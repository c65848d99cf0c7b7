use std::path::Path;

use crate::{Picture, PixelError, read_exr, read_png};

/// Reads a view's picture as RGBA with premultiplied alpha: a PNG has straight alpha or none, an EXR premultiplied alpha in its
/// channels R, G, B, A.
pub fn read_premultiplied(path: &Path) -> Result<Picture, PixelError> {
    if path.extension().is_none_or(|e| e != "exr") {
        return Ok(Picture::premultiplied(&read_png(path)?));
    }
    let image = read_exr(path)?;
    let [Some(r), Some(g), Some(b), Some(a)] = ["R", "G", "B", "A"].map(|name| image.channel(name)) else {
        let reason = "channels R, G, B and A are expected".to_owned();
        return Err(PixelError::Format { path: path.to_path_buf(), reason });
    };
    let data = (0..r.len()).flat_map(|i| [r[i], g[i], b[i], a[i]]).collect();
    Ok(Picture::new(image.width, image.height, 4, data))
}
