use std::path::Path;

use base64::Engine as _;
use pixels::{ExrImage, Rgba8, common_range, depth_range, draw_depth, encode_png, read_exr, read_premultiplied};
use scene::{Background, View};

/// A picture as the value of an `<img src>`.
pub(crate) fn data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png))
}

/// A view's picture over its background, for looking at.
pub(crate) fn colour(folder: &Path, file: &str, background: Background) -> anyhow::Result<Rgba8> {
    Ok(read_premultiplied(&folder.join(file))?.over(background.shown()).to_rgba8())
}

/// The range of depths that several views show together; `None` where there are no depths.
pub(crate) fn depths_of<'a>(folder: &Path, views: impl Iterator<Item = &'a View>) -> anyhow::Result<Option<(f32, f32)>> {
    let ranges = views.filter_map(|view| depth_file(folder, view)).map(|image| {
        let image = image?;
        Ok(image.channel("Z").zip(image.channel("A")).and_then(|(z, a)| depth_range(z, a)))
    });
    Ok(common_range(ranges.collect::<anyhow::Result<Vec<_>>>()?.into_iter().flatten()))
}

/// Depth of a rendered view as colours from near (warm) to far; white where nothing stands.
pub(crate) fn depth(folder: &Path, view: &View, range: (f32, f32)) -> anyhow::Result<Option<Rgba8>> {
    let Some(image) = depth_file(folder, view).transpose()? else { return Ok(None) };
    Ok(image.channel("Z").zip(image.channel("A")).map(|(z, a)| draw_depth(image.width, z, a, range)))
}

fn depth_file(folder: &Path, view: &View) -> Option<anyhow::Result<ExrImage>> {
    view.depth.as_ref().map(|file| Ok(read_exr(&folder.join(file))?))
}

/// The PNG bytes of an 8-bit picture.
pub(crate) fn uri_of(image: &Rgba8) -> String {
    data_uri(&encode_png(image))
}
