//! `refine`: gives rendered views the detail they systematically lack, by a network that
//! `train-refine` trained.
//!
//! A network that was trained with references takes them from the inputs `references` (true images
//! at HR) and `reference-views` (the same views as rendered, for what the field sees where).
//!
//! The paper's own network (`train-refine`'s `net: paper`) redraws patches from references' patches
//! instead of adding to the view.
//!
//! What a network that learnt from other images makes of a view's own photograph (input `enlarged`)
//! errs in another way: the mean of both is taken.
//!
//! A view whose own LR photograph is known (input `photographs`; in the paper's split all are
//! trained on and scored) is then moved as little as it takes to be consistent with that; before,
//! too, where the network learnt on views that are.
//!
//! Colours change; opacity, depth and cameras stay what the field made them.

mod enlarged;
mod network;
mod params;
mod references;
mod summary;
mod view;

use contract::{Input, Output};
use refinement::{KnownView, LrObservations, REFINER_FILE, RefinerFile, Use};
use scene::{VIEWS_FILE, Views, image_file, preview_file};
use stage::{Context, Stage};

pub use params::Params;

use enlarged::Enlarged;
use network::{AnyRefiner, Application};
use references::{read_references, without_misleading};
use summary::Summary;
use view::{RefineJob, RefinedView};

/// The stage.
pub struct Refine;

impl Stage for Refine {
    type Params = Params;
    const NAME: &'static str = "refine";
    const SUMMARY: &'static str = "Gives rendered views the detail they systematically lack.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            ("refiner", Input::required(&["refiner"], "a trained refiner")),
            (
                "references",
                Input::optional(
                    &["scene/references", "scene/truth"],
                    "true images of some other views, at HR",
                ),
            ),
            ("reference-views", Input::optional(&["views"], "those views as rendered")),
            (
                "photographs",
                Input::optional(
                    &["scene/train"],
                    "LR photographs; a view of the same camera is made consistent with its own",
                ),
            ),
            (
                "enlarged",
                Input::optional(
                    &["views"],
                    "photographs enlarged to the views' size; a view of the same camera becomes \
                    the mean of both",
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
        let input = context.input("views")?;
        let mut views = Views::read(input)?;
        let job = RefineJob {
            context,
            input,
            background: views.background.shown(),
            network: AnyRefiner::read(refiner, &file)?,
            application: Application::new(params, &file),
            photographs: context
                .optional_input("photographs")
                .map(LrObservations::read)
                .transpose()?,
            enlarged: context.optional_input("enlarged").map(Enlarged::read).transpose()?,
            takes_consistent: file.data_consistent,
        };
        let references = usable_references(&job, &views, params, file.confidence.unwrap_or(1.0))?;
        let refined = refine_all(&job, &mut views, &references)?;
        context.write_json(VIEWS_FILE, &views)?;
        say_unseen(&job, &references, &refined.uses);
        context.write_summary(&refined.text())
    }
}

/// The references that views are refined by: the first ones given, consistent with their
/// photographs if the network learnt by such, without misleading ones.
fn usable_references(
    job: &RefineJob<'_>,
    views: &Views,
    params: &Params,
    confidence: f64,
) -> anyhow::Result<Vec<KnownView>> {
    let mut references =
        read_references(job.context, job.network.takes_references(), views.background)?;
    references.truncate(params.max_references.map_or(usize::MAX, |most| most as usize));
    if let Some(own) = job.photographs.as_ref().filter(|_| job.takes_consistent) {
        for reference in &mut references {
            reference.rendered = own.make_consistent(reference.rendered.clone())?;
        }
    }
    without_misleading(job, references, views, confidence)
}

/// Refines all views and writes their files; an earlier run's are taken as they are.
fn refine_all(
    job: &RefineJob<'_>,
    views: &mut Views,
    references: &[KnownView],
) -> anyhow::Result<Summary> {
    let mut summary = Summary {
        views: views.views.len(),
        consistent: 0,
        means: 0,
        residual_weight: job.application.residual_weight,
        is_reference_based: job.network.guidance().is_some(),
        uses: vec![Use::default(); references.len()],
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
        summary.means +=
            usize::from(job.enlarged.as_ref().is_some_and(|enlarged| enlarged.has(&view.camera)));
        summary.uses.iter_mut().zip(&refined.uses).for_each(|(sum, of_use)| sum.add(of_use));
        view.depth = view.depth.as_ref().map(|_| image.clone());
        view.image = Some(image);
        progress.add(1);
    }
    if job.takes_consistent && summary.consistent < summary.views {
        job.context.say(
            "the network was trained on views consistent with LR photographs of their own, which \
            some of these haven't: train one without",
        );
    }
    Ok(summary)
}

/// Says which references were of no use.
fn say_unseen(job: &RefineJob<'_>, references: &[KnownView], uses: &[Use]) {
    if job.network.guidance().is_none() {
        return;
    }
    for (reference, _) in references.iter().zip(uses).filter(|(_, of_use)| of_use.seen == 0) {
        let name = &reference.rendered.camera.name;
        job.context.say(format!("reference {name} sees nothing of these views"));
    }
}
