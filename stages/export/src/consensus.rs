use rayon::prelude::*;
use stage::Progress;

use crate::seen::{SeenView, Sight};

/// Views see one surface where they agree to so many pixel widths.
const AGREEMENT_PIXELS: f64 = 2.0;
/// They see one side of it where the cosine between their normals is larger: normals agree to 45°.
/// Thin things have another side.
const MERGED_SIDE_COSINE: f64 = 0.7;

/// Moves what each view sees to the mean of what all views see of the same surface, and drops what
/// more than a third of them look through: floaters, and fringes of edges.
pub(crate) fn agree(views: &mut [SeenView], progress: &Progress) {
    let agreed: Vec<Vec<(usize, Option<f32>)>> = views
        .par_iter()
        .map(|view| {
            let shifts = view.surface().map(|(at, _)| (at, shift(views, view, at))).collect();
            progress.add(1);
            shifts
        })
        .collect();
    for (view, agreed) in views.iter_mut().zip(agreed) {
        for (at, shift) in agreed {
            match shift {
                Some(shift) => view.move_along_normal(at, shift),
                None => view.forget(at),
            }
        }
    }
}

/// How far a pixel's point is moved along its normal; `None` where it is dropped.
fn shift(views: &[SeenView], view: &SeenView, at: usize) -> Option<f32> {
    let (point, normal) = (view.world_point(at), view.world_normal(at));
    let reach = (AGREEMENT_PIXELS * view.footprint(at)) as f32;
    let (mut sum, mut weights, mut seen, mut looked_through) = (0.0, 0.0, 0, 0);
    for other in views {
        match other.look(point, reach) {
            Sight::Surface { distance, cosine, index }
                if other.world_normal(index).dot(normal) > MERGED_SIDE_COSINE =>
            {
                let weight = cosine.max(0.05);
                sum += weight * distance;
                weights += weight;
                seen += 1;
            }
            Sight::Empty => looked_through += 1,
            _ => {}
        }
    }
    // It sees the point itself.
    (2 * looked_through <= seen).then(|| -sum / weights)
}
