use crate::image_buffer::Rgba8;

/// A colour scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Palette {
    /// Dark to light, for errors.
    Error,
    /// Rainbow-like with even steps, for depth.
    Depth,
}

/// The colour of a value in [0, 1]; outside it, of the nearer end.
pub fn heat(palette: Palette, value: f32) -> [u8; 3] {
    let gradient = match palette {
        Palette::Error => colorous::INFERNO,
        Palette::Depth => colorous::TURBO,
    };
    // NaN.max(0.0) is 0.0: even a broken value has a colour.
    let colour = gradient.eval_continuous(f64::from(value.max(0.0).min(1.0)));
    [colour.r, colour.g, colour.b]
}

/// The range of depths that an image of them shows: from the nearest hundredth to the farthest,
/// since a floater or two must not take the whole scale. `None` where opacity `a` is nowhere one
/// half.
pub fn depth_range(z: &[f32], a: &[f32]) -> Option<(f32, f32)> {
    let mut seen: Vec<f32> = z.iter().zip(a).filter(|(_, a)| **a >= 0.5).map(|(z, _)| *z).collect();
    seen.sort_by(f32::total_cmp);
    let at = |share: f32| seen.get(((seen.len().max(1) - 1) as f32 * share) as usize).copied();
    at(0.01).zip(at(0.99))
}

/// One range for several images, so that a depth has the same colour in all of them.
pub fn common_range(ranges: impl IntoIterator<Item = (f32, f32)>) -> Option<(f32, f32)> {
    ranges.into_iter().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
}

/// Depth as colours from near (warm) to far, even in disparity where the far end is many times as
/// far; white where nothing stands.
pub fn draw_depth(width: usize, z: &[f32], a: &[f32], (near, far): (f32, f32)) -> Rgba8 {
    let scale = |z: f32| if far > 4.0 * near && near > 0.0 { -1.0 / z.max(near) } else { z };
    let (low, high) = (scale(near), scale(far));
    let pixels = z.iter().zip(a).flat_map(|(z, a)| {
        let value = 1.0 - (scale(*z) - low) / (high - low).max(f32::MIN_POSITIVE);
        let heat = heat(Palette::Depth, 0.08 + 0.84 * value.clamp(0.0, 1.0));
        let over = |c: u8| (f32::from(c) * a + 255.0 * (1.0 - a)).round() as u8;
        [over(heat[0]), over(heat[1]), over(heat[2]), 255]
    });
    Rgba8::new(width, z.len() / width.max(1), pixels.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One image spans little, the other much: alone the first is even in depth, the second in
    /// disparity.
    #[test]
    fn a_depth_has_one_colour_in_all_images() {
        let depths = |step: f32| (0..=100).map(|i| 2.0 + step * i as f32).collect::<Vec<f32>>();
        let (close, deep, opaque) = (depths(0.02), depths(0.5), [1.0; 101]);
        let ranges = [&close, &deep].map(|z| depth_range(z, &opaque).unwrap());
        let drawn = |z: &[f32], range| draw_depth(z.len(), z, &opaque, range);
        let at_three = |image: &Rgba8, i: usize| image.data[4 * i..4 * i + 4].to_vec();
        let range = common_range(ranges).unwrap();
        assert_eq!(at_three(&drawn(&close, range), 50), at_three(&drawn(&deep, range), 2));
        assert_ne!(
            at_three(&drawn(&close, ranges[0]), 50),
            at_three(&drawn(&deep, ranges[1]), 2),
            "each by itself"
        );
        assert_eq!(common_range([]), None);
    }
}
