//! Numerical tools whose results have equal bits on any machine and at any thread count.
//!
//! * [`CounterRng`], [`uniform`]: random numbers as a function of seed, stream (one per use) and
//!   counter (Salmon et al. 2011), so that threads draw them in any order.
//! * [`kernel!`]: a function on sixteen logical lanes ([`simd::Lanes`]), compiled for AVX-512, AVX2
//!   and the compilation target. The family is chosen at run time.
//! * [`SpeedTest`]: a fixed piece of work, whose time compares machines.
//!
//! ```
//! use numerics::{CounterRng, uniform};
//! let mut rng = CounterRng::new(7, 1, 3);
//! assert_eq!(rng.uniform(), uniform(7, 1, 3));
//! assert!(rng.below(10) < 10);
//! ```

mod random;
pub mod simd;
mod speed;

pub use random::{CounterRng, uniform};
pub use speed::SpeedTest;
