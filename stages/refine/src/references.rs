use artifact::{Failure, FailureExt as _};
use refinement::{Guidance, KnownView, Use, with_references};
use scene::{Background, Views};
use stage::Context;

use crate::view::{RefineJob, read_view};

/// The references that a reference-based network asks for; what another is given is said and left
/// out.
pub(crate) fn read_references(
    context: &Context,
    wanted: bool,
    background: Background,
) -> anyhow::Result<Vec<KnownView>> {
    let given = context.optional_input("references").zip(context.optional_input("reference-views"));
    let Some((images, rendered)) = given else {
        if wanted {
            context.say(
                "the network knows how to use references, but there are none: give inputs \
                    references and reference-views",
            );
        }
        return Ok(Vec::new());
    };
    if !wanted {
        context.say(
            "the network was trained without references: those given are left out; set \
                train-refine's parameter references_per_view",
        );
        return Ok(Vec::new());
    }
    let (images_list, rendered_list) = (Views::read(images)?, Views::read(rendered)?);
    let mut references = Vec::new();
    for image in &images_list.views {
        let name = &image.camera.name;
        let Some(truth) = image.read_photograph(images).bad_input(format!("reference {name}"))?
        else {
            continue;
        };
        let Some(view) = rendered_list.taken_by(&image.camera) else {
            let message = format!(
                "input reference-views: no view {name} with that pose; \
                render it for input references"
            );
            return Err(Failure::BadInput(message).into());
        };
        let view = read_view(rendered, view, background.shown())?.0;
        let known = KnownView::new(view, truth.over(background.shown()))
            .bad_input("input reference-views")?;
        references.push(same_exposure(context, known));
    }
    Ok(references)
}

/// A reference as it would look with the exposure of the images that the field learnt from.
fn same_exposure(context: &Context, reference: KnownView) -> KnownView {
    let Some(exposure) = reference.exposure().filter(|exposure| !exposure.is_none()) else {
        return reference;
    };
    let [r, g, b] = exposure.gain;
    let name = &reference.rendered.camera.name;
    context.say(format!(
        "reference {name} has another exposure ({r:.2}, {g:.2}, {b:.2} times as bright): taken back"
    ));
    reference.without(&exposure)
}

/// A reference is doubted where the confidence in it is less than this share of that in those of
/// the downscaled field.
const DOUBTED_BELOW: f64 = 0.75;

/// A doubted reference stays if the confidence in it is at least so many times as high as with all
/// depths nearer or farther by the share [`DEPTH_SHIFT`].
const SENSITIVE_FROM: f64 = 1.1;
const DEPTH_SHIFT: f32 = 0.1;

/// Views, spread over all, by which references are judged.
const JUDGING_VIEWS: usize = 8;

/// The references that agree with what is rendered; others are said and left out. In those,
/// confidence is less than a share of what they see, unless it would be clearly less still were all
/// depths others. Then depths are right, and confidence is low for another reason: seen from far
/// aside, surfaces look otherwise.
///
/// `confidence` is that in the references of the network's training.
pub(crate) fn without_misleading(
    job: &RefineJob<'_>,
    references: Vec<KnownView>,
    views: &Views,
    confidence: f64,
) -> anyhow::Result<Vec<KnownView>> {
    let Some(guidance) = job.network.guidance().filter(|_| !references.is_empty()) else {
        return Ok(references);
    };
    let judge = Judge { job, views, guidance };
    let shares = judge.confidence(&references, guidance, 1.0)?;
    let mut kept = Vec::new();
    for (reference, share) in references.into_iter().zip(shares) {
        if share >= DOUBTED_BELOW * confidence || judge.has_right_depth(&reference)? {
            kept.push(reference);
            continue;
        }
        let name = &reference.rendered.camera.name;
        job.context.say(format!(
            "reference {name} looks otherwise than what is rendered (confidence {:.0} %) and \
            is left out: wrong depth, a wrong pose, or \
             something that moved?",
            100.0 * share
        ));
    }
    Ok(kept)
}

/// Judges references by some views.
struct Judge<'a> {
    job: &'a RefineJob<'a>,
    views: &'a Views,
    guidance: Guidance,
}

impl Judge<'_> {
    /// Whether confidence in a reference is clearly lower with all depths nearer and farther.
    fn has_right_depth(&self, reference: &KnownView) -> anyhow::Result<bool> {
        // At another depth a reference sees nothing by its own.
        let blind = Guidance { occlusion: false, ..self.guidance };
        let mut shares = [0.0; 3];
        for (share, factor) in shares.iter_mut().zip([1.0, 1.0 - DEPTH_SHIFT, 1.0 + DEPTH_SHIFT]) {
            *share = self.confidence(std::slice::from_ref(reference), blind, factor)?[0];
        }
        let [as_rendered, nearer, farther] = shares;
        Ok(as_rendered >= SENSITIVE_FROM * f64::max(nearer, farther))
    }

    /// Confidence in each reference, as a share of what it sees of the views, were depths so many
    /// times what they are.
    fn confidence(
        &self,
        references: &[KnownView],
        guidance: Guidance,
        depth_factor: f32,
    ) -> anyhow::Result<Vec<f64>> {
        let every = self.views.views.len().div_ceil(JUDGING_VIEWS).max(1);
        let mut uses = vec![Use::default(); references.len()];
        let references: Vec<&KnownView> = references.iter().collect();
        for view in self.views.views.iter().step_by(every) {
            let mut shown = self.job.shown(view)?.0;
            shown.depth.iter_mut().for_each(|depth| *depth *= depth_factor);
            let conditioned = with_references(&shown, &references, guidance);
            uses.iter_mut().zip(&conditioned.uses).for_each(|(sum, of_use)| sum.add(of_use));
        }
        Ok(uses.iter().map(Use::confidence_share).collect())
    }
}
