use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A ray in scene units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Ray {
    /// Where it starts.
    pub origin: [f32; 3],
    /// Unit length; a direction that isn't finite or is zero sees the background alone.
    pub direction: [f32; 3],
    /// What it sees where nothing stands in its way.
    pub background: [f32; 3],
}

/// Where the field lies: an axis-aligned box, and the distances along rays at which to look.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Space {
    /// Smallest corner.
    pub min: [f64; 3],
    /// Largest corner.
    pub max: [f64; 3],
    /// Nothing before this distance.
    pub near: f64,
    /// Nothing behind this distance.
    pub far: f64,
}

/// A ray in the unit cube: p(t) = origin + t·direction, with t the distance in cube sides.
#[derive(Clone, Copy, Debug)]
pub(crate) struct UnitRay {
    pub(crate) origin: [f32; 3],
    pub(crate) direction: [f32; 3],
    /// Where it enters and leaves the box; nothing when `enter >= leave`.
    pub(crate) enter: f32,
    pub(crate) leave: f32,
}

impl Space {
    /// A box with a range of distances.
    pub fn new(min: [f64; 3], max: [f64; 3], near: f64, far: f64) -> Self {
        Self { min, max, near, far }
    }

    /// Longest side: what one unit inside stands for.
    pub(crate) fn side(&self) -> f64 {
        (0..3).map(|i| self.max[i] - self.min[i]).fold(f64::MIN_POSITIVE, f64::max)
    }

    /// Whether the box has an inside and the range a length.
    pub fn is_valid(&self) -> bool {
        let finite = self.min.iter().chain(&self.max).chain([&self.near, &self.far]).all(|x| x.is_finite());
        finite && (0..3).all(|i| self.min[i] < self.max[i]) && 0.0 <= self.near && self.near < self.far
    }

    /// Clips a ray to the box and the range. Computed in f64, so that scenes of 1e-6 and 1e6 units lose nothing.
    pub(crate) fn clip(&self, ray: &Ray) -> UnitRay {
        let side = self.side();
        let (mut enter, mut leave) = (self.near / side, self.far / side);
        let mut origin = [0.0f32; 3];
        let mut usable = false;
        for i in 0..3 {
            let o = (f64::from(ray.origin[i]) - self.min[i]) / side;
            let d = f64::from(ray.direction[i]);
            let extent = (self.max[i] - self.min[i]) / side;
            origin[i] = o as f32;
            usable |= d != 0.0;
            if d == 0.0 {
                // Parallel to these faces: inside for ever, or never.
                if !(0.0..=extent).contains(&o) {
                    leave = f64::NEG_INFINITY;
                }
            } else {
                let (a, b) = (-o / d, (extent - o) / d);
                enter = enter.max(a.min(b));
                leave = leave.min(a.max(b));
            }
        }
        // A NaN anywhere fails this comparison.
        let usable = usable && enter < leave && ray.direction.iter().chain(&ray.origin).all(|x| x.is_finite());
        let (enter, leave) = if usable { (enter as f32, leave as f32) } else { (0.0, 0.0) };
        UnitRay { origin, direction: ray.direction, enter, leave }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(origin: [f32; 3], direction: [f32; 3]) -> Ray {
        Ray { origin, direction, background: [1.0; 3] }
    }

    #[test]
    fn rays_meet_the_box_or_not() {
        for scale in [1e-6, 1.0, 1e6f64] {
            let s = scale as f32;
            let space = Space::new([-scale; 3], [scale; 3], 0.0, 100.0 * scale);
            let hit = space.clip(&ray([0., 0., 4. * s], [0., 0., -1.]));
            assert!((hit.enter - 1.5).abs() < 1e-5 && (hit.leave - 2.5).abs() < 1e-5, "{hit:?}");
            // Starting inside, missing, parallel to a face inside and outside, behind, zero length, NaN.
            assert_eq!(space.clip(&ray([0.; 3], [1., 0., 0.])).enter, 0.0);
            for (o, d) in [
                ([0., 3., 4.], [0., 0., -1.]),
                ([2., 0., 0.], [0., 1., 0.]),
                ([0., 0., 4.], [0., 0., 1.]),
                ([0.; 3], [0.; 3]),
                ([0.; 3], [f32::NAN, 0., 1.]),
            ] {
                let miss = space.clip(&ray(o.map(|x| x * s), d));
                assert!(miss.enter >= miss.leave, "{o:?} {d:?}: {miss:?}");
            }
        }
    }
}
