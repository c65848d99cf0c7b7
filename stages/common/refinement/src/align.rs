use crate::channels::INPUTS;
use crate::sums::Sums;
use crate::view::{KnownView, Rendered};
use crate::warped_pixel::WarpedPixel;

/// Pixels that a reference is moved at most.
const FARTHEST: f64 = 2.0;

/// What a reference shows of rows from one on, each pixel from where what lies around it fits what
/// is rendered: one step of Lucas and Kanade (1981) from where geometry puts it, held back by the
/// detail that rendering lacks, whose squares stand for how little a difference says of a place.
pub(crate) fn align(
    warped: &[WarpedPixel],
    rendered: &Rendered,
    reference: &KnownView,
    first_row: usize,
) -> Vec<WarpedPixel> {
    let view = &rendered.view;
    let width = view.width;
    let pixel =
        |x: usize, y: usize| &view.data[(y * width + x) * INPUTS..(y * width + x + 1) * INPUTS];
    let slope = |x: usize, y: usize, c: usize| {
        let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
        let (top, bottom) = (y.saturating_sub(1), (y + 1).min(view.height - 1));
        let per = |far: f32, near: f32, pixels: usize| f64::from(far - near) / pixels.max(1) as f64;
        (
            per(pixel(right, y)[c], pixel(left, y)[c], right - left),
            per(pixel(x, bottom)[c], pixel(x, top)[c], bottom - top),
        )
    };
    let terms = |(i, own): (usize, &WarpedPixel)| {
        let mut terms = [0.0; 6];
        for c in (0..3).filter(|_| own.confidence > 0.0) {
            let (x, y) = slope(i % width, first_row + i / width, c);
            let (apart, lacks) = (f64::from(own.difference[c]), f64::from(own.lacking[c]));
            let of_channel = [x * x, x * y, y * y, x * apart, y * apart, lacks * lacks];
            terms.iter_mut().zip(of_channel).for_each(|(sum, term)| *sum += term);
        }
        terms
    };
    let sums = Sums::new(width, &warped.iter().enumerate().map(terms).collect::<Vec<_>>());
    let moved = |(i, own): (usize, &WarpedPixel)| {
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
        let share = (FARTHEST / length).min(1.0);
        let across =
            step((x > 0).then(|| &warped[i - 1]), own, (x + 1 < width).then(|| &warped[i + 1]));
        let down =
            step(i.checked_sub(width).map(|above| &warped[above]), own, warped.get(i + width));
        let place = std::array::from_fn(|k| {
            own.place[k] + (share * (dx * across[k] + dy * down[k])) as f32
        });
        WarpedPixel::new(reference, place, own.visibility, pixel(x, first_row + y))
    };
    warped.iter().enumerate().map(moved).collect()
}

/// How far what a reference shows moves in it from one pixel to the next: the shorter of the steps
/// from the one before and to the one after, for the other may lead over an edge; 0 where neither
/// is shown.
fn step(before: Option<&WarpedPixel>, own: &WarpedPixel, after: Option<&WarpedPixel>) -> [f64; 2] {
    let between = |from: &WarpedPixel, to: &WarpedPixel| {
        let is_shown = from.confidence > 0.0 && to.confidence > 0.0;
        is_shown.then(|| [0, 1].map(|k| f64::from(to.place[k] - from.place[k])))
    };
    let steps = [
        after.and_then(|after| between(own, after)),
        before.and_then(|before| between(before, own)),
    ];
    let length = |[x, y]: &[f64; 2]| x.hypot(*y);
    steps.into_iter().flatten().min_by(|a, b| length(a).total_cmp(&length(b))).unwrap_or([0.0; 2])
}
