//! Borders of photographs, which show what is behind an object (docs/design/035).

use pixels::{Rgba8, are_similar, count_similar, medians};
use scene::Background;

use crate::Frame;

/// Minimum percentage of one colour in the borders of nine in ten views: an object that fills the
/// image covers a fifth of the border, a bright sky about half (docs/design/035).
const MIN_COLOUR_PERCENT: usize = 60;

/// Content of one image's border.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Border {
    /// The image has alpha.
    Alpha,
    /// At least 60 % of the border's pixels are similar to their median.
    Colour {
        /// Median of the border's pixels.
        median: [u8; 3],
        /// Percentage of similar pixels.
        percent: usize,
    },
    /// Anything else.
    Mixed,
}

impl Border {
    /// Maximum deviation of a flat colour in 8-bit levels: JPEG noise on a uniform area. A clear
    /// sky varies more from corner to corner (docs/design/035).
    pub const MAX_NOISE: u8 = 8;

    /// Classifies an image's border.
    pub fn of(image: &Rgba8) -> Self {
        if image.data.chunks_exact(4).any(|p| p[3] != u8::MAX) {
            return Self::Alpha;
        }
        let (width, height) = (image.width, image.height);
        let rows = (0..width).flat_map(|x| [(x, 0), (x, height - 1)]);
        let columns = (0..height).flat_map(|y| [(0, y), (width - 1, y)]);
        let border: Vec<[u8; 3]> = rows.chain(columns).map(|(x, y)| image.colour(x, y)).collect();
        let median = medians(&border);
        let similar = count_similar(&border, median, Self::MAX_NOISE);
        let percent = 100 * similar / border.len().max(1);
        if percent >= MIN_COLOUR_PERCENT { Self::Colour { median, percent } } else { Self::Mixed }
    }

    /// Classifies the border of a frame's image. Fisheye photographs are black outside their image
    /// circle, so their colour is no evidence.
    pub fn of_frame(frame: &Frame, image: &Rgba8) -> Self {
        match Self::of(image) {
            Self::Colour { .. } if frame.intrinsics().has_clamped_rays() => Self::Mixed,
            border => border,
        }
    }

    /// Returns the background that the border suggests; `None` if the border shows the scene.
    pub fn background(self) -> Option<Background> {
        match self {
            // Alpha is composited over white.
            Self::Alpha => Some(Background::White),
            Self::Colour { median, .. } => plain_background(median),
            Self::Mixed => None,
        }
    }
}

/// Returns the background of a colour that is white or black.
pub fn plain_background(colour: [u8; 3]) -> Option<Background> {
    let plain = [([u8::MAX; 3], Background::White), ([0; 3], Background::Black)];
    let found = plain.iter().find(|(level, _)| are_similar(colour, *level, Border::MAX_NOISE));
    found.map(|(_, background)| *background)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn borders_suggest_a_background() {
        let background =
            |pixel: [u8; 4]| Border::of(&Rgba8::new(6, 4, pixel.repeat(24))).background();
        assert_eq!(background([250, 255, 248, 255]), Some(Background::White));
        assert_eq!(background([7, 0, 3, 255]), Some(Background::Black));
        assert_eq!(background([7, 0, 3, 254]), Some(Background::White), "alpha");
        assert_eq!(background([128, 128, 128, 255]), None, "a wall");
        let stripes: Vec<u8> = (0..24).flat_map(|i| [(i % 6) * 40, 0, 0, 255]).collect();
        assert_eq!(Border::of(&Rgba8::new(6, 4, stripes)), Border::Mixed);
    }
}
