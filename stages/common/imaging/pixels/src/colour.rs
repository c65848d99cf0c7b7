/// Encodes linear light as display sRGB (IEC 61966-2-1). Uses only arithmetic and `libm`, so that
/// results are equal on all machines.
pub fn srgb_from_linear(linear: f64) -> f64 {
    let linear = linear.clamp(0.0, 1.0);
    if linear <= 0.003_130_8 {
        12.92 * linear
    } else {
        1.055 * libm::pow(linear, 1.0 / 2.4) - 0.055
    }
}

/// Decodes display sRGB to linear light, the inverse of [`srgb_from_linear`].
pub fn linear_from_srgb(encoded: f64) -> f64 {
    let encoded = encoded.clamp(0.0, 1.0);
    if encoded <= 0.040_45 { encoded / 12.92 } else { libm::pow((encoded + 0.055) / 1.055, 2.4) }
}

/// Converts one of 256 levels to [0, 1].
pub(crate) fn from_u8(level: u8) -> f32 {
    f32::from(level) / 255.0
}

/// Returns the nearest of 256 levels for a value, clamped to [0, 1].
pub fn to_u8(value: f32) -> u8 {
    // `as` saturates and maps NaN to 0.
    (value * 255.0 + 0.5) as u8
}

/// Colour scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Palette {
    /// Dark to light, for errors (inferno).
    Error,
    /// Rainbow-like with even steps, for depth (turbo).
    Depth,
}

/// Returns a palette's colour for a value, clamped to [0, 1].
pub fn palette_colour(palette: Palette, value: f32) -> [u8; 3] {
    let gradient = match palette {
        Palette::Error => colorous::INFERNO,
        Palette::Depth => colorous::TURBO,
    };
    // Unlike `clamp`, `max` maps NaN to 0.
    let colour = gradient.eval_continuous(f64::from(value.max(0.0).min(1.0)));
    [colour.r, colour.g, colour.b]
}

#[cfg(test)]
mod tests {
    #[test]
    fn srgb_levels_survive_a_round_trip() {
        for level in 0..=255 {
            let encoded = f64::from(level) / 255.0;
            let reencoded = super::srgb_from_linear(super::linear_from_srgb(encoded));
            assert!((reencoded - encoded).abs() < 1e-6, "{encoded} becomes {reencoded}");
        }
    }

    #[test]
    fn black_white_and_middle_grey_are_encoded() {
        assert_eq!(super::srgb_from_linear(0.0), 0.0);
        assert!((super::srgb_from_linear(1.0) - 1.0).abs() < 1e-12);
        // 18 % grey is encoded as 46.1 %.
        assert!((super::srgb_from_linear(0.18) - 0.4613).abs() < 1e-4);
    }
}
