use glam::DVec3;

/// Relative size of a rounding step, 2⁻²⁶: a quarter of what single precision resolves in the unit
/// cube, and far above the rounding errors of f64, also a million scene sizes from the origin.
const STEP: f64 = 1.0 / 67_108_864.0;

/// Returns the largest power of two that isn't above a positive number; 0 for subnormal numbers.
pub fn power_of_two_below(value: f64) -> f64 {
    const EXPONENT: u64 = 0x7ff0_0000_0000_0000;
    f64::from_bits(value.to_bits() & EXPONENT)
}

/// Returns the step to which lengths of a magnitude are rounded.
pub(crate) fn rounding_step(magnitude: f64) -> f64 {
    STEP * power_of_two_below(magnitude)
}

/// Returns the nearest multiple of a step; the number itself if the step is 0.
pub(crate) fn multiple(value: f64, step: f64) -> f64 {
    if step > 0.0 { (value / step).round() * step } else { value }
}

/// Rounds a number to 26 binary digits.
pub(crate) fn rounded(value: f64) -> f64 {
    multiple(value, rounding_step(value))
}

/// Rounds a point's offset from an anchor.
pub(crate) fn rounded_offset(point: DVec3, anchor: DVec3, step: f64) -> DVec3 {
    let offset = (point - anchor).to_array().map(|x| multiple(x, step));
    anchor + DVec3::from(offset)
}
