//! `prep`: posed images → scene. Makes HR ground truth and, from it, the LR images that training
//! may see.
//!
//! * [`Params`]; `split`: which views are for what; `image_plan`: which images are made;
//!   `scene_plan`: all that is decided before anything is written; `writer`: writes it, a function
//!   a subtree; `summary`: what was found and chosen, for people.
//! * `sizes`: LR and HR size from `lr_width`, `hr_width`, `scale`.
//! * `degrade`: HR and LR images of one photograph, through Pillow's exact kernels.
//! * `bounds`: where the scene is, from what the cameras see.
//! * `memory`: how many images are prepared at a time.
//! * `borders`, `strips`: what lies behind the scene, by the borders of its images.
//! * `pose_warnings`: poses that can't be right, or hardly.
//!
//! The photographs are read by the crate `dataset`, whatever form their folder has.
//!
//! The scene has six subtrees, so that a stage sees what it may and no more: `train/` (LR images,
//! cameras, bounds), `downscaled/` (the same, shrunk once more: what refinement learns from, since
//! `train/` is its HR truth), `train-cameras/` and `cameras/` (the training and the test cameras at
//! HR size, no images), `truth/` (HR test images, depth), `references/` (HR training images).

mod borders;
mod bounds;
mod degrade;
mod error;
mod frame_name;
mod image_plan;
mod memory;
mod params;
mod pose_warnings;
mod references;
mod scene_plan;
mod sizes;
mod split;
mod strips;
mod summary;
mod writer;

use std::path::Path;

use artifact::{Failure, FailureExt as _, counted, list_source_files, printable};
use contract::{Input, Output, Rule};
use dataset::{Dataset, Frame};
use scene::Background;
use serde_json::json;
use stage::{Context, Stage};

use borders::borders;
pub use bounds::{SeenDepths, SpaceError, SpaceKind, place};
pub use degrade::{LrImage, degrade};
use frame_name::frame_name;
use image_plan::ImagePlan;
pub use params::{LensHandling, LrSource, Params, SplitKind};
use scene_plan::{ScenePlan, space_note, warnings_of_poses};
pub use sizes::{SizeError, Sizes, enlarged, sizes};
use split::split;
pub use summary::SceneSummary;
use writer::SceneWriter;

/// The stage.
pub struct Prep;

impl Stage for Prep {
    type Params = Params;
    const NAME: &'static str = "prep";
    const SUMMARY: &'static str = "Makes a scene of posed images: LR images to train on, HR \
        ground truth, cameras and bounds.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "dataset",
            Input::required(&["dataset"], "posed photographs, whatever form their folder has"),
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
        let whole = Rule::new(
            "parameter kernel: average needs a whole scale; choose box, or another scale",
        );
        vec![
            whole
                .when("kernel", json!({"const": "average"}))
                .must("scale", json!({"multipleOf": 1})),
        ]
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let set = dataset(context, params)?;
        let split = split(&set, params)?;
        let warnings = warnings_of_poses(&set, &split).bad_input("dataset")?;
        let images = ImagePlan::new(&set, &split, params)?;
        let mut notes: Vec<String> =
            set.notes.iter().cloned().chain([images.choice(&split)]).chain(warnings).collect();
        notes.iter().for_each(|note| context.say(note));
        let used = split.train.iter().chain(&split.test).map(|&i| &set.frames[i]);
        let threads = memory::threads(context, used, &images)?;
        let training: Vec<&Frame> = split.train.iter().map(|&i| &set.frames[i]).collect();
        let (background, signs) = threads.install(|| background(params, &training))?;
        let plan = ScenePlan::new(&set, &split, params, images, background)?;
        let writer = SceneWriter::new(context, &plan);
        for note in signs.into_iter().chain([space_note(&plan.bounds, background)]) {
            context.say(&note);
            notes.push(note);
        }
        threads.install(|| writer.write())?;
        if let Some(note) = writer.clipping_note() {
            context.say(&note);
            notes.push(note);
        }
        let summary = SceneSummary::new(&set, &plan, notes);
        context.write_json("scene.json", &summary)?;
        context.write_summary(&summary.in_words())
    }
}

/// The data set, with its lenses treated as asked, and all its views together where it isn't its
/// own split that counts.
fn dataset(context: &Context, params: &Params) -> anyhow::Result<Dataset> {
    let folder = context.input("dataset")?.folder();
    note_passed_over(context, folder);
    let set = Dataset::read(folder).bad_input("dataset")?;
    let set = match params.lens {
        LensHandling::Follow => {
            let wrong = set
                .frames
                .iter()
                .find_map(|frame| frame.camera().check().err().map(|e| (frame, e)));
            if let Some((frame, e)) = wrong {
                let frame = frame_name(frame);
                let message =
                    format!("dataset: {frame}: {e} (parameter lens: undo keeps what has its ray)");
                return Err(Failure::BadInput(message).into());
            }
            set.followed()
        }
        LensHandling::Undo => set.undistorted().bad_input("dataset")?,
        LensHandling::Ignore => set.without_distortion(),
    };
    let is_own = !matches!(params.split, Some(SplitKind::Holdout | SplitKind::Paper));
    Ok(if is_own { set } else { set.merged() })
}

/// Logs the files of a data set that are neither hashed nor read. Scenes don't note them: such
/// files come and go without another hash.
fn note_passed_over(context: &Context, folder: &Path) {
    let Ok((_, passed_over)) = list_source_files(folder) else { return };
    if let Some(first) = passed_over.first() {
        let first = first.display().to_string();
        context.say(format!(
            "{} passed over (links to nothing, editors' and systems' own), first {}",
            counted(passed_over.len(), "file"),
            printable(&first)
        ));
    }
}

/// Returns what lies behind the scene, and the signs by which that is known where it wasn't given.
fn background(params: &Params, train: &[&Frame]) -> anyhow::Result<(Background, Vec<String>)> {
    if let Some(given) = params.background {
        return Ok((given, Vec::new()));
    }
    let borders = borders(train)?;
    Ok((borders.background(), borders.signs()))
}
