use std::path::Path;

use anyhow::Context as _;
use base64::Engine as _;
use pixels::{Palette, Rgba8, encode_png, heat, read_exr, read_premultiplied};
use scene::{Background, View, Views};

/// A picture as the value of an `<img src>`.
pub(crate) fn data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png))
}

/// `views.json` of a folder.
pub(crate) fn read_views(folder: &Path) -> anyhow::Result<Views> {
    let path = folder.join(scene::VIEWS_FILE);
    let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
    serde_json::from_slice(&bytes).with_context(|| path.display().to_string())
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
    let mut seen: Vec<f32> = z.iter().zip(a).filter(|(_, a)| **a >= 0.5).map(|(z, _)| *z).collect();
    seen.sort_by(f32::total_cmp);
    // A floater or two must not take the whole scale.
    let at = |share: f32| seen.get(((seen.len().max(1) - 1) as f32 * share) as usize).copied().unwrap_or_default();
    let (near, far) = (at(0.01), at(0.99));
    let pixel = |(z, a): (&f32, &f32)| {
        let value = 1.0 - (z - near) / (far - near).max(f32::MIN_POSITIVE);
        let heat = heat(Palette::Depth, 0.08 + 0.84 * value.clamp(0.0, 1.0));
        let over = |c: u8| (f32::from(c) * a + 255.0 * (1.0 - a)).round() as u8;
        [over(heat[0]), over(heat[1]), over(heat[2]), 255]
    };
    Ok(Some(Rgba8::new(image.width, image.height, z.iter().zip(a).flat_map(pixel).collect())))
}

/// The PNG bytes of an 8-bit picture.
pub(crate) fn uri_of(image: &Rgba8) -> String {
    data_uri(&encode_png(image))
}
