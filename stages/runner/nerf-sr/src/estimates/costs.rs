use serde_json::Value;

/// Kind of scene, on which the cost of a ray depends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SceneKind {
    /// Object before a background of one colour: most rays miss it.
    Object,
    /// Opaque scene in NDC.
    Frustum,
    /// Opaque scene all around the cameras.
    Unbounded,
}

impl SceneKind {
    /// Returns whether every ray hits a surface.
    pub(crate) fn is_opaque(self) -> bool {
        self != Self::Object
    }
}

/// Number and total pixels of the images of a folder.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Images {
    pub(crate) count: u64,
    pub(crate) pixels: u64,
}

/// Properties of a stage's inputs, on which its time depends.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Work {
    pub(crate) kind: SceneKind,
    /// Images that the stage reads or renders.
    pub(crate) images: Images,
    /// Number of fields of the ensemble that is rendered.
    pub(crate) fields: u64,
    /// True if a training is initialised from a field.
    pub(crate) is_fine_tuning: bool,
}

/// Seconds per training ray late in a training: lego 100×2, fern 252×2 and the demo scene with
/// backdrop (docs/results/engine.md).
const OBJECT_RAY_SECONDS: f64 = 12e-6;
const FRUSTUM_RAY_SECONDS: f64 = 27e-6;
const UNBOUNDED_RAY_SECONDS: f64 = 22e-6;
/// Default of `march_steps` in NDC and in other spaces, and of `hidden_dim`, as in `train-ss`.
const FRUSTUM_STEPS: f64 = 256.0;
const OTHER_STEPS: f64 = 512.0;
const HIDDEN_DIM: f64 = 64.0;
/// Exponents by which a ray's cost grows with `march_steps` and `hidden_dim`: 0.58 and 0.68 of the
/// time at half of either (docs/design/008).
const STEPS_EXPONENT: f64 = 0.8;
const HIDDEN_EXPONENT: f64 = 0.55;
/// Late rays that cost as much as the higher cost of the first steps (docs/design/048).
const FIRST_STEPS_RAYS: f64 = 1.1e6;
/// Seconds per training ray of the paper's field (docs/results/engine.md: 369 rays a second on two
/// cores).
const MLP_RAY_SECONDS: f64 = 5.4e-3;
/// Seconds per rendered ray, and part of the pixels that get all rays at the default tolerance, of
/// objects and opaque scenes (docs/results/engine.md).
const OBJECT_RENDERED_RAY_SECONDS: f64 = 4.4e-6;
const OPAQUE_RENDERED_RAY_SECONDS: f64 = 8e-6;
const OBJECT_DETAILED_PIXELS: f64 = 0.31;
const OPAQUE_DETAILED_PIXELS: f64 = 0.39;
/// Seconds per pixel of `eval` without LPIPS: lego 100×2, 12 views.
const SCORED_PIXEL_SECONDS: f64 = 2e-6;
/// Seconds of a start of a stage; chosen by hand.
const START_SECONDS: f64 = 0.3;
/// Rays of an opaque scene and of a fine-tuning, as in `train-ss`.
const OPAQUE_RAYS: f64 = 0.6;
const FINE_TUNING_RAYS: f64 = 0.5;

/// Returns the processor seconds of a stage, without a correction for the machine; `None` for
/// stages without a model.
pub(crate) fn processor_seconds(program: &str, parameters: &Value, work: &Work) -> Option<f64> {
    let number = |name: &str| parameters[name].as_f64();
    let pixels = work.images.pixels as f64;
    let seconds = match program {
        "train-ss" if parameters["field"] == "mlp" => number("rays")? * MLP_RAY_SECONDS,
        "train-ss" => {
            let fields = number("ensemble")?;
            let first_steps = if work.is_fine_tuning { 0.0 } else { fields * FIRST_STEPS_RAYS };
            let (ray, steps) = match work.kind {
                SceneKind::Object => (OBJECT_RAY_SECONDS, OTHER_STEPS),
                SceneKind::Frustum => (FRUSTUM_RAY_SECONDS, FRUSTUM_STEPS),
                SceneKind::Unbounded => (UNBOUNDED_RAY_SECONDS, OTHER_STEPS),
            };
            let more_steps = number("march_steps").map_or(1.0, |given| given / steps);
            let wider = number("hidden_dim").map_or(1.0, |given| given / HIDDEN_DIM);
            let ray = ray * more_steps.powf(STEPS_EXPONENT) * wider.powf(HIDDEN_EXPONENT);
            ray * (rays(parameters, work)? + first_steps)
        }
        "render-depth" => {
            let (ray, detailed) = if work.kind.is_opaque() {
                (OPAQUE_RENDERED_RAY_SECONDS, OPAQUE_DETAILED_PIXELS)
            } else {
                (OBJECT_RENDERED_RAY_SECONDS, OBJECT_DETAILED_PIXELS)
            };
            let detailed = if number("tolerance")? > 0.0 { detailed } else { 1.0 };
            let further = number("samples_per_axis")?.powi(2) - 1.0;
            work.fields as f64 * pixels * (1.0 + detailed * further) * ray
        }
        "eval" => pixels * SCORED_PIXEL_SECONDS,
        _ => return None,
    };
    Some(START_SECONDS + seconds)
}

/// Returns the number of rays of a training: the given one, or that which follows from the pixels.
fn rays(parameters: &Value, work: &Work) -> Option<f64> {
    let number = |name: &str| parameters[name].as_f64();
    if let Some(rays) = number("rays") {
        return Some(rays);
    }
    let opaque = if work.kind.is_opaque() { OPAQUE_RAYS } else { 1.0 };
    let rays = opaque * number("rays_per_pixel")? * work.images.pixels as f64;
    let rays = rays.max(number("min_rays")?).min(number("max_rays")?);
    Some(if work.is_fine_tuning { FINE_TUNING_RAYS * rays } else { rays })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn work(kind: SceneKind, pixels: u64) -> Work {
        let images = Images { count: 1, pixels };
        Work { kind, images, fields: 1, is_fine_tuning: false }
    }

    /// Published times (docs/results/engine.md), twice the minutes of two cores.
    #[test]
    fn published_times_are_estimated_within_30_percent() {
        let training = |rays: u64| json!({"field": "grid", "rays": rays, "ensemble": 1});
        let rendering = |samples: u32| json!({"samples_per_axis": samples, "tolerance": 0.005});
        let (object, opaque) = (SceneKind::Object, SceneKind::Frustum);
        let unbounded = SceneKind::Unbounded;
        for (name, program, parameters, work, seconds) in [
            ("lego 100×2", "train-ss", training(32_000_000), work(object, 1_000_000), 408.0),
            ("lego 100×2, short", "train-ss", training(2_000_000), work(object, 1_000_000), 46.8),
            ("lego 200×2", "train-ss", training(80_000_000), work(object, 4_000_000), 1056.0),
            ("lego 200×4", "train-ss", training(66_000_000), work(object, 4_000_000), 648.0),
            ("fern 252×2", "train-ss", training(15_000_000), work(opaque, 809_676), 420.0),
            ("fern 252×4", "train-ss", training(17_500_000), work(opaque, 809_676), 408.0),
            ("backdrop 100×2", "train-ss", training(1_500_000), work(unbounded, 800_000), 58.8),
            ("lego, rendered", "render-depth", rendering(2), work(object, 480_000), 4.06),
            ("lego, one ray", "render-depth", rendering(1), work(object, 480_000), 2.06),
            ("opaque, rendered", "render-depth", rendering(2), work(opaque, 400_000), 6.7),
            ("opaque, one ray", "render-depth", rendering(1), work(opaque, 400_000), 4.1),
        ] {
            let estimate = processor_seconds(program, &parameters, &work).unwrap();
            let ratio = estimate / seconds;
            println!("{name}: {estimate:.1} s for {seconds} s");
            assert!((0.7..1.3).contains(&ratio), "{name}: {estimate} s for {seconds} s");
        }
    }

    #[test]
    fn rays_follow_from_pixels_as_in_training() {
        let by_pixel = json!({"rays": null, "rays_per_pixel": 10, "min_rays": 50, "max_rays": 900});
        let of = |kind, pixels, is_fine_tuning| {
            rays(&by_pixel, &Work { is_fine_tuning, ..work(kind, pixels) }).unwrap()
        };
        assert_eq!(of(SceneKind::Object, 30, false), 300.0);
        assert_eq!(of(SceneKind::Unbounded, 30, false), 180.0);
        assert_eq!(of(SceneKind::Unbounded, 30, true), 90.0);
        assert_eq!([1, 1000].map(|pixels| of(SceneKind::Object, pixels, false)), [50.0, 900.0]);
        let given = json!({"rays": 7, "rays_per_pixel": 10});
        assert_eq!(rays(&given, &work(SceneKind::Unbounded, 30)), Some(7.0));
    }

    #[test]
    fn unknown_stages_have_no_estimate() {
        let work = work(SceneKind::Object, 1);
        for program in ["prep", "report", "mine"] {
            assert_eq!(processor_seconds(program, &json!({}), &work), None);
        }
        assert_eq!(processor_seconds("train-ss", &json!({}), &work), None, "no parameters");
    }
}
