use pixels::Kernel;
use scene::Background;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::bounds::SpaceKind;

/// Parameters of `prep`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the LR images in pixels; the height follows the aspect. Default: the HR width
    /// divided by `scale`.
    #[schemars(range(min = 1), extend("x-group" = "output", "x-default" = "by data set"))]
    pub lr_width: Option<u32>,
    /// Width of the HR images in pixels. Default: `lr_width` times `scale`, or the width of the
    /// images given.
    #[schemars(range(min = 1), extend("x-group" = "output", "x-default" = "by data set"))]
    pub hr_width: Option<u32>,
    /// HR width over LR width. It needn't be given beside both widths.
    #[schemars(range(min = 1.0, max = 16.0), extend("x-group" = "output", "x-default" = "2"))]
    pub scale: Option<f64>,
    /// Where LR images come from: `photographs` as given, without HR ground truth, or `downscaled`
    /// from HR images by `kernel`. Default: `downscaled` for a benchmark's data set and with
    /// `lr_width`, else `photographs`.
    #[schemars(extend("x-group" = "data", "x-default" = "by data set"))]
    pub lr_source: Option<LrSource>,
    /// Kernel that makes LR images from HR ones. With `lr_source: photographs`, the kernel that is
    /// assumed to have made them. Default: `lanczos` for downscaled images, `box` for photographs.
    #[schemars(extend("x-group" = "data", "x-default" = "by `lr_source`"))]
    pub kernel: Option<Kernel>,
    /// Treatment of lens distortion and of fisheye lenses, where the data set states them.
    #[schemars(extend("x-group" = "data"))]
    pub lens: LensHandling,
    /// What lies behind the scene. Default: `white` where images have alpha. Without alpha `white`
    /// or `black` where the borders of nine in ten views are that colour and no strips, else
    /// `opaque`.
    #[schemars(extend("x-group" = "field", "x-default" = "by data set"))]
    pub background: Option<Background>,
    /// Distance along rays before which nothing lies. Default: from the cameras.
    #[schemars(range(min = 0.0), extend("x-group" = "field", "x-default" = "by data set"))]
    pub near: Option<f64>,
    /// Distance along rays behind which nothing lies. Default: from the cameras.
    #[schemars(range(min = 0.0), extend("x-group" = "field", "x-default" = "by data set"))]
    pub far: Option<f64>,
    /// Space that the field keeps in its unit cube. Default: `ndc` where all cameras look one way
    /// and the nearest depth is known or the background is `opaque`, `contraction` where else it is
    /// `opaque` or points are known far outside the space that the cameras look at, else `box`.
    #[schemars(extend("x-group" = "field", "x-default" = "by data set"))]
    pub space: Option<SpaceKind>,
    /// Which views are for training and which for testing. Default: the data set's own split, else
    /// `holdout`.
    #[schemars(extend("x-group" = "data", "x-default" = "by data set"))]
    pub split: Option<SplitKind>,
    /// Maximum number of test views, spread evenly.
    #[schemars(range(min = 1), extend("x-group" = "data", "x-default" = "all"))]
    pub test_views: Option<u32>,
    /// Number of training views that are kept at HR, as references. The first view is one; each
    /// further one has the camera farthest from those before.
    #[schemars(extend("x-group" = "data"))]
    pub hr_references: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            lr_width: None,
            hr_width: None,
            scale: None,
            lr_source: None,
            kernel: None,
            lens: LensHandling::Follow,
            background: None,
            near: None,
            far: None,
            space: None,
            split: None,
            test_views: None,
            hr_references: 1,
        }
    }
}

/// What is done about lens distortion, where the data say what it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LensHandling {
    /// Rays follow it: photographs stay as they were taken, to the last pixel, and so do rendered
    /// views. Pixels more than 89° from the axis of a fisheye lens are masked.
    Follow,
    /// Photographs are resampled to what pinhole cameras would have taken, and lose a border. A
    /// fisheye lens's pinhole camera sees at most 100° across the longer side.
    Undo,
    /// Photographs are taken for a pinhole's: the habit with LLFF's scenes, whose files don't speak
    /// of lenses. To compare with.
    Ignore,
}

/// Where LR images come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LrSource {
    /// The photographs as they are given; there is no HR truth.
    Photographs,
    /// HR images, made smaller by `kernel`.
    Downscaled,
}

/// Ways to part views for training from views for testing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SplitKind {
    /// As the data set itself says.
    Given,
    /// Every eighth view, the first among them, is for testing alone: what a figure needs to be
    /// honest.
    Holdout,
    /// All views are for both, references excepted, which aren't tested: the paper's way with
    /// photographs.
    Paper,
}
