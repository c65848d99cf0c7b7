//! `nerf-sr run refined`: a network trained on downscaled images adds missing detail to views.

#![allow(missing_docs, reason = "a test")]
mod common;

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::SystemTime;

use common::{
    Finished, Project, kill_again_and_again, manifest, signal, stage, stage_command, wait_until,
};

/// Parameters of the shipped targets at tiny sizes.
const REFINED: &str = "
  downscaled-field:
    parameters: {rays: 40000}
  train-refine:
    parameters: {steps: 60, batch_size: 4, patch_size: 16, features: 8, blocks: 1}
  upsample:
    parameters: {method: bicubic}
  finetuned-field:
    parameters: {rays: 60000}
  train-reference:
    parameters: {references_per_view: 2}
  train-paper:
    parameters: {steps: 3, batch_size: 2, patch_size: 16, features: 4}
";

fn project() -> Project {
    Project::shipped(&["sisr-fuse", "paper-refine"], REFINED)
}

fn green(file: &Path) -> Vec<f32> {
    pixels::read_exr(file).unwrap().channel("G").unwrap().to_vec()
}

#[test]
fn page_lists_rendered_and_refined_views() {
    let project = project();
    // 40000 rays are too few: the network learns to leave views unchanged.
    project.replace("rays: 40000", "rays: 80000");
    let run = project.ok(&["run", "refined"]);
    assert!(run.contains("out/refined/index.html"), "{run}");
    let page = std::fs::read_to_string(project.path("out/refined/index.html")).unwrap();
    assert!(
        ["refined", "rendered"].iter().all(|row| page.contains(&format!("scope=\"row\">{row}<"))),
        "the page lacks the refined or the rendered row"
    );
    let rows: serde_json::Value =
        serde_json::from_slice(&std::fs::read(project.path("out/refined/results.json")).unwrap())
            .unwrap();
    let stages: Vec<&str> =
        rows.as_array().unwrap().iter().map(|r| r["stage"].as_str().unwrap()).collect();
    assert_eq!(stages, ["eval", "eval-refined"]);

    // Colours change, opacity and depth don't.
    let folder = |stage: &str| project.artifact(stage, &["refined"]);
    let (rendered, refined) = (folder("render-depth"), folder("refine"));
    for file in std::fs::read_dir(rendered.join("images")).unwrap() {
        let name = file.unwrap().file_name();
        let read = |folder: &Path| pixels::read_exr(&folder.join("images").join(&name)).unwrap();
        let (before, after) = (read(&rendered), read(&refined));
        assert_eq!(before.channel("Z"), after.channel("Z"));
        assert_eq!(before.channel("A"), after.channel("A"));
        let changed = before
            .channel("G")
            .unwrap()
            .iter()
            .zip(after.channel("G").unwrap())
            .filter(|(a, b)| a != b)
            .count();
        assert!(changed > 100, "{changed} pixels changed");
    }
    // A folder of views is not a refiner.
    let views = rendered.as_path();
    stage("refine", "{}", &[("views", views), ("refiner", views)], &project.path("no"), &[])
        .fails(3, &["refiner.json"]);
}

/// Runs `refined` and returns the rows of its page.
fn refined_rows(project: &Project, more: &[&str]) -> Vec<serde_json::Value> {
    project.ok(&[&["run", "refined"], more].concat());
    let text = std::fs::read(project.path("out/refined/results.json")).unwrap();
    serde_json::from_slice(&text).unwrap()
}

/// Returns a parameter of a stage, as JSON text, for each refined row.
fn parameters(project: &Project, stage: &str, name: &str, more: &[&str]) -> Vec<String> {
    let rows = refined_rows(project, more);
    let refined = rows.iter().filter(|row| row["stage"] == "eval-refined");
    refined.map(|row| row["stages"][stage]["parameters"][name].to_string()).collect()
}

/// A block has the settings of the block that it extends, from the file and from the command
/// line; its own settings override them.
#[test]
fn a_block_inherits_settings_of_the_block_it_extends() {
    let project = project();
    assert_eq!(parameters(&project, "downscaled-field", "n_levels", &[]), ["4"]);
    let settings = ["-p", "supersample=1,2", "-p", "rays=50000"];
    assert_eq!(parameters(&project, "downscaled-field", "supersample", &settings), ["1.0", "2.0"]);
    assert_eq!(parameters(&project, "train-ss", "rays", &settings), ["50000", "50000"]);
    assert_eq!(parameters(&project, "downscaled-field", "rays", &settings), ["40000", "40000"]);
    assert_eq!(
        parameters(&project, "downscaled-field", "rays", &["-p", "downscaled-field.rays=30000"]),
        ["30000"]
    );
    let own_parameters = "parameters: {rays: 40000}";
    for (addition, words) in [
        ("extends: nothing", &["pipeline.yaml:", "extends: no stage \"nothing\""][..]),
        ("extends: downscaled-views", &["itself extends \"render-depth\""]),
        ("extends: train-ss\n    run: train-ss", &["remove one of them"]),
        ("like: train-ss", &["pipeline.yaml:", "unknown field `like`"]),
    ] {
        let changed = format!("{own_parameters}\n    {addition}");
        project.replace(own_parameters, &changed);
        project.run(&["plan", "refined"]).fails(2, words);
        project.replace(&changed, own_parameters);
    }
}

/// Returns the mean PSNR at LR, in dB, of each row.
fn mean_lr_psnrs(project: &Project, more: &[&str]) -> Vec<f64> {
    let rows = refined_rows(project, more);
    rows.iter().map(|r| r["mean"]["low_resolution"]["psnr"].as_f64().unwrap()).collect()
}

fn refine_summary(project: &Project, more: &[&str]) -> String {
    let folder = project.artifact("refine", &[&["refined"], more].concat());
    std::fs::read_to_string(folder.join("summary.txt")).unwrap()
}

fn is_data_consistent(project: &Project, more: &[&str]) -> bool {
    project.json("train-refine", "refiner.json", &[&["refined"], more].concat())["data_consistent"]
        .as_bool()
        .unwrap()
}

/// Only a training view has an LR photograph to be consistent with. In the paper's split, all views
/// are training views; in the given split, none of the refined views is.
#[test]
fn views_are_consistent_with_their_own_photographs() {
    let project = project();
    let given_split = mean_lr_psnrs(&project, &[]);
    assert!(
        given_split[1] < given_split[0] + 3.0
            && !refine_summary(&project, &[]).contains("consistent"),
        "{given_split:?}"
    );
    let paper_split = mean_lr_psnrs(&project, &["-p", "split=paper"]);
    assert!(paper_split[1] > paper_split[0] + 6.0, "{paper_split:?}");
    assert!(
        refine_summary(&project, &["-p", "split=paper"]).contains("consistent with LR photographs")
    );
    // The network is trained on consistent views, too, and warns about views without photographs.
    assert!(
        is_data_consistent(&project, &["-p", "split=paper"]) && !is_data_consistent(&project, &[])
    );
    let folder = |stage: &str| project.artifact(stage, &["refined", "-p", "split=paper"]);
    let (views, refiner) = (folder("render-depth"), folder("train-refine"));
    let (finished, _) = refine_with(&project, &views, "alone", &refiner, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    assert!(
        finished.stderr.contains("trained on views consistent with LR photographs of their own"),
        "{}",
        finished.stderr
    );
}

fn refine_enlarged(
    project: &Project,
    views: &Path,
    refiner: &Path,
    name: &str,
    enlarged: Option<&Path>,
) -> (Finished, PathBuf) {
    let mut inputs = vec![("views", views), ("refiner", refiner)];
    inputs.extend(enlarged.map(|enlarged| ("enlarged", enlarged)));
    let output = project.path(name);
    (stage("refine", "{}", &inputs, &output, &[]), output)
}

fn green_over_white(folder: &Path, name: &str) -> Vec<f32> {
    let file = folder.join(format!("images/{name}.exr"));
    pixels::read_premultiplied(&file).unwrap().over(1.0).channel(1)
}

/// A refined view is averaged with its own enlarged photograph, except at masked pixels, and is
/// consistent with the photograph.
#[test]
fn refined_views_are_averaged_with_their_enlarged_photographs() {
    let project = project();
    let arguments = ["sisr-fuse", "-p", "split=paper"];
    project.ok(&[&["run"], &arguments[..]].concat());
    let folder = |stage: &str| project.artifact(stage, &arguments);
    let summary = std::fs::read_to_string(folder("refine-sisr").join("summary.txt")).unwrap();
    assert!(
        summary.contains("14 averaged with") && summary.contains("14 consistent with"),
        "{summary}"
    );

    let (views, refiner, enlarged) =
        (folder("render-depth"), folder("train-refine"), project.path("enlarged"));
    let (train, cameras) = (folder("prep").join("train"), folder("prep").join("train-cameras"));
    // The right half of one photograph is masked.
    let name = "r_1";
    let photographs = changed_copy(&project, "photographs", &train, "json", &|path| {
        let mut list: serde_json::Value =
            serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        for view in list["views"]
            .as_array_mut()
            .into_iter()
            .flatten()
            .filter(|view| view["camera"]["name"] == name)
        {
            view["mask"] = "masks/it.png".into();
        }
        std::fs::write(path, list.to_string()).unwrap();
    });
    let counts = (0..24 * 24).map(|i| i % 24 < 12).collect();
    let mask = pixels::Mask { width: 24, height: 24, counts };
    std::fs::create_dir(photographs.join("masks")).unwrap();
    pixels::write_png(&photographs.join("masks/it.png"), &mask.to_rgba8()).unwrap();
    let inputs = [("views", photographs.as_path()), ("cameras", &cameras)];
    assert_eq!(stage("upsample", "{}", &inputs, &enlarged, &[]).code, 0);

    let (refined, mean) = (
        refine_enlarged(&project, &views, &refiner, "plain", None).1,
        refine_enlarged(&project, &views, &refiner, "mean", Some(&enlarged)).1,
    );
    let (refined, mean, enlarged) = (
        green_over_white(&refined, name),
        green_over_white(&mean, name),
        green_over_white(&enlarged, name),
    );
    for (i, ((refined, mean), enlarged)) in refined.iter().zip(&mean).zip(&enlarged).enumerate() {
        let expected = if i % 48 < 24 { 0.5 * (refined + enlarged) } else { *refined };
        assert!(
            (mean - expected).abs() < 2e-3,
            "pixel {i}: {mean}, not the mean of {refined} and {enlarged}"
        );
    }
    assert!(
        refined.iter().zip(&enlarged).any(|(a, b)| (a - b).abs() > 0.05),
        "the refined view equals the enlarged photograph"
    );
    // Photographs that weren't enlarged have another size than the view.
    refine_enlarged(&project, &views, &refiner, "no", Some(&photographs))
        .0
        .fails(3, &["input enlarged: view", "24×24 pixels, but the view to refine has 48×48"]);
}

fn refine_with(
    project: &Project,
    views: &Path,
    name: &str,
    refiner: &Path,
    more: &[(&str, &Path)],
) -> (Finished, PathBuf) {
    let inputs = [&[("views", views), ("refiner", refiner)], more].concat();
    let output = project.path(name);
    let mut command = std::process::Command::new(common::bin("refine"));
    command.arg("--output").arg(&output);
    for (name, folder) in inputs {
        command.arg("--input").arg(format!("{name}={}", folder.display()));
    }
    (Finished::of(command.output().unwrap()), output)
}

#[test]
fn only_a_network_trained_with_references_uses_them() {
    let (project, target) = forward_facing_project();
    project.ok(&[&["run"], &target[..]].concat());
    let folder = |stage: &str| project.artifact(stage, &target);
    let (views, refiner) = (folder("finetuned-views"), folder("train-reference"));
    let (prep, reference_views, referenced) =
        (folder("prep"), folder("reference-views"), folder("refine-reference"));
    let references = prep.join("references");
    let image = "images/r_0.exr";
    // Without references, the network refines views differently, and warns.
    let (finished, output) = refine_with(&project, &views, "alone", &refiner, &[]);
    assert!(
        finished.code == 0 && finished.stderr.contains("but none are given"),
        "{}",
        finished.stderr
    );
    assert_ne!(green(&output.join(image)), green(&referenced.join(image)));
    // Every reference needs the rendered view of its pose.
    let reference_inputs =
        [("references", references.as_path()), ("reference-views", views.as_path())];
    refine_with(&project, &views, "no", &refiner, &reference_inputs)
        .0
        .fails(3, &["input reference-views: no view r_0 with the reference's pose"]);
    // A network trained without references ignores them, and warns.
    let plain_arguments = [&["train-refine"], &target[1..]].concat();
    project.ok(&[&["run"], &plain_arguments[..]].concat());
    let plain_refiner = project.artifact("train-refine", &plain_arguments);
    let reference_inputs =
        [("references", references.as_path()), ("reference-views", reference_views.as_path())];
    let (finished, _) = refine_with(&project, &views, "plain", &plain_refiner, &reference_inputs);
    assert!(
        finished.code == 0 && finished.stderr.contains("trained without references"),
        "{}",
        finished.stderr
    );
}

/// Returns a forward-facing scene, whose references cover much of each view, and arguments that
/// refine it. Its field is trained until references and renders agree.
fn forward_facing_project() -> (Project, Vec<&'static str>) {
    let project = project();
    project.replace("train: 12", "train: 30");
    project.replace("rays: 60000", "rays: 300000, seed: 2");
    project.replace("rays: 40000", "rays: 200000");
    project.replace(
        "parameters: {references_per_view: 2}",
        "parameters: {references_per_view: 2, steps: 600, features: 16, blocks: 2}",
    );
    let settings = ["-p", "layout=forward", "-p", "backdrop=true", "-p", "near=2", "-p", "far=80"];
    (project, [&["refine-reference", "-p", "prep.hr_references=2"], &settings[..]].concat())
}

/// Copies a folder and changes the copied files with the given extension.
fn changed_copy(
    project: &Project,
    name: &str,
    source: &Path,
    extension: &str,
    change: &dyn Fn(&Path),
) -> PathBuf {
    let copy = project.path(name);
    for file in
        walkdir::WalkDir::new(source).into_iter().flatten().filter(|f| f.file_type().is_file())
    {
        let target = copy.join(file.path().strip_prefix(source).unwrap());
        std::fs::create_dir_all(target.parent().unwrap()).unwrap();
        std::fs::write(&target, std::fs::read(file.path()).unwrap()).unwrap();
        if target.extension().is_some_and(|e| e == extension) {
            change(&target);
        }
    }
    // The manifest contains the hashes of the original files.
    std::fs::remove_file(copy.join("artifact.json")).ok();
    copy
}

/// Changes a view's depth, pixel by pixel.
fn change_depth(path: &Path, change: fn(usize, f32) -> f32) {
    let image = pixels::read_exr(path).unwrap();
    let channels = scene::VIEW_CHANNELS;
    let size = (image.width, image.height);
    let written = scene::write_view_image(path, size, &channels, |first, _, samples| {
        for (i, sample) in (first * image.width..).zip(samples.chunks_exact_mut(5)) {
            (0..5).for_each(|c| sample[c] = image.channel(channels[c].name).unwrap()[i]);
            sample[4] = change(i, sample[4]);
        }
        Ok::<(), Box<dyn std::error::Error>>(())
    });
    written.unwrap();
}

/// Returns a pixel's random depth factor, from 0.985 to 1.015.
fn depth_noise(seed: u64, pixel: usize) -> f32 {
    1.0 + 0.03 * (numerics::uniform(seed, 2, pixel as u64) - 0.5)
}

fn with_depths(
    project: &Project,
    name: &str,
    views: &Path,
    change: fn(usize, f32) -> f32,
) -> PathBuf {
    changed_copy(project, name, views, "exr", &|path| change_depth(path, change))
}

fn with_colours(
    project: &Project,
    references: &Path,
    name: &str,
    change: fn([f32; 3]) -> [f32; 3],
) -> PathBuf {
    changed_copy(project, name, references, "png", &|path| {
        let image = pixels::read_premultiplied(path).unwrap().over(1.0);
        let data = image.data.as_chunks::<3>().0.iter().flat_map(|p| change(*p)).collect();
        pixels::write_png(path, &pixels::Image::new(image.width, image.height, 3, data).to_rgba8())
            .unwrap();
    })
}

fn first_psnr(prep: &Path, views: &Path) -> f64 {
    let read = |path: &Path| pixels::read_premultiplied(path).unwrap().over(1.0);
    let images = prep.join("truth/images").read_dir().unwrap().map(|entry| entry.unwrap().path());
    let truth = images.min().unwrap();
    let name = truth.with_extension("exr");
    eval::psnr(&read(&views.join("images").join(name.file_name().unwrap())), &read(&truth))
}

/// Inputs of refining and scoring a scene's rendered views.
struct Refining<'a> {
    project: &'a Project,
    refiner: &'a Path,
    prep: &'a Path,
    /// PSNR of the first rendered view, in dB.
    rendered_psnr: f64,
}

impl Refining<'_> {
    /// Refines views, checks that the first one's PSNR is not much lower, and returns stderr.
    fn refine(
        &self,
        name: &str,
        views: &Path,
        references: &Path,
        reference_views: &Path,
    ) -> String {
        let more = [("references", references), ("reference-views", reference_views)];
        let (finished, output) = refine_with(self.project, views, name, self.refiner, &more);
        assert_eq!(finished.code, 0, "{}", finished.stderr);
        let summary = std::fs::read_to_string(output.join("summary.txt")).unwrap();
        let (psnr, rendered_psnr) = (first_psnr(self.prep, &output), self.rendered_psnr);
        println!(
            "{name}: {psnr:.2} dB, rendered {rendered_psnr:.2}; {summary}; {}",
            finished.stderr
        );
        // The bound doesn't hold for every field: with seeds 1, 3, 4, 5 and 6, shifted depths cost
        // 0.1 to 0.35 dB or weren't reported (e423529, docs/design/018).
        assert!(psnr > rendered_psnr - 0.25, "{name}: {psnr} dB, rendered {rendered_psnr}");
        finished.stderr
    }
}

/// Noisy or shifted depths, and references that are hidden, darker or differently coloured, hardly
/// lower a view's PSNR. All of them except the noise must be reported.
#[test]
fn bad_references_do_no_harm() {
    let (project, target) = forward_facing_project();
    project.ok(&[&["run"], &target[..]].concat());
    let folder = |stage: &str| project.artifact(stage, &target);
    let (views, refiner, prep, reference_views) = (
        folder("finetuned-views"),
        folder("train-reference"),
        folder("prep"),
        folder("reference-views"),
    );
    println!("{}", project.json("train-reference", "refiner.json", &target));
    let references = prep.join("references");
    let rendered_psnr = first_psnr(&prep, &views);
    let refining = Refining { project: &project, refiner: &refiner, prep: &prep, rendered_psnr };
    let log = refining.refine("good", &views, &references, &reference_views);
    assert!(!log.contains("reference r_"), "{log}");

    let (noisy_views, noisy_references) = (
        with_depths(&project, "a", &views, |i, z| z * depth_noise(1, i)),
        with_depths(&project, "b", &reference_views, |i, z| z * depth_noise(3, i)),
    );
    refining.refine("noisy", &noisy_views, &references, &noisy_references);
    let (shifted_views, shifted_references) = (
        with_depths(&project, "c", &views, |_, _| 2.5),
        with_depths(&project, "d", &reference_views, |_, _| 2.5),
    );
    let log = refining.refine("shifted", &shifted_views, &references, &shifted_references);
    assert!(log.contains("differs from the renders"), "{log}");
    let log = refining.refine(
        "hidden",
        &views,
        &references,
        &with_depths(&project, "e", &reference_views, |_, z| 0.01 * z),
    );
    assert!(log.contains("shows no part of these views"), "{log}");
    let log = refining.refine(
        "dark",
        &views,
        &with_colours(&project, &references, "f", |p| p.map(|v| 0.6 * v)),
        &reference_views,
    );
    assert!(log.contains("has another exposure"), "{log}");
    let log = refining.refine(
        "other",
        &views,
        &with_colours(&project, &references, "g", |[r, g, b]| [g, b, 1.0 - r]),
        &reference_views,
    );
    assert!(log.contains("differs from the renders"), "{log}");
}

fn mean_psnr(project: &Project, arguments: &[&str], stage: &str) -> f64 {
    let metrics = project.json(stage, "metrics.json", arguments);
    metrics["mean"]["psnr"].as_f64().unwrap()
}

fn member_weights(field: &Path, member: u32) -> Option<Vec<u8>> {
    std::fs::read(field.join(format!("field-{member}.safetensors"))).ok()
}

fn psnr_after_finetuning(
    project: &Project,
    initial_field: &Path,
    combine: &str,
    rays: &str,
    references: &str,
) -> f64 {
    let settings = [("rays", rays), ("max_references", references), ("combine", combine)]
        .map(|(name, value)| format!("finetuned-field.{name}={value}"));
    let more = [
        "-p",
        "prep.hr_references=6",
        "-p",
        "train-ss.rays=800000",
        "-p",
        &settings[0],
        "-p",
        &settings[1],
        "-p",
        &settings[2],
    ];
    let arguments = [&["eval-finetuned"], &more[..]].concat();
    project.ok(&[&["run"], &arguments[..]].concat());
    let psnr = mean_psnr(project, &arguments, "eval-finetuned");
    println!("{psnr:.2} dB, {settings:?}");
    let field = project.artifact("finetuned-field", &arguments);
    assert_eq!(member_weights(&field, 1).is_some(), combine == "ensemble");
    assert_eq!(
        member_weights(&field, 0) == member_weights(initial_field, 0),
        combine == "ensemble",
        "the initial field is the first member"
    );
    psnr
}

#[test]
fn hr_references_in_training_raise_the_psnr() {
    // `joined-field` is trained on LR images and references from the start; the shipped
    // `finetuned-field` is initialised from the field of LR images.
    let joined = "
  joined-field:
    extends: train-ss
    inputs: {scene: prep/train, references: prep/references}
  joined-views:
    extends: render-depth
    inputs: {field: joined-field, cameras: prep/cameras}
  eval-joined:
    extends: eval
    inputs: {views: joined-views, truth: prep/truth}
";
    let project = Project::shipped(&["hr-finetune"], joined);
    let arguments =
        ["eval", "eval-joined", "-p", "prep.hr_references=6", "-p", "train-ss.rays=800000"];
    project.ok(&[&["run"], &arguments[..]].concat());
    println!(
        "{:.2} dB from LR images, {:.2} dB with six of twelve at HR",
        mean_psnr(&project, &arguments, "eval"),
        mean_psnr(&project, &arguments, "eval-joined")
    );
    assert!(
        mean_psnr(&project, &arguments, "eval-joined")
            > mean_psnr(&project, &arguments, "eval") + 0.3
    );
    // Fewer rays are enough if training is initialised from the field of LR images and both fields,
    // or their weights' mean, are kept. Few rays, or one reference alone, hardly lose PSNR.
    let initial_field = project.artifact("train-ss", &arguments);
    for combine in ["ensemble", "average_weights"] {
        assert!(
            psnr_after_finetuning(&project, &initial_field, combine, "100000", "6")
                > mean_psnr(&project, &arguments, "eval") + 0.2
        );
        assert!(
            psnr_after_finetuning(&project, &initial_field, combine, "8000", "6")
                > mean_psnr(&project, &arguments, "eval") - 0.02
        );
        assert!(
            psnr_after_finetuning(&project, &initial_field, combine, "100000", "1")
                > mean_psnr(&project, &arguments, "eval") - 0.02
        );
    }
    // Zero references give the field of a training without references.
    let no_references = [&arguments[..], &["-p", "joined-field.max_references=0"]].concat();
    project.ok(&[&["run"], &no_references[..]].concat());
    let weights =
        |stage: &str| member_weights(&project.artifact(stage, &no_references), 0).unwrap();
    assert!(weights("joined-field") == weights("train-ss"));
}

#[track_caller]
fn init_fails(project: &Project, scene: &Path, parameters: &str, field: &Path, words: &[&str]) {
    stage("train-ss", parameters, &[("scene", scene), ("init", field)], &project.path("no"), &[])
        .fails(3, words);
    assert!(!project.path("no").exists());
}

fn with_field_json(project: &Project, field: &Path, name: &str, json: &str) -> PathBuf {
    let field = changed_copy(project, name, field, "none", &|_| ());
    std::fs::write(field.join("field.json"), json).unwrap();
    field
}

/// An initial field needs the parameters' architecture, and the scene's background and bounds.
#[test]
fn incompatible_initial_fields_are_refused() {
    let project = Project::tiny();
    project.ok(&["run", "train-ss"]);
    let folder = |stage: &str| project.artifact(stage, &["train-ss"]);
    let (scene, field) = (folder("prep").join("train"), folder("train-ss"));
    let json = std::fs::read_to_string(field.join("field.json")).unwrap();
    init_fails(
        &project,
        &scene,
        "{}",
        &field,
        &["input init: the field's architecture differs from the parameters"],
    );
    let params = r#"{"rays": 8000, "n_levels": 4, "log2_hashmap_size": 12, "hidden_dim": 16, "march_steps": 128}"#;
    init_fails(
        &project,
        &scene,
        params,
        &with_field_json(&project, &field, "black", &json.replace("\"white\"", "\"black\"")),
        &["input init: the field's background differs from the scene's"],
    );
    init_fails(
        &project,
        &scene,
        params,
        &with_field_json(&project, &field, "far", &json.replace("\"far\": ", "\"far\": 1")),
        &["input init: the field's bounds differ from the scene's"],
    );
    let damaged = with_field_json(&project, &field, "cut", &json);
    std::fs::write(damaged.join("field-0.safetensors"), b"{").unwrap();
    init_fails(&project, &scene, params, &damaged, &["input init", "field-0.safetensors"]);
    // An ensemble has at most 16 members, including the initial field's.
    let large_ensemble = params.replace('{', r#"{"ensemble": 16, "#);
    stage(
        "train-ss",
        &large_ensemble,
        &[("scene", scene.as_path()), ("init", field.as_path())],
        &project.path("no"),
        &[],
    )
    .fails(
        2,
        &[
            "parameter ensemble: members = 17 is not in 1..=16 including those of input init",
            "combine to average_weights",
        ],
    );
}

/// Returns rendered downscaled views, their ground truth, and parameters of a training of seconds.
fn training_inputs(project: &Project) -> (std::path::PathBuf, std::path::PathBuf, &'static str) {
    project.ok(&["run", "downscaled-views"]);
    let folder = |stage: &str| project.artifact(stage, &["downscaled-views"]);
    (
        folder("downscaled-views"),
        folder("prep").join("train"),
        r#"{"steps": 600, "batch_size": 8, "patch_size": 24, "features": 32, "blocks": 2}"#,
    )
}

/// Step, of 600, from which training is slowed down.
const SLOW_FROM: u64 = 100;

#[test]
fn a_training_killed_at_any_moment_ends_in_the_same_bytes_at_any_thread_count() {
    let project = project();
    let (views, truth, params) = training_inputs(&project);
    // With references, training draws pools of views. The checkpoint doesn't contain the current
    // pool, which must be drawn again.
    let params = &params.replace('{', r#"{"references_per_view": 1, "#);
    let inputs = [("views", views.as_path()), ("truth", truth.as_path())];
    let (expected, output, work) =
        (project.path("whole"), project.path("killed"), project.path("work"));
    assert_eq!(stage("train-refine", params, &inputs, &expected, &["--threads", "1"]).code, 0);
    let more = ["--work", work.to_str().unwrap(), "--progress", "plain"];
    kill_again_and_again(
        "train-refine",
        params,
        &inputs,
        &output,
        &work,
        SLOW_FROM,
        &[100, 100, 300, 700],
    );
    let last = stage("train-refine", params, &inputs, &output, &more);
    assert_eq!(last.code, 0, "{}", last.stderr);
    assert!(last.stderr.contains("resuming from step"), "{}", last.stderr);
    assert_eq!(manifest(&output), manifest(&expected));
    check_truncated_checkpoint(&project, &inputs);
}

/// Checks that a truncated checkpoint is reported and skipped, and that training starts over.
fn check_truncated_checkpoint(project: &Project, inputs: &[(&str, &Path)]) {
    let params = r#"{"steps": 100, "batch_size": 2, "patch_size": 16, "features": 8, "blocks": 1}"#;
    let [expected, output, work] = ["short", "cut", "cut-work"].map(|name| project.path(name));
    assert_eq!(stage("train-refine", params, inputs, &expected, &[]).code, 0);
    let more = ["--work", work.to_str().unwrap(), "--progress", "plain"];
    let stopped = stage_command("train-refine", params, inputs, &output, &more)
        .env("NERF_SR_STOP_AFTER", "50")
        .output()
        .unwrap();
    assert_eq!(stopped.status.code(), Some(130));
    let checkpoint = work.join("checkpoint.safetensors");
    let bytes = std::fs::read(&checkpoint).unwrap();
    std::fs::write(&checkpoint, &bytes[..bytes.len() / 2]).unwrap();
    let restarted = stage("train-refine", params, inputs, &output, &more);
    assert_eq!(restarted.code, 0, "{}", restarted.stderr);
    let is_reported =
        |line: &str| line.contains("checkpoint.safetensors: ") && line.ends_with("; starting over");
    assert!(restarted.stderr.lines().any(is_reported), "{}", restarted.stderr);
    assert_eq!(manifest(&output), manifest(&expected));
}

/// Returns the folders of finished parts in a work folder.
fn finished_parts(work: &Path) -> Vec<PathBuf> {
    let files = walkdir::WalkDir::new(work).sort_by_file_name().into_iter().flatten();
    let parts = files
        .filter(|f| f.file_name() == "artifact.json")
        .map(|f| f.path().parent().unwrap().to_owned());
    parts.filter(|part| !part.file_name().unwrap().to_string_lossy().starts_with('.')).collect()
}

fn write_times(parts: &[PathBuf]) -> Vec<SystemTime> {
    parts
        .iter()
        .map(|part| part.join("artifact.json").metadata().unwrap().modified().unwrap())
        .collect()
}

/// Runs a stage and returns its output's manifest.
fn output_manifest(
    project: &Project,
    name: &str,
    params: &str,
    inputs: &[(&str, &Path)],
    output: &str,
    more: &[&str],
) -> String {
    let output = project.path(output);
    let finished = stage(name, params, inputs, &output, more);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    manifest(&output)
}

/// Views that were finished before a kill aren't computed again, unless the views are damaged, or
/// parameters or inputs differ.
#[test]
fn finished_views_are_reused_after_a_kill() {
    let project = project();
    project.ok(&["run", "refine-reference", "-p", "prep.hr_references=2"]);
    let folder =
        |stage: &str| project.artifact(stage, &["refine-reference", "-p", "prep.hr_references=2"]);
    let (prep, field, rendered) = (folder("prep"), folder("train-ss"), folder("reference-views"));
    let (cameras, references, refiner) =
        (prep.join("train"), prep.join("references"), folder("train-reference"));
    let views = project.path("render-depth-whole");
    let render = [("field", field.as_path()), ("cameras", &cameras)];
    let refine = [
        ("views", views.as_path()),
        ("refiner", &refiner),
        ("references", &references),
        ("reference-views", &rendered),
    ];
    for (name, inputs, params, other_params) in [
        ("render-depth", &render[..], r#"{"size": 120}"#, r#"{"size": 40}"#),
        ("refine", &refine, r#"{"self_ensemble": 8}"#, r#"{"self_ensemble": 1}"#),
    ] {
        let (work, output, expected) = (
            project.path(&format!("{name}-work")),
            project.path(name),
            project.path(&format!("{name}-whole")),
        );
        let more = ["--work", work.to_str().unwrap()];
        assert_eq!(stage(name, params, inputs, &expected, &[]).code, 0);
        let mut child = stage_command(name, params, inputs, &output, &more)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        wait_until(|| !finished_parts(&work).is_empty() || child.try_wait().unwrap().is_some());
        signal(&child, "-KILL");
        child.wait().unwrap();
        let resume = |output: &str, params: &str| {
            output_manifest(&project, name, params, inputs, output, &more)
        };
        let before = finished_parts(&work);
        let times = write_times(&before);
        assert!(!before.is_empty() && resume("resumed", params) == manifest(&expected), "{name}");
        assert_eq!(write_times(&before), times, "{name}: finished views were written again");
        // One part is damaged, one has a truncated manifest, one is missing.
        let parts = finished_parts(&work);
        let times = write_times(&parts[3..]);
        assert_eq!(parts.len(), 12, "{parts:?}");
        let image = walkdir::WalkDir::new(&parts[0])
            .into_iter()
            .flatten()
            .find(|f| f.path().extension().is_some_and(|e| e == "exr"));
        let image = image.unwrap().path().to_owned();
        let mut bytes = std::fs::read(&image).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::remove_file(&image).unwrap(); // the output has a hard link to the image
        std::fs::write(&image, bytes).unwrap();
        std::fs::write(parts[1].join("artifact.json"), "{").unwrap();
        std::fs::remove_dir_all(&parts[2]).unwrap();
        assert_eq!(resume("mended", params), manifest(&expected), "{name}");
        assert!(finished_parts(&work) == parts && write_times(&parts[3..]) == times, "{name}");
        assert!(
            resume("different", other_params) != manifest(&expected),
            "{name}: other parameters must give other views"
        );
        // Without a manifest, an input has no identity, and no part is kept.
        let unidentified =
            changed_copy(&project, &format!("{name}-bare"), inputs[0].1, "none", &|_| ());
        let before = finished_parts(&work);
        let unidentified_inputs = [&[(inputs[0].0, unidentified.as_path())], &inputs[1..]].concat();
        assert_eq!(stage(name, params, &unidentified_inputs, &output, &more).code, 0);
        assert!(
            finished_parts(&work) == before && manifest(&output) == manifest(&expected),
            "{name}"
        );
        ["resumed", "mended", "different"]
            .iter()
            .for_each(|output| std::fs::remove_dir_all(project.path(output)).unwrap());
    }
}

fn train(project: &Project, params: &str, views: &Path, truth: &Path) -> Finished {
    stage("train-refine", params, &[("views", views), ("truth", truth)], &project.path("no"), &[])
}

#[test]
fn wrong_views_are_refused() {
    let project = project();
    let (views, truth, _) = training_inputs(&project);
    train(&project, r#"{"patch_size": 15}"#, &views, &truth)
        .fails(2, &["parameter patch_size: expected an even number, found 15"]);
    train(&project, "{}", &views, &truth.with_file_name("downscaled"))
        .fails(3, &["24×24 pixels, but its image has 12×12"]);
    train(&project, "{}", &views, &truth.with_file_name("truth"))
        .fails(3, &["no view has an image in input truth with the same name and pose"]);
}

#[track_caller]
fn fails_to_train(project: &Project, inputs: &[(&str, &Path)], params: &str, words: &[&str]) {
    stage("train-refine", params, inputs, &project.path("failed"), &[]).fails(3, words);
}

fn mean_difference(first: &[f32], second: &[f32]) -> f32 {
    first.iter().zip(second).map(|(a, b)| (a - b).abs()).sum::<f32>() / first.len() as f32
}

/// `train-refine` and `refine` also run the paper's network, and report impossible parameters.
#[test]
fn the_papers_network_refines_by_references() {
    let project = project();
    project.replace("parameters: {size: 48,", "parameters: {size: 72,");
    project.replace("{lr_width: 24, scale: 2}", "{lr_width: 36, scale: 2}");
    project.ok(&["run", "eval-paper"]);
    let folder = |stage: &str| project.artifact(stage, &["eval-paper"]);
    let summary = std::fs::read_to_string(folder("refine-paper").join("summary.txt")).unwrap();
    assert!(summary.contains("3 views with 1 reference"), "{summary}");
    let (views, refiner) = (folder("render-depth"), folder("train-paper"));
    let file: serde_json::Value =
        serde_json::from_slice(&std::fs::read(refiner.join("refiner.json")).unwrap()).unwrap();
    assert_eq!(file["network"]["paper"]["width"], 4);

    // Without references, each patch is its own reference.
    let output = project.path("none");
    let finished = stage("refine", "{}", &[("views", &views), ("refiner", &refiner)], &output, &[]);
    assert_eq!(finished.code, 0, "{}", finished.stderr);
    for file in std::fs::read_dir(views.join("images")).unwrap() {
        let image = Path::new("images").join(file.unwrap().file_name());
        let [rendered, refined, unreferenced] = [&views, &folder("refine-paper"), &output]
            .map(|folder| pixels::read_exr(&folder.join(&image)).unwrap());
        assert_eq!((refined.width, refined.height), (72, 72));
        for channel in ["A", "Z"] {
            assert_eq!(rendered.channel(channel), refined.channel(channel));
        }
        let [rendered, refined, unreferenced] =
            [&rendered, &refined, &unreferenced].map(|image| image.channel("G").unwrap());
        assert!(refined.iter().all(|sample| sample.is_finite()));
        let change = mean_difference(rendered, refined);
        assert!((0.01..0.5).contains(&change), "{change}");
        assert!(mean_difference(unreferenced, refined) > 0.001, "the reference changes nothing");
    }
    // Missing weights, and impossible numbers of patch pixels or references, are refused.
    let (references, reference_views) =
        (folder("prep").join("references"), folder("reference-views"));
    let inputs = [("views", reference_views.as_path()), ("truth", references.as_path())];
    fails_to_train(
        &project,
        &[&inputs[..], &[("weights", references.as_path())]].concat(),
        r#"{"net": "paper", "steps": 1}"#,
        &["input weights", "vgg19.safetensors"],
    );
    fails_to_train(
        &project,
        &inputs,
        r#"{"net": "paper", "patch_size": 96}"#,
        &["smaller than a patch of 96×96"],
    );
    fails_to_train(&project, &inputs, r#"{"net": "paper", "patch_size": 20}"#, &["multiple of 8"]);
    fails_to_train(
        &project,
        &inputs,
        r#"{"references_per_view": 1}"#,
        &["input views: references_per_view needs at least three views"],
    );
}
