use glam::DVec3;
use scene::{Bounds, Frustum, Space};

/// Evenly spaced nodes: in the world, or in the cube of an NDC frustum, where their spacing in the
/// world grows with depth.
pub(crate) struct Lattice {
    frustum: Option<Frustum>,
    origin: DVec3,
    spacing: f64,
    /// Number of nodes along x, y and z.
    pub(crate) counts: [usize; 3],
}

impl Lattice {
    /// Creates a lattice that fills a field's box or NDC frustum, with `cells` cells along the
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
        // A rounding error must not add a cell.
        let counts = (sides / spacing - 1e-6).ceil().to_array().map(|n| n.max(1.0) as usize + 1);
        Self { frustum, origin, spacing, counts }
    }

    /// Returns the number of nodes.
    pub(crate) fn len(&self) -> usize {
        self.counts.iter().product()
    }

    /// Returns the distances in linear indices between neighbours along x, y and z, x fastest.
    pub(crate) fn strides(&self) -> [usize; 3] {
        [1, self.counts[0], self.counts[0] * self.counts[1]]
    }

    /// Converts lattice coordinates, in spacings along each axis, to a world point.
    pub(crate) fn to_world(&self, node: [f64; 3]) -> DVec3 {
        let point = self.origin + self.spacing * DVec3::from(node);
        self.frustum.map_or(point, |frustum| frustum.to_world(point))
    }

    /// Converts a world point to lattice coordinates.
    pub(crate) fn to_lattice(&self, point: DVec3) -> [f64; 3] {
        let point = self.frustum.map_or(point, |f| f.to_cube(f.to_camera(point)));
        ((point - self.origin) / self.spacing).to_array()
    }

    /// Returns the distance between neighbouring nodes at lattice coordinates, in scene units: the
    /// largest along the axes.
    pub(crate) fn spacing_at(&self, node: [f64; 3]) -> f64 {
        if self.frustum.is_none() {
            return self.spacing;
        }
        let point = self.to_world(node);
        let mut spacing = 0.0f64;
        for axis in 0..3 {
            let mut neighbour = node;
            neighbour[axis] += 1.0;
            spacing = spacing.max((self.to_world(neighbour) - point).length());
        }
        spacing
    }

    /// Returns whether the lattice's axes are left-handed in the world: a frustum's third axis
    /// points away from the camera.
    pub(crate) fn is_mirrored(&self) -> bool {
        self.frustum.is_some()
    }
}
