use pixels::Image;

use crate::channels::INPUTS;
use crate::sums::Sums;
use crate::view::{KnownView, Rendered};
use crate::warped_pixel::WarpedPixel;

/// Pixels that a reference is moved at most.
const MOST_SHIFT_PIXELS: f64 = 2.0;

/// What a reference shows of rows from one on, each pixel from where what lies around it fits what
/// is rendered: one step of Lucas and Kanade (1981) from where geometry puts it, held back by the
/// detail that rendering lacks, whose squares stand for how little a difference says of a place.
pub(crate) fn align(
    warped: &[WarpedPixel],
    rendered: &Rendered,
    reference: &KnownView,
    first_row: usize,
) -> Vec<WarpedPixel> {
    let rows = WarpedRows { warped, view: &rendered.view, first_row };
    let terms: Vec<[f64; 6]> = (0..warped.len()).map(|i| rows.terms(i)).collect();
    let sums = Sums::new(rows.view.width, &terms);
    (0..warped.len()).map(|i| rows.moved(i, &sums, reference)).collect()
}

/// What a reference shows of rows of a view from one on.
struct WarpedRows<'a> {
    warped: &'a [WarpedPixel],
    view: &'a Image,
    first_row: usize,
}

impl WarpedRows<'_> {
    /// A pixel of the view.
    fn pixel(&self, x: usize, y: usize) -> &[f32] {
        let at = y * self.view.width + x;
        &self.view.data[at * INPUTS..(at + 1) * INPUTS]
    }

    /// How a channel of the view rises across and down.
    fn slope(&self, x: usize, y: usize, c: usize) -> (f64, f64) {
        let (left, right) = (x.saturating_sub(1), (x + 1).min(self.view.width - 1));
        let (top, bottom) = (y.saturating_sub(1), (y + 1).min(self.view.height - 1));
        let per = |far: f32, near: f32, pixels: usize| f64::from(far - near) / pixels.max(1) as f64;
        (
            per(self.pixel(right, y)[c], self.pixel(left, y)[c], right - left),
            per(self.pixel(x, bottom)[c], self.pixel(x, top)[c], bottom - top),
        )
    }

    /// What a pixel adds to the normal equations of those around it.
    fn terms(&self, i: usize) -> [f64; 6] {
        let (own, width) = (&self.warped[i], self.view.width);
        let mut terms = [0.0; 6];
        for c in (0..3).filter(|_| own.confidence > 0.0) {
            let (x, y) = self.slope(i % width, self.first_row + i / width, c);
            let (apart, lacks) = (f64::from(own.difference[c]), f64::from(own.lacking[c]));
            let of_channel = [x * x, x * y, y * y, x * apart, y * apart, lacks * lacks];
            terms.iter_mut().zip(of_channel).for_each(|(sum, term)| *sum += term);
        }
        terms
    }

    /// What the reference shows of a pixel where it fits best.
    fn moved(&self, i: usize, sums: &Sums<6>, reference: &KnownView) -> WarpedPixel {
        let (warped, own, width) = (self.warped, &self.warped[i], self.view.width);
        if own.confidence <= 0.0 {
            return *own;
        }
        let (x, y) = (i % width, i / width);
        let [xx, xy, yy, x_apart, y_apart, lacks] = sums.around(x, y);
        let (xx, yy) = (xx + lacks, yy + lacks);
        // Where all is flat and nothing is lacking it stays: what is divided by 0 isn't finite.
        let determinant = xx * yy - xy * xy;
        let (dx, dy) = (
            (xy * y_apart - yy * x_apart) / determinant,
            (xy * x_apart - xx * y_apart) / determinant,
        );
        let length = dx.hypot(dy);
        if !length.is_finite() || length == 0.0 {
            return *own;
        }
        let share = (MOST_SHIFT_PIXELS / length).min(1.0);
        let across =
            step((x > 0).then(|| &warped[i - 1]), own, (x + 1 < width).then(|| &warped[i + 1]));
        let down =
            step(i.checked_sub(width).map(|above| &warped[above]), own, warped.get(i + width));
        let place = std::array::from_fn(|k| {
            own.place[k] + (share * (dx * across[k] + dy * down[k])) as f32
        });
        WarpedPixel::new(reference, place, own.visibility, self.pixel(x, self.first_row + y))
    }
}

/// How far what a reference shows moves in it from one pixel to the next: the shorter of the steps
/// from the one before and to the one after, for the other may lead over an edge; 0 where neither
/// is shown.
fn step(before: Option<&WarpedPixel>, own: &WarpedPixel, after: Option<&WarpedPixel>) -> [f64; 2] {
    let steps = [
        after.and_then(|after| between(own, after)),
        before.and_then(|before| between(before, own)),
    ];
    let length = |[x, y]: &[f64; 2]| x.hypot(*y);
    steps.into_iter().flatten().min_by(|a, b| length(a).total_cmp(&length(b))).unwrap_or([0.0; 2])
}

/// The step from one pixel to another, where both are shown.
fn between(from: &WarpedPixel, to: &WarpedPixel) -> Option<[f64; 2]> {
    let is_shown = from.confidence > 0.0 && to.confidence > 0.0;
    is_shown.then(|| [0, 1].map(|k| f64::from(to.place[k] - from.place[k])))
}
