//! State that training estimates in addition to the field.

mod exposure;
mod hr_cache;
mod moving_cameras;

use std::io;

use serde::{Deserialize, Serialize};

pub(crate) use exposure::{ExposureDifference, ExposureMeasurement, Exposures};
pub(crate) use hr_cache::{HrCache, KernelOperator, LrPixel};
pub(crate) use moving_cameras::MovingCameras;

/// State estimated during training; each part is `None` unless enabled. Checkpoints have the cache
/// in a file of its own.
#[derive(Serialize, Deserialize)]
pub(crate) struct SupervisionState {
    /// HR pixels as last rendered.
    #[serde(skip)]
    pub(crate) cache: Option<HrCache>,
    /// Gains of each photograph's channels.
    pub(crate) exposures: Option<Exposures>,
    /// Measurement of whether gains are needed.
    pub(crate) measurement: Option<ExposureMeasurement>,
    /// Cameras whose poses are optimised.
    pub(crate) cameras: Option<MovingCameras>,
}

impl SupervisionState {
    /// Returns the number of views of each part but the cache.
    pub(crate) fn view_counts(&self) -> [Option<usize>; 3] {
        [
            self.exposures.as_ref().map(Exposures::views),
            self.measurement.as_ref().map(ExposureMeasurement::views),
            self.cameras.as_ref().map(|cameras| cameras.cameras().len()),
        ]
    }

    /// Restores a saved state of equal [`SupervisionState::view_counts`], with the cache `from` its
    /// file.
    pub(crate) fn restore(&mut self, saved: Self, from: &mut impl io::Read) -> io::Result<()> {
        if let Some(cache) = &mut self.cache {
            cache.restore(from)?;
        }
        self.measurement = saved.measurement;
        if let (Some(own), Some(saved)) = (&mut self.exposures, saved.exposures) {
            own.restore(saved);
        }
        if let (Some(own), Some(saved)) = (&mut self.cameras, saved.cameras) {
            own.restore(saved);
        }
        Ok(())
    }
}
