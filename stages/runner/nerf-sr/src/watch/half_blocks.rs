use std::fmt::Write as _;

use pixels::{Filter, Rgba8, resize_pillow};

/// Maximum width of a picture in characters; chosen by hand.
const MAX_COLUMNS: usize = 64;
const RESET: &str = "\x1b[0m";

/// Draws an image as text for a terminal of the given size. Each character is `▀`, whose foreground
/// is the upper pixel and whose background is the lower one.
pub(super) fn half_blocks(image: &Rgba8, columns: u16, rows: u16) -> String {
    let columns = usize::from(columns).min(MAX_COLUMNS).min(image.width).max(1);
    // A third of the terminal is left for earlier lines.
    let lines = (usize::from(rows) * 2 / 3).max(1);
    let scale = (columns as f64 / image.width as f64).min(2.0 * lines as f64 / image.height as f64);
    let [width, height] =
        [image.width, image.height].map(|side| ((side as f64 * scale).round() as usize).max(1));
    let height = height.next_multiple_of(2);
    let small = resize_pillow(image, width, height, Filter::Box);
    let (pixels, _) = small.data.as_chunks::<4>();
    let mut text = String::new();
    for y in (0..height).step_by(2) {
        if y > 0 {
            text.push('\n');
        }
        for x in 0..width {
            let [r, g, b, _] = pixels[y * width + x];
            let [down_r, down_g, down_b, _] = pixels[(y + 1) * width + x];
            // Writing to a string can't fail.
            write!(text, "\x1b[38;2;{r};{g};{b};48;2;{down_r};{down_g};{down_b}m▀").ok();
        }
        text += RESET;
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_character_has_two_pixels_and_proportions_are_kept() {
        let pixel = |i: usize| if i < 8 { [255, 0, 0, 255] } else { [0, 0, 255, 255] };
        let image = Rgba8::new(4, 4, (0..16).flat_map(pixel).collect());
        let text = half_blocks(&image, 2, 24);
        assert_eq!(text, "\x1b[38;2;255;0;0;48;2;0;0;255m▀".repeat(2) + RESET);
        let wide = Rgba8::new(400, 100, vec![255; 400 * 100 * 4]);
        for (columns, rows) in [(80, 24), (10, 24), (80, 1), (0, 0)] {
            let text = half_blocks(&wide, columns, rows);
            let widths: Vec<usize> = text.lines().map(|line| line.matches('▀').count()).collect();
            assert!(widths.len() <= usize::from(rows).max(1));
            assert!(widths.iter().all(|width| *width <= usize::from(columns).clamp(1, 64)));
        }
        assert_eq!(half_blocks(&wide, 80, 24).lines().count(), 8);
    }
}
