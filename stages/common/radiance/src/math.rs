//! Exponentials whose bits don't depend on the machine, written so that loops over them vectorise.

/// e^x for finite x; saturates at about e^±87. Relative error below 2e-7.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    // max before min, so that NaN becomes a number here; NaNs are looked for in sums, not in every
    // exponent.
    let x = x.max(-87.0).min(87.0);
    // Adding and taking away 1.5·2^23 rounds to the nearest whole number.
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
    // The low bits of `rounded` are k; a cast would saturate, and so not vectorise.
    e * f32::from_bits(rounded.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23)
}

/// The whole number not above x, for x in 0..=2^22, as a number and as an integer. A cast would
/// saturate, and so not vectorise.
#[inline(always)]
pub(crate) fn floor(x: f32) -> (f32, u32) {
    const ROUND: f32 = 8_388_608.0;
    let nearest = (x + ROUND) - ROUND;
    let floor = if nearest > x { nearest - 1.0 } else { nearest };
    (floor, (floor + ROUND).to_bits() - ROUND.to_bits())
}

/// 1 - e^(-x) for x ≥ 0, without losing small x to cancellation.
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

/// 1 / (1 + e^-x).
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn floor_is_the_whole_part() {
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
        fn close_to_f64(x in -86.0f32..86.0) {
            let exact = f64::from(x).exp();
            prop_assert!(((f64::from(exp(x)) - exact) / exact).abs() < 2e-7, "{} {}", exp(x),
                exact);
        }

        #[test]
        fn small_optical_depths_keep_their_digits(e in -30.0f32..4.0) {
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
