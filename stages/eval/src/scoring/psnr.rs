use pixels::{Image, psnr_of};

/// Peak signal-to-noise ratio in dB, peak 1, of the mean squared error over all samples.
/// Predictions lie in [0, 1]; equal images, which have no PSNR, count as 100 dB.
pub fn psnr(found: &Image, expected: &Image) -> f64 {
    let pairs = found.data.iter().zip(&expected.data);
    let sum: f64 = pairs.map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
    psnr_of(sum / found.data.len() as f64)
}

/// [`psnr`] of the pixels that count, where these are so much of all pixels and the others are
/// equal.
pub(super) fn masked_psnr(found: &Image, expected: &Image, counted_share: f64) -> f64 {
    psnr(found, expected) + 10.0 * counted_share.log10()
}
