use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::Image;
use refinement::paper::PaperRefiner;
use refinement::{
    KnownView, Network, ReferenceStatistics, Refiner, RefinerFile, Rendered, WEIGHTS_FILE,
    WarpOptions, with_references,
};

/// Trained network of either kind.
pub(crate) enum AnyRefiner {
    /// Our network.
    Compact(Refiner),
    /// The paper's network, and the number of reference patches per patch.
    Paper(PaperRefiner, usize),
}

/// Settings for applying a network to every view.
pub(crate) struct RefinementOptions {
    /// Fraction of the predicted residual that is added: the best one for the validation views, or
    /// 1 for the paper's network.
    pub(crate) residual_weight: f32,
    /// Number of rotated and mirrored versions whose residuals are averaged; the paper's network
    /// ignores it.
    pub(crate) self_ensemble: u32,
}

impl AnyRefiner {
    pub(crate) fn read(input: &GivenInput, file: &RefinerFile) -> Result<Self, Failure> {
        let path = input.path(WEIGHTS_FILE);
        match file.network {
            Network::Compact(architecture) => Refiner::read(&path, architecture).map(Self::Compact),
            Network::Paper { width, patches } => {
                PaperRefiner::read(&path, width).map(|n| Self::Paper(n, patches as usize))
            }
        }
        .bad_input("input refiner")
    }

    /// Returns the options for warping references; `None` if the network is the paper's or takes no
    /// references.
    pub(crate) fn warp_options(&self) -> Option<WarpOptions> {
        let Self::Compact(network) = self else { return None };
        network.architecture().guidance
    }

    pub(crate) fn takes_references(&self) -> bool {
        self.warp_options().is_some() || matches!(self, Self::Paper(..))
    }

    /// Refines a view; the result's colours are in 0..1. If the network warps references, adds each
    /// reference's statistics in this view to `statistics`.
    pub(crate) fn refine(
        &self,
        rendered: &Rendered,
        references: &[KnownView],
        options: &RefinementOptions,
        statistics: &mut [ReferenceStatistics],
    ) -> anyhow::Result<Image> {
        let references: Vec<&KnownView> = references.iter().collect();
        let &RefinementOptions { residual_weight, self_ensemble } = options;
        match self {
            Self::Compact(network) => {
                let conditioned = self
                    .warp_options()
                    .map(|warp_options| with_references(rendered, &references, warp_options));
                if let Some(conditioned) = &conditioned {
                    ReferenceStatistics::add_each(statistics, &conditioned.statistics);
                }
                let view =
                    conditioned.as_ref().map_or(&rendered.view, |conditioned| &conditioned.view);
                Ok(network.refine_weighted(view, residual_weight, self_ensemble)?)
            }
            Self::Paper(network, patches) => {
                let mut redrawn =
                    network.refine(rendered, &references, *patches).bad_input("input views")?;
                blend(&rendered.view, &mut redrawn, residual_weight);
                Ok(redrawn)
            }
        }
    }
}

/// Blends from the view (weight 0) to the redrawn image (weight 1) and beyond, clamped to 0..1. The
/// view has four channels, the redrawn image three.
fn blend(view: &Image, redrawn: &mut Image, weight: f32) {
    for (i, to) in redrawn.data.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        for c in 0..3 {
            let from = view.data[4 * i + c];
            to[c] = (from + weight * (to[c] - from)).clamp(0.0, 1.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weight_blends_from_the_view_to_the_redrawn_image() {
        let view = Image::new(1, 1, 4, vec![0.2, 0.4, 0.9, 1.0]);
        for (weight, expected) in [
            (0.0, [0.2, 0.4, 0.9]),
            (0.5, [0.3, 0.4, 0.8]),
            (1.0, [0.4, 0.4, 0.7]),
            (2.0, [0.6, 0.4, 0.5]),
        ] {
            let mut redrawn = Image::new(1, 1, 3, vec![0.4, 0.4, 0.7]);
            blend(&view, &mut redrawn, weight);
            let is_near = |(a, b): (&f32, f32)| (a - b).abs() < 1e-6;
            assert!(redrawn.data.iter().zip(expected).all(is_near), "{weight}: {:?}", redrawn.data);
        }
        let mut redrawn = Image::new(1, 1, 3, vec![1.0, 0.0, 0.9]);
        blend(&view, &mut redrawn, 2.0);
        assert_eq!(redrawn.data, [1.0, 0.0, 0.9], "colours stay in 0..1");
    }
}
