//! `make bench`: speeds of the engine, absolute and relative to the machine's limits, measured in
//! one run.
//!
//! `SCENE=DIR` is a scene that `prep` made (×2, 100 px in the Makefile), `OUT=FILE` gets rows of
//! JSON `{name, value, unit}`, `RAYS=N` sets the length of the measured training (default 3
//! million), `SIMD=avx512|avx2|portable` the SIMD family. `AGAINST=FILE` is the output of an
//! earlier run to compare with.

use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use artifact::GivenInput;
use numerics::simd::{Family, set_family};
use radiance::{Architecture, Field, Passes, Phase, PhaseTimes, Ray, Trainer};
use scene::{Bounds, Camera, Views};
use serde::{Deserialize, Serialize};
#[cfg(feature = "torch")]
use train_ss::MlpParams;
use train_ss::{
    FieldParams, GridParams, Params, Resolved, ResolvedField, SceneFacts, Supersampling,
};

#[derive(Serialize, Deserialize)]
struct Row {
    name: String,
    value: f64,
    unit: String,
}

#[derive(Default)]
struct Rows(Vec<Row>);

impl Rows {
    fn add(&mut self, name: impl Into<String>, value: f64, unit: &str) {
        let row = Row { name: name.into(), value, unit: unit.to_owned() };
        println!("{:<52} {:>14.1} {unit}", row.name, row.value);
        self.0.push(row);
    }

    fn value(&self, name: &str) -> f64 {
        self.0.iter().find(|r| r.name == name).map_or(f64::NAN, |r| r.value)
    }

    /// Measures sgemm once more. Other processes can halve the speed but never increase it, so the
    /// best of all measurements is the machine's limit.
    fn sgemm(&mut self, when: &str) {
        self.add(format!("sgemm_gflops_{when}"), sgemm(), "GFLOP/s");
    }

    /// Adds speeds relative to the best sgemm.
    fn add_relative_speeds(&mut self) {
        let best = self
            .0
            .iter()
            .filter(|r| r.name.starts_with("sgemm_gflops_"))
            .map(|r| r.value)
            .fold(f64::NAN, f64::max);
        self.add("sgemm_gflops", best, "GFLOP/s");
        let speeds: Vec<(String, f64)> = self
            .0
            .iter()
            .filter(|r| r.unit == "rays/s" && !r.name.contains("one_core"))
            .map(|r| (r.name.clone(), r.value))
            .collect();
        for (name, speed) in speeds {
            self.add(format!("{name}_per_gflops"), speed / best, "rays/GFLOP");
        }
        let mlp = self.value("mlp_gflops");
        if mlp.is_finite() {
            self.add("mlp_share_of_sgemm", 100.0 * mlp / best, "%");
        }
    }
}

/// Selects the SIMD family whose kernels are measured. Fails if the machine doesn't support it.
fn choose_family(name: &str) -> anyhow::Result<()> {
    let family = match name {
        "avx512" => Family::Avx512,
        "avx2" => Family::Avx2,
        "portable" => Family::Portable,
        _ => anyhow::bail!("SIMD = {name} is none of avx512, avx2, portable"),
    };
    anyhow::ensure!(family.is_supported(), "SIMD = {name}: this machine doesn't support it");
    set_family(family);
    Ok(())
}

/// Reads the rows that an earlier run wrote.
fn read_rows(file: &Path) -> anyhow::Result<Rows> {
    let read = || anyhow::Ok(Rows(serde_json::from_slice(&std::fs::read(file)?)?));
    read().with_context(|| format!("AGAINST = {}", file.display()))
}

/// Prints this run's values next to those of an earlier run, and their ratios.
fn compare(rows: &Rows, earlier: &Rows) {
    println!("\n{:<52} {:>14} {:>14} {:>7}", "", "earlier", "now", "ratio");
    for row in &earlier.0 {
        let now = rows.value(&row.name);
        if now.is_finite() {
            let Row { name, value, unit } = row;
            println!("{name:<52} {value:>14.1} {now:>14.1} {:>7.2} {unit}", now / value);
        }
    }
}

fn main() -> anyhow::Result<()> {
    let variable = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
    if let Some(name) = variable("SIMD") {
        choose_family(&name)?;
    }
    // Fail on a wrong name before a run of minutes, not after it.
    let earlier = variable("AGAINST").map(|file| read_rows(Path::new(&file))).transpose()?;
    let mut rows = Rows::default();
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    println!("load before: {}", load.trim());
    rows.add("threads", rayon::current_num_threads() as f64, "");
    rows.sgemm("before");
    rows.add("one_core_sgemm_gflops", one_core(sgemm), "GFLOP/s");
    rows.add("memory_bandwidth", bandwidth(), "GB/s");
    passes(&mut rows);
    if let Some(scene) = variable("SCENE") {
        let rays = variable("RAYS").map_or(Ok(3_000_000), |r| r.parse())?;
        // Fields are slower early in training: only runs of equal length are comparable.
        rows.add("rays", rays as f64, "rays");
        training(&mut rows, Path::new(&scene), rays)?;
    } else {
        println!("skipped: no SCENE, so nothing was trained or rendered");
    }
    rows.add_relative_speeds();
    if let Some(earlier) = &earlier {
        compare(&rows, earlier);
    }
    rows.add("peak_rss_mib", peak_memory(), "MiB");
    if let Some(out) = variable("OUT").map(PathBuf::from) {
        artifact::write_json(&out, &rows.0)?;
        println!("wrote {}", out.display());
    }
    Ok(())
}

/// Returns the shortest time of several runs: noise only adds time.
fn best(runs: usize, mut run: impl FnMut()) -> f64 {
    let once = |_| {
        let start = Instant::now();
        run();
        start.elapsed().as_secs_f64()
    };
    (0..runs).map(once).fold(f64::INFINITY, f64::min)
}

fn one_core<T: Send>(run: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("a pool of one thread")
        .install(run)
}

/// Measures f32 matrix products, one on each core in parallel.
fn sgemm() -> f64 {
    const N: usize = 768;
    const ROW: isize = N as isize;
    let threads = rayon::current_num_threads();
    let mut work: Vec<[Vec<f32>; 3]> =
        (0..threads).map(|_| [0.5, 0.25, 0.0].map(|v| vec![v; N * N])).collect();
    let seconds = best(8, || {
        rayon::scope(|scope| {
            for [a, b, c] in &mut work {
                // SAFETY: three matrices of N·N floats, row by row.
                scope.spawn(|_| unsafe {
                    let (a, b, c) = (a.as_ptr(), b.as_ptr(), c.as_mut_ptr());
                    matrixmultiply::sgemm(N, N, N, 1.0, a, ROW, 1, b, ROW, 1, 0.0, c, ROW, 1);
                });
            }
        });
    });
    black_box(&work);
    (2 * N * N * N * threads) as f64 / seconds / 1e9
}

/// Measures a = b + 3·c over arrays far larger than the caches.
fn bandwidth() -> f64 {
    use rayon::prelude::*;
    const N: usize = 1 << 25;
    let (mut a, b, c) = (vec![0.0f32; N], vec![1.0f32; N], vec![2.0f32; N]);
    let seconds = best(5, || {
        let parts = a.par_chunks_mut(1 << 16).zip(b.par_chunks(1 << 16)).zip(c.par_chunks(1 << 16));
        parts.for_each(|((a, b), c)| {
            a.iter_mut().zip(b).zip(c).for_each(|((a, b), c)| *a = b + 3.0 * c);
        });
    });
    black_box(&a);
    (3 * 4 * N) as f64 / seconds / 1e9
}

/// Returns rays of a camera towards the unit box.
fn rays(count: usize) -> Vec<Ray> {
    let side = (count as f64).sqrt() as usize;
    let at = |i: usize| {
        let (x, y) = ((i % side) as f64 / side as f64 - 0.5, (i / side) as f64 / side as f64 - 0.5);
        let length = (x * x + y * y + 4.0).sqrt();
        Ray {
            origin: [0.1, -0.2, 4.0],
            direction: [x / length, y / length, -2.0 / length],
            background: [1.0; 3],
        }
    };
    (0..side * side).map(at).collect()
}

/// Measures one core in a field of low density, where almost every sample gets a colour.
fn passes(rows: &mut Rows) {
    let bounds = Bounds::cube(1.0, 1.0, 9.0);
    let narrow = Architecture {
        n_levels: 8,
        log2_hashmap_size: 17,
        hidden_dim: 32,
        ..Architecture::default()
    };
    let variants = [
        ("", narrow),
        ("_64_wide", Architecture { hidden_dim: 64, ..narrow }),
        ("_2_19_entries", Architecture { log2_hashmap_size: 19, ..narrow }),
        ("_256_steps", Architecture { march_steps: 256, ..narrow }),
    ];
    for (name, architecture) in variants {
        let field = Field::new(architecture, bounds, 1);
        let rays = rays(4096);
        let mut passes = Passes::new(&field);
        let [marched, coloured] = passes.run(&field, &rays, false);
        let per_sample = |seconds: f64| seconds / marched as f64 * 1e9;
        let forward = per_sample(best(5, || {
            black_box(passes.run(&field, &rays, false));
        }));
        let both = per_sample(best(5, || {
            passes.run(&field, &rays, true);
            passes.scatter(&field);
        }));
        black_box(&passes);
        rows.add(format!("forward_ns_per_sample{name}"), forward, "ns");
        rows.add(format!("forward_backward_ns_per_sample{name}"), both, "ns");
        if name.is_empty() {
            rows.add("coloured_share", 100.0 * coloured as f64 / marched as f64, "%");
            // Density network only: a multiplication and an addition for each weight, forward once,
            // backward twice.
            let flops = (3 * 2 * field.density_multiplications()) as f64;
            rows.add("networks_gflops_of_forward_backward", flops / both, "GFLOP/s");
            rows.add(
                "networks_share_of_sgemm_one_core",
                100.0 * flops / both / rows.value("one_core_sgemm_gflops"),
                "%",
            );
            // Eight corners of four floats a level: read forward, read and written backward.
            let bytes = (architecture.n_levels * 8 * 16 * 3) as f64;
            rows.add("grid_traffic_of_forward_backward", bytes / both, "GB/s");
        }
    }
}

fn supervision(input: &GivenInput, params: &Resolved) -> anyhow::Result<Supersampling> {
    train_ss::set_up_supervision(input, params, None, &std::env::temp_dir(), false, &|_| ())
}

/// Scene to train on.
struct Scene {
    input: GivenInput,
    views: Views,
}

/// Finished training run.
struct Trained {
    field: Field,
    rays_per_second: f64,
    samples_per_ray: f64,
    phases: [PhaseTimes; Phase::ALL.len()],
}

impl Scene {
    /// Trains a field completely.
    fn train(&self, params: &Params) -> anyhow::Result<Trained> {
        let Self { input, views } = self;
        let params = params.resolve(&SceneFacts::of(views, true));
        let mut supervision = supervision(input, &params)?;
        let ResolvedField::Grid { architecture, regularisers, given } = &params.field else {
            anyhow::bail!("a grid is measured here");
        };
        let training = params.grid_training(given, *regularisers);
        let mut trainer =
            Trainer::new(Field::new(*architecture, views.bounds, params.seed), training);
        let (start, mut samples) = (Instant::now(), 0);
        while let Some(report) = trainer.step(&mut supervision)? {
            samples += report.samples;
        }
        let done = trainer.state().rays as f64;
        Ok(Trained {
            rays_per_second: done / start.elapsed().as_secs_f64(),
            samples_per_ray: samples as f64 / done,
            phases: trainer.phase_times(),
            field: trainer.finish(),
        })
    }

    /// Trains a field and adds the speed to the rows, whose names end with `name`.
    fn measure(&self, rows: &mut Rows, params: &Params, name: &str) -> anyhow::Result<Trained> {
        let trained = self.train(params)?;
        rows.add(format!("train_rays_per_s{name}"), trained.rays_per_second, "rays/s");
        rows.add(format!("train_samples_per_ray{name}"), trained.samples_per_ray, "samples");
        Ok(trained)
    }
}

/// Number of runs with one thread and with all threads, which alternate.
const ALTERNATIONS: usize = 5;

/// Adds the ratio of the median speeds with all threads and with one thread.
fn add_ratio(
    rows: &mut Rows,
    name: &str,
    mut speed: impl FnMut() -> anyhow::Result<f64> + Send,
) -> anyhow::Result<()> {
    let (mut one, mut all) = (Vec::new(), Vec::new());
    for _ in 0..ALTERNATIONS {
        one.push(one_core(&mut speed)?);
        all.push(speed()?);
    }
    rows.add(format!("{name}_all_threads_over_one"), median(&mut all) / median(&mut one), "times");
    Ok(())
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn print_phase_head(unit: &str) {
    println!(
        "{:<16} {:>12} {:>12} {:>14} {:>16}",
        "phase",
        format!("ms per {unit}"),
        "tasks",
        "longest task",
        "serial share"
    );
}

/// Prints a phase on one core: the mean time over `units`, and the serial share of `total` seconds.
fn print_phase(name: &str, times: &PhaseTimes, units: f64, total: f64) {
    println!(
        "{name:<16} {:>12.3} {:>12.1} {:>12.1} % {:>14.2} %",
        1e3 * times.elapsed / units,
        times.tasks as f64 / times.steps.max(1) as f64,
        100.0 * times.in_longest_tasks / times.in_tasks.max(f64::MIN_POSITIVE),
        100.0 * (times.elapsed - times.in_tasks) / total
    );
}

/// Adds the phases of a training run's steps. On one core, time outside of tasks is serial.
fn add_phases(rows: &mut Rows, one_core: &Trained) {
    let steps = one_core.phases.iter().map(|phase| phase.steps).max().unwrap_or(1).max(1) as f64;
    let total: f64 = one_core.phases.iter().map(|phase| phase.elapsed).sum();
    print_phase_head("step");
    for (phase, times) in Phase::ALL.iter().zip(&one_core.phases) {
        print_phase(&format!("{phase:?}"), times, steps, total);
    }
    let in_tasks: f64 = one_core.phases.iter().map(|phase| phase.in_tasks).sum();
    rows.add("serial_share_of_step", 100.0 * (total - in_tasks) / total, "%");
}

/// Measures complete training runs, with one and all threads, and renders of the first run's field.
fn training(rows: &mut Rows, folder: &Path, rays: u64) -> anyhow::Result<()> {
    let input = GivenInput::open("scene", &folder.join("train"))?;
    let views = Views::read(&input)?;
    let scene = Scene { input, views };
    // Uniform draws first, for comparison with other implementations; then the defaults.
    let grid = |rays, pixel_importance| {
        let grid = GridParams { pixel_importance, ..GridParams::default() };
        Params { field: FieldParams::Grid(grid), rays: Some(rays), ..Params::default() }
    };
    let by_detail = GridParams::default().pixel_importance;
    let field = scene.measure(rows, &grid(rays, 1.0), "")?.field;
    scene.measure(rows, &grid(rays, by_detail), "_by_detail")?;
    let short = grid(rays / 6, 1.0);
    scene.measure(rows, &short, "_first_sixth")?;
    let one_core = one_core(|| scene.measure(rows, &short, "_first_sixth_one_core"))?;
    add_phases(rows, &one_core);
    add_ratio(rows, "train", || Ok(scene.train(&short)?.rays_per_second))?;
    add_ratio(rows, "sgemm", || Ok(sgemm()))?;
    for scale in [1.0, 4.0] {
        let scaled = Params { supersample: scale, ..short.clone() };
        scene.measure(rows, &scaled, &format!("_first_sixth_x{scale}"))?;
    }

    #[cfg(feature = "torch")]
    mlp(rows, &scene.input, &scene.views)?;

    rendering(rows, folder, &field)
}

/// Measures renders of ten of a scene's views, with one and all threads and at several sizes.
fn rendering(rows: &mut Rows, folder: &Path, field: &Field) -> anyhow::Result<()> {
    let truth = Views::read(&GivenInput::open("cameras", &folder.join("cameras"))?)?;
    let cameras: Vec<Camera> = truth.views.iter().take(10).map(|v| v.camera.clone()).collect();
    let own = cameras[0].intrinsics.width;
    let mut render = |name: &str, width: u32, one: bool| {
        let all: Vec<Vec<Ray>> = cameras
            .iter()
            .map(|c| camera_rays(&c.resized(width, c.intrinsics.height * width / own)))
            .collect();
        let count: usize = all.iter().map(Vec::len).sum();
        let go = || {
            let start = Instant::now();
            all.iter().for_each(|rays| drop(black_box(field.render(rays))));
            start.elapsed().as_secs_f64()
        };
        let seconds = if one { one_core(go) } else { go().min(go()) };
        rows.add(name, count as f64 / seconds, "rays/s");
    };
    render("render_rays_per_s", own, false);
    render("render_rays_per_s_one_core", own, true);
    render("render_rays_per_s_half_size", own / 2, false);
    render("render_rays_per_s_twice_the_size", own * 2, false);
    let rays = camera_rays(&cameras[0]);
    let times = one_core(|| field.render_timed(&rays).1);
    print_phase_head("view");
    print_phase("Rendering", &times, 1.0, times.elapsed);
    rows.sgemm("after_rendering");
    Ok(())
}

/// Measures some steps of the paper's field: 2,048 rays, 64 + 64 samples, two networks of eight
/// layers of width 256.
#[cfg(feature = "torch")]
fn mlp(rows: &mut Rows, input: &GivenInput, views: &Views) -> anyhow::Result<()> {
    const STEPS: u64 = 3;
    let mlp = MlpParams { precrop_steps: Some(0), ..MlpParams::default() };
    let rays = Some((STEPS + 1) * 2048);
    let params = Params { field: FieldParams::Mlp(mlp), rays, ..Params::default() };
    let params = params.resolve(&SceneFacts::of(views, true));
    let ResolvedField::Mlp { architecture, density_noise_std } = &params.field else {
        anyhow::bail!("MLPs are measured here");
    };
    let mut supervision = supervision(input, &params)?;
    let device = fields::torch_device("cpu")?;
    let field = torch_field::Mlp::new(*architecture, views.bounds, params.seed, device)?;
    let weights = field.parameter_count() / 2;
    let mut trainer = torch_field::MlpTrainer::new(field, params.mlp_training(*density_noise_std))?;
    trainer.step(&mut supervision)?;
    let (start, mut samples) = (Instant::now(), 0);
    while let Some(report) = trainer.step(&mut supervision)? {
        samples += report.samples;
    }
    let seconds = start.elapsed().as_secs_f64();
    // A multiplication and an addition for each weight, forward once, backward twice.
    let gflops = (samples * weights * 6) as f64 / seconds / 1e9;
    rows.add("mlp_train_rays_per_s", (STEPS * 2048) as f64 / seconds, "rays/s");
    rows.add("mlp_gflops", gflops, "GFLOP/s");
    rows.sgemm("after_mlp");
    Ok(())
}

fn camera_rays(camera: &Camera) -> Vec<Ray> {
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let ray = |i: usize| {
        let ray = camera.ray((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        Ray::new(&ray, [1.0; 3])
    };
    (0..width * height).map(ray).collect()
}

fn peak_memory() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.trim().trim_end_matches(" kB").parse::<f64>().ok()).unwrap_or(f64::NAN)
        / 1024.0
}
