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

#[cfg(test)]
mod tests {
    #[test]
    fn ends_and_middle() {
        assert_eq!(super::srgb_from_linear(0.0), 0.0);
        assert!((super::srgb_from_linear(1.0) - 1.0).abs() < 1e-12);
        // 18 % grey is displayed at 46.1 %.
        assert!((super::srgb_from_linear(0.18) - 0.4613).abs() < 1e-4);
    }
}
