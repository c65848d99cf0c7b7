use artifact::counted;
use glam::DVec3;

/// Space in which photographs tell a point's depth: up to where the same point would be seen by the
/// two cameras farthest apart in directions that differ by less than a pixel.
///
/// COLMAP's own points lie far inside: COLMAP keeps those whose rays meet at 1.5° at least
/// (`Mapper.filter_min_tri_angle`), so within 38 times the distance between two cameras. At a focal
/// length of 1,000 pixels the limit is 1,000 times this distance.
pub(crate) struct Reach {
    middle: DVec3,
    distance: f64,
}

impl Reach {
    /// Creates the reach of cameras with these centres and at most this focal length in pixels.
    /// `None` for cameras in one place, which tell no depth.
    pub(crate) fn new(centres: &[DVec3], focal: f64) -> Option<Self> {
        let middle = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        let radius = centres.iter().map(|c| (*c - middle).length()).fold(0.0, f64::max);
        (radius > 0.0).then_some(Self { middle, distance: 2.0 * radius * focal.max(1.0) })
    }

    /// True if a point's depth can be told; false for one that isn't finite.
    pub(crate) fn contains(&self, point: DVec3) -> bool {
        (point - self.middle).length() <= self.distance
    }

    /// Returns a note on the points that are left out.
    pub(crate) fn note(&self, wild: usize, all: usize) -> String {
        let are = if wild == 1 { "is" } else { "are" };
        format!(
            "{wild} of {} {are} left out: too far away for the photographs to tell any depth",
            counted(all, "point")
        )
    }
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
