use std::path::Path;

use base64::Engine as _;
use pixels::{Rgba8, depth_range, draw_depth, encode_png, read_exr, read_premultiplied};
use scene::{Background, View};

/// A picture as the value of an `<img src>`.
pub(crate) fn data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png))
}

/// A view's picture over its background, for looking at.
pub(crate) fn colour(folder: &Path, file: &str, background: Background) -> anyhow::Result<Rgba8> {
    Ok(read_premultiplied(&folder.join(file))?.over(background.shown()).to_rgba8())
}

/// Depth of a rendered view as colours from near (warm) to far; white where nothing stands.
pub(crate) fn depth(folder: &Path, view: &View) -> anyhow::Result<Option<Rgba8>> {
    let Some(file) = &view.depth else { return Ok(None) };
    let image = read_exr(&folder.join(file))?;
    let (Some(z), Some(a)) = (image.channel("Z"), image.channel("A")) else { return Ok(None) };
    Ok(Some(draw_depth(image.width, z, a, depth_range(z, a).unwrap_or((0.0, 1.0)))))
}

/// The PNG bytes of an 8-bit picture.
pub(crate) fn uri_of(image: &Rgba8) -> String {
    data_uri(&encode_png(image))
}
