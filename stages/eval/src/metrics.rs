use crate::depth::DepthMetric;
use crate::low_resolution::LowResolutionMetric;
use crate::metric::Metric;
use crate::perceptual::Perceptual;
use crate::psnr::PsnrMetric;
use crate::ssim::SsimMetric;
use crate::warp::WarpMetric;

/// All metrics, in the order in which they are shown.
pub(crate) fn metrics(perceptual: Perceptual) -> Vec<Box<dyn Metric>> {
    vec![
        Box::new(PsnrMetric),
        Box::new(SsimMetric),
        Box::new(perceptual),
        Box::new(LowResolutionMetric),
        Box::new(WarpMetric),
        Box::new(DepthMetric),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metric::Figure;

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
