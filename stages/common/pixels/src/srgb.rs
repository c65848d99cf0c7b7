/// Display-encoded sRGB of linear light (IEC 61966-2-1). Pure arithmetic and `libm`, so the same
/// bits on every machine.
pub fn srgb_from_linear(linear: f64) -> f64 {
    let linear = linear.clamp(0.0, 1.0);
    if linear <= 0.003_130_8 {
        12.92 * linear
    } else {
        1.055 * libm::pow(linear, 1.0 / 2.4) - 0.055
    }
}

/// Linear light of display-encoded sRGB; undoes [`srgb_from_linear`].
pub fn linear_from_srgb(encoded: f64) -> f64 {
    let encoded = encoded.clamp(0.0, 1.0);
    if encoded <= 0.040_45 { encoded / 12.92 } else { libm::pow((encoded + 0.055) / 1.055, 2.4) }
}

#[cfg(test)]
mod tests {
    #[test]
    fn linear_light_comes_back() {
        for level in 0..=255 {
            let encoded = f64::from(level) / 255.0;
            let back = super::srgb_from_linear(super::linear_from_srgb(encoded));
            assert!((back - encoded).abs() < 1e-6, "{encoded} comes back as {back}");
        }
    }

    #[test]
    fn ends_and_middle() {
        assert_eq!(super::srgb_from_linear(0.0), 0.0);
        assert!((super::srgb_from_linear(1.0) - 1.0).abs() < 1e-12);
        // 18 % grey is displayed at 46.1 %.
        assert!((super::srgb_from_linear(0.18) - 0.4613).abs() < 1e-4);
    }
}
