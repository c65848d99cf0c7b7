//! The pipeline end to end on a tiny scene: caching, explanations, sweeps, equal bytes.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;
use std::process::{Child, Stdio};

use common::{Finished, Project};
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use scene::Views;

#[test]
fn second_runs_and_cosmetic_changes_run_nothing() {
    let project = Project::tiny();
    let first = project.ok(&["run"]);
    assert!(first.contains("eval: PSNR"), "{first}");
    assert!(first.contains("5 of 5 stages ran"), "{first}");
    let listing = project.store_listing();
    assert!(project.ok(&["run"]).contains("nothing to run"));
    // A comment, another order of keys, another number of threads, another folder.
    project.replace("default: [eval]", "# a comment\ndefault: [eval]");
    project.replace("{lr_width: 24, scale: 2}", "{scale: 2, lr_width: 24}");
    assert!(project.ok(&["run", "--threads", "1"]).contains("nothing to run"));
    let moved = Project::new(&std::fs::read_to_string(project.path("pipeline.yaml")).unwrap());
    std::fs::remove_dir_all(moved.path(".nerf-sr")).unwrap();
    std::fs::rename(project.path(".nerf-sr"), moved.path(".nerf-sr")).unwrap();
    assert!(moved.ok(&["run"]).contains("nothing to run"));
    assert_eq!(listing.len(), moved.store_listing().len());
}

#[test]
fn why_names_changed_parameters_and_equal_outputs_stop_reruns() {
    let project = Project::tiny();
    assert!(project.ok(&["why", "prep"]).contains("waits for demo-scene"));
    project.ok(&["run"]);
    assert!(project.ok(&["why", "prep"]).contains("cached"));
    // With another kernel, prep reruns, and its dependents wait for prep.
    let why = project.ok(&["why", "train-ss", "-p", "kernel=box"]);
    assert!(why.contains("train-ss: waits for prep"), "{why}");
    assert!(why.contains(r#"prep: will run: parameter kernel: null → "box""#), "{why}");
    let plan = project.ok(&["plan", "-p", "kernel=box"]);
    assert!(plan.lines().any(|l| l.starts_with("demo-scene") && l.contains("cached")), "{plan}");
    assert!(plan.lines().any(|l| l.starts_with("eval") && l.contains("waits for")), "{plan}");
    // With an explicit default, prep runs, its output is equal, and other stages stay cached.
    let run = project.ok(&["run", "-p", "lr_source=downscaled"]);
    assert!(run.contains("1 of 5 stages ran, 4 were cached"), "{run}");
    // With the other kernel, every stage after demo-scene runs.
    let run = project.ok(&["run", "-p", "kernel=box"]);
    assert!(run.contains("4 of 5 stages ran, 1 was cached"), "{run}");
}

#[test]
fn one_and_two_threads_give_equal_bytes() {
    let (one_thread, two_threads) = (Project::tiny(), Project::tiny());
    one_thread.ok(&["run", "--threads", "1"]);
    two_threads.ok(&["run", "--threads", "2"]);
    for stage in ["demo-scene", "prep", "train-ss", "render-depth", "eval"] {
        assert_eq!(one_thread.output_of(stage, &[]), two_threads.output_of(stage, &[]), "{stage}");
    }
}

#[test]
fn a_sweep_shares_common_artifacts() {
    let project = Project::tiny();
    let sweep = ["-p", "supersample=1,2", "-p", "render-depth.samples_per_axis=1,2"];
    let run = project.ok(&[&["run"][..], &sweep].concat());
    // demo-scene and prep once, training twice, rendering and eval four times.
    assert!(run.contains("12 of 12 stages ran"), "{run}");
    assert!(run.contains("eval [supersample=2, samples_per_axis=2]: PSNR"), "{run}");
    assert_eq!(project.output_of("train-ss", &sweep).len(), 2);
    // A single point of the sweep is cached.
    assert!(project.ok(&["run", "-p", "supersample=1"]).contains("nothing to run"));
}

fn zero_tensor<'a>(zeros: &'a [u8], shape: &[usize]) -> TensorView<'a> {
    let length = 4 * shape.iter().product::<usize>();
    TensorView::new(Dtype::F32, shape.to_vec(), &zeros[..length]).unwrap()
}

/// Writes a safetensors file with tensors of zeros.
fn write_zeros(file: &Path, shapes: &[(String, Vec<usize>)]) {
    let max_length = shapes.iter().map(|(_, shape)| shape.iter().product::<usize>()).max();
    let zeros = vec![0u8; 4 * max_length.unwrap()];
    let tensors = shapes.iter().map(|(name, shape)| (name.as_str(), zero_tensor(&zeros, shape)));
    std::fs::write(file, safetensors::serialize(tensors, None).unwrap()).unwrap();
}

/// Each network with its heads must give an LPIPS score; missing files of others must be reported.
#[test]
fn every_complete_lpips_network_scores() {
    let project = Project::tiny();
    let folder = project.path("weights");
    std::fs::create_dir(&folder).unwrap();
    let arguments = ["run", "-i", "eval.weights=./weights"];
    project
        .run(&arguments)
        .fails(3, &["input weights", "no LPIPS network found", "alexnet.safetensors"]);
    let layers =
        [(0, 64, 3, 11), (3, 192, 64, 5), (6, 384, 192, 3), (8, 256, 384, 3), (10, 256, 256, 3)];
    let network = layers.iter().flat_map(|&(i, outputs, inputs, size)| {
        [
            (format!("features.{i}.weight"), vec![outputs, inputs, size, size]),
            (format!("features.{i}.bias"), vec![outputs]),
        ]
    });
    write_zeros(&folder.join("alexnet.safetensors"), &network.collect::<Vec<_>>());
    // Without its heads, AlexNet is incomplete.
    project.run(&arguments).fails(3, &["no LPIPS network found"]);
    let heads = layers
        .iter()
        .enumerate()
        .map(|(k, layer)| (format!("lin{k}.model.1.weight"), vec![1, layer.1, 1, 1]));
    write_zeros(&folder.join("lpips_linear_alex_v0.1.safetensors"), &heads.collect::<Vec<_>>());
    project.ok(&arguments);
    let metrics = project.json("eval", "metrics.json", &arguments[1..]);
    assert!(
        metrics["mean"]["lpips"].is_null() && metrics["mean"]["lpips_vgg"].is_null(),
        "{}",
        metrics["mean"]
    );
    // With weights of zero, a network finds no difference.
    assert_eq!(metrics["mean"]["lpips_alex"], 0.0);
    let convention = metrics["conventions"]["lpips"].as_str().unwrap();
    assert!(
        convention.contains("by AlexNet (lpips_alex); weights not given for others")
            && convention.contains("vgg16"),
        "{convention}"
    );
    let ssim = |name: &str| metrics["mean"][name].as_f64().unwrap();
    assert!(ssim("ssim") != ssim("ssim_valid") && (ssim("ssim") - ssim("ssim_valid")).abs() < 0.2);
}

#[test]
fn graph_status_log_gc_and_verify_report_the_store() {
    let project = Project::tiny();
    project.ok(&["run"]);
    assert!(project.ok(&["graph"]).contains("train-ss (cached)  ← scene = prep/train"));
    assert!(project.ok(&["graph", "--format", "dot"]).contains("-> n"));
    assert!(project.ok(&["status"]).lines().all(|l| l.contains("cached")));
    let log = project.ok(&["log", "train-ss"]);
    let summary =
        std::fs::read_to_string(project.artifact("train-ss", &[]).join("summary.txt")).unwrap();
    let result = format!("\nresult: {}", summary.trim_end());
    assert!(log.contains("\nmemory: about ") && log.contains(&result), "{log}");
    assert!(project.ok(&["verify"]).contains("5 artifacts, 0 damaged"));
    // Artifacts of another kernel are garbage, those of the pipeline are not.
    project.ok(&["run", "-p", "kernel=box"]);
    let before = project.store_listing();
    assert!(project.ok(&["gc"]).contains("0 bytes deleted"), "recent artifacts stay");
    assert_eq!(project.store_listing(), before);
    let report = project.ok(&["gc", "--dry-run", "--keep-days", "0"]);
    assert!(report.contains("train-ss") && report.contains("would be deleted"), "{report}");
    assert_eq!(project.store_listing(), before);
    project.ok(&["gc", "--keep-days", "0"]);
    assert_eq!(project.store_listing().len(), before.len() - 4 * 3);
    assert!(project.ok(&["run"]).contains("nothing to run"));
}

#[test]
fn the_page_is_written_and_then_up_to_date() {
    let project = Project::tiny();
    project.replace("default: [eval]", "default: [report]");
    let text = std::fs::read_to_string(project.path("pipeline.yaml")).unwrap();
    project.write("pipeline.yaml", &(text + "  report:\n    inputs: {run: eval}\n"));
    let run = project.ok(&["run", "-p", "supersample=1,2"]);
    assert!(run.contains("out/report/index.html"), "{run}");
    let page = std::fs::read_to_string(project.path("out/report/index.html")).unwrap();
    for text in [
        "supersample=1",
        "supersample=2",
        "data:image/png;base64,",
        "weights not given",
        "Depth maps",
        "\"label\":\"Ground truth\",\"group\":\"Observations\"",
    ] {
        assert!(page.contains(text), "the page lacks {text:?}");
    }
    // The page fetches nothing: its only address is the namespace of SVG.
    assert!(page.contains("default-src 'none'") && !page.contains("https://"));
    assert_eq!(page.matches("http://").count(), page.matches("http://www.w3.org/2000/svg").count());
    let again = project.ok(&["run", "-p", "supersample=1,2"]);
    assert!(again.contains("up to date") && again.contains("nothing to run"), "{again}");
}

#[test]
fn a_python_program_replaces_eval() {
    let project = Project::tiny();
    let script = common::root().join("scripts/example-eval.py");
    std::fs::copy(script, project.path("my-eval.py")).unwrap();
    project.replace("  eval:\n", "  eval:\n    run: ./my-eval.py\n");
    let run = project.ok(&["run"]);
    assert!(run.contains("eval: mean squared error"), "{run}");
    assert!(project.ok(&["run"]).contains("nothing to run"));
    assert!(project.ok(&["log", "eval"]).contains("scoring with Python"));
    let why = project.ok(&["why", "eval", "-p", "peak=1"]);
    assert!(why.contains("parameter peak: 255 → 1"), "{why}");
    // A changed program is noticed, and the other stages stay cached.
    let text = std::fs::read_to_string(project.path("my-eval.py")).unwrap();
    project.write("my-eval.py", &text.replace("scoring with Python", "scoring anew"));
    std::process::Command::new("chmod").arg("+x").arg(project.path("my-eval.py")).status().unwrap();
    project.run(&["why", "eval"]).fails(2, &["my-eval.py", "check what the program does"]);
    assert!(project.ok(&["run"]).contains("1 of 5 stages ran, 4 were cached"));
}

fn spawn(project: &Project) -> Child {
    project.command(&["run"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

#[test]
fn two_runners_at_once_run_each_stage_once() {
    let project = Project::tiny();
    let runners = [spawn(&project), spawn(&project)]
        .map(|child| Finished::of(child.wait_with_output().unwrap()));
    let mut ran = 0;
    for runner in &runners {
        assert_eq!(runner.code, 0, "{}", runner.stderr);
        let last = runner.stdout.lines().last().unwrap();
        ran += if last.starts_with("nothing") {
            0
        } else {
            last.split(' ').next().unwrap().parse::<usize>().unwrap()
        };
    }
    assert_eq!(ran, 5);
}

/// Measured PSNR of settings that change the data between stages.
const OPTIONS: [(f64, &str); 11] = [
    (22.28, "background=alpha"),
    (22.41, "background=black kernel=bicubic"),
    (20.67, "kernel=average supersample_warmup=0.2"),
    (20.73, "supersample=3"),
    (24.04, "lr_width=20 scale=1.5 prep.hr_references=2 test_views=2"),
    (24.91, "lr_width=24 scale=1 supersample=1"),
    (20.97, "supervision=kernel"),
    (21.22, "lr_width=32 scale=1.5 supersample=1.5 supervision=kernel"),
    (20.63, "lr_width=16 scale=3 supersample=3 kernel=bicubic supervision=kernel"),
    (21.07, "lr_width=17 scale=2.7 supersample=2.7 supervision=kernel"),
    (
        21.44,
        "lr_width=17 scale=2.7 supersample=2.7 kernel=box render-depth.samples_per_axis=1 \
        ema_decay=0",
    ),
];

/// Computes the mean PSNR of the rendered views from the images.
fn psnr_by_hand(project: &Project, options: &[&str]) -> f64 {
    let rendered = project.artifact("render-depth", options);
    let truth = project.artifact("prep", options).join("truth");
    let list: Views =
        serde_json::from_slice(&std::fs::read(truth.join("views.json")).unwrap()).unwrap();
    let scores = list.views.iter().map(|view| {
        let file = rendered.join(format!("images/{}.exr", view.camera.name));
        let image = truth.join(view.image.as_ref().unwrap());
        psnr_of_files(&list, &file, &image)
    });
    scores.sum::<f64>() / list.views.len() as f64
}

fn psnr_of_files(list: &Views, found: &Path, expected: &Path) -> f64 {
    let [found, expected] = [found, expected].map(|file| list.read_over(file).unwrap());
    assert_eq!(found.data.len(), expected.data.len());
    let pairs = found.data.iter().zip(&expected.data);
    let errors = pairs.map(|(f, e)| f64::from(f.clamp(0.0, 1.0) - e).powi(2));
    pixels::psnr_of(errors.sum::<f64>() / found.data.len() as f64)
}

/// With each setting, `eval` must report the PSNR of the images, close to the measured one.
#[test]
fn every_setting_has_its_measured_psnr() {
    let project = Project::tiny();
    project.replace("rays: 60000", "rays: 150000");
    for (measured, settings) in OPTIONS {
        let options: Vec<&str> = settings.split(' ').flat_map(|setting| ["-p", setting]).collect();
        let run = project.ok(&[&["run"], &options[..]].concat());
        let metrics = project.json("eval", "metrics.json", &options);
        let psnr = metrics["mean"]["psnr"].as_f64().unwrap();
        assert!(run.contains(&format!("eval: PSNR {psnr:.2} dB")), "{settings}: {run}");
        let by_hand = psnr_by_hand(&project, &options);
        assert!((psnr - by_hand).abs() < 1e-3, "{settings}: {psnr} dB, by hand {by_hand}");
        // Changes of training or rendering may change the PSNR a little.
        assert!((psnr - measured).abs() < 1.0, "{settings}: {psnr} dB, measured {measured}");
        assert!(run.contains("depth error"), "{run}");
    }
}

fn member_weights(field: &Path, member: usize) -> Vec<u8> {
    std::fs::read(field.join(format!("field-{member}.safetensors"))).unwrap()
}

/// Member m of an ensemble must equal a field trained alone with seed + m, and rendered views must
/// be the mean of the members' views.
#[test]
fn ensemble_members_are_trained_independently_and_averaged() {
    let project = Project::tiny();
    let artifact = |stage: &str, settings: &[&str]| project.artifact(stage, settings);
    // Tolerance 0 renders all sub-pixel rays. Adaptive sampling would choose them by the mean's
    // error for the ensemble, and by one field's error for the single fields.
    let ensemble = [
        "-p",
        "render-depth.tolerance=0",
        "-p",
        "train-ss.seed=4",
        "-p",
        "ensemble=2",
        "-p",
        "rays=60000",
    ];
    let singles = ["train-ss.seed=4", "train-ss.seed=5"]
        .map(|seed| ["-p", "render-depth.tolerance=0", "-p", seed, "-p", "rays=30000"]);
    project.ok(&[&["run"], &ensemble[..]].concat());
    let (views, field) = (artifact("render-depth", &ensemble), artifact("train-ss", &ensemble));
    let mut images = Vec::new();
    for (m, single) in singles.iter().enumerate() {
        project.ok(&[&["run"], &single[..]].concat());
        assert!(
            member_weights(&field, m) == member_weights(&artifact("train-ss", single), 0),
            "member {m}"
        );
        images.push(artifact("render-depth", single).join("images"));
    }
    for entry in std::fs::read_dir(views.join("images")).unwrap() {
        let name = entry.unwrap().file_name();
        let read = |folder: &Path| pixels::read_exr(&folder.join(&name)).unwrap();
        let (mean, a, b) = (read(&views.join("images")), read(&images[0]), read(&images[1]));
        for channel in ["R", "G", "B", "A"] {
            let samples = |image: &pixels::ExrImage| image.channel(channel).unwrap().to_vec();
            for (mean, (a, b)) in samples(&mean).iter().zip(samples(&a).iter().zip(samples(&b))) {
                assert!((mean - (a + b) / 2.0).abs() < 1e-3, "{channel}: {mean} of {a} and {b}");
            }
        }
    }
}

/// A field must render at any size, and images need not be square.
#[test]
fn renders_have_any_size_and_shape() {
    let project = Project::tiny();
    project.ok(&["run", "render-depth", "-p", "render-depth.size=1"]);
    project.ok(&["run", "render-depth", "-p", "render-depth.size=100"]);
    // Crops the data set's images to 48×30, with an equal focal length and centre.
    let dataset = project.artifact("demo-scene", &[]);
    for split in ["train", "test"] {
        let text =
            std::fs::read_to_string(dataset.join(format!("transforms_{split}.json"))).unwrap();
        let file = project.path(&format!("cut/transforms_{split}.json"));
        std::fs::create_dir_all(file.parent().unwrap().join(split)).unwrap();
        std::fs::write(file, text.replace("depth_file_path", "ignored")).unwrap();
        for i in 0..12 {
            let name = format!("{split}/r_{i}.png");
            let Ok(image) = pixels::read_png(&dataset.join(&name)) else { continue };
            let data = image.data[9 * 48 * 4..39 * 48 * 4].to_vec();
            pixels::write_png(
                &project.path(&format!("cut/{name}")),
                &pixels::Rgba8::new(48, 30, data),
            )
            .unwrap();
        }
    }
    let run = project.ok(&["run", "-i", "dataset=cut"]);
    assert!(run.contains("eval: PSNR") && !run.contains("depth error"), "{run}");
    let scene = project.artifact("prep", &["-i", "dataset=cut"]);
    let image = pixels::read_png(&scene.join("train/images/r_0.png")).unwrap();
    assert_eq!((image.width, image.height), (24, 15));
}
