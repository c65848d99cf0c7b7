//! The shipped `pipelines/`: found by their names, and sharing one store. Nothing slow is run.

#![allow(missing_docs, reason = "a test")]
mod common;

use common::Project;

/// The fast pipeline with the shipped targets beside it.
fn project() -> Project {
    let project = Project::fast();
    project.copy_folder("pipelines", ".");
    project
}

#[test]
fn every_verb_finds_a_target_of_its_own_file() {
    let project = project();
    for (arguments, words) in [
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
        let said = project.ok(arguments);
        assert!(words.iter().all(|word| said.contains(word)), "{arguments:?}: {said}");
    }
    project.run(&["pin", "kept", "video"]).fails(2, &["has no artifact to pin yet"]);
}

/// A file of `pipelines/`, by any path, uses the artifacts and pages that pipeline.yaml made.
#[test]
fn targets_share_one_store() {
    let project = project();
    project.ok(&["run", "prep"]);
    project.ok(&["run", "camera-path"]);
    let said = project.ok(&["plan", "camera-path", "--pipeline", "pipelines/video.yaml"]);
    assert!(said.contains("cached") && !said.contains("will run"), "{said}");
    assert!(!project.path("pipelines/.nerf-sr").exists());
    let made = project.output_of("camera-path", &["camera-path"]);
    assert_eq!(
        made,
        project.output_of("camera-path", &["video", "--pipeline", "pipelines/video.yaml"])
    );
    // A folder is named from the file in which it stands.
    let dataset = project.artifact("demo-scene", &[]);
    std::os::unix::fs::symlink(dataset, project.path("scene")).unwrap();
    project.write(
        "pipelines/mine.yaml",
        "extends: ../pipeline.yaml\nstages:\n  prep: {inputs: {dataset: ../scene}}\n",
    );
    let said = project.ok(&["plan", "mine"]);
    assert!(!said.contains("demo-scene") && said.contains("report"), "{said}");
    project.write(
        "pipelines/mine.yaml",
        "extends: ../pipeline.yaml\nstages:\n  prep: {inputs: {dataset: ./scene}}\n",
    );
    project.run(&["plan", "mine"]).fails(3, &["scene"]);
}

#[test]
fn wrong_names_are_told_the_nearest() {
    let project = project();
    for (arguments, words) in [
        (&["run", "regsitered"][..], &["no stage \"regsitered\"", "did you mean registered?"][..]),
        (&["why", "downscaled-fields", "refined"], &["did you mean downscaled-field?"]),
        (&["describe", "registers"], &["did you mean register?"]),
        (
            &["plan", "refined", "-p", "downscaled-fields.rays=1"],
            &["did you mean downscaled-field?"],
        ),
    ] {
        project.run(arguments).fails(2, words);
    }
    project.replace("scene: prep/train", "scene: prep/trian");
    project
        .run(&["plan"])
        .fails(2, &["pipeline.yaml:", "prep has no subtree \"trian\"; did you mean train?"]);
}
