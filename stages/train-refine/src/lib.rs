//! `train-refine`: trains the network that refines rendered views, from views with ground truth.
//!
//! In the pipeline this is internal learning (design note 015): the views are LR-size renders of
//! the downscaled field, which is trained from LR images shrunk once more, and their truth is the
//! LR images. So the network is trained on LR images of its own scene alone.
//!
//! For refinement by references, training uses references, too: other views of the downscaled
//! field, each with its true image.
//!
//! If each view to be refined (input `cameras`) has its own LR photograph, as in the paper's split,
//! training views are made consistent with their LR photographs. Before refinement, `refine` then
//! makes views consistent with their photographs in the same way.
//!
//! Every eighth view is left out of training; the network's gain on these views is stored with it.
//!
//! With `net: paper` (block `train-paper`), the stage trains the paper's network on renders of the
//! references' views, for comparison. This takes weeks on a CPU.

mod compact;
mod examples;
mod paper;
mod params;
mod steps;

use artifact::Failure;
use refinement::{REFINER_FILE, RefinerFile};
use stage::{Context, Input, Output, Rule, Stage};

pub use params::{CompactParams, Net, PaperParams, Params};

/// Stage `train-refine`.
pub struct TrainRefine;

impl Stage for TrainRefine {
    type Params = Params;
    const NAME: &'static str = "train-refine";
    const SUMMARY: &'static str =
        "Trains the network that refines rendered views, from views with ground truth.";
    const LIBTORCH: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras =
            ["scene/cameras", "scene/train", "scene/truth", "scene/references", "cameras", "views"];
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            (
                "truth",
                Input::required(
                    &["scene/train", "scene/truth", "scene/references"],
                    "ground truth of the views",
                ),
            ),
            (
                "photographs",
                Input::optional(
                    &["scene/train"],
                    "LR photographs that the rendered field was trained on (`net: compact` only)",
                ),
            ),
            (
                "cameras",
                Input::optional(
                    &cameras,
                    "cameras of the views that `refine` will get (`net: compact` only); if each \
                    camera has an LR photograph in `photographs`, this stage's views are made \
                    consistent with their own LR photographs, as `refine` will do with its views \
                    before refinement",
                ),
            ),
            (
                "weights",
                Input::optional(
                    &["weights"],
                    "folder with VGG-19 for the perceptual loss (`net: paper` only); without it, \
                    the loss is L1",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("refiner")
    }

    fn rules() -> Vec<Rule> {
        vec![paper::weights_rule()]
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        match &params.net {
            Net::Compact(net) => compact::run(context, net, params.seed),
            Net::Paper(net) => paper::run(context, net, params.seed),
        }
    }
}

/// Writes the refiner's file, and reports the PSNR of some views before and after refinement.
fn write_refiner_file(context: &Context, views: &str, file: &RefinerFile) -> anyhow::Result<()> {
    let &RefinerFile { rendered_psnr, refined_psnr, residual_weight, .. } = file;
    if ![rendered_psnr, refined_psnr, residual_weight].iter().all(|score| score.is_finite()) {
        let message = format!("{views}: PSNR is not finite; lower the learning rate");
        return Err(Failure::Numerical(message).into());
    }
    context.write_json(REFINER_FILE, file)?;
    let summary = format!(
        "{views}: {rendered_psnr:.2} dB rendered, {refined_psnr:.2} dB refined (residual weight \
        {residual_weight:.2})"
    );
    context.log_line(&summary);
    context.write_summary(&summary)
}
