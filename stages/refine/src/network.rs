use artifact::{Failure, FailureExt as _, GivenInput};
use paper_refiner::PaperRefiner;
use pixels::Image;
use refinement::{
    Guidance, KnownView, Network, Refiner, RefinerFile, Rendered, Use, WEIGHTS_FILE,
    with_references,
};

use crate::params::Params;

/// A trained network of either kind.
pub(crate) enum AnyRefiner {
    /// Ours.
    Compact(Refiner),
    /// The paper's, and how many reference patches each patch gets.
    Paper(PaperRefiner, usize),
}

/// How a network is applied to every view.
pub(crate) struct Application {
    /// Share of the predicted residual that is added.
    pub(crate) residual_weight: f32,
    /// Turned and mirrored versions whose residuals are averaged.
    pub(crate) self_ensemble: u32,
    /// Pixels by which patches of the paper's network overlap.
    pub(crate) overlap: usize,
}

impl Application {
    /// As asked for, else as the network's training found best.
    pub(crate) fn new(params: &Params, file: &RefinerFile) -> Self {
        Self {
            residual_weight: params.residual_weight.unwrap_or(file.residual_weight) as f32,
            self_ensemble: params.self_ensemble,
            overlap: params.overlap as usize,
        }
    }
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

    /// How it takes references, where it is ours and does.
    pub(crate) fn guidance(&self) -> Option<Guidance> {
        let Self::Compact(network) = self else { return None };
        network.architecture().guidance
    }

    pub(crate) fn takes_references(&self) -> bool {
        self.guidance().is_some() || matches!(self, Self::Paper(..))
    }

    /// What the network makes of a view: colours in 0..1. What each reference was of use for is
    /// added to `uses`.
    pub(crate) fn redraw(
        &self,
        rendered: &Rendered,
        references: &[KnownView],
        application: &Application,
        uses: &mut [Use],
    ) -> anyhow::Result<Image> {
        let references: Vec<&KnownView> = references.iter().collect();
        let &Application { residual_weight, self_ensemble, overlap } = application;
        match self {
            Self::Compact(network) => {
                let Some(guidance) = self.guidance() else {
                    return Ok(network.refine_weighted(
                        &rendered.view,
                        residual_weight,
                        self_ensemble,
                    )?);
                };
                let conditioned = with_references(rendered, &references, guidance);
                uses.iter_mut().zip(&conditioned.uses).for_each(|(sum, of_use)| sum.add(of_use));
                Ok(network.refine_weighted(&conditioned.view, residual_weight, self_ensemble)?)
            }
            Self::Paper(network, patches) => {
                let mut drawn = network
                    .refine(rendered, &references, *patches, overlap)
                    .bad_input("input views")?;
                blend(&rendered.view, &mut drawn, residual_weight);
                Ok(drawn)
            }
        }
    }
}

/// Moves redrawn colours towards the view's where the weight is below 1, and beyond where it is
/// above; in 0..1. The view has four channels, the redrawn image three.
fn blend(view: &Image, drawn: &mut Image, weight: f32) {
    for (to, from) in drawn.data.chunks_exact_mut(3).zip(view.data.chunks_exact(4)) {
        (0..3).for_each(|c| to[c] = (from[c] + weight * (to[c] - from[c])).clamp(0.0, 1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weight_goes_from_the_view_to_what_was_redrawn() {
        let view = Image::new(1, 1, 4, vec![0.2, 0.4, 0.9, 1.0]);
        for (weight, expected) in [
            (0.0, [0.2, 0.4, 0.9]),
            (0.5, [0.3, 0.4, 0.8]),
            (1.0, [0.4, 0.4, 0.7]),
            (2.0, [0.6, 0.4, 0.5]),
        ] {
            let mut drawn = Image::new(1, 1, 3, vec![0.4, 0.4, 0.7]);
            blend(&view, &mut drawn, weight);
            let is_near = |(a, b): (&f32, f32)| (a - b).abs() < 1e-6;
            assert!(drawn.data.iter().zip(expected).all(is_near), "{weight}: {:?}", drawn.data);
        }
        let mut drawn = Image::new(1, 1, 3, vec![1.0, 0.0, 0.9]);
        blend(&view, &mut drawn, 2.0);
        assert_eq!(drawn.data, [1.0, 0.0, 0.9], "colours stay in 0..1");
    }
}
