use glam::DVec3;
use rayon::prelude::*;
use stage::Progress;

use crate::lattice::Lattice;
use crate::seen::{SeenView, Sight};

/// A surface counts up to so many spacings from it: more than noise, less than what is thin.
const REACH_SPACINGS: f64 = 2.5;

/// Signed distances from the surface at a lattice's places, in shares of the reach: below 0 inside,
/// 1 where nothing is near. Each is the mean of what the views say (Curless and Levoy 1996), NaN
/// where no view sees anything.
pub(crate) fn fuse(views: &[SeenView], lattice: &Lattice, progress: &Progress) -> Vec<f32> {
    let [nx, ny, _] = lattice.counts;
    let occupied = occupied_box(views);
    let mut values = vec![f32::NAN; lattice.len()];
    values.par_chunks_mut(nx).enumerate().for_each(|(row, values)| {
        for (i, value) in values.iter_mut().enumerate() {
            *value = value_at(views, occupied, lattice, [i, row % ny, row / ny]);
        }
        progress.add(1);
    });
    values
}

/// Distance from a surface up to which it counts, near a place of a lattice, in scene units.
pub(crate) fn reach(lattice: &Lattice, place: [f64; 3]) -> f32 {
    (REACH_SPACINGS * lattice.spacing_at(place)) as f32
}

/// The box around all surfaces that the views see.
fn occupied_box(views: &[SeenView]) -> [DVec3; 2] {
    let points = views.iter().flat_map(|v| v.surface().map(|(at, _)| v.world_point(at)));
    let none = [DVec3::INFINITY, DVec3::NEG_INFINITY];
    points.fold(none, |[min, max], point| [min.min(point), max.max(point)])
}

fn value_at(
    views: &[SeenView],
    [min, max]: [DVec3; 2],
    lattice: &Lattice,
    place: [usize; 3],
) -> f32 {
    let place = place.map(|i| i as f64);
    let point = lattice.point(place);
    let reach = reach(lattice, place);
    let margin = DVec3::splat(2.0 * f64::from(reach));
    if point.cmplt(min - margin).any() || point.cmpgt(max + margin).any() {
        // No surface is near, so one view that sees it knows enough.
        let is_seen = views.iter().any(|view| view.look(point, reach) == Sight::Empty);
        return if is_seen { 1.0 } else { f32::NAN };
    }
    let (mut sum, mut weights) = (0.0, 0.0);
    for view in views {
        let (value, weight) = match view.look(point, reach) {
            Sight::Hidden => continue,
            Sight::Empty => (1.0, 1.0),
            // Behind a surface there may soon be its other side.
            Sight::Surface { distance, cosine, .. } => {
                let value = distance / reach;
                (value, cosine.max(0.0) * (1.0 + value).min(1.0))
            }
        };
        sum += value * weight;
        weights += weight;
    }
    if weights > 0.0 { sum / weights } else { f32::NAN }
}
