use artifact::{Failure, FailureExt as _};
use refinement::{Guidance, KnownView, Rendered, Use, with_references};
use scene::{Background, View, Views};
use stage::Context;

use crate::network::add_uses;
use crate::view::{RefineJob, read_view};

/// Reads the references of a network that takes them; for other networks, logs that references are
/// ignored.
pub(crate) fn read_references(
    context: &Context,
    takes_references: bool,
    background: Background,
) -> anyhow::Result<Vec<KnownView>> {
    let given = context.optional_input("references").zip(context.optional_input("reference-views"));
    let Some((images, rendered)) = given else {
        if takes_references {
            context.log_line(
                "the network can use references, but none are given; give inputs references and \
                reference-views",
            );
        }
        return Ok(Vec::new());
    };
    if !takes_references {
        context.log_line(
            "references are ignored: the network was trained without references; set \
            train-refine.references_per_view",
        );
        return Ok(Vec::new());
    }
    let rendered_views = Views::read(rendered)?;
    let mut references = Vec::new();
    for true_view in &Views::read(images)?.views {
        let name = &true_view.camera.name;
        let Some(truth) =
            true_view.read_photograph(images).bad_input(format!("reference {name}"))?
        else {
            continue;
        };
        let Some(view) = rendered_views.taken_by(&true_view.camera) else {
            let message = format!(
                "input reference-views: no view {name} with the reference's pose; render the \
                cameras of input references"
            );
            return Err(Failure::BadInput(message).into());
        };
        let view = read_view(rendered, view, background.grey_level())?.0;
        let known = KnownView::new(view, truth.over(background.grey_level()))
            .bad_input("input reference-views")?;
        let (reference, note) = correct_exposure(known);
        if let Some(note) = note {
            context.log_line(note);
        }
        references.push(reference);
    }
    Ok(references)
}

/// Corrects a reference's exposure to that of the field's training images. Returns a log line if
/// the exposure differed.
fn correct_exposure(reference: KnownView) -> (KnownView, Option<String>) {
    let Some(exposure) = reference.exposure().filter(|exposure| !exposure.is_negligible()) else {
        return (reference, None);
    };
    let [r, g, b] = exposure.gain;
    let name = &reference.rendered.camera.name;
    let note = format!(
        "reference {name} has another exposure ({r:.2}, {g:.2}, {b:.2} times as bright); corrected"
    );
    (reference.with_corrected_exposure(&exposure), Some(note))
}

/// Minimum confidence in a reference, relative to that in the references of the network's training,
/// below which the reference's depth is tested (design note 018).
const MIN_RELATIVE_CONFIDENCE: f64 = 0.75;

/// Minimum ratio of the confidence in a tested reference to that with all depths shifted by
/// [`DEPTH_SHIFT`]; above it, depths count as correct (design note 018).
const MIN_DEPTH_SENSITIVITY: f64 = 1.1;
/// Relative shift of depths in the test (design note 018).
const DEPTH_SHIFT: f32 = 0.1;

/// Maximum number of views, spread over all, by which references are judged; chosen by hand.
const MAX_JUDGING_VIEWS: usize = 8;

/// Removes references that disagree with the renders, and logs each removal as soon as the
/// reference is judged. A reference with low confidence stays if confidence is even lower with
/// shifted depths: then its depths are correct, and its surfaces look different from another angle.
///
/// `confidence` is that in the references of the network's training.
pub(crate) fn remove_misleading(
    job: &RefineJob<'_>,
    references: Vec<KnownView>,
    views: &Views,
    confidence: f64,
) -> anyhow::Result<Vec<KnownView>> {
    let Some(guidance) = job.network.guidance().filter(|_| !references.is_empty()) else {
        return Ok(references);
    };
    ReferenceJudge {
        views: &views.views,
        guidance,
        read: &|view| Ok(job.read(view)?.rendered),
        log: &|note| job.context.log_line(note),
    }
    .retain_reliable(references, confidence)
}

/// Test of references against some of the views to refine.
struct ReferenceJudge<'a> {
    views: &'a [View],
    guidance: Guidance,
    /// Reads a view in the form that the network takes.
    read: &'a dyn Fn(&View) -> Result<Rendered, Failure>,
    /// Logs a removed reference.
    log: &'a dyn Fn(String),
}

impl ReferenceJudge<'_> {
    /// Returns the references that aren't misleading, and logs the others.
    fn retain_reliable(
        &self,
        references: Vec<KnownView>,
        confidence: f64,
    ) -> anyhow::Result<Vec<KnownView>> {
        let shares = self.confidence(&references, self.guidance, 1.0)?;
        let mut reliable = Vec::new();
        for (i, reference) in references.into_iter().enumerate() {
            let is_confident = shares[i] >= MIN_RELATIVE_CONFIDENCE * confidence;
            if is_confident || self.has_correct_depth(&reference)? {
                reliable.push(reference);
                continue;
            }
            let name = &reference.rendered.camera.name;
            (self.log)(format!(
                "reference {name} differs from the renders (confidence {:.0} %) and is left out: \
                wrong depth, a wrong pose, or did something move?",
                100.0 * shares[i]
            ));
        }
        Ok(reliable)
    }

    /// True if confidence in a reference is clearly lower with all depths nearer and farther.
    fn has_correct_depth(&self, reference: &KnownView) -> anyhow::Result<bool> {
        // With shifted depths, the reference's own depth would hide every point.
        let guidance = Guidance { occlusion: false, ..self.guidance };
        let reference = std::slice::from_ref(reference);
        let unshifted = self.confidence(reference, guidance, 1.0)?[0];
        let nearer = self.confidence(reference, guidance, 1.0 - DEPTH_SHIFT)?[0];
        let farther = self.confidence(reference, guidance, 1.0 + DEPTH_SHIFT)?[0];
        Ok(unshifted >= MIN_DEPTH_SENSITIVITY * f64::max(nearer, farther))
    }

    /// Returns the confidence in each reference, relative to its visibility in the views, with all
    /// depths multiplied by a factor.
    fn confidence(
        &self,
        references: &[KnownView],
        guidance: Guidance,
        depth_factor: f32,
    ) -> anyhow::Result<Vec<f64>> {
        let stride = self.views.len().div_ceil(MAX_JUDGING_VIEWS).max(1);
        let mut uses = vec![Use::default(); references.len()];
        let references: Vec<&KnownView> = references.iter().collect();
        for view in self.views.iter().step_by(stride) {
            let mut rendered = (self.read)(view)?;
            for depth in &mut rendered.depth {
                *depth *= depth_factor;
            }
            let conditioned = with_references(&rendered, &references, guidance);
            add_uses(&mut uses, &conditioned.uses);
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
    fn sorted(judge: &ReferenceJudge<'_>, confidence: f64) -> anyhow::Result<Vec<String>> {
        let right = 100.0;
        let tinted: Vec<[f32; 3]> =
            colours(right).into_iter().map(|[r, g, b]| [r + 0.04, g + 0.04, b]).collect();
        let references = vec![
            known("same", right, &colours(right)),
            known("tinted", right, &tinted),
            known("farther", right, &colours(right / 1.1)),
            known("other", right, &[[0.9; 3]; WIDTH * HEIGHT]),
        ];
        let kept = judge.retain_reliable(references, confidence)?;
        Ok(kept.into_iter().map(|reference| reference.rendered.camera.name).collect())
    }

    /// A doubted reference stays where another depth would fit less, here the tinted one. It goes
    /// where another depth would fit as well or better.
    #[test]
    fn misleading_references_are_left_out() {
        let rendered = known("view", 0.0, &colours(0.0)).rendered;
        let views = vec![View::camera_only(rendered.camera.clone()); 9];
        let asked = Cell::new(0);
        let read = |_: &View| {
            asked.set(asked.get() + 1);
            Ok::<_, Failure>(rendered.clone())
        };
        let said = RefCell::new(Vec::new());
        let log = |note: String| said.borrow_mut().push(note);
        let guidance = Guidance::default();
        let judge = ReferenceJudge { views: &views, guidance, read: &read, log: &log };
        assert_eq!(sorted(&judge, 1.0).unwrap(), ["same", "tinted"]);
        // Per channel the farther wall differs by 0.0318, and (1 + 100 · 3 · 0.0318²)⁻² is 0.59.
        let starts = [
            "reference farther differs from the renders (confidence 59 %)",
            "reference other differs from the renders",
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
                read(view)
            } else {
                Err(Failure::BadInput("no view".to_owned()))
            }
        };
        assert!(sorted(&ReferenceJudge { read: &failing, ..judge }, 1.0).is_err());
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
    fn another_exposure_is_corrected() {
        let (reference, note) = correct_exposure(seen([0.6, 0.7, 1.0]));
        let expected =
            "reference a has another exposure (0.60, 0.70, 1.00 times as bright); corrected";
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
            let (reference, note) = correct_exposure(same);
            assert!(reference.truth == truth && note.is_none(), "{note:?}");
        }
    }
}
