use std::iter::Sum;
use std::ops::Add;

/// Largest excess over 1 that rounding to half floats leaves of a colour divided by its alpha.
const ROUNDING: f32 = 1.0 / 1024.0;

/// Number of pixels whose colour is clipped to 1. EXR files may have brighter ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clipping {
    /// Number of clipped pixels.
    pub clipped: u64,
    /// Number of pixels of the EXR files.
    pub pixels: u64,
}

impl Clipping {
    /// Counts the pixel of a premultiplied colour.
    pub(crate) fn of_pixel(colour: [f32; 3], alpha: f32) -> Self {
        let limit = alpha * (1.0 + ROUNDING);
        let is_clipped = alpha > 0.0 && colour.iter().any(|value| *value > limit);
        Self { clipped: is_clipped.into(), pixels: 1 }
    }
}

impl Add for Clipping {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { clipped: self.clipped + other.clipped, pixels: self.pixels + other.pixels }
    }
}

impl Sum for Clipping {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), Self::add)
    }
}
