//! `upsample` in a pipeline, its error messages, and the table that compares all methods.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::Path;

use common::{Project, manifest, stage};
use pixels::{Filter, Image, read_exr, read_premultiplied, resize_pillow};

/// Creates a project that enlarges rendered LR views.
fn upsampling_project() -> Project {
    let project = Project::tiny();
    let blocks = "
  views-lr:
    extends: render-depth
    inputs: {field: train-ss, cameras: prep/cameras}
    parameters: {size: 24}
  upsample:
    inputs: {views: views-lr, cameras: prep/cameras}
  eval-upsampled:
    extends: eval
    inputs: {views: upsample, truth: prep/truth}
";
    let text = std::fs::read_to_string(project.path("pipeline.yaml")).unwrap();
    project.write("pipeline.yaml", &(text + blocks));
    project
}

fn goldens() -> std::path::PathBuf {
    common::root().join("stages/upsample/tests/goldens")
}

#[track_caller]
fn fails_to_upsample(
    project: &Project,
    inputs: &[(&str, &Path)],
    params: &str,
    weights: Option<&Path>,
    code: i32,
    words: &[&str],
) {
    let output = project.path("none");
    let mut inputs = inputs.to_vec();
    inputs.extend(weights.map(|weights| ("weights", weights)));
    stage("upsample", params, &inputs, &output, &[]).fails(code, words);
    assert!(!output.exists());
}

#[test]
fn views_are_enlarged_and_scored() {
    let project = upsampling_project();
    project.ok(&["run", "eval-upsampled"]);
    let folder = |stage: &str| project.artifact(stage, &["eval-upsampled"]);
    let (lr, hr) = (folder("views-lr"), folder("upsample"));
    for file in std::fs::read_dir(lr.join("images")).unwrap() {
        let name = file.unwrap().file_name();
        let lr_image = read_premultiplied(&lr.join("images").join(&name)).unwrap().over(1.0);
        let hr_image = read_exr(&hr.join("images").join(&name)).unwrap();
        assert_eq!((hr_image.width, hr_image.height, hr_image.channel("Z")), (48, 48, None));
        // Equal to Pillow's bicubic filter on 8 bits, except for rounding to half precision.
        let expected =
            Image::premultiplied(&resize_pillow(&lr_image.to_rgba8(), 48, 48, Filter::Bicubic));
        let errors = (0..4).flat_map(|c| {
            let found = hr_image.channel(["R", "G", "B", "A"][c]).unwrap();
            expected
                .channel(c)
                .into_iter()
                .zip(found)
                .map(|(a, b)| (a - b).abs())
                .collect::<Vec<_>>()
        });
        assert!(errors.fold(0.0, f32::max) < 3e-4);
    }
    // Small networks with random weights: SwinIR of this scale, LIIF for any scale.
    let weights = project.path("weights");
    std::fs::create_dir(&weights).unwrap();
    std::fs::copy(
        goldens().join("swinir_light.safetensors"),
        weights.join("swinir_x2.safetensors"),
    )
    .unwrap();
    std::fs::copy(goldens().join("liif.safetensors"), weights.join("liif.safetensors")).unwrap();
    let run = project.ok(&[
        "run",
        "eval-upsampled",
        "-i",
        "upsample.weights=weights",
        "-p",
        "method=swinir,liif",
    ]);
    assert!(run.contains("method=swinir") && run.contains("method=liif"), "{run}");
    // Bytes are equal at any thread count.
    let outputs = project.output_of(
        "upsample",
        &["eval-upsampled", "-i", "upsample.weights=weights", "-p", "method=swinir"],
    );
    let (views, cameras) = (lr, folder("prep").join("cameras"));
    for threads in ["1", "3"] {
        let output = project.path(&format!("threads-{threads}"));
        let inputs = [("views", views.as_path()), ("cameras", &cameras), ("weights", &weights)];
        let finished =
            stage("upsample", r#"{"method": "swinir"}"#, &inputs, &output, &["--threads", threads]);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        assert_eq!(manifest(&output), manifest(&project.object(&outputs[0])), "{threads} threads");
    }

    let inputs = [("views", views.as_path()), ("cameras", cameras.as_path())];
    fails_to_upsample(
        &project,
        &inputs,
        r#"{"method": "imdn"}"#,
        None,
        2,
        &["weights is missing", "imdn", "convert-weights.py"],
    );
    fails_to_upsample(
        &project,
        &inputs,
        r#"{"method": "imdn"}"#,
        Some(&weights),
        3,
        &["no file imdn_x2.safetensors"],
    );
    fails_to_upsample(
        &project,
        &inputs,
        r#"{"method": "imdn", "file": "liif.safetensors"}"#,
        Some(&weights),
        3,
        &["fea_conv", "of this network"],
    );
    fails_to_upsample(
        &project,
        &inputs,
        r#"{"method": "liif", "file": "../weights/liif.safetensors"}"#,
        Some(&weights),
        2,
        &["not the name of a file"],
    );
    std::fs::copy(goldens().join("imdn.safetensors"), weights.join("imdn_x2.safetensors")).unwrap();
    fails_to_upsample(
        &project,
        &inputs,
        r#"{"method": "imdn"}"#,
        Some(&weights),
        3,
        &["enlarges 3 times", "has 48×48 pixels and the view 24×24", "liif"],
    );
}

#[test]
fn the_table_compares_every_method() {
    let project = Project::experiments();
    let methods = ["nerf", "nerf-epochs", "bicubic", "swinir", "ss", "kernel", "hr"];
    let names = methods.join(",");
    let rays = ["-p", "train-ss.rays=160000", "-p", "field-nerf-epochs.rays=40000"];
    let options = ["--scene", "demo", "--protocol", "24x2", "--data", "data", "--show", &names];
    let arguments =
        [&["run", "paper-table", "paper-times", "paper-page"], &options[..], &rays].concat();
    project.ok(&arguments);
    let read = |file: &str| std::fs::read_to_string(project.path(file)).unwrap();
    let table = read("out/paper-table/table.md");
    for text in [
        "| method | has seen | 24x2 (PSNR / SSIM) | commit | machine |",
        "\n| ours, SS | LR |",
        "| NeRF-Swin | other images | no weights/swinir_x2.safetensors |",
        "ours, SS over NeRF at equal epochs |",
    ] {
        assert!(table.contains(text), "no {text:?} in:\n{table}");
    }
    let rows: Vec<serde_json::Value> =
        serde_json::from_str(&read("out/paper-table/rows.json")).unwrap();
    assert_eq!(rows.len(), methods.len());
    let psnr = |method: &str| rows.iter().find(|r| r["method"] == method).unwrap()["psnr"].as_f64();
    assert!(psnr("NeRF-Swin").is_none());
    // Measured PSNR: 21.4 and 20.2 dB, 20.8 and 20.6 dB.
    for (better, worse, margin) in
        [("trained at HR", "NeRF-Bi", 0.5), ("ours, SS", "NeRF, equal rays", 0.1)]
    {
        let (better, worse) = (psnr(better).unwrap(), psnr(worse).unwrap());
        assert!(better > worse + margin, "{better}, {worse}: {rows:?}");
    }
    assert_eq!(read("out/paper-table/rows.csv").lines().count(), 1 + methods.len());
    assert!(read("out/paper-times/table.md").contains("(training / rendering)"));
    let page = read("out/paper-page/index.html");
    assert!(
        page.contains("Side by side") && page.contains("eval-bicubic"),
        "the page has no comparison"
    );
    // A second run finds everything cached.
    let again = project.ok(&arguments);
    assert!(
        again.contains("paper-table (up to date)") && again.contains("nothing to run"),
        "{again}"
    );
    let unknown =
        project.run(&["plan", "paper-table", "--scene", "demo", "--show", "nerf,bicubik"]);
    unknown.fails(2, &["--show bicubik", "did you mean bicubic?"]);
}
