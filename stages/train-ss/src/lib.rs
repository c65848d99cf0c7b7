//! `train-ss`: supersampled training of a radiance field from LR images (NeRF-SR, section
//! "Supersampling").
//!
//! * [`Params`]: the stage's parameters; `supersample: 1` is plain NeRF on the same images.
//! * [`Resolved`]: the parameters with every default that the scene decides ([`Params::resolve`]).
//! * [`Supersampling`]: what rays are cast and what their colours are compared with: the paper's
//!   average (its eq. 4), or the kernel that made the LR images.
//! * [`supervision`]: reads and checks all that a training is supervised by; `memory`: what that
//!   needs.
//! * `photographs`: LR images and references, packed (`packed`) into memory and, beyond a budget, a
//!   file.
//! * `pixel_sampler`: which pixel a bundle trains on; `residual`: how their
//!   colours are judged.
//! * `sub_pixel_rays`: how many rays are cast through a pixel.
//! * `hr_cache`: the field's HR pixels as last rendered, by which the kernel is known without
//!   casting its whole footprint.
//! * `member`: one training; `field_trainer`: whatever it trains, our grid or the paper's networks.
//! * `exposure`: how bright each photograph is, where that is asked for.
//! * `moving_cameras`: where photographs were taken from, where that is asked for; `pose_choice`:
//!   whether it was better to ask.
//! * `learnt`: HR pixels, exposures and poses that a training has come to know.
//! * `checkpoint`: what makes a killed run end in the same bytes.

mod assembly;
mod checkpoint;
mod exposure;
mod field_trainer;
mod hr_cache;
mod init_field;
mod learnt;
mod member;
mod memory;
mod moving_cameras;
mod packed;
mod params;
mod photographs;
mod pixel_sampler;
mod pixel_set;
mod pose_choice;
mod reference_blocks;
mod references;
mod residual;
mod resolve;
mod setup;
mod sub_pixel_rays;
mod supersampling_options;
mod supervision;
mod training_log;

use artifact::{Failure, WARNING, amount, with_warnings};
use contract::{Input, Output, Rule};
use pixels::DEGRADATION_FILE;
use radiance::{FIELD_FILE, FIELD_FORMAT, FieldFile};
use scene::Views;
use serde_json::json;
use stage::{Context, Stage};

use init_field::InitField;
use member::{Member, TrainingData};
pub use params::{Combine, FieldParams, GridParams, MlpParams, Params, RateSchedule};
pub use pixel_sampler::Order;
pub use resolve::{ParamsError, Resolved, ResolvedField, ResolvedRegularisers, SceneFacts};
use setup::open_background;
pub use setup::supervision;
pub use supervision::{Supersampling, Supervision};
use training_log::TRAINING_FILE;
pub use training_log::{CurvePoint, TrainingLog};

/// The stage.
pub struct TrainSs;

impl Stage for TrainSs {
    type Params = Params;
    const NAME: &'static str = "train-ss";
    const SUMMARY: &'static str = "Trains a radiance field from LR images by supersampling.";
    const FROM_CHECKPOINT: bool = true;
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("scene", Input::required(&["scene/train"], "LR images with cameras and bounds")),
            (
                "references",
                Input::optional(
                    &["scene/references"],
                    "HR images of some views, to train on beside the LR images",
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
        let closed = [
            ("supervision", json!("kernel")),
            ("pose_refinement", json!(true)),
            ("exposure", json!(true)),
        ];
        let closed = closed.map(|(parameter, value)| {
            let message = open_background(parameter);
            Rule::new(&message)
                .when("scene.background", json!({"const": "alpha"}))
                .must(parameter, json!({"not": {"const": value}}))
        });
        let importance = "parameter pixel_importance: an epoch goes through all pixels evenly; \
            choose order random";
        let evenly = Rule::new(importance)
            .when("order", json!({"const": "epochs"}))
            .must("pixel_importance", json!({"anyOf": [{"type": "null"}, {"maximum": 1}]}));
        closed.into_iter().chain([evenly]).collect()
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        params.check().map_err(|e| Failure::Usage(e.to_string()))?;
        let input = context.input("scene")?;
        let references = context.optional_input("references");
        let mut views = Views::read(input)?;
        let anchor = views.views[0].camera.centre();
        views.bounds = views.bounds.rounded(anchor);
        let init = context.optional_input("init");
        let has_kernel = input.path(DEGRADATION_FILE).exists();
        let params = params.resolve(&SceneFacts {
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
        let (model, combine) = (file.field, params.combine);
        let mut log = TrainingLog { resolved: params.record(), ..TrainingLog::default() };
        if context.from_checkpoint() {
            let from = init.as_ref().map(|init| (init.member(0), combine));
            let member = Member::new(context, params.member(0), (model, from), 0, 0)?;
            log.add(member.latest_checkpoint(views.bounds)?);
            return publish(context, &file, &log);
        }
        let first = match (&init, combine) {
            (Some(init), Combine::Ensemble) => init.keep_beside(context, &mut file)?,
            _ => 0,
        };
        let members: Vec<Resolved> =
            (0..params.ensemble).map(|index| params.member(index)).collect();
        let compared = if params.pose_refinement { members[0].rays } else { 0 };
        let progress = context.progress("training", compared + params.rays);
        let data = TrainingData { input, references, views: &views, progress: &progress };
        let mut done = compared;
        for (index, own) in members.into_iter().enumerate() {
            // What the first member finds of poses holds for all.
            let own = Resolved {
                pose_refinement: own.pose_refinement && (index == 0 || log.moves_cameras(&views)),
                ..own
            };
            let from = init.as_ref().map(|init| (init.member(index as u32), combine));
            let before = if index == 0 { 0 } else { done };
            let member = Member::new(context, own, (model, from), first + index as u32, before)?;
            let trained =
                if index == 0 { pose_choice::train(&member, &data)? } else { member.run(&data)? };
            trained.warnings.iter().for_each(|warning| context.say(format!("{WARNING}{warning}")));
            done += trained.rays;
            log.add(trained);
            progress.set(done, "");
        }
        publish(context, &file, &log)
    }
}

/// Writes what lies beside the weights.
fn publish(context: &Context, file: &FieldFile, log: &TrainingLog) -> anyhow::Result<()> {
    context.write_json(FIELD_FILE, file)?;
    context.write_json(TRAINING_FILE, log)?;
    let psnr = log.curve.last().map_or(0.0, |p| p.psnr);
    let (rays, steps, samples) = (amount(log.rays), log.steps, log.samples_per_ray);
    let summary = format!(
        "{rays} rays in {steps} steps, {samples:.1} samples a ray, training PSNR {psnr:.2} dB"
    );
    context.write_summary(&with_warnings(&summary, &log.warnings))
}
