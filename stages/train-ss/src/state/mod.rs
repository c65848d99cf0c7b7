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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use pixels::{Filter, Image};
    use scene::{Camera, Intrinsics};

    use super::*;
    use crate::photographs::{Photographs, PixelMemory};

    /// Returns the state for photographs, taken from `height` above the scene.
    fn state(views: usize, height: f64) -> SupervisionState {
        let image = Image::new(24, 24, 3, vec![0.5; 24 * 24 * 3]);
        let kernel = Arc::new(KernelOperator::new(Filter::Lanczos, (24, 24), (12, 12)));
        let mut cache = HrCache::new([2, 2]);
        cache.add(&image, kernel, &mut PixelMemory::unlimited()).unwrap();
        let camera = Camera {
            name: "a".into(),
            intrinsics: Intrinsics::from_angle_x(24, 24, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., height]],
        };
        let photograph = Photographs::taken_by(camera, image).over_background();
        SupervisionState {
            cache: Some(cache),
            exposures: Some(Exposures::new(views)),
            measurement: Some(ExposureMeasurement::new(views, false)),
            cameras: Some(MovingCameras::new(std::iter::repeat_n(&photograph, views))),
        }
    }

    fn disabled() -> SupervisionState {
        SupervisionState { cache: None, exposures: None, measurement: None, cameras: None }
    }

    /// Returns a checkpoint's JSON and cache.
    fn saved(state: &SupervisionState) -> (String, Vec<u8>) {
        let mut cache_bytes = Vec::new();
        if let Some(cache) = &state.cache {
            cache.write(&mut cache_bytes).unwrap();
        }
        (serde_json::to_string(state).unwrap(), cache_bytes)
    }

    /// Every part is restored, and a shortened cache is an error.
    #[test]
    fn every_part_is_restored() {
        let mut first = state(1, 4.0);
        let pixel = LrPixel { view: 0, x: 3, y: 5 };
        first.cache.as_mut().unwrap().store(pixel, &[[255, 0, 51]; 4]);
        first.exposures.as_mut().unwrap().add_pixel(0, [0.5; 3], [0.25; 3]);
        first.measurement.as_mut().unwrap().start_step();
        let (json, cache) = saved(&first);
        assert_eq!(cache.len(), first.cache.as_ref().unwrap().byte_length());
        let read = || serde_json::from_str::<SupervisionState>(&json).unwrap();
        assert_eq!(read().view_counts(), first.view_counts());

        let mut other = state(1, 5.0);
        let (other_json, other_cache) = saved(&other);
        assert!(other_json != json && other_cache != cache);
        other.restore(read(), &mut &cache[..]).unwrap();
        assert_eq!(saved(&other), (json.clone(), cache.clone()));
        let cameras = |state: &SupervisionState| state.cameras.as_ref().unwrap().cameras().to_vec();
        assert_eq!(cameras(&other), cameras(&first));
        for exposures in [&mut first, &mut other].map(|state| state.exposures.as_mut().unwrap()) {
            exposures.update_gains(0.5);
        }
        let gains = |state: &SupervisionState| state.exposures.as_ref().unwrap().gains().to_vec();
        assert_eq!(gains(&other), gains(&first));
        assert!(other.restore(read(), &mut &cache[1..]).is_err());
    }

    /// States of other numbers of views, or with other parts, are told apart before they are
    /// restored.
    #[test]
    fn view_counts_differ_with_views_and_parts() {
        let read = |state: &SupervisionState| {
            serde_json::from_str::<SupervisionState>(&saved(state).0).unwrap().view_counts()
        };
        let two = state(2, 4.0);
        assert_eq!(read(&two), [Some(2); 3]);
        assert_eq!(read(&two), two.view_counts());
        assert_ne!(read(&two), state(3, 4.0).view_counts());
        let without_cameras = SupervisionState { cameras: None, ..state(2, 4.0) };
        assert_eq!(read(&without_cameras), [Some(2), Some(2), None]);
    }

    #[test]
    fn disabled_parts_write_nothing() {
        let (json, cache) = saved(&disabled());
        assert_eq!(json, r#"{"exposures":null,"measurement":null,"cameras":null}"#);
        assert!(cache.is_empty());
        let read: SupervisionState = serde_json::from_str(&json).unwrap();
        assert_eq!(read.view_counts(), [None; 3]);
        let mut state = disabled();
        state.restore(read, &mut &cache[..]).unwrap();
        assert_eq!(saved(&state), (json, cache));
    }
}
