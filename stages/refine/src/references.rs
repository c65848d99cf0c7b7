use artifact::{Failure, FailureExt as _, bail_bad_input};
use pixels::Exposure;
use refinement::{KnownView, ReferenceStatistics, Rendered, WarpOptions, with_references};
use scene::{Background, View, Views};
use stage::Context;

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
            bail_bad_input!(
                "input reference-views: no view {name} with the reference's pose; render the \
                cameras of input references"
            );
        };
        let view = read_view(rendered, view, background.grey_level(), true)?.0;
        let (reference, exposure) = KnownView::with_equal_exposure(view, truth, background)
            .bad_input("input reference-views")?;
        if let Some(Exposure { gain: [r, g, b], .. }) = exposure {
            context.log_line(format!(
                "reference {name} has another exposure ({r:.2}, {g:.2}, {b:.2} times as bright); \
                corrected"
            ));
        }
        references.push(reference);
    }
    Ok(references)
}

/// Minimum confidence in a reference, relative to the confidence in the references that the network
/// was trained with. With less, the views' depths are tested (design note 018).
const MIN_RELATIVE_CONFIDENCE: f64 = 0.75;

/// Minimum ratio between the confidence in a reference and the confidence with the views' depths
/// shifted by [`DEPTH_SHIFT`]. With at least this ratio, the depths are correct (design note 018).
const MIN_DEPTH_SENSITIVITY: f64 = 1.1;
/// Relative shift of the views' depths in the test (design note 018).
const DEPTH_SHIFT: f32 = 0.1;

/// Maximum number of views, spread over all, by which references are judged; chosen by hand.
const MAX_JUDGING_VIEWS: usize = 8;

/// Removes references that disagree with the renders, and logs each removal as soon as the
/// reference is judged. A reference with low confidence stays if shifted depths of the views lower
/// the confidence further. Then these depths are correct, and surfaces look different from another
/// angle.
///
/// `confidence` is the confidence in the references that the network was trained with.
pub(crate) fn remove_misleading(
    job: &RefineJob<'_>,
    references: Vec<KnownView>,
    views: &Views,
    confidence: f64,
) -> anyhow::Result<Vec<KnownView>> {
    let Some(warp_options) = job.network.warp_options().filter(|_| !references.is_empty()) else {
        return Ok(references);
    };
    ReferenceJudge {
        views: &views.views,
        warp_options,
        read: &|view| Ok(job.read(view)?.rendered),
        log: &|note| job.context.log_line(note),
    }
    .retain_reliable(references, confidence)
}

/// Test of references against some of the views to refine.
struct ReferenceJudge<'a> {
    views: &'a [View],
    warp_options: WarpOptions,
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
        let shares = self.confidence(&references, self.warp_options, 1.0)?;
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
                maybe its pose or the depth is wrong, or something moved",
                100.0 * shares[i]
            ));
        }
        Ok(reliable)
    }

    /// True if confidence in a reference is clearly lower with smaller and with larger depths of
    /// the views.
    fn has_correct_depth(&self, reference: &KnownView) -> anyhow::Result<bool> {
        // With shifted depths, the reference's own depth would hide every point.
        let warp_options = WarpOptions { occlusion: false };
        let reference = std::slice::from_ref(reference);
        let unshifted = self.confidence(reference, warp_options, 1.0)?[0];
        let nearer = self.confidence(reference, warp_options, 1.0 - DEPTH_SHIFT)?[0];
        let farther = self.confidence(reference, warp_options, 1.0 + DEPTH_SHIFT)?[0];
        Ok(unshifted >= MIN_DEPTH_SENSITIVITY * f64::max(nearer, farther))
    }

    /// Returns the confidence in each reference, relative to the reference's visibility in the
    /// views. Multiplies the views' depths by a factor.
    fn confidence(
        &self,
        references: &[KnownView],
        warp_options: WarpOptions,
        depth_factor: f32,
    ) -> anyhow::Result<Vec<f64>> {
        let stride = self.views.len().div_ceil(MAX_JUDGING_VIEWS).max(1);
        let mut statistics = vec![ReferenceStatistics::default(); references.len()];
        let references: Vec<&KnownView> = references.iter().collect();
        for view in self.views.iter().step_by(stride) {
            let mut rendered = (self.read)(view)?;
            for depth in &mut rendered.depth {
                *depth *= depth_factor;
            }
            let conditioned = with_references(&rendered, &references, warp_options);
            ReferenceStatistics::add_each(&mut statistics, &conditioned.statistics);
        }
        Ok(statistics.iter().map(ReferenceStatistics::confidence_share).collect())
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

    /// Returns the image of a wall from a camera `right` pixels to the right. Red and blue increase
    /// along a row, green decreases.
    fn colours(right: f64) -> Vec<[f32; 3]> {
        (0..WIDTH * HEIGHT).map(|i| colour((i % WIDTH) as f64 + right)).collect()
    }

    fn colour(x: f64) -> [f32; 3] {
        let rise = (0.0035 * x) as f32;
        [0.1 + rise, 0.9 - rise, 0.1 + rise]
    }

    /// Returns the view of a camera `right` pixels to the right, with a true image.
    fn known_view(name: &str, right: f64, truth: &[[f32; 3]]) -> KnownView {
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

    /// Returns the names of the reliable references among four.
    fn reliable_names(judge: &ReferenceJudge<'_>, confidence: f64) -> anyhow::Result<Vec<String>> {
        let right = 100.0;
        let tinted: Vec<[f32; 3]> =
            colours(right).into_iter().map(|[r, g, b]| [r + 0.04, g + 0.04, b]).collect();
        let references = vec![
            known_view("same", right, &colours(right)),
            known_view("tinted", right, &tinted),
            known_view("farther", right, &colours(right / 1.1)),
            known_view("other", right, &[[0.9; 3]; WIDTH * HEIGHT]),
        ];
        let kept = judge.retain_reliable(references, confidence)?;
        Ok(kept.into_iter().map(|reference| reference.rendered.camera.name).collect())
    }

    /// A reference with low confidence is kept if shifted depths fit worse, like the tinted one.
    /// The reference is removed if shifted depths fit equally well or better.
    #[test]
    fn misleading_references_are_left_out() {
        let rendered = known_view("view", 0.0, &colours(0.0)).rendered;
        let views = vec![View::camera_only(rendered.camera.clone()); 9];
        let read_count = Cell::new(0);
        let read = |_: &View| {
            read_count.set(read_count.get() + 1);
            Ok::<_, Failure>(rendered.clone())
        };
        let logged = RefCell::new(Vec::new());
        let log = |note: String| logged.borrow_mut().push(note);
        let warp_options = WarpOptions::default();
        let judge = ReferenceJudge { views: &views, warp_options, read: &read, log: &log };
        assert_eq!(reliable_names(&judge, 1.0).unwrap(), ["same", "tinted"]);
        // Per channel the farther wall differs by 0.0318, and (1 + 100 · 3 · 0.0318²)⁻² is 0.59.
        let starts = [
            "reference farther differs from the renders (confidence 59 %)",
            "reference other differs from the renders",
        ];
        let notes = logged.take();
        assert_eq!(notes.len(), 2, "{notes:?}");
        assert!(notes[0].starts_with(starts[0]), "{}", notes[0]);
        assert!(notes[1].starts_with(starts[1]), "{}", notes[1]);
        // Every second of nine views is read: once for all references, then three times for each of
        // three references with low confidence.
        assert_eq!(read_count.get(), 5 * (1 + 3 * 3));
        // With lower confidence during training, lower confidence suffices.
        assert_eq!(reliable_names(&judge, 0.7).unwrap(), ["same", "tinted", "farther"]);
        // The note on one reference is logged even if views can't be read for the next one.
        read_count.set(0);
        logged.borrow_mut().clear();
        let failing = |view: &View| {
            if read_count.get() < 5 * (1 + 2 * 3) {
                read(view)
            } else {
                Err(Failure::BadInput("no view".to_owned()))
            }
        };
        assert!(reliable_names(&ReferenceJudge { read: &failing, ..judge }, 1.0).is_err());
        let notes = logged.take();
        assert!(notes.len() == 1 && notes[0].starts_with(starts[0]), "{notes:?}");
    }
}
