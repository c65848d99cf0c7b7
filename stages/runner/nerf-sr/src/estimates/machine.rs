//! Speed of this machine relative to the reference machine, on which the constants of the estimates
//! were measured.

use std::sync::OnceLock;
use std::time::Instant;

use numerics::SpeedTest;

/// Seconds of a piece of work on the reference machine: two cores with AVX-512.
const REFERENCE_SECONDS: f64 = 0.42e-3;
/// Number of measurements, of which the fastest counts: others may have been interrupted by other
/// programs. All together take a hundredth of a second. Chosen by hand.
const MEASUREMENTS: u32 = 24;

/// Returns this machine's time for the work of [`SpeedTest`] over the reference machine's time. The
/// first call measures the machine.
pub(crate) fn slowness() -> f64 {
    static SLOWNESS: OnceLock<f64> = OnceLock::new();
    *SLOWNESS.get_or_init(measure)
}

fn measure() -> f64 {
    let mut test = SpeedTest::default();
    let mut fastest = f64::INFINITY;
    let mut sum = 0.0;
    for _ in 0..MEASUREMENTS {
        let start = Instant::now();
        sum += test.work();
        fastest = fastest.min(start.elapsed().as_secs_f64());
    }
    // The compiler must not leave the work out.
    std::hint::black_box(sum);
    fastest / REFERENCE_SECONDS
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Machines of the last twenty years are within a factor of fifty of the reference machine,
    /// even while other tests run.
    #[test]
    fn slowness_of_this_machine_is_plausible() {
        let start = Instant::now();
        let slowness = measure();
        println!("{slowness:.2} in {:.3} s", start.elapsed().as_secs_f64());
        assert!((0.02..50.0).contains(&slowness), "{slowness}");
    }
}
