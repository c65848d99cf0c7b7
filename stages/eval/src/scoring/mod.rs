//! What views are scored by: a file for each metric. A new one is a file, and here its `mod` and
//! its line in the list.

mod depth;
mod low_resolution;
#[cfg(feature = "torch")]
mod lpips;
mod lpips_network;
mod perceptual;
mod psnr;
mod ssim;
mod warp;

use crate::metric::Metric;

pub use depth::{DepthError, depth_error};
#[cfg(feature = "torch")]
pub use lpips::Lpips;
pub use lpips_network::LpipsNetwork;
pub(crate) use perceptual::Perceptual;
pub use psnr::psnr;
pub use ssim::{Ssim, ssim};
pub use warp::WarpScore;

/// All metrics, in the order in which they are shown.
pub(crate) fn metrics(perceptual: Perceptual) -> Vec<Box<dyn Metric>> {
    vec![
        Box::new(psnr::PsnrMetric),
        Box::new(ssim::SsimMetric),
        Box::new(perceptual),
        Box::new(low_resolution::LowResolutionMetric),
        Box::new(warp::WarpMetric),
        Box::new(depth::DepthMetric),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use metrics::Figure;

    /// Every figure's number is among the scores, and has a name of its own.
    #[test]
    fn figures_are_told_apart() {
        let all = metrics(Perceptual::new(None).unwrap());
        let figures: Vec<Figure> = all.iter().flat_map(|metric| metric.figures()).collect();
        for (i, figure) in figures.iter().enumerate() {
            assert!(figures[..i].iter().all(|f| f.path != figure.path && f.label != figure.label));
        }
        assert_eq!(figures[0].path, "psnr");
    }
}
