//! State that training estimates in addition to the field.

mod exposure;
mod hr_cache;
mod moving_cameras;

use std::io;

pub(crate) use exposure::{ExposureDifference, ExposureMeasurement, Exposures};
pub(crate) use hr_cache::{HrCache, KernelOperator, LrPixel};
pub(crate) use moving_cameras::MovingCameras;

/// State estimated during training; each part is `None` unless enabled.
pub(crate) struct SupervisionState {
    /// HR pixels as last rendered.
    pub(crate) cache: Option<HrCache>,
    /// Gains of each photograph's channels.
    pub(crate) exposures: Option<Exposures>,
    /// Measurement of whether gains are needed.
    pub(crate) measurement: Option<ExposureMeasurement>,
    /// Cameras whose poses are optimised.
    pub(crate) cameras: Option<MovingCameras>,
}

impl SupervisionState {
    /// Writes the state for a checkpoint.
    pub(crate) fn write(&self, to: &mut impl io::Write) -> io::Result<()> {
        if let Some(cache) = &self.cache {
            cache.write(to)?;
        }
        if let Some(exposures) = &self.exposures {
            to.write_all(&exposures.to_bytes())?;
        }
        if let Some(measurement) = &self.measurement {
            to.write_all(&measurement.to_bytes())?;
        }
        if let Some(cameras) = &self.cameras {
            to.write_all(&cameras.to_bytes())?;
        }
        Ok(())
    }

    /// Returns the number of bytes that [`SupervisionState::write`] writes.
    pub(crate) fn byte_length(&self) -> usize {
        self.cache.as_ref().map_or(0, HrCache::byte_length)
            + self.exposures.as_ref().map_or(0, |exposures| exposures.to_bytes().len())
            + self.measurement.as_ref().map_or(0, |measurement| measurement.to_bytes().len())
            + self.cameras.as_ref().map_or(0, |cameras| cameras.to_bytes().len())
    }

    /// Restores the output of [`SupervisionState::write`].
    pub(crate) fn restore(&mut self, from: &mut impl io::Read) -> io::Result<()> {
        if let Some(cache) = &mut self.cache {
            cache.restore(from)?;
        }
        if let Some(exposures) = &mut self.exposures {
            exposures.restore(&read_bytes(from, exposures.to_bytes().len())?);
        }
        if let Some(measurement) = &mut self.measurement {
            measurement.restore(&read_bytes(from, measurement.to_bytes().len())?);
        }
        if let Some(cameras) = &mut self.cameras {
            cameras.restore(&read_bytes(from, cameras.to_bytes().len())?);
        }
        Ok(())
    }
}

fn read_bytes(from: &mut impl io::Read, length: usize) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; length];
    from.read_exact(&mut bytes)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use pixels::{Filter, Image};
    use scene::{Camera, Intrinsics};

    use super::*;
    use crate::photographs::{Photographs, PixelMemory};

    /// Returns the state for one photograph, taken from `height` above the scene.
    fn state(height: f64) -> SupervisionState {
        let image = Image::new(24, 24, 3, vec![0.5; 24 * 24 * 3]);
        let kernel = Arc::new(KernelOperator::new(Filter::Lanczos, (24, 24), (12, 12)));
        let mut cache = HrCache::new([2, 2]);
        cache.add(&image, kernel, &mut PixelMemory::unlimited()).unwrap();
        let camera = Camera {
            name: "a".into(),
            intrinsics: Intrinsics::from_angle_x(24, 24, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., height]],
        };
        let cameras =
            MovingCameras::new([Photographs::taken_by(camera, image).over_background()].iter());
        SupervisionState {
            cache: Some(cache),
            exposures: Some(Exposures::new(1)),
            measurement: Some(ExposureMeasurement::new(1, false)),
            cameras: Some(cameras),
        }
    }

    fn state_bytes(state: &SupervisionState) -> Vec<u8> {
        let mut bytes = Vec::new();
        state.write(&mut bytes).unwrap();
        bytes
    }

    /// Every part is restored, and a shortened state is an error.
    #[test]
    fn every_part_is_restored() {
        let mut first = state(4.0);
        let pixel = LrPixel { view: 0, x: 3, y: 5 };
        first.cache.as_mut().unwrap().store(pixel, &[[255, 0, 51]; 4]);
        first.exposures.as_mut().unwrap().add_pixel(0, [0.5; 3], [0.25; 3]);
        let measurement = first.measurement.as_mut().unwrap();
        measurement.start_step();
        let bytes = state_bytes(&first);
        assert_eq!(bytes.len(), first.byte_length());
        let mut other = state(5.0);
        assert_ne!(state_bytes(&other), bytes);
        other.restore(&mut &bytes[..]).unwrap();
        assert_eq!(state_bytes(&other), bytes);
        let cameras = |state: &SupervisionState| state.cameras.as_ref().unwrap().cameras().to_vec();
        assert_eq!(cameras(&other), cameras(&first));
        assert!(other.restore(&mut &bytes[1..]).is_err());
    }

    #[test]
    fn disabled_parts_write_nothing() {
        let disabled =
            SupervisionState { cache: None, exposures: None, measurement: None, cameras: None };
        assert_eq!((state_bytes(&disabled).len(), disabled.byte_length()), (0, 0));
    }
}
