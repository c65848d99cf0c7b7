/// How many sub-pixel rays are cast through an LR pixel: few at first, and all after a warm-up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SubPixelRays {
    /// Along x and y, when all are cast.
    pub(crate) full: [usize; 2],
    /// Along x and y, now.
    pub(crate) now: [usize; 2],
    /// Share of the training during which they are fewer.
    pub(crate) warmup: f64,
}

impl SubPixelRays {
    /// All of them, until the training says how far it is.
    pub(crate) fn new(full: [usize; 2], warmup: f64) -> Self {
        Self { full, now: full, warmup }
    }

    /// Casts as many as belong to such a share of the training.
    pub(crate) fn set_progress(&mut self, done: f64) {
        self.now = self.full;
        if done < self.warmup {
            let stages = warmup_stages(self.full[0].max(self.full[1]) as u64);
            let now = 1 << (done / self.warmup * f64::from(stages)) as u32;
            self.now = self.full.map(|n| n.min(now));
        }
    }

    /// Whether all are cast.
    pub(crate) fn are_all_cast(&self) -> bool {
        self.now == self.full
    }

    /// How many are cast through a pixel.
    pub(crate) fn count(&self) -> usize {
        self.now[0] * self.now[1]
    }
}

/// Sub-pixel rays along a side of an LR pixel, for a scale. A scale that isn't whole takes one
/// more; a scale that is whole but for rounding is whole.
pub(crate) fn rays_per_side(scale: f64) -> u64 {
    (scale - 1e-6).ceil() as u64
}

/// How often the sub-pixel rays along a side double before all are cast: as many stages has the
/// warm-up.
pub(crate) fn warmup_stages(side: u64) -> u32 {
    side.next_power_of_two().trailing_zeros()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rays_at(side: usize, done: f64) -> usize {
        let mut rays = SubPixelRays::new([side; 2], 0.3);
        rays.set_progress(done);
        assert_eq!(rays.are_all_cast(), rays.count() == side * side);
        rays.count()
    }

    /// 1, 2, 4 … sub-pixel rays a side, each for an equal part of the warm-up, and then all.
    #[test]
    fn sub_pixel_rays_double_until_all_are_cast() {
        for (side, expected) in [(1, [1, 1, 1]), (2, [1, 1, 4]), (3, [1, 4, 9]), (4, [1, 4, 16])] {
            assert_eq!([0.0, 0.2, 0.3].map(|done| rays_at(side, done)), expected, "{side}");
        }
    }
}
