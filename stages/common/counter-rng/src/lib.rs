//! Random numbers as a function of a seed, a purpose and a counter (Salmon et al. 2011), so that
//! any thread may draw any of them at any time.
//!
//! ```
//! use counter_rng::{CounterRng, uniform};
//! let mut rng = CounterRng::new(7, 1, 3);
//! assert_eq!(rng.uniform(), uniform(7, 1, 3));
//! assert!(rng.below(10) < 10);
//! ```

/// Scrambles a counter (splitmix64).
#[inline]
fn scramble(mut x: u64) -> u64 {
    x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// A number in [0, 1) that depends on a seed, a purpose and a counter alone.
#[inline]
pub fn uniform(seed: u64, purpose: u64, counter: u64) -> f32 {
    CounterRng::new(seed, purpose, counter).uniform()
}

/// A sequence of random numbers that depends on a seed, a purpose and a counter alone.
#[derive(Clone, Debug)]
pub struct CounterRng(u64);

impl CounterRng {
    /// Starts the sequence.
    #[inline]
    pub fn new(seed: u64, purpose: u64, counter: u64) -> Self {
        Self(scramble(scramble(seed ^ purpose.wrapping_mul(0xD1B5_4A32_D192_ED03)) ^ counter))
    }

    #[inline]
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        scramble(self.0)
    }

    /// In [0, 1).
    #[inline]
    pub fn uniform(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 24) as f32
    }

    /// In 0..bound.
    #[inline]
    pub fn below(&mut self, bound: u64) -> u64 {
        ((u128::from(self.next()) * u128::from(bound)) >> 64) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::CounterRng;

    /// Results that are made anew must be those made before.
    #[test]
    fn draws_stay_as_they_are() {
        let mut rng = CounterRng::new(7, 1, 3);
        assert_eq!(rng.uniform(), 16_024_985.0 / 16_777_216.0);
        assert_eq!(rng.below(1000), 106);
    }
}
