//! Reference-based refinement: HR references warped to a view by its depth, and the confidence in
//! them.

use std::ops::Range;

use pixels::Image;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::sums::{COMPARED_RADIUS, Sums};
use crate::view::{INPUTS, KnownView, REFERENCE_INPUTS, Rendered};
use crate::warped_pixel::WarpedPixel;

/// Options for warping references to a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WarpOptions {
    /// True if points that are hidden in a reference, according to its own depth, are excluded.
    pub occlusion: bool,
}

impl Default for WarpOptions {
    /// Returns options that exclude hidden points.
    fn default() -> Self {
        Self { occlusion: true }
    }
}

/// Number of channels of reference features.
const FEATURES: usize = REFERENCE_INPUTS - INPUTS;

/// Statistics of one reference in a view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ReferenceStatistics {
    /// Number of the view's pixels that are visible in the reference.
    #[serde(rename = "seen")]
    pub visible_pixels: usize,
    /// Sum of the visible pixels' visibility, which depends on viewing angle and resolution.
    pub visibility: f64,
    /// Sum of the visible pixels' confidence: visibility, reduced where the reference differs from
    /// the rendered view.
    pub confidence: f64,
}

impl ReferenceStatistics {
    /// Returns the confidence as a fraction of the visibility.
    pub fn confidence_share(&self) -> f64 {
        if self.visibility > 0.0 { self.confidence / self.visibility } else { 1.0 }
    }

    /// Adds statistics of the same reference for other pixels.
    pub fn add(&mut self, other: &Self) {
        self.visible_pixels += other.visible_pixels;
        self.visibility += other.visibility;
        self.confidence += other.confidence;
    }

    /// Adds each reference's statistics for other pixels to its sum.
    pub fn add_each(sums: &mut [Self], others: &[Self]) {
        for (sum, other) in sums.iter_mut().zip(others) {
            sum.add(other);
        }
    }
}

/// View with reference features.
#[derive(Clone, Debug)]
pub struct ConditionedView {
    /// Input of a reference-based refiner: colour, opacity, and the references' difference,
    /// confidence and detail.
    pub view: Image,
    /// Statistics of each reference.
    pub statistics: Vec<ReferenceStatistics>,
}

/// Length of the mean RGB difference around a pixel at which confidence is a quarter of visibility
/// (design note 018).
const DIFFERENCE_AT_QUARTER_CONFIDENCE: f32 = 0.1;
/// Length of the second difference of warped positions at which confidence is half as large, in
/// pixels of the reference; chosen by hand.
const SECOND_DIFFERENCE_AT_HALF_CONFIDENCE: f32 = 1.0;
/// Number of rows of a view that are warped together, so that memory doesn't grow with the view.
const BAND_ROWS: usize = 32;

/// Sums over references at one pixel, weighted by the fourth power of confidence (design note 017).
#[derive(Clone, Copy, Default)]
struct FeatureSums {
    difference: [f32; 3],
    detail: [f32; 3],
    weight: f32,
    max_confidence: f32,
}

impl FeatureSums {
    /// Adds a reference's pixel. Its features fade to 0, the value of an invisible point, as
    /// confidence falls below visibility.
    fn add(&mut self, pixel: &WarpedPixel) {
        let weight = pixel.confidence.powi(4);
        let fade = pixel.confidence / pixel.visibility.max(f32::MIN_POSITIVE);
        for c in 0..3 {
            self.difference[c] += weight * fade * pixel.difference[c];
            self.detail[c] += weight * fade * pixel.detail[c];
        }
        self.weight += weight;
        self.max_confidence = self.max_confidence.max(pixel.confidence);
    }

    /// Returns the features of the pixel:
    /// * colours of references minus those of the render;
    /// * confidence, from 0 (visible in no reference) to 1 (visible in a reference from the same
    ///   direction, at the view's resolution or a finer one, with the rendered colour);
    /// * detail: colours of references minus those of their own renders. Detail helps even if a
    ///   reference displays a point slightly displaced or in another light.
    fn features(self) -> [f32; FEATURES] {
        if self.weight > 0.0 {
            let [r, g, b] = self.difference.map(|v| v / self.weight);
            let [x, y, z] = self.detail.map(|v| v / self.weight);
            [r, g, b, self.max_confidence, x, y, z]
        } else {
            [0.0; FEATURES]
        }
    }
}

/// Warps a reference to rows of a view. Confidence is lower where the reference differs from the
/// rendered view in the mean around a pixel (wrong depth, a moved object, a highlight), and where
/// the warped positions of neighbouring pixels aren't evenly spaced (noisy depth, an edge).
fn warp(
    rendered: &Rendered,
    reference: &KnownView,
    rows: &Range<usize>,
    options: WarpOptions,
) -> Vec<WarpedPixel> {
    let (width, height) = (rendered.view.width, rendered.view.height);
    let first_row = rows.start.saturating_sub(COMPARED_RADIUS);
    let rows_with_margin = first_row..(rows.end + COMPARED_RADIUS).min(height);
    let warped = warp_by_depth(rendered, reference, rows_with_margin, options.occlusion);
    let terms = warped.iter().map(|pixel| {
        let [r, g, b] = pixel.difference.map(f64::from);
        if pixel.confidence > 0.0 { [r, g, b, 1.0] } else { [0.0; 4] }
    });
    let sums = Sums::new(width, &terms.collect::<Vec<_>>());
    let mut pixels = Vec::with_capacity(width * rows.len());
    for y in rows.start - first_row..rows.end - first_row {
        for x in 0..width {
            let mut own = warped[y * width + x];
            if own.confidence > 0.0 {
                let difference = mean_difference(&sums, x, y) / DIFFERENCE_AT_QUARTER_CONFIDENCE;
                let squared = squared_second_differences(&warped, width, x, y);
                own.confidence *= (1.0 + difference * difference).powi(-2)
                    / (1.0 + squared / SECOND_DIFFERENCE_AT_HALF_CONFIDENCE.powi(2));
            }
            pixels.push(own);
        }
    }
    pixels
}

/// Warps a reference to rows of a view by depth alone.
fn warp_by_depth(
    rendered: &Rendered,
    reference: &KnownView,
    rows: Range<usize>,
    occlusion: bool,
) -> Vec<WarpedPixel> {
    let width = rendered.view.width;
    let (surface, theirs) = (rendered.surface(), reference.rendered.surface());
    let mut warped = Vec::with_capacity(width * rows.len());
    for (column, row) in rows.flat_map(|row| (0..width).map(move |column| (column, row))) {
        let projection = if occlusion {
            surface.visible_projection(column, row, &theirs)
        } else {
            surface.projection_ignoring_occlusion(column, row, theirs.camera)
        };
        let Some(projection) = projection else {
            warped.push(WarpedPixel::default());
            continue;
        };
        let visibility = projection.cosine.max(0.0) * projection.relative_resolution.min(1.0);
        let pixel = &rendered.view.data[(row * width + column) * INPUTS..];
        warped.push(WarpedPixel::new(reference, projection.position, visibility, pixel));
    }
    warped
}

/// Returns the length of the mean colour difference around a pixel.
fn mean_difference(sums: &Sums<4>, x: usize, y: usize) -> f32 {
    let [r, g, b, count] = sums.around(x, y);
    [r, g, b].map(|sum| (sum / count.max(1.0)).powi(2)).iter().sum::<f64>().sqrt() as f32
}

/// Returns the squared second differences, a + b - 2·own, of the positions around a pixel of warped
/// rows in a reference: the sum of the horizontal and the vertical one, 0 for one with an invisible
/// neighbour.
fn squared_second_differences(warped: &[WarpedPixel], width: usize, x: usize, y: usize) -> f32 {
    let own = warped[y * width + x].position;
    let neighbour = |dx: isize, dy: isize| {
        let (x, y) = (x.checked_add_signed(dx)?, y.checked_add_signed(dy)?);
        let other = (x < width).then(|| warped.get(y * width + x))??;
        (other.confidence > 0.0).then_some(other.position)
    };
    let squared = |a: Option<[f32; 2]>, b: Option<[f32; 2]>| {
        let Some((a, b)) = a.zip(b) else { return 0.0 };
        (0..2).map(|i| (a[i] + b[i] - 2.0 * own[i]).powi(2)).sum::<f32>()
    };
    squared(neighbour(-1, 0), neighbour(1, 0)) + squared(neighbour(0, -1), neighbour(0, 1))
}

/// Adds reference features to a view. `options` must be those of the refiner
/// ([`crate::RefinerArchitecture::guidance`]).
pub fn with_references(
    rendered: &Rendered,
    references: &[&KnownView],
    options: WarpOptions,
) -> ConditionedView {
    let (width, height) = (rendered.view.width, rendered.view.height);
    let mut data = vec![0.0; width * height * REFERENCE_INPUTS];
    let bands = data.par_chunks_mut(width * BAND_ROWS * REFERENCE_INPUTS).enumerate();
    let parts: Vec<Vec<ReferenceStatistics>> = bands
        .map(|(i, band)| fill_band(band, i * BAND_ROWS, rendered, references, options))
        .collect();
    let mut statistics = vec![ReferenceStatistics::default(); references.len()];
    for part in &parts {
        ReferenceStatistics::add_each(&mut statistics, part);
    }
    ConditionedView { view: Image::new(width, height, REFERENCE_INPUTS, data), statistics }
}

/// Fills a band of rows of a conditioned view, starting at `first_row`; returns the references'
/// statistics.
fn fill_band(
    band: &mut [f32],
    first_row: usize,
    rendered: &Rendered,
    references: &[&KnownView],
    options: WarpOptions,
) -> Vec<ReferenceStatistics> {
    let width = rendered.view.width;
    let rows = first_row..first_row + band.len() / (width * REFERENCE_INPUTS);
    let mut sums = vec![FeatureSums::default(); width * rows.len()];
    let mut statistics = vec![ReferenceStatistics::default(); references.len()];
    for (reference, own) in references.iter().zip(&mut statistics) {
        let warped = warp(rendered, reference, &rows, options);
        for (sums, pixel) in sums.iter_mut().zip(&warped) {
            own.visible_pixels += usize::from(pixel.visibility > 0.0);
            own.visibility += f64::from(pixel.visibility);
            own.confidence += f64::from(pixel.confidence);
            sums.add(pixel);
        }
    }
    let view = &rendered.view.data[first_row * width * INPUTS..];
    for (i, pixel) in band.chunks_exact_mut(REFERENCE_INPUTS).enumerate() {
        pixel[..INPUTS].copy_from_slice(&view[i * INPUTS..(i + 1) * INPUTS]);
        pixel[INPUTS..].copy_from_slice(&sums[i].features());
    }
    statistics
}

#[cfg(test)]
mod tests {
    use numerics::uniform;
    use scene::{Camera, Intrinsics};

    use super::*;

    const WIDTH: usize = 96;
    const HEIGHT: usize = 48;

    /// Returns a colour channel of the wall at a pixel of [`wall`]'s view.
    fn level(right: usize, x: isize, y: isize, c: u64) -> f32 {
        let patch = (x + right as isize).div_euclid(6) * 1000 + y.div_euclid(6);
        0.2 + 0.6 * uniform(4, c, patch as u64)
    }

    fn blurred(right: usize, x: isize, y: isize, c: u64) -> f32 {
        (-1..=1).map(|i| level(right, x + i, y - i, c) + level(right, x + i, y + i, c)).sum::<f32>()
            / 6.0
    }

    /// Returns a view of a wall at distance 2 with patches of six pixels; the render is blurred.
    /// The camera is `right` pixels to the right, and `depth` is the rendered depth.
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

    /// Returns the fraction of the view's pixels that are visible in the reference, their mean
    /// confidence, and the mean error of warped colours, weighted by confidence.
    fn warp_quality(
        view: &KnownView,
        reference: &KnownView,
        options: WarpOptions,
    ) -> (f64, f64, f64) {
        let ConditionedView { view: conditioned, statistics } =
            with_references(&view.rendered, &[reference], options);
        let visible_pixels = statistics[0].visible_pixels;
        let (visible, confidence) = (
            visible_pixels as f64 / (WIDTH * HEIGHT) as f64,
            statistics[0].confidence / visible_pixels.max(1) as f64,
        );
        let (mut weighted_sum, mut weight_sum) = (0.0, 0.0);
        for (pixel, truth) in
            conditioned.data.chunks_exact(REFERENCE_INPUTS).zip(view.truth.data.chunks_exact(3))
        {
            let error =
                (0..3).map(|c| f64::from(pixel[c] + pixel[4 + c] - truth[c]).abs()).sum::<f64>()
                    / 3.0;
            weighted_sum += error * f64::from(pixel[7]);
            weight_sum += f64::from(pixel[7]);
        }
        (visible, confidence, weighted_sum / f64::max(weight_sum, 1e-9))
    }

    #[test]
    fn confidence_falls_where_reference_and_render_differ() {
        let (view, reference) = (wall(0, |_| 2.0), wall(24, |_| 2.0));
        let (visible, confidence, error) = warp_quality(&view, &reference, WarpOptions::default());
        assert!(
            (0.7..0.8).contains(&visible) && confidence > 0.85 && error < 0.01,
            "correct: {visible} {confidence} {error}"
        );
        // Depth 3 instead of 2 displaces warped references by eight pixels.
        let (_, confidence, _) =
            warp_quality(&wall(0, |_| 3.0), &wall(24, |_| 3.0), WarpOptions::default());
        assert!(confidence < 0.5, "shifted: {confidence}");
        // Depths with noise within the tolerance of the visibility test, from a distant camera.
        let noisy = |seed: u64| move |i: usize| 2.0 + 0.03 * (uniform(seed, 1, i as u64) - 0.5);
        let (_, noiseless, _) =
            warp_quality(&wall(0, |_| 2.0), &wall(60, |_| 2.0), WarpOptions::default());
        let (_, confidence, _) =
            warp_quality(&wall(0, noisy(1)), &wall(60, noisy(2)), WarpOptions::default());
        assert!(confidence < 0.8 * noiseless, "noisy: {confidence} of {noiseless}");
        // A reference with other colours.
        let mut recoloured = wall(24, |_| 2.0);
        recoloured.truth.data.iter_mut().for_each(|v| *v = 1.0 - *v);
        let (_, confidence, _) = warp_quality(&view, &recoloured, WarpOptions::default());
        assert!(confidence < 0.5, "recoloured: {confidence}");
        // A reference that observes another part of the wall.
        assert_eq!(warp_quality(&view, &wall(500, |_| 2.0), WarpOptions::default()).0, 0.0);
    }

    fn visible_pixels(view: &KnownView, reference: &KnownView, occlusion: bool) -> usize {
        let options = WarpOptions { occlusion };
        with_references(&view.rendered, &[reference], options).statistics[0].visible_pixels
    }

    #[test]
    fn hidden_points_are_warped_only_without_the_occlusion_test() {
        // A plate hides the middle third of the reference.
        let plate =
            |i: usize| if (WIDTH / 3..2 * WIDTH / 3).contains(&(i % WIDTH)) { 1.0 } else { 2.0 };
        let (view, reference) = (wall(0, |_| 2.0), wall(24, plate));
        let hidden = (visible_pixels(&view, &reference, false)
            - visible_pixels(&view, &reference, true)) as f64
            / (WIDTH * HEIGHT) as f64;
        assert!((0.28..0.36).contains(&hidden), "{hidden} of the view is hidden");
    }

    #[test]
    fn features_of_a_band_equal_those_of_the_complete_view() {
        let (view, reference) = (wall(0, |_| 2.0), wall(24, |_| 2.0));
        let options = WarpOptions::default();
        let complete = with_references(&view.rendered, &[&reference], options).view;
        let mut band = vec![0.0; 34 * WIDTH * REFERENCE_INPUTS];
        fill_band(&mut band, 7, &view.rendered, &[&reference], options);
        for (found, expected) in band.iter().zip(&complete.data[7 * WIDTH * REFERENCE_INPUTS..]) {
            assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        }
    }
}
