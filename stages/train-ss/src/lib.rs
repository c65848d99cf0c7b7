//! `train-ss`: supersampled training of a radiance field from LR images (NeRF-SR, section
//! "Supersampling").
//!
//! * `params`: parameters, and defaults that depend on the scene ([`Params::resolve`]).
//!   `supersample: 1` is plain NeRF on the same images.
//! * `supersample`: the number of sub-pixel rays of an LR pixel, during and after the warm-up.
//! * `photographs`: LR images and HR references, packed into memory and, beyond a budget, a file.
//! * `silhouettes`: cells that are empty according to photographs with alpha.
//! * `state`: HR cache, exposures and poses, estimated in addition to the field.
//! * `supervision`: drawn pixels, their rays and their loss: the paper's average (eq. 4), or the
//!   kernel that made the LR images ([`Supersampling`]).
//! * `training`: trainers of our grid and of the paper's MLPs, with checkpoints and a log.

mod params;
mod photographs;
mod silhouettes;
mod state;
mod supersample;
mod supervision;
mod training;

use artifact::{WARNING, format_amount, with_warnings};
use fields::{FIELD_FILE, FIELD_FORMAT, FieldFile};
use pixels::DEGRADATION_FILE;
use radiance::{TRAINING_FILE, TrainingLog};
use scene::Views;
use serde_json::json;
use stage::{Context, Input, Output, Rule, Stage};

pub use params::{
    Combine, Exposure, FieldParams, GridParams, MlpParams, Params, Resolved, ResolvedField,
    SceneFacts, Supervision,
};
use supervision::alpha_background_error;
pub use supervision::{Supersampling, set_up_supervision};
use training::{InitField, Member, TrainingData, train_with_best_poses};

/// Stage `train-ss`.
pub struct TrainSs;

impl Stage for TrainSs {
    type Params = Params;
    const NAME: &'static str = "train-ss";
    const SUMMARY: &'static str = "Trains a radiance field from LR images by supersampling.";
    const LIBTORCH: bool = cfg!(feature = "torch");
    const FROM_CHECKPOINT: bool = true;
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("scene", Input::required(&["scene/train"], "LR images with cameras and bounds")),
            (
                "references",
                Input::optional(
                    &["scene/references"],
                    "HR images of some views, to train on in addition to the LR images",
                ),
            ),
            (
                "init",
                Input::optional(
                    &["field"],
                    "a field to fine-tune, trained on the same scene with the same parameters; \
                    see combine",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("field").with_resolved(TRAINING_FILE)
    }

    fn rules() -> Vec<Rule> {
        let conflicts = [
            ("supervision", json!("kernel")),
            ("pose_refinement", json!(true)),
            ("exposure", json!(true)),
        ];
        let conflicts = conflicts.map(|(parameter, value)| {
            let message = alpha_background_error(parameter);
            Rule::new(&message)
                .when("scene.background", json!({"const": "alpha"}))
                .must(parameter, json!({"not": {"const": value}}))
        });
        conflicts.to_vec()
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let input = context.input("scene")?;
        let references = context.optional_input("references");
        let mut views = Views::read(input)?;
        let anchor = views.views[0].camera.centre();
        views.bounds = views.bounds.rounded(anchor);
        let init = context.optional_input("init");
        let has_kernel = input.path(DEGRADATION_FILE).exists();
        let given_exposure = params.exposure;
        let mut params = params.resolve(&SceneFacts {
            is_fine_tuning: init.is_some(),
            ..SceneFacts::of(&views, has_kernel)
        });
        let mut file = FieldFile {
            format: FIELD_FORMAT,
            field: params.model(),
            members: if context.from_checkpoint() { 1 } else { params.ensemble },
            bounds: views.bounds,
            background: views.background,
        };
        let init = init.map(|input| InitField::read(input, &mut file, anchor)).transpose()?;
        views.bounds = file.bounds;
        if let (Some(init), None) = (&init, given_exposure) {
            params.exposure = init.has_exposures()?.into();
        }
        let mut log = TrainingLog { resolved: params.record(), ..TrainingLog::default() };
        if context.from_checkpoint() {
            let init = init.as_ref().map(|init| (init.member(0), params.combine));
            let member = Member::new(context, params.member(0), (file.field, init), 0, 0)?;
            log.append(member.write_checkpoint_weights(views.bounds)?);
            return publish(context, &file, &log);
        }
        let first_index = match (&init, params.combine) {
            (Some(init), Combine::Ensemble) => init.copy_members(context, &mut file)?,
            _ => 0,
        };
        // The first member trains twice to choose between given and refined poses.
        let comparison_rays = if params.pose_refinement { params.member(0).rays } else { 0 };
        let total_rays = comparison_rays + params.rays;
        let progress = context.progress("training", total_rays);
        let cells = params.silhouettes.then(|| silhouettes::cells_in_visual_hull(input, &views));
        let cells = cells.transpose()?.flatten();
        if let Some(cells) = &cells {
            let empty = cells.iter().filter(|is_allowed| !**is_allowed).count();
            let percent = 100.0 * empty as f64 / cells.len() as f64;
            context.log_line(format!("silhouettes: {percent:.0} % of the cells are empty"));
        }
        let (cells, progress) = (cells.as_deref(), &progress);
        let data = TrainingData { input, references, views: &views, cells, progress, total_rays };
        let mut rays = comparison_rays;
        for index in 0..params.ensemble {
            let mut member_params = params.member(index);
            if index > 0 {
                // The choice of poses by the first member applies to all.
                member_params.pose_refinement &= log.has_moved_cameras(&views);
            }
            let init = init.as_ref().map(|init| (init.member(index), params.combine));
            let before = if index == 0 { 0 } else { rays };
            let init = (file.field, init);
            let member = Member::new(context, member_params, init, first_index + index, before)?;
            let trained = if index == 0 {
                train_with_best_poses(&member, &data)?
            } else {
                member.run(&data)?
            };
            for warning in &trained.warnings {
                context.log_line(format!("{WARNING}{warning}"));
            }
            rays += trained.rays;
            log.append(trained);
            // The measurement by the first member decides for all.
            params.exposure = (!log.exposures.is_empty()).into();
            progress.set(rays, "");
        }
        log.resolved.extend(params.record());
        publish(context, &file, &log)
    }
}

/// Writes the field's description, the log and the summary.
fn publish(context: &Context, file: &FieldFile, log: &TrainingLog) -> anyhow::Result<()> {
    context.write_json(FIELD_FILE, file)?;
    context.write_json(TRAINING_FILE, log)?;
    let psnr = log.curve.last().map_or(0.0, |p| p.psnr);
    let (rays, steps, samples) = (format_amount(log.rays), log.steps, log.samples_per_ray);
    let summary = format!(
        "{rays} rays in {steps} steps, {samples:.1} samples per ray, training PSNR {psnr:.2} dB"
    );
    context.write_summary(&with_warnings(&summary, &log.warnings))
}
