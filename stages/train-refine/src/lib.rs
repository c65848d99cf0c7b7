//! `train-refine`: trains the network that refines rendered views, from views whose truth is known.
//!
//! This is internal learning; in the pipeline the views are of the downscaled field: a field
//! trained from LR images that were shrunk once more, rendered at LR size, beside the LR images
//! themselves. So it sees LR images alone, and the scene it is for.
//!
//! For views that will be refined by references, it sees references in training, too: other views
//! of the downscaled field, of which every one has its true image.
//!
//! Where all views to be refined (input `cameras`) have LR photographs of their own, as in the
//! paper's split, they are made consistent with those before the network sees them; so do the views
//! that it learns from.
//!
//! Every eighth view is left out of training; what the network brings there is measured and kept
//! with it.
//!
//! `net: paper` trains the published network instead, on the rendered views of references beside
//! the references (block `train-paper`): that is for comparison, and takes weeks on a CPU.

mod compact;
mod examples;
mod paper;
mod params;
mod said;
mod steps;

use contract::{Input, Output};
use stage::{Context, Stage};

pub use params::{CompactParams, Net, PaperParams, Params};

/// The stage.
pub struct TrainRefine;

impl Stage for TrainRefine {
    type Params = Params;
    const NAME: &'static str = "train-refine";
    const SUMMARY: &'static str =
        "Trains the network that refines rendered views, from views whose truth is known.";

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras =
            ["scene/cameras", "scene/train", "scene/truth", "scene/references", "cameras", "views"];
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            (
                "truth",
                Input::required(
                    &["scene/train", "scene/truth", "scene/references"],
                    "what they should look like",
                ),
            ),
            (
                "photographs",
                Input::optional(
                    &["scene/train"],
                    "net: compact: LR photographs that the field which rendered them was trained \
                    on",
                ),
            ),
            (
                "cameras",
                Input::optional(
                    &cameras,
                    "net: compact: cameras of the views to be refined; where all have LR \
                    photographs, so have examples",
                ),
            ),
            (
                "weights",
                Input::optional(
                    &["weights"],
                    "net: paper: folder with VGG-19, for the perceptual loss; without it L1 alone",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("refiner")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        match &params.net {
            Net::Compact(net) => compact::run(context, net, params.seed),
            Net::Paper(net) => paper::run(context, net, params.seed),
        }
    }
}
