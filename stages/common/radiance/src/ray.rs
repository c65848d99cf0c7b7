use scene::Bounds;

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

/// A ray in the unit cube: p(t) = origin + t·direction, with t the distance in cube sides.
#[derive(Clone, Copy, Debug)]
pub(crate) struct UnitRay {
    pub(crate) origin: [f32; 3],
    pub(crate) direction: [f32; 3],
    /// Where it enters and leaves the box; nothing when `enter >= leave`.
    pub(crate) enter: f32,
    pub(crate) leave: f32,
}

/// Clips a ray to the box and the range of distances, in units of the box's longest side. Computed in f64, so that scenes of
/// 1e-6 and 1e6 units lose nothing.
pub(crate) fn clip(bounds: &Bounds, ray: &Ray) -> UnitRay {
    let side = bounds.longest_side();
    let (mut enter, mut leave) = (bounds.near / side, bounds.far / side);
    let mut origin = [0.0f32; 3];
    let mut usable = false;
    for i in 0..3 {
        let o = (f64::from(ray.origin[i]) - bounds.min[i]) / side;
        let d = f64::from(ray.direction[i]);
        let extent = (bounds.max[i] - bounds.min[i]) / side;
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
            let bounds = Bounds { min: [-scale; 3], max: [scale; 3], near: 0.0, far: 100.0 * scale };
            let hit = clip(&bounds, &ray([0., 0., 4. * s], [0., 0., -1.]));
            assert!((hit.enter - 1.5).abs() < 1e-5 && (hit.leave - 2.5).abs() < 1e-5, "{hit:?}");
            // Starting inside, missing, parallel to a face inside and outside, behind, zero length, NaN.
            assert_eq!(clip(&bounds, &ray([0.; 3], [1., 0., 0.])).enter, 0.0);
            for (o, d) in [
                ([0., 3., 4.], [0., 0., -1.]),
                ([2., 0., 0.], [0., 1., 0.]),
                ([0., 0., 4.], [0., 0., 1.]),
                ([0.; 3], [0.; 3]),
                ([0.; 3], [f32::NAN, 0., 1.]),
            ] {
                let miss = clip(&bounds, &ray(o.map(|x| x * s), d));
                assert!(miss.enter >= miss.leave, "{o:?} {d:?}: {miss:?}");
            }
        }
    }
}
