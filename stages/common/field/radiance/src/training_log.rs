use std::collections::BTreeMap;

use scene::{Pose, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Name of a [`TrainingLog`] in a field artifact.
pub const TRAINING_FILE: &str = "training.json";

/// Content of `training.json`: course of training, over all ensemble members in order.
// No serde `deny_unknown_fields`: sinks also read logs of other versions, which may have more
// fields.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct TrainingLog {
    /// Number of steps.
    pub steps: u64,
    /// Number of rays.
    pub rays: u64,
    /// Mean number of samples per ray.
    pub samples_per_ray: f64,
    /// Final values of the parameters whose default depends on the scene, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub resolved: BTreeMap<String, Value>,
    /// PSNR of the training pixels against the number of rays, about a hundred points per member.
    pub curve: Vec<CurvePoint>,
    /// RGB gain of each training view relative to the field, in the order of `views.json`; empty
    /// unless exposures are estimated. From the first member.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub exposures: Vec<[f32; 3]>,
    /// `camera_to_world` of each training view in the order of `views.json`: refined poses, or the
    /// given ones if refinement didn't improve them; empty without pose refinement. From the first
    /// member.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub poses: Vec<Pose>,
    /// Warnings, one line each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}

impl TrainingLog {
    /// Appends the log of the next member. `resolved` stays unchanged, and exposures and poses are
    /// those of the first member.
    pub fn append(&mut self, next: TrainingLog) {
        let samples =
            self.samples_per_ray * self.rays as f64 + next.samples_per_ray * next.rays as f64;
        let before = self.rays;
        if self.steps == 0 {
            self.exposures = next.exposures;
            self.poses = next.poses;
        }
        self.warnings.extend(next.warnings);
        self.curve
            .extend(next.curve.into_iter().map(|p| CurvePoint { rays: before + p.rays, ..p }));
        self.steps += next.steps;
        self.rays += next.rays;
        self.samples_per_ray = samples / self.rays.max(1) as f64;
    }

    /// True if the poses differ from the given ones.
    pub fn has_moved_cameras(&self, views: &Views) -> bool {
        self.poses.iter().zip(&views.views).any(|(pose, view)| *pose != view.camera.camera_to_world)
    }
}

/// Point of the training curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct CurvePoint {
    /// Number of rays cast so far.
    pub rays: u64,
    /// PSNR of the pixels trained on since the previous point, in dB.
    pub psnr: f64,
}
