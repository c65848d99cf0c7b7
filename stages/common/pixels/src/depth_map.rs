use crate::exr_file::ExrImage;
use crate::heat::{Palette, heat};
use crate::image_buffer::Rgba8;

/// Depth and opacity of a view, a number a pixel, row by row: channels `Z` and `A` of its EXR file.
/// There are as many of both.
#[derive(Clone, Copy, Debug)]
pub struct DepthMap<'a> {
    /// Camera-space z-depth in scene units: positive before the camera, and without meaning where
    /// opacity is 0.
    pub depth: &'a [f32],
    /// Opacity, in 0 to 1.
    pub opacity: &'a [f32],
}

fn is_surface(opacity: f32) -> bool {
    opacity >= 0.5
}

impl<'a> DepthMap<'a> {
    /// The depth map of an image. `None` where one of the channels is missing.
    pub fn of(image: &'a ExrImage) -> Option<Self> {
        Some(Self { depth: image.channel("Z")?, opacity: image.channel("A")? })
    }

    /// Whether a pixel, counted row by row, shows a surface: its opacity is at least one half.
    ///
    /// # Panics
    /// Where the pixel lies outside.
    pub fn has_surface(&self, pixel: usize) -> bool {
        is_surface(self.opacity[pixel])
    }

    /// The range of surfaces' depths that an image of them shows, in scene units: from the nearest
    /// hundredth to the farthest, since a floater or two must not take the whole scale. `None`
    /// where there is no surface.
    pub fn range(&self) -> Option<(f32, f32)> {
        let surfaces = self.depth.iter().zip(self.opacity).filter(|(_, a)| is_surface(**a));
        let mut seen: Vec<f32> = surfaces.map(|(z, _)| *z).collect();
        seen.sort_by(f32::total_cmp);
        let at = |share: f32| seen.get(((seen.len().max(1) - 1) as f32 * share) as usize).copied();
        at(0.01).zip(at(0.99))
    }

    /// Depth as colours from near (warm) to far, even in disparity where the far end is many times
    /// as far; white where nothing stands. The range is in scene units, `width` in pixels.
    ///
    /// # Panics
    /// Where the map hasn't whole rows of that width, or depths and opacities aren't as many.
    pub fn draw(&self, width: usize, (near, far): (f32, f32)) -> Rgba8 {
        let scale = |z: f32| if far > 4.0 * near && near > 0.0 { -1.0 / z.max(near) } else { z };
        let (low, high) = (scale(near), scale(far));
        let pixels = self.depth.iter().zip(self.opacity).flat_map(|(z, a)| {
            let value = 1.0 - (scale(*z) - low) / (high - low).max(f32::MIN_POSITIVE);
            let heat = heat(Palette::Depth, 0.08 + 0.84 * value.clamp(0.0, 1.0));
            let over = |c: u8| (f32::from(c) * a + 255.0 * (1.0 - a)).round() as u8;
            [over(heat[0]), over(heat[1]), over(heat[2]), 255]
        });
        Rgba8::new(width, self.depth.len() / width.max(1), pixels.collect())
    }
}

/// One range for several images, so that a depth has the same colour in all of them.
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
        let whole = image(vec![channel("A", 0.5), channel("Z", 3.0)]);
        let map = DepthMap::of(&whole).unwrap();
        assert_eq!((map.depth, map.opacity), (&[3.0; 2][..], &[0.5; 2][..]));
        assert!(DepthMap::of(&image(vec![channel("A", 0.5)])).is_none());
        assert!(DepthMap::of(&image(vec![channel("Z", 3.0)])).is_none());
    }

    #[test]
    fn surfaces_alone_make_the_range() {
        let map = DepthMap { depth: &[9.0, 2.0, 3.0, 1.0], opacity: &[0.49, 0.5, 1.0, 0.0] };
        assert_eq!([0, 1, 2, 3].map(|pixel| map.has_surface(pixel)), [false, true, true, false]);
        assert_eq!(map.range(), Some((2.0, 2.0)), "the farthest hundredth of two is left out");
        assert_eq!(DepthMap { opacity: &[0.2; 4], ..map }.range(), None);
    }

    /// One image spans little, the other much: alone the first is even in depth, the second in
    /// disparity.
    #[test]
    fn a_depth_has_one_colour_in_all_images() {
        let depths = |step: f32| (0..=100).map(|i| 2.0 + step * i as f32).collect::<Vec<f32>>();
        let (close, deep, opaque) = (depths(0.02), depths(0.5), [1.0; 101]);
        let maps = [&close, &deep].map(|depth| DepthMap { depth, opacity: &opaque });
        let ranges = maps.map(|map| map.range().unwrap());
        let drawn = |i: usize, range| maps[i].draw(101, range);
        let at_three = |image: &Rgba8, i: usize| image.data[4 * i..4 * i + 4].to_vec();
        let range = common_range(ranges).unwrap();
        assert_eq!(at_three(&drawn(0, range), 50), at_three(&drawn(1, range), 2));
        assert_ne!(
            at_three(&drawn(0, ranges[0]), 50),
            at_three(&drawn(1, ranges[1]), 2),
            "each by itself"
        );
        assert_eq!(common_range([]), None);
    }
}
