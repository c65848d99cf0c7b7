//! Depth ranges from a model's points.

use std::collections::{BTreeMap, BTreeSet};

use artifact::format_count;
use glam::DVec3;
use scene::Intrinsics;

use super::model::Image;

/// Ball within which photographs determine a point's depth: outside it, the two cameras farthest
/// apart observe a point in directions that differ by less than a pixel.
///
/// COLMAP's own points are far inside: COLMAP keeps points whose rays meet at 1.5° or more
/// (`Mapper.filter_min_tri_angle`), so within 38 times the distance between two cameras. At a focal
/// length of 1,000 pixels the limit is 1,000 times this distance.
pub(super) struct Reach {
    centre: DVec3,
    radius: f64,
}

impl Reach {
    /// Creates the reach of cameras with these centres and at most this focal length in pixels.
    /// `None` for cameras at one position, which determine no depth.
    pub(super) fn new(centres: &[DVec3], focal: f64) -> Option<Self> {
        let centre = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        let extent = centres.iter().map(|c| (*c - centre).length()).fold(0.0, f64::max);
        (extent > 0.0).then_some(Self { centre, radius: 2.0 * extent * focal.max(1.0) })
    }

    /// True if a point is within reach; false if it isn't finite.
    pub(super) fn contains(&self, point: DVec3) -> bool {
        (point - self.centre).length() <= self.radius
    }
}

/// Describes removed points for the log.
pub(super) fn removed_points_note(removed: usize, all: usize) -> String {
    format!(
        "{removed} of {} removed: too far from the cameras to have a measurable depth",
        format_count(all, "point")
    )
}

/// Quantiles of the points' depths that bound a view; a few points are always wrong. Chosen by
/// hand.
const DEPTH_QUANTILES: [f64; 2] = [0.001, 0.999];

/// Returns the [`DEPTH_QUANTILES`] of the depths of the points that an image observes, or of their
/// distances with a fisheye lens. `None` unless the quantiles differ.
pub(super) fn depth_range(
    image: &Image,
    camera: &Intrinsics,
    points: &BTreeMap<u64, DVec3>,
) -> Option<[f64; 2]> {
    let observed: BTreeSet<u64> = image.points.iter().copied().collect();
    let mut depths: Vec<f64> = Vec::new();
    for point in observed.iter().filter_map(|id| points.get(id)) {
        let p = image.rotation * *point + image.translation;
        let depth = if camera.distortion.is_fisheye() { p.length() } else { p.z };
        if depth.is_finite() && depth > 0.0 {
            depths.push(depth);
        }
    }
    depths.sort_unstable_by(f64::total_cmp);
    let last = depths.len().checked_sub(1)?;
    let [near, far] = DEPTH_QUANTILES.map(|q| depths[(q * last as f64).round() as usize]);
    (near < far).then_some([near, far])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_without_parallax_are_outside() {
        for scale in [1e-6, 1.0, 1e6] {
            let middle = scale * DVec3::new(100.0, 0.0, 0.0);
            let centres = [-2.0, 0.0, 2.0].map(|x| middle + scale * DVec3::new(x, 0.0, 0.0));
            let reach = Reach::new(&centres, 500.0).unwrap();
            let is_inside = |distance: f64| reach.contains(middle + distance * scale * DVec3::Y);
            assert_eq!([0.0, 38.0 * 4.0, 1_999.0].map(is_inside), [true; 3]);
            assert_eq!([2_001.0, 1e10, 1e300, f64::INFINITY, f64::NAN].map(is_inside), [false; 5]);
            assert!(Reach::new(&centres[..1], 500.0).is_none());
            assert!(Reach::new(&[], 500.0).is_none());
        }
    }
}
