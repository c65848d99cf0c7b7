use pixels::Picture;
use rayon::prelude::*;
use scene::Surface;

use crate::refiner::{GUIDED_INPUTS, INPUTS};
use crate::view::{KnownView, Rendered};

/// What references know of a pixel of a view: how the colour they show there differs from the rendered one, and how far they can be trusted,
/// from 0 (none of them sees it) to 1 (one sees it from the same direction, as large).
pub(crate) fn guide<'a>(
    surface: &Surface<'_>,
    references: impl Iterator<Item = &'a KnownView>,
    (column, row): (usize, usize),
    rendered: &[f32],
) -> [f32; 4] {
    let (mut sum, mut weights, mut confidence) = ([0.0f32; 3], 0.0, 0.0f32);
    for reference in references {
        let Some(sight) = surface.sight(column, row, &reference.rendered.surface()) else { continue };
        let trust = sight.cosine.max(0.0) * sight.detail.min(1.0);
        // The best counts most.
        let weight = trust.powi(4);
        let colour = reference.truth.colour_at(sight.place);
        (0..3).for_each(|c| sum[c] += weight * colour[c]);
        weights += weight;
        confidence = confidence.max(trust);
    }
    if weights <= 0.0 {
        return [0.0; 4];
    }
    let [r, g, b] = [0, 1, 2].map(|c| sum[c] / weights - rendered[c]);
    [r, g, b, confidence]
}

/// A view with what references know of it, as a guided refiner takes it: colour, opacity, difference to the references, their confidence.
pub fn guided(rendered: &Rendered, references: &[&KnownView]) -> Picture {
    let (view, surface) = (&rendered.view, rendered.surface());
    let mut data = vec![0.0; view.width * view.height * GUIDED_INPUTS];
    let rows = data.par_chunks_exact_mut(view.width * GUIDED_INPUTS).zip(view.data.par_chunks_exact(view.width * INPUTS));
    rows.enumerate().for_each(|(row, (out, pixels))| {
        let pixels = out.chunks_exact_mut(GUIDED_INPUTS).zip(pixels.chunks_exact(INPUTS));
        for (column, (out, pixel)) in pixels.enumerate() {
            out[..INPUTS].copy_from_slice(pixel);
            out[INPUTS..].copy_from_slice(&guide(&surface, references.iter().copied(), (column, row), pixel));
        }
    });
    Picture::new(view.width, view.height, GUIDED_INPUTS, data)
}
