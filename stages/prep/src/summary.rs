use artifact::{WARNING, counted, with_warnings};
use dataset::Dataset;
use pixels::Kernel;
use scene::{Background, Bounds, length};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::scene_plan::ScenePlan;
use crate::sizes::Sizes;

/// `scene.json`: what `prep` found and chose, for people.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SceneSummary {
    /// Form of the data set.
    pub format: String,
    /// Size of the data's own images.
    pub native: [u32; 2],
    /// Size of the HR images.
    pub hr: [u32; 2],
    /// Size of the LR images.
    pub lr: [u32; 2],
    /// HR over LR, per axis.
    pub scale: [f64; 2],
    /// Whether LR images were made from HR ones.
    pub has_truth: bool,
    /// How LR images were made, or are taken to have been made.
    pub kernel: Kernel,
    /// What lies behind the scene.
    pub background: Background,
    /// Where the scene is.
    pub bounds: Bounds,
    /// Number of training views.
    pub train: usize,
    /// Number of test views.
    pub test: usize,
    /// Whether test views have true depth.
    pub has_depth: bool,
    /// What was found and chosen, a line each.
    pub notes: Vec<String>,
}

impl SceneSummary {
    /// Of a scene that was made, with what was found and chosen.
    pub(crate) fn new(set: &Dataset, plan: &ScenePlan<'_>, notes: Vec<String>) -> Self {
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
            train: train.len(),
            test: test.len(),
            has_depth: images.has_truth && test.iter().any(|frame| frame.depth.is_some()),
            notes,
        }
    }

    /// A line for people, and warnings after it.
    pub(crate) fn in_words(&self) -> String {
        let warnings: Vec<String> =
            self.notes.iter().filter_map(|n| n.strip_prefix(WARNING)).map(str::to_owned).collect();
        let ([lr_width, lr_height], [hr_width, hr_height]) = (self.lr, self.hr);
        let (train, test) = (counted(self.train, "training view"), counted(self.test, "test view"));
        let [near, far] = [self.bounds.near, self.bounds.far].map(|end| length(end, 2));
        let kernel = self.kernel;
        let summary = format!(
            "{train} at {lr_width}×{lr_height} from {hr_width}×{hr_height} ({kernel:?}), {test}; \
            rays from {near} to {far}"
        );
        with_warnings(&summary, &warnings)
    }
}
