//! `prep`: posed images → scene. Creates the LR images that training may see, and HR ground truth
//! if there is any.
//!
//! * [`Params`]; `split`: training views, test views, references; `image_plan`: image sizes and
//!   kernel; `scene_plan`: all decisions before anything is written; `writer`: writes the scene,
//!   one function per subtree; `summary`: human-readable `scene.json`.
//! * `sizes`: LR and HR size from `lr_width` and `scale`.
//! * `degrade`: HR and LR images of one photograph, by Pillow's exact kernels.
//! * `bounds`: the scene's extent and space, from cameras and depths.
//! * `memory`: number of images that are prepared at a time.
//! * `detail`: how far the spectrum of the photographs reaches.
//! * `inspection`: sampled views, for `detail` and `borders`.
//! * `borders`, `strips`: the scene's background, from the borders of its images.
//! * `pose_warnings`, `pose_conventions`: checks of implausible poses.
//!
//! The crate `dataset` reads the photographs, in any of its formats.
//!
//! The scene has six subtrees, so that a stage is given only those that it may see: `train/` (LR
//! images, cameras, bounds), `downscaled/` (the same, downscaled once more: refinement learns from
//! it with `train/` as HR truth), `train-cameras/` and `cameras/` (training and test cameras at HR
//! size, without images), `truth/` (HR test images, depth), `references/` (HR training images).

mod borders;
mod bounds;
mod degrade;
mod detail;
mod image_plan;
mod inspection;
mod memory;
mod params;
mod pose_conventions;
mod pose_warnings;
mod scene_plan;
mod sizes;
mod split;
mod strips;
mod summary;
mod writer;

use std::path::Path;

use artifact::{
    Failure, FailureExt as _, bail_bad_input, format_count, list_source_files, printable,
};
use dataset::{Dataset, Frame};
use serde_json::json;
use stage::{Context, Input, Output, Rule, Stage};

pub use bounds::SpaceKind;
use image_plan::ImagePlan;
use inspection::Inspection;
pub use params::{LensHandling, LrSource, Params, SplitKind};
use scene_plan::{ScenePlan, check_poses, space_note};
use split::split_views;
pub use summary::SceneSummary;
use writer::SceneWriter;

/// The stage `prep`.
pub struct Prep;

impl Stage for Prep {
    type Params = Params;
    const NAME: &'static str = "prep";
    const SUMMARY: &'static str = "Prepares a scene from posed images: LR training images, HR \
        ground truth, cameras and bounds.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "dataset",
            Input::required(&["dataset"], "folder of posed photographs, in any supported format"),
        )]
    }

    fn output() -> Output {
        Output::kind("scene")
            .with_subtree("train", "scene/train")
            .with_subtree("downscaled", "scene/train")
            .with_subtree("train-cameras", "scene/cameras")
            .with_subtree("cameras", "scene/cameras")
            .with_subtree("truth", "scene/truth")
            .with_subtree("references", "scene/references")
    }

    fn rules() -> Vec<Rule> {
        let rule = Rule::new(
            "parameter kernel: average requires an integer scale; choose box or another scale",
        );
        vec![
            rule.when("kernel", json!({"const": "average"}))
                .must("scale", json!({"multipleOf": 1})),
        ]
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let set = read_dataset(context, params)?;
        let split = split_views(&set, params)?;
        let warnings = check_poses(&set, &split)?;
        let images = ImagePlan::new(&set, &split, params)?;
        let mut notes = Vec::new();
        let mut log = |note: String| {
            context.log_line(&note);
            notes.push(note);
        };
        set.notes.iter().cloned().for_each(&mut log);
        log(images.note(&split));
        if let Some(lr_width) = params.lr_width.filter(|_| !images.has_truth) {
            log(format!("lr_width {lr_width} has no effect with lr_source photographs"));
        }
        if params.hr_references > Params::default().hr_references && !images.has_truth {
            let note = "hr_references gives no references with lr_source photographs; it only \
                removes test views of split paper";
            log(note.to_owned());
        }
        warnings.into_iter().for_each(&mut log);
        let used = split.train.iter().chain(&split.test).map(|&i| &set.frames[i]);
        let threads = memory::thread_pool(context, used, &images)?;
        let training: Vec<&Frame> = split.train.iter().map(|&i| &set.frames[i]).collect();
        let Inspection { borders, spectrum } = threads.install(|| Inspection::of(&training))?;
        let background = params.background.unwrap_or(borders.background());
        let border_notes = borders.notes(params.background.is_some());
        let detail = spectrum.reach().map(|reach| detail::lr_reach(reach, images.lr_factor()));
        let detail_note =
            detail.and_then(|reach| detail::missing_detail_warning(reach, &images, params.scale));
        let plan = ScenePlan::new(&set, &split, params, images, background)?;
        let writer = SceneWriter::new(context, &plan);
        let space_note = space_note(&plan.bounds, background);
        border_notes.into_iter().chain([space_note]).chain(detail_note).for_each(&mut log);
        threads.install(|| writer.write())?;
        writer.warnings().into_iter().for_each(&mut log);
        let summary = SceneSummary::new(&set, &plan, detail, notes);
        context.write_json("scene.json", &summary)?;
        context.write_summary(&summary.text())
    }
}

/// Reads the data set and applies the parameter `lens`. Merges the data set's own training and test
/// views if another split is requested.
fn read_dataset(context: &Context, params: &Params) -> anyhow::Result<Dataset> {
    let folder = context.input("dataset")?.folder();
    log_ignored_files(context, folder);
    let set = Dataset::read(folder).bad_input("dataset")?;
    let set = match params.lens {
        LensHandling::Follow => {
            check_lenses(&set)?;
            set.with_lens_mask_note()
        }
        LensHandling::Undo => set.undistorted().bad_input("dataset")?,
    };
    let needs_merge = matches!(params.split, Some(SplitKind::Holdout | SplitKind::Paper));
    Ok(if needs_merge { set.without_split() } else { set })
}

/// Fails at the first frame whose camera is invalid, for example if its distortion isn't invertible
/// within the image. Pixels of a fisheye lens beyond 89° are masked instead.
fn check_lenses(set: &Dataset) -> Result<(), Failure> {
    for frame in &set.frames {
        if let Err(error) = frame.camera().check() {
            bail_bad_input!(
                "dataset: {}: {error} (parameter lens: undo keeps the valid part of the image)",
                frame_label(frame)
            );
        }
    }
    Ok(())
}

/// Logs the files of a data set that are neither hashed nor read. `scene.json` doesn't list them,
/// since they don't change the data set's hash.
fn log_ignored_files(context: &Context, folder: &Path) {
    let Ok((_, ignored)) = list_source_files(folder) else { return };
    if let Some(first) = ignored.first() {
        context.log_line(format!(
            "{} ignored: dangling links, editor and system files (first: {})",
            format_count(ignored.len(), "file"),
            printable(&first.display().to_string())
        ));
    }
}

/// Returns `frame NAME`, the prefix of messages about a frame.
fn frame_label(frame: &Frame) -> String {
    format!("frame {}", frame.name)
}
