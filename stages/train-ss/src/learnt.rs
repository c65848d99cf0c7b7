use std::io;

use crate::exposure::Exposures;
use crate::hr_cache::HrCache;
use crate::moving_cameras::MovingCameras;

/// What a supervision comes to know in the training: each part where that is asked for.
pub(crate) struct Learnt {
    /// HR pixels as they were last rendered.
    pub(crate) cache: Option<HrCache>,
    /// How bright each photograph is.
    pub(crate) exposures: Option<Exposures>,
    /// Where photographs were taken from.
    pub(crate) moving: Option<MovingCameras>,
}

impl Learnt {
    /// Writes all of it, for a checkpoint.
    pub(crate) fn write(&self, to: &mut impl io::Write) -> io::Result<()> {
        self.cache.iter().try_for_each(|cache| cache.write(to))?;
        self.exposures.iter().try_for_each(|exposures| to.write_all(&exposures.bytes()))?;
        self.moving.iter().try_for_each(|moving| to.write_all(&moving.bytes()))
    }

    /// Bytes that [`Learnt::write`] writes.
    pub(crate) fn written_len(&self) -> usize {
        let exposures = self.exposures.as_ref().map_or(0, Exposures::len);
        self.cache.as_ref().map_or(0, HrCache::len)
            + exposures
            + self.moving.as_ref().map_or(0, MovingCameras::len)
    }

    /// Restores what was written.
    pub(crate) fn restore(&mut self, from: &mut impl io::Read) -> io::Result<()> {
        self.cache.iter_mut().try_for_each(|cache| cache.restore(from))?;
        if let Some(exposures) = &mut self.exposures {
            let mut bytes = vec![0; exposures.len()];
            from.read_exact(&mut bytes)?;
            exposures.restore(&bytes);
        }
        if let Some(moving) = &mut self.moving {
            let mut bytes = vec![0; moving.len()];
            from.read_exact(&mut bytes)?;
            moving.restore(&bytes);
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
    use crate::hr_cache::{KernelOperator, LrPixel};
    use crate::packed::PixelMemory;

    /// Of one photograph, taken from `height` above the scene.
    fn learnt(height: f64) -> Learnt {
        let image = Image::new(24, 24, 3, vec![0.5; 24 * 24 * 3]);
        let kernel = Arc::new(KernelOperator::new(Filter::Lanczos, (24, 24), (12, 12)));
        let mut cache = HrCache::new([2, 2]);
        cache.add(&image, kernel, &mut PixelMemory::unlimited()).unwrap();
        let camera = Camera {
            name: "a".into(),
            intrinsics: Intrinsics::from_angle_x(24, 24, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., height]],
        };
        let moving = MovingCameras::new(vec![camera], vec![MovingCameras::pyramid(&image)]);
        Learnt { cache: Some(cache), exposures: Some(Exposures::new(1)), moving: Some(moving) }
    }

    fn written(learnt: &Learnt) -> Vec<u8> {
        let mut bytes = Vec::new();
        learnt.write(&mut bytes).unwrap();
        bytes
    }

    /// Each part comes back as it was, and what is cut short is an error.
    #[test]
    fn all_of_it_comes_back() {
        let mut first = learnt(4.0);
        let pixel = LrPixel { view: 0, x: 3, y: 5 };
        first.cache.as_mut().unwrap().remember(pixel, &[[1.0, 0.0, 0.2]; 4]);
        first.exposures.as_mut().unwrap().learn(0, [0.5; 3], [0.25; 3]);
        let bytes = written(&first);
        assert_eq!(bytes.len(), first.written_len());
        let mut other = learnt(5.0);
        assert_ne!(written(&other), bytes);
        other.restore(&mut &bytes[..]).unwrap();
        assert_eq!(written(&other), bytes);
        let cameras = |of: &Learnt| of.moving.as_ref().unwrap().cameras().to_vec();
        assert_eq!(cameras(&other), cameras(&first));
        assert!(other.restore(&mut &bytes[1..]).is_err());
    }

    /// Where nothing is asked for, nothing is written.
    #[test]
    fn nothing_takes_no_place() {
        let nothing = Learnt { cache: None, exposures: None, moving: None };
        assert_eq!((written(&nothing).len(), nothing.written_len()), (0, 0));
    }
}
