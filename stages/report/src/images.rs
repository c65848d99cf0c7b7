use std::path::Path;

use base64::Engine as _;
use pixels::{
    ExrImage, Filter, Rgba8, common_range, depth_range, draw_depth, encode_png, read_exr,
    read_premultiplied, resize_pillow,
};
use scene::{Background, View};

/// A view's image over its background, for looking at.
pub(crate) fn colour(folder: &Path, file: &str, background: Background) -> anyhow::Result<Rgba8> {
    Ok(read_premultiplied(&folder.join(file))?.over(background.shown()).to_rgba8())
}

/// The range of depths that several views show together; `None` where there are no depths.
pub(crate) fn depths_of<'a>(
    folder: &Path,
    views: impl Iterator<Item = &'a View>,
) -> anyhow::Result<Option<(f32, f32)>> {
    let ranges = views.filter_map(|view| depth_file(folder, view)).map(|image| {
        let image = image?;
        Ok(image.channel("Z").zip(image.channel("A")).and_then(|(z, a)| depth_range(z, a)))
    });
    Ok(common_range(ranges.collect::<anyhow::Result<Vec<_>>>()?.into_iter().flatten()))
}

/// Depth of a rendered view as colours from near (warm) to far; white where nothing stands.
pub(crate) fn depth(
    folder: &Path,
    view: &View,
    range: (f32, f32),
) -> anyhow::Result<Option<Rgba8>> {
    let Some(image) = depth_file(folder, view).transpose()? else { return Ok(None) };
    Ok(image
        .channel("Z")
        .zip(image.channel("A"))
        .map(|(z, a)| draw_depth(image.width, z, a, range)))
}

fn depth_file(folder: &Path, view: &View) -> Option<anyhow::Result<ExrImage>> {
    view.depth.as_ref().map(|file| Ok(read_exr(&folder.join(file))?))
}

/// An image as the value of an `<img src>`.
pub(crate) fn uri_of(image: &Rgba8) -> String {
    format!(
        "data:image/png;base64,{}",
        base64::engine::general_purpose::STANDARD.encode(encode_png(image))
    )
}

/// Pixels across at most, of images in a gallery: twice as many as their figures are wide.
const WIDEST: usize = 600;

/// An image in a gallery. What no screen would show there is left out: views at HR make pages of a
/// hundred megabytes.
pub(crate) fn shown_in_gallery(image: &Rgba8) -> String {
    let times = image.width.div_ceil(WIDEST);
    if times < 2 {
        return uri_of(image);
    }
    let less = |size: usize| size.div_ceil(times).max(1);
    uri_of(&resize_pillow(image, less(image.width), less(image.height), Filter::Box))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The size that a PNG in a page says it has.
    fn size(uri: &str) -> (u32, u32) {
        let png = base64::engine::general_purpose::STANDARD
            .decode(uri.split_once(',').unwrap().1)
            .unwrap();
        let number = |at: usize| u32::from_be_bytes(png[at..at + 4].try_into().unwrap());
        (number(16), number(20))
    }

    #[test]
    fn galleries_have_images_that_a_screen_can_show() {
        for ((width, height), expected) in [
            ((600, 10), (600, 10)),
            ((601, 3), (301, 2)),
            ((1008, 756), (504, 378)),
            ((4032, 1), (576, 1)),
        ] {
            let image = Rgba8::new(width, height, vec![200; width * height * 4]);
            assert_eq!(size(&shown_in_gallery(&image)), expected);
            assert_eq!(size(&uri_of(&image)), (width as u32, height as u32));
        }
    }
}
