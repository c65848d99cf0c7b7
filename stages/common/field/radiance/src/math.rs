//! Exponentials with equal bits on every machine, written so that loops over them vectorise, and
//! spherical harmonics.

use crate::spec::BASIS;

/// Returns e^x for finite x; saturates at about e^±87. The relative error is below 2e-7.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    // max before min turns NaN into a number. NaNs are detected in sums, not in every exponent.
    let x = x.max(-87.0).min(87.0);
    // Adding and subtracting 1.5·2^23 rounds to the nearest integer.
    const ROUND: f32 = 12_582_912.0;
    let rounded = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let k = rounded - ROUND;
    let r = k.mul_add(-0.693_359_4, x);
    let r = k.mul_add(2.121_944_4e-4, r);
    let mut p = 1.987_569_1e-4f32;
    p = p.mul_add(r, 1.398_2e-3);
    p = p.mul_add(r, 8.333_452e-3);
    p = p.mul_add(r, 4.166_579_6e-2);
    p = p.mul_add(r, 1.666_666_5e-1);
    p = p.mul_add(r, 5.000_000_3e-1);
    let e = (p * r).mul_add(r, r) + 1.0;
    // The low bits of `rounded` are k. `as u32` saturates, which blocks vectorisation.
    e * f32::from_bits(rounded.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23)
}

/// Returns the integer part of x, for x in 0..=2^22, as a float and as an integer. `as u32`
/// saturates, which blocks vectorisation.
#[inline(always)]
pub(crate) fn floor(x: f32) -> (f32, u32) {
    const ROUND: f32 = 8_388_608.0;
    let nearest = (x + ROUND) - ROUND;
    let floor = if nearest > x { nearest - 1.0 } else { nearest };
    (floor, (floor + ROUND).to_bits() - ROUND.to_bits())
}

/// Returns 1 - e^(-x) for x ≥ 0 without cancellation at small x.
#[inline(always)]
pub(crate) fn one_minus_exp_neg(x: f32) -> f32 {
    // Taylor to x^7 below 0.25, where 1 - e^-x would cancel.
    let mut p = -1.0 / 5040.0f32;
    p = p.mul_add(-x, -1.0 / 720.0);
    p = p.mul_add(-x, -1.0 / 120.0);
    p = p.mul_add(-x, -1.0 / 24.0);
    p = p.mul_add(-x, -1.0 / 6.0);
    p = p.mul_add(-x, -0.5);
    p = p.mul_add(-x, -1.0);
    let series = p * -x;
    let direct = 1.0 - exp(-x);
    if x < 0.25 { series } else { direct }
}

/// Returns 1 / (1 + e^-x).
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Returns the real spherical harmonics of a unit direction up to degree 2.
#[inline]
pub fn spherical_harmonics([x, y, z]: [f32; 3]) -> [f32; BASIS] {
    [
        0.282_094_8,
        -0.488_602_5 * y,
        0.488_602_5 * z,
        -0.488_602_5 * x,
        1.092_548_4 * x * y,
        -1.092_548_4 * y * z,
        0.315_391_57 * (3.0 * z * z - 1.0),
        -1.092_548_4 * x * z,
        0.546_274_2 * (x * x - y * y),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// ∫ Yi·Yj over the sphere is 1 for i = j, otherwise 0.
    #[test]
    fn spherical_harmonics_are_orthonormal() {
        let n = 200;
        let mut gram = [[0.0f64; BASIS]; BASIS];
        for a in 0..n {
            for b in 0..n {
                let z = (2.0 * (f64::from(a) + 0.5) / f64::from(n)) - 1.0;
                let phi = std::f64::consts::TAU * (f64::from(b) + 0.5) / f64::from(n);
                let r = (1.0 - z * z).sqrt();
                let y =
                    spherical_harmonics([(r * phi.cos()) as f32, (r * phi.sin()) as f32, z as f32])
                        .map(f64::from);
                for i in 0..BASIS {
                    for j in 0..BASIS {
                        gram[i][j] += y[i] * y[j] * 4.0 * std::f64::consts::PI / f64::from(n * n);
                    }
                }
            }
        }
        for (i, row) in gram.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                assert!((value - f64::from(u8::from(i == j))).abs() < 1e-3, "{i} {j} {value}");
            }
        }
    }

    #[test]
    fn floor_is_the_integer_part() {
        for x in (0..200_000).map(|i| i as f32 * 0.021).chain([
            0.0,
            0.5,
            1.0,
            1.5,
            2.5,
            4096.0,
            4_194_303.5,
        ]) {
            assert_eq!(floor(x), (x.floor(), x as u32), "{x}");
        }
    }

    proptest! {
        #[test]
        fn exp_is_close_to_f64(x in -86.0f32..86.0) {
            let exact = f64::from(x).exp();
            prop_assert!(((f64::from(exp(x)) - exact) / exact).abs() < 2e-7, "{} {}", exp(x),
                exact);
        }

        #[test]
        fn small_optical_depths_keep_their_precision(e in -30.0f32..4.0) {
            let x = e.exp2();
            let exact = -(-f64::from(x)).exp_m1();
            prop_assert!(((f64::from(one_minus_exp_neg(x)) - exact) / exact).abs() < 4e-7, "{x}");
        }
    }

    #[test]
    fn extremes_stay_finite() {
        for x in [f32::NEG_INFINITY, -1e30, -88.0, 0.0, 88.0, 1e30, f32::INFINITY] {
            assert!(exp(x).is_finite() && exp(x) >= 0.0);
            assert!((0.0..=1.0).contains(&sigmoid(x)));
        }
        assert_eq!(exp(0.0), 1.0);
        assert_eq!(one_minus_exp_neg(0.0), 0.0);
        assert_eq!(one_minus_exp_neg(1e30), 1.0);
    }
}
