/// Errors of colours beyond this are outliers: what moved, or was never learnt.
pub(crate) const HUBER_ERROR: f64 = 0.1;

/// Huber's robust error.
pub(crate) fn huber(error: f64) -> f64 {
    let size = error.abs();
    if size > HUBER_ERROR { HUBER_ERROR * (2.0 * size - HUBER_ERROR) } else { size * size }
}
