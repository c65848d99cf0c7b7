use pixels::Image;

use crate::sums::Sums;
use crate::view::{INPUTS, KnownView, Rendered};
use crate::warped_pixel::WarpedPixel;

/// Maximum distance in pixels that a reference's pixel is moved; chosen by hand.
const MAX_SHIFT_PIXELS: f64 = 2.0;

/// Moves each warped pixel of a band of rows, starting at `first_row`, to the position in the
/// reference where its neighbourhood fits the rendered view best.
///
/// One step of Lucas and Kanade (1981) from the position given by geometry. The step is damped by
/// the squared detail that rendering lacks, since that detail, too, makes the images differ (design
/// note 018).
pub(crate) fn align(
    warped: &[WarpedPixel],
    rendered: &Rendered,
    reference: &KnownView,
    first_row: usize,
) -> Vec<WarpedPixel> {
    let rows = WarpedRows { warped, view: &rendered.view, first_row };
    let terms: Vec<[f64; 6]> = (0..warped.len()).map(|i| rows.normal_terms(i)).collect();
    let sums = Sums::new(rows.view.width, &terms);
    (0..warped.len()).map(|i| rows.aligned(i, &sums, reference)).collect()
}

/// Rows of a view with a reference's warped pixels.
struct WarpedRows<'a> {
    warped: &'a [WarpedPixel],
    view: &'a Image,
    first_row: usize,
}

impl WarpedRows<'_> {
    /// Returns a pixel of the view.
    fn pixel(&self, x: usize, y: usize) -> &[f32] {
        let start = (y * self.view.width + x) * INPUTS;
        &self.view.data[start..start + INPUTS]
    }

    /// Returns the horizontal and vertical gradient of a channel of the view.
    fn gradient(&self, x: usize, y: usize, c: usize) -> (f64, f64) {
        let (left, right) = (x.saturating_sub(1), (x + 1).min(self.view.width - 1));
        let (top, bottom) = (y.saturating_sub(1), (y + 1).min(self.view.height - 1));
        let dx = self.pixel(right, y)[c] - self.pixel(left, y)[c];
        let dy = self.pixel(x, bottom)[c] - self.pixel(x, top)[c];
        let (width, height) = ((right - left).max(1) as f64, (bottom - top).max(1) as f64);
        (f64::from(dx) / width, f64::from(dy) / height)
    }

    /// Returns a pixel's contribution to the normal equations of the pixels around it: xx, xy, yy,
    /// x and y times the difference, and the squared missing detail.
    fn normal_terms(&self, i: usize) -> [f64; 6] {
        let (own, width) = (&self.warped[i], self.view.width);
        let mut terms = [0.0; 6];
        if own.confidence <= 0.0 {
            return terms;
        }
        for c in 0..3 {
            let (x, y) = self.gradient(i % width, self.first_row + i / width, c);
            let (difference, detail) = (f64::from(own.difference[c]), f64::from(own.detail[c]));
            let channel = [x * x, x * y, y * y, x * difference, y * difference, detail * detail];
            for (sum, term) in terms.iter_mut().zip(channel) {
                *sum += term;
            }
        }
        terms
    }

    /// Returns a pixel moved to the position where it fits best.
    fn aligned(&self, i: usize, sums: &Sums<6>, reference: &KnownView) -> WarpedPixel {
        let (warped, own, width) = (self.warped, &self.warped[i], self.view.width);
        if own.confidence <= 0.0 {
            return *own;
        }
        let (x, y) = (i % width, i / width);
        let [xx, xy, yy, x_difference, y_difference, damping] = sums.around(x, y);
        let (xx, yy) = (xx + damping, yy + damping);
        let determinant = xx * yy - xy * xy;
        let dx = (xy * y_difference - yy * x_difference) / determinant;
        let dy = (xy * x_difference - xx * y_difference) / determinant;
        let length = dx.hypot(dy);
        // Not finite if the determinant is 0: the view is flat and lacks no detail.
        if !length.is_finite() || length == 0.0 {
            return *own;
        }
        let scale = (MAX_SHIFT_PIXELS / length).min(1.0);
        let left = if x > 0 { Some(&warped[i - 1]) } else { None };
        let right = if x + 1 < width { Some(&warped[i + 1]) } else { None };
        let above = i.checked_sub(width).map(|above| &warped[above]);
        let across = shorter_step(left, own, right);
        let down = shorter_step(above, own, warped.get(i + width));
        let position = std::array::from_fn(|k| {
            own.position[k] + (scale * (dx * across[k] + dy * down[k])) as f32
        });
        WarpedPixel::new(reference, position, own.visibility, self.pixel(x, self.first_row + y))
    }
}

/// Returns the step in the reference from one pixel of the view to the next: the shorter of the
/// steps from the pixel before and to the pixel after, since the longer one may cross an edge; 0 if
/// neither neighbour is visible.
fn shorter_step(
    before: Option<&WarpedPixel>,
    own: &WarpedPixel,
    after: Option<&WarpedPixel>,
) -> [f64; 2] {
    let steps = [
        after.and_then(|after| step_between(own, after)),
        before.and_then(|before| step_between(before, own)),
    ];
    let steps = steps.into_iter().flatten();
    steps.min_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1]))).unwrap_or([0.0; 2])
}

/// Returns the step in the reference between two pixels if both are visible there.
fn step_between(from: &WarpedPixel, to: &WarpedPixel) -> Option<[f64; 2]> {
    let is_visible = from.confidence > 0.0 && to.confidence > 0.0;
    is_visible.then(|| [0, 1].map(|k| f64::from(to.position[k] - from.position[k])))
}
