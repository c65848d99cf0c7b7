/// Scrambles a counter (splitmix64).
#[inline]
fn scramble(mut x: u64) -> u64 {
    x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// Returns a number in [0, 1) that depends only on seed, stream and counter.
#[inline]
pub fn uniform(seed: u64, stream: u64, counter: u64) -> f32 {
    CounterRng::new(seed, stream, counter).uniform()
}

/// Sequence of random numbers that depends only on seed, stream and counter.
#[derive(Clone, Debug)]
pub struct CounterRng(u64);

impl CounterRng {
    /// Starts a sequence.
    #[inline]
    pub fn new(seed: u64, stream: u64, counter: u64) -> Self {
        Self(scramble(scramble(seed ^ stream.wrapping_mul(0xD1B5_4A32_D192_ED03)) ^ counter))
    }

    #[inline]
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        scramble(self.0)
    }

    /// Draws a number in [0, 1).
    #[inline]
    pub fn uniform(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 24) as f32
    }

    /// Draws from the standard normal distribution (Box and Muller 1958).
    pub fn normal(&mut self) -> f64 {
        // Never 0, whose logarithm is infinite.
        let u = 1.0 - f64::from(self.uniform());
        let v = f64::from(self.uniform());
        (-2.0 * libm::log(u)).sqrt() * libm::cos(std::f64::consts::TAU * v)
    }

    /// Draws an integer in 0..bound.
    #[inline]
    pub fn below(&mut self, bound: u64) -> u64 {
        ((u128::from(self.next()) * u128::from(bound)) >> 64) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::CounterRng;

    /// Other draws would change every result.
    #[test]
    fn draws_are_pinned() {
        let mut rng = CounterRng::new(7, 1, 3);
        assert_eq!(rng.uniform(), 16_024_985.0 / 16_777_216.0);
        assert_eq!(rng.below(1000), 106);
    }
}
