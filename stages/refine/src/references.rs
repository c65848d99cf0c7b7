use artifact::{Failure, FailureExt as _};
use refinement::{Guidance, KnownView, Rendered, Use, with_references};
use scene::{Background, View, Views};
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
        let (reference, note) = same_exposure(known);
        if let Some(note) = note {
            context.say(note);
        }
        references.push(reference);
    }
    Ok(references)
}

/// A reference as it would look with the exposure of the images that the field learnt from, and
/// what to say where it had another.
fn same_exposure(reference: KnownView) -> (KnownView, Option<String>) {
    let Some(exposure) = reference.exposure().filter(|exposure| !exposure.is_negligible()) else {
        return (reference, None);
    };
    let [r, g, b] = exposure.gain;
    let name = &reference.rendered.camera.name;
    let note = format!(
        "reference {name} has another exposure ({r:.2}, {g:.2}, {b:.2} times as bright): taken back"
    );
    (reference.with_corrected_exposure(&exposure), Some(note))
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

/// The references that agree with what is rendered; others are left out, and each is said once it
/// is judged. In those, confidence is less than a share of what they see, unless it would be
/// clearly less still were all depths others. Then depths are right, and confidence is low for
/// another reason: seen from far aside, surfaces look otherwise.
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
    let shown = |view: &View| job.shown(view).map(|(rendered, ..)| rendered);
    let say = |note: String| job.context.say(note);
    Judge { views: &views.views, guidance, shown: &shown, say: &say }
        .sort_out(references, confidence)
}

/// Judges references by some views.
struct Judge<'a> {
    views: &'a [View],
    guidance: Guidance,
    /// A view as the network takes it.
    shown: &'a dyn Fn(&View) -> Result<Rendered, Failure>,
    /// Says what is wrong with a reference.
    say: &'a dyn Fn(String),
}

impl Judge<'_> {
    /// The references that aren't misleading. Each of the others is said as soon as it is judged.
    fn sort_out(
        &self,
        references: Vec<KnownView>,
        confidence: f64,
    ) -> anyhow::Result<Vec<KnownView>> {
        let shares = self.confidence(&references, self.guidance, 1.0)?;
        let mut kept = Vec::new();
        for (reference, share) in references.into_iter().zip(shares) {
            if share >= DOUBTED_BELOW * confidence || self.has_right_depth(&reference)? {
                kept.push(reference);
                continue;
            }
            let name = &reference.rendered.camera.name;
            (self.say)(format!(
                "reference {name} looks otherwise than what is rendered (confidence {:.0} %) and \
                is left out: wrong depth, a wrong pose, or something that moved?",
                100.0 * share
            ));
        }
        Ok(kept)
    }

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
        let every = self.views.len().div_ceil(JUDGING_VIEWS).max(1);
        let mut uses = vec![Use::default(); references.len()];
        let references: Vec<&KnownView> = references.iter().collect();
        for view in self.views.iter().step_by(every) {
            let mut shown = (self.shown)(view)?;
            shown.depth.iter_mut().for_each(|depth| *depth *= depth_factor);
            let conditioned = with_references(&shown, &references, guidance);
            uses.iter_mut().zip(&conditioned.uses).for_each(|(sum, of_use)| sum.add(of_use));
        }
        Ok(uses.iter().map(Use::confidence_share).collect())
    }
}

#[cfg(test)]
mod tests {
    use std::cell::{Cell, RefCell};

    use pixels::Image;
    use scene::{Camera, Intrinsics};

    use super::*;

    const WIDTH: usize = 128;
    const HEIGHT: usize = 8;
    const FOCAL: f64 = 200.0;
    const DEPTH: f64 = 2.0;

    /// What a camera sees of a wall from so many pixels to the right: red and blue rise, green
    /// falls.
    fn colours(right: f64) -> Vec<[f32; 3]> {
        (0..WIDTH * HEIGHT).map(|i| colour((i % WIDTH) as f64 + right)).collect()
    }

    fn colour(x: f64) -> [f32; 3] {
        let rise = (0.0035 * x) as f32;
        [0.1 + rise, 0.9 - rise, 0.1 + rise]
    }

    /// The wall as rendered from there, with a true image.
    fn known(name: &str, right: f64, truth: &[[f32; 3]]) -> KnownView {
        let camera = Camera {
            name: name.to_owned(),
            intrinsics: Intrinsics {
                fx: FOCAL,
                fy: FOCAL,
                ..Intrinsics::from_angle_x(WIDTH as u32, HEIGHT as u32, 1.0)
            },
            camera_to_world: [
                [1.0, 0.0, 0.0, right * DEPTH / FOCAL],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, DEPTH],
            ],
        };
        let pixels: Vec<[f32; 4]> =
            colours(right).into_iter().map(|[r, g, b]| [r, g, b, 1.0]).collect();
        let rendered = Rendered {
            camera,
            view: Image::new(WIDTH, HEIGHT, 4, pixels.as_flattened().to_vec()),
            depth: vec![DEPTH as f32; WIDTH * HEIGHT],
            opacity: vec![1.0; WIDTH * HEIGHT],
        };
        let truth = Image::new(WIDTH, HEIGHT, 3, truth.as_flattened().to_vec());
        KnownView { rendered, truth }
    }

    /// Names of the references that are kept of four.
    fn sorted(judge: &Judge<'_>, confidence: f64) -> anyhow::Result<Vec<String>> {
        let right = 100.0;
        let tinted: Vec<[f32; 3]> =
            colours(right).into_iter().map(|[r, g, b]| [r + 0.04, g + 0.04, b]).collect();
        let references = vec![
            known("same", right, &colours(right)),
            known("tinted", right, &tinted),
            known("farther", right, &colours(right / 1.1)),
            known("other", right, &[[0.9; 3]; WIDTH * HEIGHT]),
        ];
        let kept = judge.sort_out(references, confidence)?;
        Ok(kept.into_iter().map(|reference| reference.rendered.camera.name).collect())
    }

    /// A doubted reference stays where another depth would fit less, here the tinted one. It goes
    /// where another depth would fit as well or better.
    #[test]
    fn misleading_references_are_left_out() {
        let rendered = known("view", 0.0, &colours(0.0)).rendered;
        let views = vec![View::camera_only(rendered.camera.clone()); 9];
        let asked = Cell::new(0);
        let shown = |_: &View| {
            asked.set(asked.get() + 1);
            Ok::<_, Failure>(rendered.clone())
        };
        let said = RefCell::new(Vec::new());
        let say = |note: String| said.borrow_mut().push(note);
        let guidance = Guidance::default();
        let judge = Judge { views: &views, guidance, shown: &shown, say: &say };
        assert_eq!(sorted(&judge, 1.0).unwrap(), ["same", "tinted"]);
        // Per channel the farther wall differs by 0.0318, and (1 + 100 · 3 · 0.0318²)⁻² is 0.59.
        let starts = [
            "reference farther looks otherwise than what is rendered (confidence 59 %)",
            "reference other looks otherwise than what is rendered",
        ];
        let notes = said.take();
        assert_eq!(notes.len(), 2, "{notes:?}");
        assert!(notes[0].starts_with(starts[0]), "{}", notes[0]);
        assert!(notes[1].starts_with(starts[1]), "{}", notes[1]);
        // Every second of nine views is asked for: once for all, then three times for each of three
        // doubted references.
        assert_eq!(asked.get(), 5 * (1 + 3 * 3));
        // Where the network's training had less confidence, less is asked for.
        assert_eq!(sorted(&judge, 0.7).unwrap(), ["same", "tinted", "farther"]);
        // What was said of one isn't lost where views can't be read for the next.
        asked.set(0);
        said.borrow_mut().clear();
        let failing = |view: &View| {
            if asked.get() < 5 * (1 + 2 * 3) {
                shown(view)
            } else {
                Err(Failure::BadInput("no view".to_owned()))
            }
        };
        assert!(sorted(&Judge { shown: &failing, ..judge }, 1.0).is_err());
        let notes = said.take();
        assert!(notes.len() == 1 && notes[0].starts_with(starts[0]), "{notes:?}");
    }

    /// A reference whose channels are so many times as bright.
    fn seen(gain: [f32; 3]) -> KnownView {
        let truth: Vec<[f32; 3]> =
            colours(0.0).iter().map(|right| std::array::from_fn(|c| gain[c] * right[c])).collect();
        known("a", 0.0, &truth)
    }

    #[test]
    fn another_exposure_is_taken_back() {
        let (reference, note) = same_exposure(seen([0.6, 0.7, 1.0]));
        let expected =
            "reference a has another exposure (0.60, 0.70, 1.00 times as bright): taken back";
        assert_eq!(note.as_deref(), Some(expected));
        let off = reference
            .truth
            .data
            .iter()
            .zip(colours(0.0).as_flattened())
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(off < 1e-4, "{off}");
        // What a field may get wrong, and an image that says nothing, stay as they are.
        for same in [seen([1.05, 0.95, 1.0]), known("a", 0.0, &[[1.0; 3]; WIDTH * HEIGHT])] {
            let truth = same.truth.clone();
            let (reference, note) = same_exposure(same);
            assert!(reference.truth == truth && note.is_none(), "{note:?}");
        }
    }
}
