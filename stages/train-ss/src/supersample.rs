/// Schedule of the sub-pixel rays of an LR pixel: few during the warm-up, then all.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SupersampleSchedule {
    /// Rays along x and y after the warm-up.
    pub(crate) supersample: [usize; 2],
    /// Rays along x and y at the current progress.
    pub(crate) current_supersample: [usize; 2],
    /// Fraction of the training that the warm-up takes.
    pub(crate) warmup: f64,
}

impl SupersampleSchedule {
    /// Creates a schedule that casts all rays until the first [`Self::set_progress`].
    pub(crate) fn new(supersample: [usize; 2], warmup: f64) -> Self {
        Self { supersample, current_supersample: supersample, warmup }
    }

    /// Sets the number of rays for a training progress in 0..1.
    pub(crate) fn set_progress(&mut self, progress: f64) {
        self.current_supersample = self.supersample;
        if progress < self.warmup {
            let doublings = warmup_doublings(self.supersample[0].max(self.supersample[1]) as u64);
            let limit = 1 << (progress / self.warmup * f64::from(doublings)) as u32;
            self.current_supersample = self.supersample.map(|rays| rays.min(limit));
        }
    }

    /// True if all sub-pixel rays are cast.
    pub(crate) fn is_warmed_up(&self) -> bool {
        self.current_supersample == self.supersample
    }

    /// Returns the current number of rays of an LR pixel.
    pub(crate) fn rays_per_pixel(&self) -> usize {
        self.current_supersample[0] * self.current_supersample[1]
    }
}

/// Returns the number of sub-pixel rays along each side of an LR pixel: `supersample` rounded up,
/// except that values above an integer by no more than rounding errors are rounded down.
pub(crate) fn whole_supersample(supersample: f64) -> u64 {
    (supersample - 1e-6).ceil() as u64
}

/// Returns the number of doublings in the warm-up, from one ray per side to `supersample`.
pub(crate) fn warmup_doublings(supersample: u64) -> u32 {
    supersample.next_power_of_two().trailing_zeros()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rays_at(supersample: usize, progress: f64) -> usize {
        let mut schedule = SupersampleSchedule::new([supersample; 2], 0.3);
        schedule.set_progress(progress);
        assert_eq!(schedule.is_warmed_up(), schedule.rays_per_pixel() == supersample * supersample);
        schedule.rays_per_pixel()
    }

    /// Equal parts of the warm-up cast 1, 2, 4 … sub-pixel rays per side; later, all are cast.
    #[test]
    fn sub_pixel_rays_double_until_all_are_cast() {
        for (supersample, expected) in
            [(1, [1, 1, 1]), (2, [1, 1, 4]), (3, [1, 4, 9]), (4, [1, 4, 16])]
        {
            assert_eq!(
                [0.0, 0.2, 0.3].map(|progress| rays_at(supersample, progress)),
                expected,
                "{supersample}"
            );
        }
    }
}
