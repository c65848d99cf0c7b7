//! `refine`: adds the detail that rendered views systematically lack, by a network of
//! `train-refine`.
//!
//! A network trained with references takes them from the inputs `references` (HR images)
//! and `reference-views` (renders of the same views, for depth).
//!
//! The paper's network (`net: paper` of `train-refine`) redraws patches from references' patches
//! instead of adding a residual.
//!
//! With input `enlarged`, the result is averaged with the view's photograph enlarged by a SISR
//! network, whose errors are partly independent (design note 021).
//!
//! A view with an LR photograph of its own (input `photographs`; in the paper's split every view
//! has one) is then changed as little as possible, so that the view is consistent with the
//! photograph (design note 016). If the network was trained on consistent views, this is also done
//! before refinement.
//!
//! Colours change; opacity, depth and cameras stay unchanged.

mod enlarged;
mod network;
mod references;
mod summary;
mod view;

use refinement::{KnownView, LrObservations, REFINER_FILE, ReferenceStatistics, RefinerFile};
use scene::{VIEWS_FILE, Views, image_file, preview_file};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};

use enlarged::EnlargedPhotographs;
use network::{AnyRefiner, RefinementOptions};
use references::{read_references, remove_misleading};
use summary::Summary;
use view::{RefineJob, RefinedView};

/// Parameters of `refine`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Maximum number of HR references: the first ones of input `references` are used.
    #[schemars(extend("x-default" = "all"))]
    pub max_references: Option<u32>,
    /// Number of rotated and mirrored versions of a view whose residuals are averaged (geometric
    /// self-ensemble). The running time is proportional to this number. The paper's network ignores
    /// the parameter.
    #[schemars(range(min = 1, max = 8))]
    pub self_ensemble: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { max_references: None, self_ensemble: 2 }
    }
}

/// Stage `refine`.
pub struct Refine;

impl Stage for Refine {
    type Params = Params;
    const NAME: &'static str = "refine";
    const SUMMARY: &'static str = "Adds the detail that rendered views systematically lack.";
    const LIBTORCH: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            ("refiner", Input::required(&["refiner"], "a trained refiner")),
            (
                "references",
                Input::optional(
                    &["scene/references", "scene/truth"],
                    "HR images of some views of the scene",
                ),
            ),
            ("reference-views", Input::optional(&["views"], "renders of the references' views")),
            (
                "photographs",
                Input::optional(
                    &["scene/train"],
                    "LR photographs; a view with a photograph's camera is made consistent with the \
                    photograph",
                ),
            ),
            (
                "enlarged",
                Input::optional(
                    &["views"],
                    "photographs enlarged to the views' size; a view with a photograph's camera is \
                    averaged with the enlarged photograph",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("views")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        let refiner = context.input("refiner")?;
        let file: RefinerFile = refiner.read_json(REFINER_FILE)?;
        let views_input = context.input("views")?;
        let mut views = Views::read(views_input)?;
        let [photographs, enlarged] =
            ["photographs", "enlarged"].map(|name| context.optional_input(name));
        let job = RefineJob {
            context,
            views_input,
            background: views.background.grey_level(),
            network: AnyRefiner::read(refiner, &file)?,
            options: RefinementOptions {
                residual_weight: file.residual_weight as f32,
                self_ensemble: params.self_ensemble,
            },
            photographs: photographs.map(LrObservations::read).transpose()?,
            enlarged: enlarged.map(EnlargedPhotographs::read).transpose()?,
            expects_consistent: file.data_consistent,
        };
        let references = usable_references(&job, &views, params, file.confidence.unwrap_or(1.0))?;
        let refined = refine_all(&job, &mut views, &references)?;
        context.write_json(VIEWS_FILE, &views)?;
        report_invisible_references(&job, &references, &refined.statistics);
        context.write_summary(&refined.text())
    }
}

/// Reads the first `max_references` references. Makes them consistent with their LR photographs if
/// the network was trained on consistent views, and removes misleading references.
fn usable_references(
    job: &RefineJob<'_>,
    views: &Views,
    params: &Params,
    confidence: f64,
) -> anyhow::Result<Vec<KnownView>> {
    let mut references =
        read_references(job.context, job.network.takes_references(), views.background)?;
    references.truncate(params.max_references.map_or(usize::MAX, |count| count as usize));
    if let Some(photographs) = job.photographs.as_ref().filter(|_| job.expects_consistent) {
        for reference in &mut references {
            reference.rendered = photographs.make_consistent(reference.rendered.clone())?;
        }
    }
    remove_misleading(job, references, views, confidence)
}

/// Refines all views and writes their files, except those that an earlier run has written.
fn refine_all(
    job: &RefineJob<'_>,
    views: &mut Views,
    references: &[KnownView],
) -> anyhow::Result<Summary> {
    let mut summary = Summary {
        views: views.views.len(),
        consistent: 0,
        averaged: 0,
        residual_weight: job.options.residual_weight,
        has_reference_statistics: job.network.warp_options().is_some(),
        statistics: vec![ReferenceStatistics::default(); references.len()],
    };
    let progress = job.context.progress("refining", views.views.len() as u64);
    for view in &mut views.views {
        job.context.check_interrupt()?;
        let name = &view.camera.name;
        let [image, preview] = [image_file(name), preview_file(name)];
        let refined: RefinedView = job
            .context
            .part(name, &[&image, &preview], || job.refine(view, references, [&image, &preview]))?;
        summary.consistent += usize::from(refined.is_consistent);
        summary.averaged +=
            usize::from(job.enlarged.as_ref().is_some_and(|enlarged| enlarged.has(&view.camera)));
        ReferenceStatistics::add_each(&mut summary.statistics, &refined.statistics);
        view.depth = view.depth.as_ref().map(|_| image.clone());
        view.image = Some(image);
        // These files of the input aren't copied.
        (view.mask, view.low_resolution) = (None, None);
        progress.add(1);
    }
    if job.expects_consistent && summary.consistent < summary.views {
        job.context.log_line(
            "the network was trained on views consistent with LR photographs of their own, but \
            some of these views have none; train a network without the input `photographs`",
        );
    }
    Ok(summary)
}

/// Logs the references in which no view's points are visible.
fn report_invisible_references(
    job: &RefineJob<'_>,
    references: &[KnownView],
    statistics: &[ReferenceStatistics],
) {
    if job.network.warp_options().is_none() {
        return;
    }
    for (i, reference) in references.iter().enumerate() {
        if statistics[i].visible_pixels == 0 {
            let name = &reference.rendered.camera.name;
            job.context.log_line(format!("reference {name} shows no part of these views"));
        }
    }
}
