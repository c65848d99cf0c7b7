//! Models of the processor time and peak memory of `train-ss`.

use radiance::GivenSizes;
use serde::Deserialize as _;
use serde_json::Value;
use store::SceneKind;
use workload::{PixelStorage, RayBudget, TrainingMemory, grid_training_bytes, program_bytes};

use super::number;
use crate::estimates::work::Work;

/// Costs of training in a kind of scene.
#[derive(Clone, Copy)]
struct TrainingCosts {
    /// Seconds per training ray late in a training, without those per step.
    ray_seconds: f64,
    /// Samples of a ray late in a training.
    ray_samples: f64,
    /// Seconds per step of any size.
    step_seconds: f64,
}

/// Costs measured on lego 100×2, fern 252×2 and the demo scene with backdrop, with steps of 6,144
/// to 24,576 samples (docs/results/engine.md). More cells of a frustum are occupied, and its tables
/// are larger.
const OBJECT: TrainingCosts =
    TrainingCosts { ray_seconds: 10.8e-6, ray_samples: 22.0, step_seconds: 3.3e-3 };
const FRUSTUM: TrainingCosts =
    TrainingCosts { ray_seconds: 20e-6, ray_samples: 36.0, step_seconds: 8.3e-3 };
const UNBOUNDED: TrainingCosts =
    TrainingCosts { ray_seconds: 20e-6, ray_samples: 36.0, step_seconds: 3.3e-3 };
/// Exponents by which a ray's cost grows with `march_steps` and `hidden_dim`: 0.58 and 0.68 of the
/// time at half of either (docs/design/008).
const STEPS_EXPONENT: f64 = 0.8;
const HIDDEN_EXPONENT: f64 = 0.55;
/// Ratio of a step's mean number of samples to `samples_per_step`: steps grow to 8/3 times as many.
const STEP_GROWTH: f64 = 2.0;
/// Extra cost of the first steps with the default `samples_per_step`, as a number of rays late in a
/// training (docs/design/048).
const FIRST_STEPS_RAYS: f64 = 1.1e6;
const DEFAULT_STEP_SAMPLES: f64 = 24_576.0;
/// Number of rays after which the extra cost of a step has fallen to 1/e: an early draft
/// of the demo scene with 200,000 rays took 6.4 s.
const FIRST_STEPS_LENGTH: f64 = 330e3;
/// Seconds per training ray of the paper's field (docs/results/engine.md: 369 rays a second on two
/// cores).
const MLP_RAY_SECONDS: f64 = 5.4e-3;
/// Minimum bytes of the paper's field, as in `train-ss`.
const MLP_BYTES: u64 = 500_000_000;

/// Returns the ratios of a ray's samples and of a sample's cost to those of a field with the
/// default sizes.
fn field_factors(field: &Value, kind: SceneKind) -> Option<(f64, f64)> {
    let by_default = GivenSizes {
        cells_per_pixel: radiance::CELLS_PER_PIXEL,
        log2_hashmap_size: None,
        march_steps: None,
        ..GivenSizes::deserialize(field).ok()?
    };
    let is_ndc = kind == SceneKind::Frustum;
    let by_default = by_default.for_scene(1.0, is_ndc);
    let own = GivenSizes::deserialize(field).ok()?.for_scene(1.0, is_ndc);
    let steps = f64::from(own.march_steps) / f64::from(by_default.march_steps);
    let hidden =
        f64::from(own.hidden_dim) / f64::from(radiance::Architecture::default().hidden_dim);
    Some((steps.powf(STEPS_EXPONENT), hidden.powf(HIDDEN_EXPONENT)))
}

/// Returns the ratio of a ray's cost to that of a field with the default sizes.
pub(super) fn field_factor(field: &Value, kind: SceneKind) -> Option<f64> {
    let (samples, sample) = field_factors(field, kind)?;
    Some(samples * sample)
}

pub(super) fn training_seconds(parameters: &Value, work: &Work) -> Option<f64> {
    if parameters["field"] == "mlp" {
        return Some(number(parameters, "rays")? * MLP_RAY_SECONDS);
    }
    let budget = RayBudget::deserialize(parameters).ok()?;
    let is_opaque = work.kind.is_opaque();
    let rays = budget.total(work.images.pixels, is_opaque, work.is_fine_tuning) as f64;
    let fields = number(parameters, "ensemble")?;
    let step_samples = number(parameters, "samples_per_step")?;
    let first_steps = if work.is_fine_tuning {
        0.0
    } else {
        // The number of first steps hardly depends on their size.
        fields * first_steps(rays / fields) * step_samples / DEFAULT_STEP_SAMPLES
    };
    let TrainingCosts { ray_seconds, ray_samples, step_seconds } = match work.kind {
        SceneKind::Object => OBJECT,
        SceneKind::Frustum => FRUSTUM,
        SceneKind::Unbounded => UNBOUNDED,
    };
    let (samples, sample) = field_factors(parameters, work.kind)?;
    let steps = (samples * rays + first_steps) * ray_samples / (STEP_GROWTH * step_samples);
    Some(ray_seconds * (samples * sample * rays + first_steps) + step_seconds * steps)
}

/// Returns the extra cost of the first steps of a training of one field, as a number of rays late
/// in the training.
fn first_steps(rays: f64) -> f64 {
    FIRST_STEPS_RAYS * (1.0 - (-rays / FIRST_STEPS_LENGTH).exp())
}

pub(super) fn training_memory(parameters: &Value, work: &Work) -> Option<u64> {
    Some(training_need(parameters, work)?.total(program_bytes(work.has_libtorch)))
}

/// Returns the memory of a training as `train-ss` computes it, with each image as large
/// as the largest one.
pub(super) fn training_need(parameters: &Value, work: &Work) -> Option<TrainingMemory> {
    let field = if parameters["field"] == "mlp" {
        MLP_BYTES
    } else {
        // The runner gives every stage a folder for checkpoints.
        grid_training_bytes(work.grid_floats(parameters)?, true)
    };
    let has_kernel = match parameters["supervision"].as_str() {
        Some(supervision) => supervision == "kernel",
        None => parameters["field"] != "mlp",
    };
    let supersample = number(parameters, "supersample")?;
    let storage = PixelStorage {
        is_opaque: work.kind.is_opaque(),
        has_cache: has_kernel && !(work.has_box_kernel && supersample.fract() == 0.0),
        refines_poses: parameters["pose_refinement"] == true,
    };
    let mut memory = TrainingMemory { field, ..TrainingMemory::default() };
    let size = work.images.largest_size;
    let hr_size = [size.0, size.1].map(|side| (side as f64 * supersample).round() as u64);
    for _ in 0..work.images.count {
        memory.add_photograph(storage, size, (hr_size[0], hr_size[1]));
    }
    for _ in 0..work.references.count {
        memory.add_reference(storage, work.references.largest_size);
    }
    Some(memory)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::tests::training;
    use super::*;

    /// Half of the steps or of the width makes rays cheaper, by the measured exponents.
    #[test]
    fn smaller_networks_and_fewer_steps_are_cheaper() {
        let factor = |march_steps: Value, hidden_dim: u32, kind| {
            let mut field = training(1);
            field["march_steps"] = march_steps;
            field["hidden_dim"] = hidden_dim.into();
            field_factor(&field, kind).unwrap()
        };
        for kind in [SceneKind::Object, SceneKind::Unbounded] {
            assert_eq!(factor(Value::Null, 64, kind), 1.0);
            assert!((factor(json!(256), 64, kind) - 0.574).abs() < 1e-3);
            assert!((factor(Value::Null, 32, kind) - 0.683).abs() < 1e-3);
        }
        assert_eq!(factor(json!(256), 64, SceneKind::Frustum), 1.0);
    }
}
