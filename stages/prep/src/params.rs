use pixels::Kernel;
use scene::Background;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::bounds::SpaceKind;

/// Parameters of `prep`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the LR images in pixels; the height follows the aspect ratio. Has no effect with
    /// `lr_source: photographs`. Default: the width of the data set's images divided by `scale`.
    #[schemars(range(min = 1), extend("x-group" = "output", "x-default" = "by data set"))]
    pub lr_width: Option<u32>,
    /// HR width divided by LR width.
    #[schemars(range(min = 1.0, max = 16.0), extend("x-group" = "output"))]
    pub scale: f64,
    /// Source of the LR images: the `photographs` themselves, without HR ground truth, or images
    /// `downscaled` from HR images by `kernel`. Default: `downscaled` for benchmark formats
    /// (Blender, LLFF) and with `lr_width`, otherwise `photographs`.
    #[schemars(extend("x-group" = "data", "x-default" = "by data set"))]
    pub lr_source: Option<LrSource>,
    /// Degradation kernel from HR to LR images. With `lr_source: photographs`, the assumed kernel
    /// of the photographs. Default: `lanczos` for downscaled images, `box` for photographs.
    #[schemars(extend("x-group" = "data", "x-default" = "by `lr_source`"))]
    pub kernel: Option<Kernel>,
    /// Treatment of lens distortion and of fisheye lenses that the data set describes. `follow`:
    /// rays follow the distortion. `undo`: photographs are resampled without it, which crops their
    /// borders.
    #[schemars(extend("x-group" = "data"))]
    pub lens: LensHandling,
    /// Background of the scene. Default: `white` if images have alpha. Without alpha, `white` or
    /// `black` if most of the border has that colour in nine of ten views and isn't an empty margin
    /// from undistortion or letterboxing, otherwise `opaque`.
    #[schemars(extend("x-group" = "field", "x-default" = "by data set"))]
    pub background: Option<Background>,
    /// Distance along rays at which the scene starts. With `space: ndc` and known depths, a value
    /// below the derived one has no effect. Default: derived from the cameras.
    #[schemars(range(min = 0.0), extend("x-group" = "field", "x-default" = "by data set"))]
    pub near: Option<f64>,
    /// Distance along rays at which the scene ends. With `space: ndc` and known depths, a value
    /// above the derived one has no effect. Default: derived from the cameras.
    #[schemars(range(min = 0.0), extend("x-group" = "field", "x-default" = "by data set"))]
    pub far: Option<f64>,
    /// Space of the field's unit cube. Default: the first of these whose condition is true. `ndc`:
    /// all cameras face one direction, and depths are known or the background is `opaque`.
    /// `contraction`: depths are unknown and the background is `opaque`, or known points are far
    /// outside the region that the cameras face. `box`: in all other cases.
    #[schemars(extend("x-group" = "field", "x-default" = "by data set"))]
    pub space: Option<SpaceKind>,
    /// Split into training and test views. `given`: the data set's own. `holdout`: every eighth
    /// view is a test view. `paper`: all views are trained on, and all except references are test
    /// views. Default: `given` if the data set has a split, otherwise `holdout`.
    #[schemars(extend("x-group" = "data", "x-default" = "by data set"))]
    pub split: Option<SplitKind>,
    /// Maximum number of test views, chosen at even intervals.
    #[schemars(range(min = 1), extend("x-group" = "data", "x-default" = "all"))]
    pub test_views: Option<u32>,
    /// Number of training views that are also stored at HR, as references. The first training view
    /// is the first reference; each further one has the camera farthest from all previous ones.
    /// There are no references with `lr_source: photographs`.
    #[schemars(extend("x-group" = "data"))]
    pub hr_references: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            lr_width: None,
            scale: 2.0,
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

/// Treatment of lens distortion that the data set describes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LensHandling {
    /// Rays follow the distortion: photographs are unchanged, and rendered views have the same
    /// distortion. Pixels more than 89° from the axis of a fisheye lens are masked.
    Follow,
    /// Photographs are resampled to pinhole cameras, which crops their border. The pinhole camera
    /// that replaces a fisheye lens has a field of view of at most 100° along the longer side.
    Undo,
}

/// Source of the LR images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LrSource {
    /// The unmodified photographs; HR truth doesn't exist.
    Photographs,
    /// HR images, downscaled by `kernel`.
    Downscaled,
}

/// Split of the views into training and test views.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SplitKind {
    /// The data set's own split.
    Given,
    /// Every eighth view, starting with the first, is a test view and never trained on, so that
    /// scores measure unseen views.
    Holdout,
    /// All views are training views, and all except references are test views: the paper's protocol
    /// for photographs.
    Paper,
}
