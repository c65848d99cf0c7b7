//! Reference-based refinement: HR references brought over to a view by its depth, and the
//! confidence in what they show there.

use std::ops::Range;

use pixels::Image;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::align::align;
use crate::channels::{INPUTS, REFERENCE_INPUTS};
use crate::guidance::Guidance;
use crate::sums::{COMPARED_RADIUS, Sums};
use crate::view::{KnownView, Rendered};
use crate::warped_pixel::WarpedPixel;

/// What references know of some rows of a view: how the colour they show there differs from the
/// rendered one; the confidence in them, from 0 (none of them sees it) to 1 (one sees it from the
/// same direction, as large, and as it is rendered); and what their own rendered views lack there,
/// which is of use even where they show a surface a little aside, or in another light.
#[derive(Debug)]
struct ReferenceFeatures {
    known: Vec<[f32; KNOWN]>,
    uses: Vec<Use>,
}

/// Channels of what references know.
const KNOWN: usize = REFERENCE_INPUTS - INPUTS;

/// What of a view a reference was of use for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Use {
    /// Pixels that it sees.
    pub seen: usize,
    /// Sum over them of how well it sees them, by angle and size.
    #[serde(rename = "sight")]
    pub visibility: f64,
    /// Sum over them of the confidence in it: less where it looks otherwise than what is rendered.
    #[serde(rename = "confidence")]
    pub confidence: f64,
}

impl Use {
    /// Confidence in what it sees, a share of its visibility.
    pub fn confidence_share(&self) -> f64 {
        if self.visibility > 0.0 { self.confidence / self.visibility } else { 1.0 }
    }

    /// Adds what another part makes of the same reference.
    pub fn add(&mut self, other: &Self) {
        self.seen += other.seen;
        self.visibility += other.visibility;
        self.confidence += other.confidence;
    }
}

/// A view with what references know of it.
#[derive(Clone, Debug)]
pub struct ConditionedView {
    /// As a reference-based refiner takes it: colour, opacity, difference to the references, their
    /// confidence, and what their own views lack.
    pub view: Image,
    /// What each reference was of use for.
    pub uses: Vec<Use>,
}

/// The mean difference around a pixel that quarters the confidence.
const QUARTERING_DIFFERENCE: f32 = 0.1;
/// The jump between neighbours that halves the confidence, in pixels of the reference.
const HALVING_JUMP: f32 = 1.0;

impl ReferenceFeatures {
    /// What references know of rows.
    fn new(
        rendered: &Rendered,
        references: &[&KnownView],
        rows: Range<usize>,
        guidance: Guidance,
    ) -> Self {
        let mut sums =
            vec![([0.0f32; 3], [0.0f32; 3], 0.0f32, 0.0f32); rendered.view.width * rows.len()];
        let mut uses = Vec::new();
        for reference in references {
            let warped = warp(rendered, reference, &rows, guidance);
            let mut of_use = Use::default();
            for (
                (sum, lacks, weights, best),
                WarpedPixel { difference, lacking, visibility, confidence, .. },
            ) in sums.iter_mut().zip(warped)
            {
                of_use.add(&Use {
                    seen: usize::from(visibility > 0.0),
                    visibility: f64::from(visibility),
                    confidence: f64::from(confidence),
                });
                // The best counts most. What has no confidence fades, as if it weren't seen.
                let weight = confidence.powi(4);
                let share = confidence / visibility.max(f32::MIN_POSITIVE);
                (0..3).for_each(|c| sum[c] += weight * share * difference[c]);
                (0..3).for_each(|c| lacks[c] += weight * share * lacking[c]);
                *weights += weight;
                *best = best.max(confidence);
            }
            uses.push(of_use);
        }
        let known = sums.into_iter().map(|(sum, lacks, weights, confidence)| {
            let ([r, g, b], [x, y, z]) = (sum.map(|v| v / weights), lacks.map(|v| v / weights));
            if weights > 0.0 { [r, g, b, confidence, x, y, z] } else { [0.0; KNOWN] }
        });
        Self { known: known.collect(), uses }
    }
}

/// What a reference shows of rows, with less confidence where around a pixel it looks otherwise
/// than rendered (wrong depth, something that moved, a highlight) or comes from here and there
/// (noisy depth, an edge).
fn warp(
    rendered: &Rendered,
    reference: &KnownView,
    rows: &Range<usize>,
    guidance: Guidance,
) -> Vec<WarpedPixel> {
    let (width, height) = (rendered.view.width, rendered.view.height);
    // What is looked at around a pixel was itself moved by what lies around it.
    let around = if guidance.alignment { 2 * COMPARED_RADIUS } else { COMPARED_RADIUS };
    let near = rows.start.saturating_sub(around)..(rows.end + around).min(height);
    let mut warped = shown(rendered, reference, near.clone(), guidance.occlusion);
    if guidance.alignment {
        warped = align(&warped, rendered, reference, near.start);
    }
    let terms = warped.iter().map(|pixel| {
        let [r, g, b] = pixel.difference.map(f64::from);
        if pixel.confidence > 0.0 { [r, g, b, 1.0] } else { [0.0; 4] }
    });
    let sums = Sums::new(width, &terms.collect::<Vec<_>>());
    let mut all = Vec::with_capacity(width * rows.len());
    let neighbours = Neighbours { warped: &warped, width };
    for y in rows.start - near.start..rows.end - near.start {
        for x in 0..width {
            let mut own = warped[y * width + x];
            if own.confidence > 0.0 {
                let apart = mean_difference(&sums, x, y) / QUARTERING_DIFFERENCE;
                let jumped = neighbours.jumped(x, y);
                own.confidence *=
                    (1.0 + apart * apart).powi(-2) / (1.0 + jumped / (HALVING_JUMP * HALVING_JUMP));
            }
            all.push(own);
        }
    }
    all
}

/// What a reference shows of rows where geometry puts them.
fn shown(
    rendered: &Rendered,
    reference: &KnownView,
    rows: Range<usize>,
    occlusion: bool,
) -> Vec<WarpedPixel> {
    let width = rendered.view.width;
    let (surface, theirs) = (rendered.surface(), reference.rendered.surface());
    let mut shown = Vec::with_capacity(width * rows.len());
    for (column, row) in rows.flat_map(|row| (0..width).map(move |column| (column, row))) {
        let visibility = if occlusion {
            surface.visibility(column, row, &theirs)
        } else {
            surface.visibility_through(column, row, theirs.camera)
        };
        let Some(visibility) = visibility else {
            shown.push(WarpedPixel::default());
            continue;
        };
        let well = visibility.cosine.max(0.0) * visibility.detail.min(1.0);
        let pixel = &rendered.view.data[(row * width + column) * INPUTS..];
        shown.push(WarpedPixel::new(reference, visibility.place, well, pixel));
    }
    shown
}

/// How large the mean difference around a pixel is.
fn mean_difference(sums: &Sums<4>, x: usize, y: usize) -> f32 {
    let [r, g, b, count] = sums.around(x, y);
    [r, g, b].map(|sum| (sum / count.max(1.0)).powi(2)).iter().sum::<f64>().sqrt() as f32
}

/// Where neighbouring pixels were found in a reference.
struct Neighbours<'a> {
    warped: &'a [WarpedPixel],
    width: usize,
}

impl Neighbours<'_> {
    fn place(&self, x: usize, y: usize, dx: isize, dy: isize) -> Option<[f32; 2]> {
        let (x, y) = (x.checked_add_signed(dx)?, y.checked_add_signed(dy)?);
        let other = (x < self.width).then(|| self.warped.get(y * self.width + x))??;
        (other.confidence > 0.0).then_some(other.place)
    }

    /// How far a pixel was found from the middle of its neighbours, squared: to both sides, and
    /// above and below.
    fn jumped(&self, x: usize, y: usize) -> f32 {
        let own = self.warped[y * self.width + x].place;
        apart(own, self.place(x, y, -1, 0), self.place(x, y, 1, 0))
            + apart(own, self.place(x, y, 0, -1), self.place(x, y, 0, 1))
    }
}

/// How far the steps to a place from a neighbour and on to another are from equal, squared; 0 where
/// one of those isn't there.
fn apart(own: [f32; 2], a: Option<[f32; 2]>, b: Option<[f32; 2]>) -> f32 {
    let (Some(a), Some(b)) = (a, b) else { return 0.0 };
    (0..2).map(|i| (a[i] + b[i] - 2.0 * own[i]).powi(2)).sum::<f32>()
}

/// A view with what references know of it, as a reference-based refiner takes it: with its
/// [`crate::RefinerArchitecture::guidance`].
pub fn with_references(
    rendered: &Rendered,
    references: &[&KnownView],
    guidance: Guidance,
) -> ConditionedView {
    let (width, height) = (rendered.view.width, rendered.view.height);
    let mut data = vec![0.0; width * height * REFERENCE_INPUTS];
    let bands = data.par_chunks_mut(width * BAND_ROWS * REFERENCE_INPUTS).enumerate();
    let uses: Vec<Vec<Use>> = bands
        .map(|(i, out)| condition(out, i * BAND_ROWS, rendered, references, guidance))
        .collect();
    let mut sums = vec![Use::default(); references.len()];
    uses.iter()
        .for_each(|band| sums.iter_mut().zip(band).for_each(|(sum, of_use)| sum.add(of_use)));
    ConditionedView { view: Image::new(width, height, REFERENCE_INPUTS, data), uses: sums }
}

/// Fills a band of a conditioned view from its first row on; what references were of use for.
fn condition(
    out: &mut [f32],
    first: usize,
    rendered: &Rendered,
    references: &[&KnownView],
    guidance: Guidance,
) -> Vec<Use> {
    let Image { width, height, .. } = rendered.view;
    let rows = first..(first + BAND_ROWS).min(height);
    let features = ReferenceFeatures::new(rendered, references, rows.clone(), guidance);
    let pixels =
        rendered.view.data[rows.start * width * INPUTS..].chunks_exact(INPUTS).zip(&features.known);
    for (out, (pixel, known)) in out.chunks_exact_mut(REFERENCE_INPUTS).zip(pixels) {
        out[..INPUTS].copy_from_slice(pixel);
        out[INPUTS..].copy_from_slice(known);
    }
    features.uses
}

/// Rows of a view that are looked at together: memory is bounded, whatever its size.
const BAND_ROWS: usize = 32;

#[cfg(test)]
mod tests {
    use counter_rng::uniform;
    use scene::{Camera, Intrinsics};

    use super::*;

    const WIDTH: usize = 96;
    const HEIGHT: usize = 48;

    fn level(right: usize, x: isize, y: isize, c: u64) -> f32 {
        let patch = (x + right as isize).div_euclid(6) * 1000 + y.div_euclid(6);
        0.2 + 0.6 * uniform(4, c, patch as u64)
    }

    fn blurred(right: usize, x: isize, y: isize, c: u64) -> f32 {
        (-1..=1).map(|i| level(right, x + i, y - i, c) + level(right, x + i, y + i, c)).sum::<f32>()
            / 6.0
    }

    /// A wall at distance 2 with patches of six pixels, as it is and blurred, from a camera so many
    /// pixels to the right; `depth` is what the field believes.
    fn wall(right: usize, depth: impl Fn(usize) -> f32) -> KnownView {
        let pixels = || (0..HEIGHT as isize).flat_map(|y| (0..WIDTH as isize).map(move |x| (x, y)));
        let truth = pixels().flat_map(|(x, y)| [0, 1, 2].map(|c| level(right, x, y, c))).collect();
        let view = pixels()
            .flat_map(|(x, y)| {
                [blurred(right, x, y, 0), blurred(right, x, y, 1), blurred(right, x, y, 2), 1.0]
            })
            .collect();
        let camera = Camera {
            name: right.to_string(),
            intrinsics: Intrinsics {
                width: WIDTH as u32,
                height: HEIGHT as u32,
                fx: 300.0,
                fy: 300.0,
                cx: 48.0,
                cy: 24.0,
                distortion: Default::default(),
            },
            camera_to_world: [
                [1.0, 0.0, 0.0, right as f64 * 2.0 / 300.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 2.0],
            ],
        };
        let view = Image::new(WIDTH, HEIGHT, 4, view);
        let depth = (0..WIDTH * HEIGHT).map(depth).collect();
        let rendered = Rendered { camera, view, depth, opacity: vec![1.0; WIDTH * HEIGHT] };
        KnownView { rendered, truth: Image::new(WIDTH, HEIGHT, 3, truth) }
    }

    /// Share of the view that is known of, confidence there, and how far what is shown there is
    /// from the truth, weighted by the confidence.
    fn judged(view: &KnownView, reference: &KnownView, guidance: Guidance) -> (f64, f64, f64) {
        let ConditionedView { view: conditioned, uses } =
            with_references(&view.rendered, &[reference], guidance);
        let (seen, confidence) = (
            uses[0].seen as f64 / (WIDTH * HEIGHT) as f64,
            uses[0].confidence / uses[0].seen.max(1) as f64,
        );
        let (mut sum, mut all) = (0.0, 0.0);
        for (pixel, truth) in
            conditioned.data.chunks_exact(REFERENCE_INPUTS).zip(view.truth.data.chunks_exact(3))
        {
            let off =
                (0..3).map(|c| f64::from(pixel[c] + pixel[4 + c] - truth[c]).abs()).sum::<f64>()
                    / 3.0;
            sum += off * f64::from(pixel[7]);
            all += f64::from(pixel[7]);
        }
        (seen, confidence, sum / f64::max(all, 1e-9))
    }

    #[test]
    fn confidence_falls_where_it_looks_otherwise_than_rendered() {
        let (view, reference) = (wall(0, |_| 2.0), wall(24, |_| 2.0));
        let (seen, confidence, off) = judged(&view, &reference, Guidance::default());
        assert!(
            (0.7..0.8).contains(&seen) && confidence > 0.85 && off < 0.01,
            "right: {seen} {confidence} {off}"
        );
        // A plane a third too far away: the reference shows what lies eight pixels to the side.
        let (_, confidence, _) = judged(&wall(0, |_| 3.0), &wall(24, |_| 3.0), Guidance::default());
        assert!(confidence < 0.5, "shifted: {confidence}");
        // Depths with noise within what counts as the same surface, seen from far aside.
        let noisy = |seed: u64| move |i: usize| 2.0 + 0.03 * (uniform(seed, 1, i as u64) - 0.5);
        let (_, calm, _) = judged(&wall(0, |_| 2.0), &wall(60, |_| 2.0), Guidance::default());
        let (_, confidence, _) =
            judged(&wall(0, noisy(1)), &wall(60, noisy(2)), Guidance::default());
        assert!(confidence < 0.8 * calm, "noisy: {confidence} of {calm}");
        // A reference of something else.
        let mut other = wall(24, |_| 2.0);
        other.truth.data.iter_mut().for_each(|v| *v = 1.0 - *v);
        let (_, confidence, _) = judged(&view, &other, Guidance::default());
        assert!(confidence < 0.5, "other: {confidence}");
        // One that looks away.
        assert_eq!(judged(&view, &wall(500, |_| 2.0), Guidance::default()).0, 0.0);
    }

    fn error_at_depth(depth: f32, alignment: bool) -> f64 {
        let guidance = Guidance { alignment, ..Guidance::default() };
        judged(&wall(0, |_| depth), &wall(24, |_| depth), guidance).2
    }

    /// Depths a little off put what a reference shows a pixel and more to the side: it is moved
    /// back; where depths are right it stays.
    #[test]
    fn alignment_moves_what_is_shown_to_where_it_fits() {
        for depth in [1.9, 2.1] {
            let (moved, was) = (error_at_depth(depth, true), error_at_depth(depth, false));
            assert!(moved < 0.7 * was, "depth {depth}: {moved} off where it was {was}");
        }
        let right = error_at_depth(2.0, true);
        assert!(right < 0.01, "{right}");
    }

    fn seen(view: &KnownView, reference: &KnownView, occlusion: bool) -> usize {
        let guidance = Guidance { occlusion, ..Guidance::default() };
        with_references(&view.rendered, &[reference], guidance).uses[0].seen
    }

    /// What something stands before is shown only by references that needn't see it.
    #[test]
    fn what_is_hidden_is_not_shown() {
        // The reference has a plate before the middle third of its image.
        let plate =
            |i: usize| if (WIDTH / 3..2 * WIDTH / 3).contains(&(i % WIDTH)) { 1.0 } else { 2.0 };
        let (view, reference) = (wall(0, |_| 2.0), wall(24, plate));
        let hidden = (seen(&view, &reference, false) - seen(&view, &reference, true)) as f64
            / (WIDTH * HEIGHT) as f64;
        assert!((0.28..0.36).contains(&hidden), "{hidden} of the view is hidden");
    }

    /// Bands have what the whole has.
    #[test]
    fn bands_are_those_of_the_whole() {
        let (view, reference) = (wall(0, |_| 2.0), wall(24, |_| 2.0));
        for guidance in [Guidance::default(), Guidance { alignment: true, ..Guidance::default() }] {
            let whole = with_references(&view.rendered, &[&reference], guidance).view;
            let band = ReferenceFeatures::new(&view.rendered, &[&reference], 7..41, guidance);
            assert_eq!(band.known.len(), 34 * WIDTH);
            let expected =
                whole.data[7 * WIDTH * REFERENCE_INPUTS..].chunks_exact(REFERENCE_INPUTS);
            for (found, expected) in band.known.iter().zip(expected) {
                assert!(
                    found.iter().zip(&expected[INPUTS..]).all(|(a, b)| (a - b).abs() < 1e-5),
                    "{found:?} {expected:?}"
                );
            }
        }
    }
}
