use artifact::{WARNING, format_count, with_warnings};
use dataset::Dataset;
use pixels::Kernel;
use scene::{Background, Bounds, format_length};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::scene_plan::ScenePlan;
use crate::sizes::Sizes;

/// `scene.json`: human-readable record of `prep`'s findings and choices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SceneSummary {
    /// Format of the data set.
    pub format: String,
    /// Width and height of the data set's images.
    pub native: [u32; 2],
    /// HR width and height.
    pub hr: [u32; 2],
    /// Width and height of the LR images.
    pub lr: [u32; 2],
    /// HR size over LR size along x and y.
    pub scale: [f64; 2],
    /// True if LR images were downscaled from HR images.
    pub has_truth: bool,
    /// Kernel that created the LR images, or is assumed to have created them.
    pub kernel: Kernel,
    /// Background of the scene.
    pub background: Background,
    /// Extent and space of the scene.
    pub bounds: Bounds,
    /// Part of the LR images' resolution that their detail reaches, from 0 to 1; `None` for images
    /// without structure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detail: Option<f64>,
    /// Number of training views.
    pub train: usize,
    /// Number of test views.
    pub test: usize,
    /// True if test views have true depth.
    pub has_depth: bool,
    /// Findings and choices, one per line.
    pub notes: Vec<String>,
}

impl SceneSummary {
    /// Summarises a written scene.
    pub(crate) fn new(
        set: &Dataset,
        plan: &ScenePlan<'_>,
        detail: Option<f64>,
        notes: Vec<String>,
    ) -> Self {
        let ScenePlan { images, background, bounds, train, test, .. } = plan;
        let Sizes { lr, hr } = images.sizes;
        Self {
            format: set.format.to_string(),
            native: images.native.into(),
            hr: hr.into(),
            lr: lr.into(),
            scale: [f64::from(hr.0) / f64::from(lr.0), f64::from(hr.1) / f64::from(lr.1)],
            has_truth: images.has_truth,
            kernel: images.kernel,
            background: *background,
            bounds: *bounds,
            detail,
            train: train.len(),
            test: test.len(),
            has_depth: images.has_truth && test.iter().any(|frame| frame.depth_file.is_some()),
            notes,
        }
    }

    /// Formats the stage's summary line, followed by the warnings.
    pub(crate) fn text(&self) -> String {
        let warnings: Vec<String> =
            self.notes.iter().filter_map(|n| n.strip_prefix(WARNING)).map(str::to_owned).collect();
        let ([lr_width, lr_height], [hr_width, hr_height]) = (self.lr, self.hr);
        let (train, test) =
            (format_count(self.train, "training view"), format_count(self.test, "test view"));
        let [near, far] = [self.bounds.near, self.bounds.far].map(|end| format_length(end, 2));
        let kernel = format!("{:?}", self.kernel).to_lowercase();
        let origin = if self.has_truth {
            format!("from {hr_width}×{hr_height} ({kernel})")
        } else {
            format!("(photographs; HR is {hr_width}×{hr_height})")
        };
        let summary = format!(
            "{train} at {lr_width}×{lr_height} {origin}, {test}; rays from {near} to {far}"
        );
        with_warnings(&summary, &warnings)
    }
}
