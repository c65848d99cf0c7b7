use glam::DVec3;
use scene::{Bounds, Frustum, Space};

/// Evenly spaced places: in the world, or in NDC in a frustum's cube. There they lie the wider
/// apart the farther away they are.
pub(crate) struct Lattice {
    frustum: Option<Frustum>,
    origin: DVec3,
    spacing: f64,
    /// Places along x, y and z.
    pub(crate) counts: [usize; 3],
}

impl Lattice {
    /// A lattice that fills a field's box, or in NDC its frustum, with so many cells along its
    /// longest side.
    pub(crate) fn new(bounds: &Bounds, cells: u32) -> Self {
        let (frustum, origin, sides) = match bounds.space {
            Space::Ndc(frustum) => {
                let [x, y] = [0, 1].map(|i| frustum.max[i] - frustum.min[i]);
                (Some(frustum), DVec3::ZERO, DVec3::new(x / x.max(y), y / x.max(y), 1.0))
            }
            _ => {
                let min = DVec3::from(bounds.min);
                (None, min, DVec3::from(bounds.max) - min)
            }
        };
        let spacing = sides.max_element() / f64::from(cells);
        // A rounding error is no cell.
        let counts = (sides / spacing - 1e-6).ceil().to_array().map(|n| n.max(1.0) as usize + 1);
        Self { frustum, origin, spacing, counts }
    }

    /// Number of places.
    pub(crate) fn len(&self) -> usize {
        self.counts.iter().product()
    }

    /// How far a step of one along x, y or z goes in the list of all places, x fastest.
    pub(crate) fn strides(&self) -> [usize; 3] {
        [1, self.counts[0], self.counts[0] * self.counts[1]]
    }

    /// The world point at a place, counted in spacings along each axis.
    pub(crate) fn point(&self, place: [f64; 3]) -> DVec3 {
        let at = self.origin + self.spacing * DVec3::from(place);
        self.frustum.map_or(at, |frustum| frustum.to_world(at))
    }

    /// The place of a world point; undoes [`Lattice::point`].
    pub(crate) fn place(&self, point: DVec3) -> [f64; 3] {
        let at = self.frustum.map_or(point, |f| f.to_cube(f.to_camera(point)));
        ((at - self.origin) / self.spacing).to_array()
    }

    /// Distance of neighbours near a place, in scene units: the largest along the axes.
    pub(crate) fn spacing_at(&self, place: [f64; 3]) -> f64 {
        if self.frustum.is_none() {
            return self.spacing;
        }
        let at = self.point(place);
        let steps = (0..3).map(|axis| {
            let mut next = place;
            next[axis] += 1.0;
            (self.point(next) - at).length()
        });
        steps.fold(0.0, f64::max)
    }

    /// Whether the lattice's axes are left-handed in the world: a frustum's third goes away from
    /// the camera.
    pub(crate) fn is_mirrored(&self) -> bool {
        self.frustum.is_some()
    }
}
