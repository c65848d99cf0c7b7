//! Models of the stages' processor time and peak memory.

mod training;

use std::sync::OnceLock;
use std::thread::Builder;
use std::time::{Duration, Instant};

use numerics::SpeedTest;
use serde_json::Value;
use store::ModelCost;
use workload::{export_bytes, export_scale, program_bytes};

use super::work::Work;
use training::{field_factor, training_memory, training_need, training_seconds};

/// Costs of rendering a kind of scene.
#[derive(Clone, Copy)]
struct RenderingCosts {
    /// Seconds per ray of a view that is 200 pixels wide.
    ray_seconds: f64,
    /// Exponent by which a ray's seconds change with the view's width: neighbouring rays of a wider
    /// view read the same cells, and fewer rays pass an object closely.
    width_exponent: f64,
    /// Exponent by which a ray's seconds change with its factor of training.
    field_exponent: f64,
    /// Fraction of the pixels that get all rays at the default tolerance, which is taken for any
    /// tolerance above 0.
    detailed_share: f64,
}

/// Costs of rendering objects and opaque scenes: lego at 200 and 800 pixels, fern at 504 and 1008,
/// and the demo scene with a backdrop at 3200.
const OBJECT_RENDERING: RenderingCosts = RenderingCosts {
    ray_seconds: 3e-6,
    width_exponent: -0.43,
    field_exponent: 0.7,
    detailed_share: 0.23,
};
const OPAQUE_RENDERING: RenderingCosts = RenderingCosts {
    ray_seconds: 7.4e-6,
    width_exponent: -0.25,
    field_exponent: 0.25,
    detailed_share: 0.29,
};
/// Bytes of a rendered field per float of its grid: the grid, and the file that it is read from.
const RENDERED_BYTES_PER_FLOAT: u64 = 7;
/// Bytes of `render-depth` without its field and libtorch, but with the rays of a band of rows; as
/// in the tests below.
const RENDERER_BYTES: u64 = 28_000_000;
/// Bytes of any other program that can contain libtorch, without it and data; as in the tests
/// below.
const PROGRAM_BYTES: u64 = 5_000_000;
/// Costs of scoring a view by `eval`.
#[derive(Clone, Copy)]
struct ScoringCosts {
    /// Seconds per pixel.
    pixel_seconds: f64,
    /// Bytes per pixel.
    pixel_bytes: u64,
}

/// Costs of scoring without and with LPIPS: lego 100×2, 12 views.
const SCORING: ScoringCosts = ScoringCosts { pixel_seconds: 1.4e-6, pixel_bytes: 125 };
const LPIPS_SCORING: ScoringCosts = ScoringCosts { pixel_seconds: 2.2e-6, pixel_bytes: 580 };
/// Seconds per photograph's pixel of `prep`.
const PREPARED_PIXEL_SECONDS: f64 = 30e-9;
/// Bytes of `prep` without data. Fraction of the first thread's peak memory that each further
/// thread adds: threads have their peaks at different times (fern and lego, two threads).
const PREP_BYTES: u64 = 9_000_000;
const FURTHER_THREAD_SHARE: f64 = 0.45;
/// Seconds per pixel of the training views that `train-refine` reads: 60 photographs of 1600×1200.
const EXAMPLE_PIXEL_SECONDS: f64 = 0.18e-6;
/// Seconds per pixel of a training step's patches of `train-refine`, and per pixel of a version of
/// a view of `refine`: lego and fern.
const PATCH_PIXEL_SECONDS: f64 = 1.1e-6;
const REFINED_PIXEL_SECONDS: f64 = 0.47e-6;
/// Share of the patches' seconds that one reference adds, and exponent by which it grows with the
/// number of references: 1 to 8 references of fern.
const REFERENCE_SHARE: f64 = 0.36;
const REFERENCES_EXPONENT: f64 = 0.68;
/// Seconds per pixel of a refined view and per reference, and bytes per pixel of a view that is
/// refined with references, in all and per reference: fern.
const WARPED_PIXEL_SECONDS: f64 = 1.25e-6;
const WARPED_PIXEL_BYTES: u64 = 200;
const REFERENCE_PIXEL_BYTES: u64 = 25;
/// Bytes per pixel of a network's training views and of its patches.
const EXAMPLE_PIXEL_BYTES: u64 = 43;
const PATCH_PIXEL_BYTES: u64 = 1_740;
/// Bytes of `refine` besides those of a program with libtorch, and per pixel of a view: lego, fern,
/// and the demo scene at 3200×2400.
const REFINER_BYTES: u64 = 34_000_000;
const REFINED_PIXEL_BYTES: u64 = 75;
/// Bytes of all warped references in a refiner's training, per pixel of the largest view: lego and
/// fern. They don't depend on the number of references.
const WARPED_VIEWS_BYTES: u64 = 3_000;
/// Seconds of a start of a stage; chosen by hand.
const START_SECONDS: f64 = 0.3;
/// Seconds of `demo-scene`: per pixel, for the image file; per ray, without and with a backdrop.
/// Derived from the default scene, one with a backdrop, and one with a single ray per pixel.
const DEMO_PIXEL_SECONDS: f64 = 0.2e-6;
const DEMO_RAY_SECONDS: f64 = 0.165e-6;
const BACKDROP_RAY_SECONDS: f64 = 0.32e-6;
/// Bytes of `demo-scene` without data and per pixel of a view, and of `camera-path`.
const DEMO_BYTES: u64 = 5_000_000;
const DEMO_PIXEL_BYTES: u64 = 16;
const CAMERA_PATH_BYTES: u64 = 5_000_000;

/// Seconds of a piece of work on the reference machine: two busy cores with AVX-512.
const REFERENCE_SECONDS: f64 = 0.34e-3;
/// Duration of the measurement of a machine, on all cores at once as in a stage; chosen by hand.
const MEASUREMENT: Duration = Duration::from_millis(150);

/// Returns the cost of a stage on the machine of these figures; `None` for stages without a model.
pub(crate) fn model_cost(program: &str, parameters: &Value, work: &Work) -> Option<ModelCost> {
    let (seconds, peak_memory) = match program {
        "prep" => (work.images.pixels as f64 * PREPARED_PIXEL_SECONDS, prep_memory(work)),
        "train-ss" => (training_seconds(parameters, work)?, training_memory(parameters, work)?),
        "render-depth" => (rendering_seconds(parameters, work)?, rendering_memory(work)?),
        "eval" => scoring(work),
        "train-refine" => refiner_training(parameters, work)?,
        "refine" => refinement(parameters, work)?,
        "export" => export(parameters, work)?,
        "demo-scene" => demo_scene(parameters, work)?,
        "camera-path" => (0.0, CAMERA_PATH_BYTES),
        _ => return None,
    };
    let start = if matches!(program, "prep" | "demo-scene") { 0.0 } else { START_SECONDS };
    let casts_rays = matches!(program, "demo-scene" | "train-ss" | "render-depth" | "export");
    let scene = casts_rays.then_some(work.kind);
    Some(ModelCost { processor_seconds: start + seconds, peak_memory, scene })
}

/// Returns the memory below which a stage fails. If memory is short, a training stores pixels in a
/// file, and `prep` uses fewer threads.
pub(crate) fn min_memory(program: &str, parameters: &Value, work: &Work) -> Option<u64> {
    match program {
        "prep" => Some(work.preparation_bytes),
        "train-ss" => {
            Some(training_need(parameters, work)?.minimum(program_bytes(work.has_libtorch)))
        }
        _ => Some(model_cost(program, parameters, work)?.peak_memory),
    }
}

fn number(parameters: &Value, name: &str) -> Option<f64> {
    parameters[name].as_f64()
}

/// Returns the bytes that libtorch takes in a program that contains it.
fn libtorch_bytes(work: &Work) -> u64 {
    program_bytes(work.has_libtorch) - program_bytes(false)
}

/// Returns the bytes of a program that can contain libtorch, without data.
fn torch_program_bytes(work: &Work) -> u64 {
    PROGRAM_BYTES + libtorch_bytes(work)
}

/// Returns the bytes of data of the views that are processed at a time, one by each thread.
fn concurrent_bytes(work: &Work, bytes_per_pixel: u64) -> u64 {
    work.images.count.min(work.threads) * bytes_per_pixel * work.images.largest_pixels()
}

fn demo_scene(parameters: &Value, work: &Work) -> Option<(f64, u64)> {
    let ray = if work.kind.is_opaque() { BACKDROP_RAY_SECONDS } else { DEMO_RAY_SECONDS };
    let pixel = DEMO_PIXEL_SECONDS + ray * number(parameters, "samples_per_axis")?.powi(2);
    let memory = DEMO_BYTES + concurrent_bytes(work, DEMO_PIXEL_BYTES);
    Some((work.images.pixels as f64 * pixel, memory))
}

fn prep_memory(work: &Work) -> u64 {
    let threads = work.images.count.min(work.threads).max(1) as f64;
    let views = 1.0 + FURTHER_THREAD_SHARE * (threads - 1.0);
    PREP_BYTES + (views * work.preparation_bytes as f64) as u64
}

fn rendering_costs(work: &Work) -> RenderingCosts {
    if work.kind.is_opaque() { OPAQUE_RENDERING } else { OBJECT_RENDERING }
}

impl RenderingCosts {
    /// Returns the seconds per ray of views with the given width.
    fn ray_seconds(self, width: f64) -> f64 {
        self.ray_seconds * (width.max(1.0) / 200.0).powf(self.width_exponent)
    }
}

fn rendering_seconds(parameters: &Value, work: &Work) -> Option<f64> {
    let costs = rendering_costs(work);
    let field = work.field.as_ref()?;
    if field["field"] == "mlp" {
        return None;
    }
    let detailed = if number(parameters, "tolerance")? > 0.0 {
        costs.detailed_share * work.resolved_part(field)?
    } else {
        1.0
    };
    let samples = number(parameters, "samples_per_axis")?;
    let further = if samples > 1.0 { samples.powi(2) } else { 0.0 };
    let rays = work.images.pixels as f64 * (1.0 + detailed * further);
    let ray_seconds = costs.ray_seconds(work.images.largest_size.0 as f64)
        * field_factor(field, work.kind)?.powf(costs.field_exponent);
    Some(number(field, "ensemble")? * rays * ray_seconds)
}

fn rendering_memory(work: &Work) -> Option<u64> {
    let field = work.field.as_ref().filter(|field| field["field"] != "mlp")?;
    let floats = number(field, "ensemble")? as u64 * work.grid_floats(field)?;
    Some(RENDERER_BYTES + libtorch_bytes(work) + RENDERED_BYTES_PER_FLOAT * floats)
}

fn scoring(work: &Work) -> (f64, u64) {
    let costs = if work.computes_lpips { LPIPS_SCORING } else { SCORING };
    let memory = torch_program_bytes(work) + concurrent_bytes(work, costs.pixel_bytes);
    (work.images.pixels as f64 * costs.pixel_seconds, memory)
}

fn refiner_training(parameters: &Value, work: &Work) -> Option<(f64, u64)> {
    if parameters["net"] != "compact" {
        return None;
    }
    let patches = number(parameters, "patch_size")?.powi(2) * number(parameters, "batch_size")?;
    let references = number(parameters, "references_per_view")?;
    let share = REFERENCE_SHARE * references.powf(REFERENCES_EXPONENT);
    let seconds = number(parameters, "steps")? * patches * PATCH_PIXEL_SECONDS * (1.0 + share)
        + work.images.pixels as f64 * EXAMPLE_PIXEL_SECONDS;
    let warped = if references > 0.0 { WARPED_VIEWS_BYTES } else { 0 };
    let bytes = EXAMPLE_PIXEL_BYTES * work.images.pixels
        + PATCH_PIXEL_BYTES * patches as u64
        + warped * work.images.largest_pixels();
    Some((seconds, torch_program_bytes(work) + bytes))
}

fn refinement(parameters: &Value, work: &Work) -> Option<(f64, u64)> {
    let versions = number(parameters, "self_ensemble")? * REFINED_PIXEL_SECONDS;
    let references = match &work.refiner {
        Some(refiner) if refiner["net"] != "compact" => return None,
        Some(refiner) if refiner["references_per_view"] == 0 => 0,
        _ => work.references.count,
    };
    let seconds = versions + references as f64 * WARPED_PIXEL_SECONDS;
    let mut pixel_bytes = REFINED_PIXEL_BYTES + REFERENCE_PIXEL_BYTES * references;
    if references > 0 {
        pixel_bytes += WARPED_PIXEL_BYTES;
    }
    let bytes = REFINER_BYTES + pixel_bytes * work.images.largest_pixels();
    Some((seconds * work.images.pixels as f64, torch_program_bytes(work) + bytes))
}

/// Returns the cost of an export. The time is that of rendering a field with the default sizes. The
/// memory is computed as in `export`, for a mesh grid with equally many nodes along all axes.
fn export(parameters: &Value, work: &Work) -> Option<(f64, u64)> {
    let scale = match number(parameters, "size") {
        Some(width) => width / work.images.largest_size.0.max(1) as f64,
        None => export_scale(work.images.pixels),
    };
    let pixels = (work.images.pixels as f64 * scale.powi(2)) as u64;
    let has_mesh = parameters["mesh"] == true;
    let nodes = if has_mesh { (number(parameters, "resolution")? + 1.0).powi(3) } else { 0.0 };
    let bytes = export_bytes(pixels, nodes as u64);
    let field = work.field.as_ref()?;
    let width = work.images.largest_size.0 as f64 * scale;
    let ray_seconds = rendering_costs(work).ray_seconds(width);
    let seconds = number(field, "ensemble")? * pixels as f64 * ray_seconds;
    Some((seconds, rendering_memory(work)? + bytes))
}

/// Returns the ratio of this machine's time for the work of [`SpeedTest`] to the reference
/// machine's time. The first call measures the machine.
pub(crate) fn slowness() -> f64 {
    static SLOWNESS: OnceLock<f64> = OnceLock::new();
    *SLOWNESS.get_or_init(measure)
}

/// Measures all cores at once, because one core alone is faster: cores share caches, memory and
/// heat. If the system starts no thread, this machine counts as the reference machine.
fn measure() -> f64 {
    let test = SpeedTest::default();
    let mut times = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..stage::processors().count)
            .filter_map(|_| Builder::new().spawn_scoped(scope, || working_times(test.clone())).ok())
            .collect();
        let times = threads.into_iter().map(|thread| thread.join().unwrap_or_default());
        times.collect::<Vec<_>>().concat()
    });
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).map_or(1.0, |median| median / REFERENCE_SECONDS)
}

/// Returns the seconds of each piece of work that is done during the measurement.
fn working_times(mut test: SpeedTest) -> Vec<f64> {
    let (start, mut times) = (Instant::now(), Vec::new());
    while start.elapsed() < MEASUREMENT {
        let start = Instant::now();
        // The compiler must not leave the work out.
        std::hint::black_box(test.work());
        times.push(start.elapsed().as_secs_f64());
    }
    times
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use store::SceneKind;

    use super::super::scene::SceneImages;
    use super::super::work::Images;
    use super::*;

    /// Returns work with square images; the field's LR width is their width.
    fn work(kind: SceneKind, count: u64, width: u64) -> Work {
        let images = Images { count, pixels: count * width * width, largest_size: (width, width) };
        Work {
            kind,
            pixels_across: width as f64,
            has_box_kernel: false,
            images,
            references: Images::default(),
            refiner: None,
            preparation_bytes: 0,
            field: Some(training(1)),
            is_fine_tuning: false,
            computes_lpips: false,
            has_libtorch: true,
            threads: 2,
        }
    }

    /// Returns the default parameters of a training.
    pub(super) fn training(rays: u64) -> Value {
        json!({
            "field": "grid", "rays": rays, "rays_per_pixel": 1, "opaque_ray_factor": 1, "min_rays": 1,
            "max_rays": 1,
            "ensemble": 1, "supersample": 2.0, "supervision": null, "pose_refinement": false,
            "samples_per_step": 24_576, "n_levels": 8, "cells_per_pixel": 2.56, "log2_hashmap_size": null,
            "hidden_dim": 64, "march_steps": null,
        })
    }

    /// Fails if an estimated time is off by 30 % or more.
    #[track_caller]
    fn check_time(name: &str, program: &str, parameters: &Value, work: &Work, seconds: f64) {
        let estimate = model_cost(program, parameters, work).unwrap().processor_seconds;
        let ratio = estimate / seconds;
        println!("{name}: {estimate:.1} s for {seconds} s");
        assert!((0.7..1.3).contains(&ratio), "{name}: {estimate} s for {seconds} s");
    }

    /// Expected times are published (docs/results/engine.md): twice the elapsed time on two cores.
    #[test]
    fn times_of_training_are_estimated_within_30_percent() {
        let (object, opaque) = (SceneKind::Object, SceneKind::Frustum);
        let (lego, fern) = (work(object, 100, 100), work(opaque, 17, 218));
        let mut draft = training(1_000_000);
        draft["march_steps"] = json!(256);
        draft["hidden_dim"] = json!(32);
        // Rows of docs/results/time.md, with the parameters of these qualities.
        let small_network = |rays: u64, step_samples: u64, cells: f64| {
            let mut parameters = training(rays);
            parameters["samples_per_step"] = json!(step_samples);
            parameters["cells_per_pixel"] = json!(cells);
            parameters["hidden_dim"] = json!(32);
            parameters
        };
        let withheld = work(object, 88, 100);
        let short = |rays: u64| {
            let mut parameters = draft.clone();
            parameters["rays"] = json!(rays);
            parameters
        };
        let (demo, backdrop) = (work(object, 80, 100), work(SceneKind::Unbounded, 80, 100));
        for (name, parameters, work, seconds) in [
            ("lego 100×2", training(32_000_000), &lego, 408.0),
            ("lego 100×2, short", training(2_000_000), &lego, 46.8),
            ("draft", small_network(1_056_000, 6_144, 1.28), &withheld, 11.4),
            ("fast", small_network(3_080_000, 12_288, 1.6), &withheld, 30.2),
            ("balanced", training(9_680_000), &withheld, 138.0),
            ("best", training(28_160_000), &withheld, 390.0),
            ("half the steps and width", draft.clone(), &lego, 16.3),
            ("demo, 200,000 rays", short(200_000), &demo, 6.4),
            ("demo, 50,000 rays", short(50_000), &demo, 2.8),
            ("lego 200×2", training(80_000_000), &lego, 1056.0),
            ("lego 200×4", training(66_000_000), &lego, 648.0),
            ("fern 252×2", training(15_000_000), &fern, 420.0),
            ("fern 252×4", training(17_500_000), &fern, 408.0),
            ("backdrop 100×2", training(1_500_000), &backdrop, 58.8),
        ] {
            check_time(name, "train-ss", &parameters, work, seconds);
        }
    }

    /// Expected times are processor times on two cores, from records of runs.
    #[test]
    fn times_of_rendering_and_refining_are_estimated_within_30_percent() {
        let rendering = |samples: u32| json!({"samples_per_axis": samples, "tolerance": 0.0025});
        let (object, opaque) = (SceneKind::Object, SceneKind::Frustum);
        let lego = work(object, 100, 100);
        let views = |kind, count| work(kind, count, 200);
        let refiner = json!({
            "net": "compact", "patch_size": 64, "batch_size": 8, "steps": 3500, "self_ensemble": 2,
            "references_per_view": 0,
        });
        let mut by_eight = refiner.clone();
        by_eight["references_per_view"] = json!(8);
        let mut balanced = refiner.clone();
        balanced["steps"] = json!(1200);
        let references = Images { count: 8, ..Images::default() };
        let referenced = Work { references, ..work(opaque, 12, 873) };
        let unused = Work { refiner: Some(refiner.clone()), ..referenced.clone() };
        // A draft's field and rendering.
        let mut field = training(1);
        field["cells_per_pixel"] = json!(1.28);
        field["hidden_dim"] = json!(32);
        let draft = |work| Work { field: Some(field.clone()), ..work };
        let (lego_draft, fern_draft) = (draft(views(object, 12)), draft(work(opaque, 3, 436)));
        for (name, program, parameters, work, seconds) in [
            ("lego, rendered", "render-depth", rendering(2), &views(object, 12), 3.4),
            ("lego 200×4, one ray", "render-depth", rendering(1), &work(object, 50, 800), 44.7),
            ("opaque, rendered", "render-depth", rendering(2), &views(opaque, 10), 6.7),
            ("opaque, one ray", "render-depth", rendering(1), &views(opaque, 10), 4.1),
            ("fern 252×2", "render-depth", rendering(2), &work(opaque, 3, 436), 6.9),
            ("fern 252×4, one ray", "render-depth", rendering(1), &work(opaque, 19, 873), 65.6),
            ("lego, refiner", "train-refine", refiner.clone(), &lego, 122.4),
            ("1600×1200, refiner", "train-refine", balanced, &work(opaque, 60, 1386), 63.7),
            ("fern, refiner by 8", "train-refine", by_eight, &work(opaque, 20, 218), 315.8),
            ("fern, refined", "refine", refiner.clone(), &work(opaque, 12, 873), 10.6),
            ("fern, refined by 8 references", "refine", refiner.clone(), &referenced, 105.5),
            ("fern, references unused", "refine", refiner, &unused, 10.6),
            ("lego, draft", "render-depth", rendering(1), &lego_draft, 1.1),
            ("fern, draft", "render-depth", rendering(1), &fern_draft, 2.7),
        ] {
            check_time(name, program, &parameters, work, seconds);
        }
    }

    /// Expected values are processor time on two busy cores; the default is 90 views of 200 pixels.
    #[test]
    fn the_demo_scene_is_estimated_within_30_percent() {
        for (changes, seconds) in [
            (json!({}), 10.30),
            (json!({"size": 100}), 2.62),
            (json!({"size": 400, "train": 20, "test": 5}), 11.04),
            (json!({"backdrop": true, "train": 40}), 10.71),
            (json!({"form": "transforms", "train": 40}), 5.66),
            (json!({"samples_per_axis": 1}), 1.39),
        ] {
            let mut parameters = json!({
                "size": 200, "aspect": 1.0, "train": 80, "test": 10, "backdrop": false,
                "samples_per_axis": 4,
            });
            for (name, value) in changes.as_object().unwrap() {
                parameters[name] = value.clone();
            }
            let scene = SceneImages::of_demo(&parameters, &Value::Null).unwrap();
            let work = Work::of_demo(&scene, 2);
            let cost = model_cost("demo-scene", &parameters, &work).unwrap();
            let ratio = cost.processor_seconds / seconds;
            println!("{changes}: {:.2} s for {seconds} s", cost.processor_seconds);
            assert!((0.7..1.3).contains(&ratio), "{changes}: {ratio}");
        }
        assert!(SceneImages::of_demo(&json!({"size": 200}), &Value::Null).is_none());
    }

    /// Expected values are peak memory, in MB, from records of runs.
    #[test]
    fn measured_memory_is_estimated_within_20_percent() {
        let (object, opaque) = (SceneKind::Object, SceneKind::Frustum);
        let fern = Work { pixels_across: 170.7, ..work(opaque, 17, 109) };
        let fern_field = Work { pixels_across: 170.7, ..work(opaque, 3, 218) };
        let lego = work(object, 50, 800);
        let scored = Work { computes_lpips: true, ..lego.clone() };
        let photographs = |bytes| Work { preparation_bytes: bytes, ..work(object, 20, 1) };
        let without_libtorch = |work: Work| Work { has_libtorch: false, ..work };
        let [demo_100, demo_200] =
            [work(object, 80, 100), work(object, 10, 200)].map(without_libtorch);
        let demo_200 = Work { pixels_across: 100.0, ..demo_200 };
        let refiner = json!({
            "net": "compact", "patch_size": 64, "batch_size": 8, "steps": 1, "self_ensemble": 1,
            "references_per_view": 0,
        });
        let mut referenced = refiner.clone();
        referenced["references_per_view"] = json!(1);
        let references = |count| Images { count, ..Images::default() };
        let [by_one, by_eight] =
            [1, 8].map(|count| Work { references: references(count), ..work(opaque, 12, 873) });
        let render = json!({"samples_per_axis": 1, "tolerance": 0.0025});
        let (train, render_demo) = (training(12_000_000), render.clone());
        for (name, program, parameters, work, measured) in [
            ("fern, trained", "train-ss", training(500_000), &fern, 415.6),
            ("demo 32, trained", "train-ss", training(150_000), &work(object, 80, 32), 180.4),
            ("demo 100, trained", "train-ss", training(150_000), &work(object, 80, 100), 250.9),
            ("fern, rendered", "render-depth", render.clone(), &fern_field, 212.0),
            ("demo 32, rendered", "render-depth", render, &work(object, 12, 32), 144.0),
            ("demo 100, trained without libtorch", "train-ss", train, &demo_100, 172.0),
            ("demo 200, rendered without libtorch", "render-depth", render_demo, &demo_200, 42.5),
            ("demo 200, scored without libtorch", "eval", json!({}), &demo_200, 14.7),
            ("lego 800, LPIPS", "eval", json!({}), &scored, 865.0),
            ("demo 200, no LPIPS", "eval", json!({}), &work(object, 10, 200), 130.0),
            ("lego 800, refined", "refine", refiner.clone(), &lego, 202.0),
            ("3200×2400, refined", "refine", refiner.clone(), &work(opaque, 1, 2771), 730.2),
            (
                "1600×1200, refiner",
                "train-refine",
                refiner.clone(),
                &work(opaque, 60, 1386),
                5100.0,
            ),
            ("lego 200, refiner", "train-refine", refiner.clone(), &work(object, 100, 200), 350.0),
            ("lego 100, refiner", "train-refine", refiner.clone(), &work(object, 100, 100), 220.0),
            ("fern, refiner by one", "train-refine", referenced, &work(opaque, 20, 218), 366.0),
            ("fern, refined by one", "refine", refiner.clone(), &by_one, 402.0),
            ("fern, refined by 8", "refine", refiner, &by_eight, 493.0),
            ("fern, prepared", "prep", json!({}), &photographs(158_000_000), 205.0),
            ("lego, prepared", "prep", json!({}), &photographs(8_960_000), 19.8),
            ("demo 200, prepared", "prep", json!({}), &photographs(800_000), 9.2),
            ("demo 400, prepared", "prep", json!({}), &photographs(3_200_000), 13.3),
        ] {
            let peak_memory = model_cost(program, &parameters, work).unwrap().peak_memory as f64;
            println!("{name}: {:.0} MB for {measured} MB", peak_memory / 1e6);
            let ratio = peak_memory / 1e6 / measured;
            assert!((0.8..1.2).contains(&ratio), "{name}: {peak_memory} B for {measured} MB");
        }
    }

    #[test]
    fn unknown_stages_have_no_estimate() {
        let work = work(SceneKind::Object, 1, 1);
        for program in ["report", "mine"] {
            assert_eq!(model_cost(program, &json!({}), &work), None);
        }
        for program in ["train-ss", "demo-scene"] {
            assert_eq!(model_cost(program, &json!({}), &work), None, "no parameters");
        }
        assert_eq!(min_memory("train-ss", &json!({}), &work), None, "no parameters");
    }

    /// Machines of the last twenty years are within a factor of fifty of the reference machine,
    /// even while other tests run.
    #[test]
    fn slowness_of_this_machine_is_plausible() {
        let start = Instant::now();
        let slowness = measure();
        println!("{slowness:.2} in {:.3} s", start.elapsed().as_secs_f64());
        assert!((0.02..50.0).contains(&slowness), "{slowness}");
    }
}
