use crate::colour::{Palette, palette_colour};
use crate::exr_file::ExrImage;
use crate::image_buffer::Rgba8;

/// Depth and opacity of a view's pixels, row by row: channels `Z` and `A` of its EXR file. Both
/// slices have the same length.
#[derive(Clone, Copy, Debug)]
pub struct DepthMap<'a> {
    /// Camera-space z-depth in scene units: positive in front of the camera. Where opacity is
    /// 0, renders have the far end.
    pub depth: &'a [f32],
    /// Opacity in [0, 1].
    pub opacity: &'a [f32],
}

/// Minimum opacity of a surface: the median depth is only defined for an opacity of at least 0.5.
const MIN_SURFACE_OPACITY: f32 = 0.5;

impl<'a> DepthMap<'a> {
    /// Wraps the channels of an EXR image; `None` if one is missing.
    pub fn of(image: &'a ExrImage) -> Option<Self> {
        Some(Self { depth: image.channel("Z")?, opacity: image.channel("A")? })
    }

    /// True if the pixel with this row-major index has an opacity of at least one half.
    ///
    /// # Panics
    /// If the index is out of range.
    pub fn has_surface(&self, pixel: usize) -> bool {
        self.opacity[pixel] >= MIN_SURFACE_OPACITY
    }

    /// Returns the 1 % and 99 % quantiles of the surfaces' depths in scene units, the range to
    /// draw: a few floaters must not stretch it. `None` without a surface.
    pub fn range(&self) -> Option<(f32, f32)> {
        let surfaces = (0..self.depth.len()).filter(|i| self.has_surface(*i));
        let mut depths: Vec<f32> = surfaces.map(|i| self.depth[i]).collect();
        depths.sort_by(f32::total_cmp);
        let last = depths.len().checked_sub(1)? as f32;
        Some((depths[(last * 0.01) as usize], depths[(last * 0.99) as usize]))
    }

    /// Draws depth from near (warm) to far (cold) over white. `width` is in pixels, the range in
    /// scene units; if far is more than 4 times near, values are drawn linearly in disparity.
    ///
    /// # Panics
    /// If the number of pixels isn't a multiple of `width`, or depths and opacities differ in
    /// number.
    pub fn draw(&self, width: usize, range: (f32, f32)) -> Rgba8 {
        let (low, high) = (display_depth(range.0, range), display_depth(range.1, range));
        let mut data = Vec::with_capacity(4 * self.depth.len());
        for (i, z) in self.depth.iter().enumerate() {
            let alpha = self.opacity[i];
            let value =
                1.0 - (display_depth(*z, range) - low) / (high - low).max(f32::MIN_POSITIVE);
            // Leaves out the dark colours at both ends of the palette.
            let colour = palette_colour(Palette::Depth, 0.08 + 0.84 * value.clamp(0.0, 1.0));
            for c in colour {
                data.push((f32::from(c) * alpha + 255.0 * (1.0 - alpha)).round() as u8);
            }
            data.push(u8::MAX);
        }
        Rgba8::new(width, self.depth.len() / width.max(1), data)
    }
}

/// Returns depth, or negated disparity if far is more than 4 times near.
fn display_depth(z: f32, (near, far): (f32, f32)) -> f32 {
    if far > 4.0 * near && near > 0.0 { -1.0 / z.max(near) } else { z }
}

/// Returns the union of several images' ranges, so that a depth has the same colour in all images.
pub fn common_range(ranges: impl IntoIterator<Item = (f32, f32)>) -> Option<(f32, f32)> {
    ranges.into_iter().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_needs_both_channels() {
        let channel = |name: &str, value: f32| (name.to_owned(), vec![value; 2]);
        let image = |channels| ExrImage { width: 2, height: 1, channels };
        let complete = image(vec![channel("A", 0.5), channel("Z", 3.0)]);
        let map = DepthMap::of(&complete).unwrap();
        assert_eq!((map.depth, map.opacity), (&[3.0; 2][..], &[0.5; 2][..]));
        assert!(DepthMap::of(&image(vec![channel("A", 0.5)])).is_none());
        assert!(DepthMap::of(&image(vec![channel("Z", 3.0)])).is_none());
    }

    #[test]
    fn only_surfaces_determine_the_range() {
        let map = DepthMap { depth: &[9.0, 2.0, 3.0, 1.0], opacity: &[0.49, 0.5, 1.0, 0.0] };
        assert_eq!([0, 1, 2, 3].map(|pixel| map.has_surface(pixel)), [false, true, true, false]);
        assert_eq!(map.range(), Some((2.0, 2.0)), "quantiles are rounded down");
        assert_eq!(DepthMap { opacity: &[0.2; 4], ..map }.range(), None);
    }

    /// With separate ranges, the first image is linear in depth, and the second, with its larger
    /// range, in disparity. Pixel 50 of the first and pixel 2 of the second have the same depth.
    #[test]
    fn a_depth_has_one_colour_in_all_images() {
        let depths = |step: f32| (0..=100).map(|i| 2.0 + step * i as f32).collect::<Vec<f32>>();
        let (narrow, wide, opaque) = (depths(0.02), depths(0.5), [1.0; 101]);
        let maps = [&narrow, &wide].map(|depth| DepthMap { depth, opacity: &opaque });
        let ranges = maps.map(|map| map.range().unwrap());
        let draw = |i: usize, range| maps[i].draw(101, range);
        let colour = |image: &Rgba8, i: usize| image.data[4 * i..4 * i + 4].to_vec();
        let range = common_range(ranges).unwrap();
        assert_eq!(colour(&draw(0, range), 50), colour(&draw(1, range), 2));
        assert_ne!(
            colour(&draw(0, ranges[0]), 50),
            colour(&draw(1, ranges[1]), 2),
            "separate ranges"
        );
        assert_eq!(common_range([]), None);
    }
}
