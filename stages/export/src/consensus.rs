use rayon::prelude::*;
use stage::Progress;

use crate::surface_view::{PointState, SurfaceView};

/// Maximum distance in pixel widths at which views observe the same surface (design note 043).
const MAX_DISTANCE_PIXELS: f64 = 2.0;
/// Minimum cosine between normals at which views observe the same side of a surface: 45° (design
/// note 043). Thin objects have another side close by.
const MIN_SAME_SIDE_COSINE: f64 = 0.7;

/// Moves every pixel's point to the mean of the surfaces that all views observe there. Removes
/// points where too many views observe empty space, such as floaters and false points along edges.
pub(crate) fn apply_consensus(views: &mut [SurfaceView], progress: &Progress) {
    let shifts: Vec<Vec<(usize, Option<f32>)>> = views
        .par_iter()
        .map(|view| {
            let shifts = view
                .surface_pixels()
                .map(|(index, _)| (index, consensus_shift(views, view, index)))
                .collect();
            progress.add(1);
            shifts
        })
        .collect();
    for (i, shifts) in shifts.into_iter().enumerate() {
        let view = &mut views[i];
        for (index, shift) in shifts {
            match shift {
                Some(shift) => view.move_along_normal(index, shift),
                None => view.remove_surface(index),
            }
        }
    }
}

/// Returns the distance by which a pixel's point moves along its normal; `None` if the point is
/// removed, because more than half as many views see through it as observe it.
fn consensus_shift(views: &[SurfaceView], view: &SurfaceView, index: usize) -> Option<f32> {
    let (point, normal) = (view.world_point(index), view.world_normal(index));
    let max_distance = (MAX_DISTANCE_PIXELS * view.pixel_width(index)) as f32;
    let (mut sum, mut weights) = (0.0, 0.0);
    // At least one view observes the point: its own.
    let (mut observing, mut seeing_through) = (0, 0);
    for other in views {
        match other.point_state(point, max_distance) {
            PointState::Surface { distance, cosine, index }
                if other.world_normal(index).dot(normal) > MIN_SAME_SIDE_COSINE =>
            {
                let weight = cosine.max(0.05);
                sum += weight * distance;
                weights += weight;
                observing += 1;
            }
            PointState::Empty => seeing_through += 1,
            _ => {}
        }
    }
    (2 * seeing_through <= observing).then(|| -sum / weights)
}
