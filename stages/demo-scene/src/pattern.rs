use glam::DVec3;

use crate::material::{Reflectance, cell, hash};

/// Material of a generated scene: a pattern in space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PatternedMaterial {
    pub(crate) pattern: Pattern,
    pub(crate) colours: [DVec3; 3],
    /// Direction across stripes.
    pub(crate) direction: DVec3,
    /// Number of repetitions per half of the shape's size.
    pub(crate) frequency: f64,
    pub(crate) seed: u32,
    /// Strength of the highlight.
    pub(crate) specular: f64,
    /// Sharpness of the highlight.
    pub(crate) exponent: i32,
    /// Fraction of light that is mirrored at normal incidence.
    pub(crate) mirror: f64,
}

/// Kind of pattern.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pattern {
    /// One colour.
    Plain,
    /// Parallel layers.
    Stripes,
    /// Cubes of two colours in turn.
    Checks,
    /// Cubes of random colours with joints.
    Cells,
    /// Rows of marks.
    Marks,
    /// Balls of all sizes that hide each other (dead leaves).
    Leaves,
    /// Smooth noise of several octaves.
    Clouds,
}

impl PatternedMaterial {
    /// Returns the reflectance at a point.
    pub(crate) fn reflectance(&self, p: DVec3) -> Reflectance {
        let Self { specular, exponent, mirror, .. } = *self;
        Reflectance { albedo: self.albedo(p), specular, exponent, mirror }
    }

    /// Returns the albedo at a point.
    fn albedo(&self, p: DVec3) -> DVec3 {
        let [a, b, c] = self.colours;
        let q = p * self.frequency + 0.31;
        let [x, y, z] = q.to_array().map(cell);
        let random = |k: i64| hash(x, y, z.wrapping_mul(8).wrapping_add(k), self.seed);
        match self.pattern {
            Pattern::Plain => a,
            Pattern::Stripes => {
                let phase = (p.dot(self.direction) * self.frequency).rem_euclid(1.0);
                if phase < 0.5 {
                    a
                } else if phase < 0.7 {
                    c
                } else {
                    b
                }
            }
            Pattern::Checks => {
                if (x + y + z) % 2 == 0 {
                    a
                } else {
                    b
                }
            }
            Pattern::Cells => {
                let inner = q - q.floor();
                let is_joint = inner.min_element() < 0.07 && self.seed.is_multiple_of(2);
                if is_joint { c } else { a.lerp(b, random(1)) }
            }
            Pattern::Marks => {
                let row = q.y.rem_euclid(1.0);
                let letter = hash(cell(q.x * 2.5), y, cell(q.z * 2.5), self.seed);
                if (0.25..0.75).contains(&row) && letter < 0.55 { b } else { a }
            }
            Pattern::Leaves => self.leaves(p),
            Pattern::Clouds => {
                let noise = (0..5).map(|octave| {
                    let scale = f64::from(1 << octave);
                    self.smooth_noise(q * (0.4 * scale), octave) / scale
                });
                let level = (noise.sum::<f64>() - 0.5).clamp(0.0, 1.0);
                a.lerp(b, level)
            }
        }
    }

    /// Returns the colour of the uppermost ball around a point; larger balls lie lower.
    fn leaves(&self, p: DVec3) -> DVec3 {
        let [a, b, c] = self.colours;
        for level in (0..6u32).rev() {
            let q = p * (self.frequency * 0.2 * f64::from(1u32 << level));
            let corner = q.floor();
            let [x, y, z] = corner.to_array().map(|v| v as i64);
            let random = |k: i64| {
                hash(x, y, z.wrapping_mul(64).wrapping_add(i64::from(level) * 8 + k), self.seed)
            };
            let centre = DVec3::new(random(0), random(1), random(2)) * 0.4 + 0.3;
            if random(3) < 0.45 && (q - corner - centre).length() < 0.1 + 0.4 * random(4) {
                let light = 0.4 + 0.9 * random(6);
                return [a, b, c][(random(5) * 3.0) as usize % 3] * light;
            }
        }
        a
    }

    /// Returns noise from 0 to 1 that is smooth between the corners of unit cubes.
    fn smooth_noise(&self, q: DVec3, stream: i32) -> f64 {
        let corner = q.floor();
        let f = q - corner;
        let f = f * f * (3.0 - 2.0 * f);
        let [x, y, z] = corner.to_array().map(|v| v as i64);
        let mut sum = 0.0;
        for k in 0..8i64 {
            let bits = [k & 1, (k >> 1) & 1, k >> 2];
            let at = |axis: usize, f: f64| if bits[axis] == 1 { f } else { 1.0 - f };
            let weight = at(0, f.x) * at(1, f.y) * at(2, f.z);
            let [i, j, l] = [x + bits[0], y + bits[1], z + bits[2]];
            sum +=
                weight * hash(i, j, l.wrapping_mul(8).wrapping_add(i64::from(stream)), self.seed);
        }
        sum
    }
}
