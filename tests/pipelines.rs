//! Shipped `pipelines/`: targets are found by name and share one store. No slow stage runs.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::Project;

/// Creates a project with the fast pipeline and the shipped targets.
fn project() -> Project {
    let project = Project::fast();
    project.copy_folder("pipelines", ".");
    project
}

#[test]
fn every_verb_finds_shipped_targets() {
    let project = project();
    for (arguments, texts) in [
        (&["plan", "refined"][..], &["downscaled-field", "eval-refined", "refined"][..]),
        (&["plan", "eval-refined"], &["downscaled-field", "eval-refined"]),
        (
            &["plan", "reference-refine", "-p", "prep.hr_references=2"],
            &["finetuned-field", "refine-reference"],
        ),
        (&["plan", "hr-finetune"], &["finetuned-views"]),
        (&["plan", "sisr-fuse", "-p", "upsample.method=bicubic"], &["refine-sisr"]),
        (&["plan", "paper-refine"], &["train-paper"]),
        (&["plan", "registered"], &["register ", "registered-views"]),
        (&["plan", "report", "refined", "video"], &["report", "eval-refined", "path-views"]),
        (&["why", "train-refine", "refined"], &["train-refine: waits for ", "downscaled-views"]),
        (
            &["why", "video", "video"],
            &["video: shows path-views; a run writes the page again", "\n  path-views: waits for "],
        ),
        (&["status", "refined"], &["downscaled-views"]),
        (&["graph", "video"], &["camera-path"]),
        (&["plan", "viewer"], &["train-ss", "viewer"]),
        (&["log", "camera-path", "video"], &["has not run yet"]),
        (&["gc", "refined", "--dry-run"], &["would be kept"]),
        (&["describe", "train-refine"], &["Usage: train-refine ", "\nParameters, "]),
    ] {
        let output = project.ok(arguments);
        assert!(texts.iter().all(|text| output.contains(text)), "{arguments:?}: {output}");
    }
    project.run(&["pin", "kept", "video"]).fails(2, &["has no artifact to pin yet"]);
}

/// A file of `pipelines/`, given by name or path, uses the store of pipeline.yaml.
#[test]
fn targets_share_one_store() {
    let project = project();
    project.ok(&["run", "prep"]);
    project.ok(&["run", "camera-path"]);
    let plan = project.ok(&["plan", "camera-path", "--pipeline", "pipelines/video.yaml"]);
    assert!(plan.contains("cached") && !plan.contains("will run"), "{plan}");
    assert!(!project.path("pipelines/.nerf-sr").exists());
    let artifacts = project.output_of("camera-path", &["camera-path"]);
    assert_eq!(
        artifacts,
        project.output_of("camera-path", &["video", "--pipeline", "pipelines/video.yaml"])
    );
    // A folder is relative to the pipeline file that names the folder.
    let dataset = project.artifact("demo-scene", &[]);
    std::os::unix::fs::symlink(dataset, project.path("scene")).unwrap();
    project.write(
        "pipelines/mine.yaml",
        "extends: ../pipeline.yaml\nstages:\n  prep: {inputs: {dataset: ../scene}}\n",
    );
    let plan = project.ok(&["plan", "mine"]);
    assert!(!plan.contains("demo-scene") && plan.contains("report"), "{plan}");
    project.write(
        "pipelines/mine.yaml",
        "extends: ../pipeline.yaml\nstages:\n  prep: {inputs: {dataset: ./scene}}\n",
    );
    project.run(&["plan", "mine"]).fails(3, &["scene"]);
}

#[test]
fn unknown_names_get_a_suggestion() {
    let project = project();
    for (arguments, texts) in [
        (&["run", "regsitered"][..], &["no stage \"regsitered\"", "did you mean registered?"][..]),
        (&["why", "downscaled-fields", "refined"], &["did you mean downscaled-field?"]),
        (&["describe", "registers"], &["did you mean register?"]),
        (
            &["plan", "refined", "-p", "downscaled-fields.rays=1"],
            &["did you mean downscaled-field?"],
        ),
    ] {
        project.run(arguments).fails(2, texts);
    }
    project.replace("scene: prep/train", "scene: prep/trian");
    project
        .run(&["plan"])
        .fails(2, &["pipeline.yaml:", "prep has no subtree \"trian\"; did you mean train?"]);
}
