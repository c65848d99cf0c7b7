use std::collections::BTreeMap;

use scene::Views;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// `training.json`: how the training went, over all members one after the other.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainingLog {
    /// Steps taken.
    pub steps: u64,
    /// Rays cast.
    pub rays: u64,
    /// Mean samples a ray over the whole training.
    pub samples_per_ray: f64,
    /// Values in use of the parameters whose default depends on the scene, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub resolved: BTreeMap<String, Value>,
    /// PSNR of training pixels against rays, about a hundred points a member.
    pub curve: Vec<CurvePoint>,
    /// How many times as bright as all together each training view is, in the order of
    /// `views.json`, red, green and blue, where that was asked for; of the first member.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub exposures: Vec<[f32; 3]>,
    /// Where each training view was found to be taken from, `camera_to_world` in the order of
    /// `views.json`, where that was asked for; of the first member. The given poses where no better
    /// ones were found.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub poses: Vec<scene::Pose>,
    /// What looks wrong about it, a line each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}

impl TrainingLog {
    /// Appends another training's.
    pub(crate) fn add(&mut self, next: TrainingLog) {
        let samples =
            self.samples_per_ray * self.rays as f64 + next.samples_per_ray * next.rays as f64;
        let before = self.rays;
        if self.steps == 0 {
            (self.exposures, self.poses) = (next.exposures, next.poses);
        }
        self.warnings.extend(next.warnings);
        self.curve
            .extend(next.curve.into_iter().map(|p| CurvePoint { rays: before + p.rays, ..p }));
        self.steps += next.steps;
        self.rays += next.rays;
        self.samples_per_ray = samples / self.rays.max(1) as f64;
    }

    /// Whether it has found other poses than the given ones.
    pub(crate) fn moves_cameras(&self, views: &Views) -> bool {
        self.poses.iter().zip(&views.views).any(|(pose, view)| *pose != view.camera.camera_to_world)
    }
}

/// A point of the training curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CurvePoint {
    /// Rays cast until here.
    pub rays: u64,
    /// PSNR over the training pixels since the last point.
    pub psnr: f64,
}

/// Name of a [`TrainingLog`] in the output.
pub(crate) const TRAINING_FILE: &str = "training.json";
