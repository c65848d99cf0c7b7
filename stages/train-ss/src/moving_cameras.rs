use pixels::Image;
use poses::{CameraMotion, MeanMotion, Options, Pyramid, refine, remove_common_motion};
use radiance::{RayField, RenderError};
use scene::Camera;

/// Cameras that move while the field learns, so that it renders what their photographs show.
#[derive(Debug)]
pub(crate) struct MovingCameras {
    were: Vec<Camera>,
    now: Vec<Camera>,
    photographs: Vec<Pyramid>,
    /// Rounds taken; in each every camera is moved.
    rounds: u32,
}

/// Rounds of a training.
const ROUNDS: u32 = 24;
/// Shares of the training at the first and after the last round. It begins early, before the field
/// has explained photographs that don't fit by floaters, and ends before weights are averaged.
const FIRST_ROUND_SHARE: f64 = 0.02;
const LAST_ROUND_SHARE: f64 = 0.7;
/// Share at which photographs are compared at their own size; before it at smaller ones, since a
/// field that isn't sharp yet pulls from afar.
const OWN_SIZE_SHARE: f64 = 0.4;
/// Renderings of a camera in a round.
const RENDERINGS_PER_ROUND: u32 = 3;
/// Halvings of the photographs' size to begin with.
const FIRST_HALVINGS: u32 = 3;

impl MovingCameras {
    /// An RGB photograph, NaN where nothing is known, at all sizes that it is compared at.
    pub(crate) fn pyramid(photograph: &Image) -> Pyramid {
        Pyramid::new(photograph, FIRST_HALVINGS)
    }

    /// Cameras, and their photographs.
    pub(crate) fn new(cameras: Vec<Camera>, photographs: Vec<Pyramid>) -> Self {
        Self { were: cameras.clone(), now: cameras, photographs, rounds: 0 }
    }

    /// Where they are now.
    pub(crate) fn cameras(&self) -> &[Camera] {
        &self.now
    }

    /// Whether it is time for a round, with such a share of the training done.
    pub(crate) fn are_due(&self, done: f64) -> bool {
        let range = LAST_ROUND_SHARE - FIRST_ROUND_SHARE;
        self.rounds < ROUNDS
            && done >= FIRST_ROUND_SHARE + range * f64::from(self.rounds) / f64::from(ROUNDS)
    }

    /// Moves every camera; `exposure` has what the field's colours are to a photograph's.
    pub(crate) fn step(
        &mut self,
        field: &dyn RayField,
        done: f64,
        background: f32,
        exposure: impl Fn(usize) -> [f32; 3],
    ) -> Result<(), RenderError> {
        for (i, (camera, photograph)) in self.now.iter_mut().zip(&self.photographs).enumerate() {
            let smaller = f64::from(photograph.smaller_levels()) * (1.0 - done / OWN_SIZE_SHARE);
            let options =
                Options { max_renders: RENDERINGS_PER_ROUND, background, exposure: exposure(i) };
            *camera =
                refine(field, camera, photograph, smaller.max(0.0).ceil() as u32, &options)?.camera;
        }
        remove_common_motion(&mut self.now, &self.were);
        self.rounds += 1;
        Ok(())
    }

    /// How far the first `count` of them have gone, by the depth that a field shows them.
    pub(crate) fn moved(
        &self,
        field: &dyn RayField,
        count: usize,
        background: f32,
    ) -> Result<MeanMotion, RenderError> {
        let options = Options { max_renders: 1, background, ..Options::default() };
        let seen = self.now.iter().zip(&self.photographs).take(count);
        let depths = seen
            .map(|(camera, photograph)| Ok(refine(field, camera, photograph, 0, &options)?.depth));
        let depths = depths.collect::<Result<Vec<_>, RenderError>>()?;
        let steps = self
            .were
            .iter()
            .zip(&self.now)
            .zip(depths)
            .map(|((from, to), depth)| CameraMotion { from, to, depth });
        Ok(MeanMotion::of_cameras(steps))
    }

    /// All that a resumed training needs.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let poses = self.now.iter().flat_map(|camera| camera.camera_to_world.into_iter().flatten());
        self.rounds.to_le_bytes().into_iter().chain(poses.flat_map(f64::to_le_bytes)).collect()
    }

    /// Length of that.
    pub(crate) fn len(&self) -> usize {
        4 + 12 * 8 * self.now.len()
    }

    /// Restores what [`MovingCameras::bytes`] gave.
    pub(crate) fn restore(&mut self, bytes: &[u8]) {
        let Some((rounds, poses)) = bytes.split_first_chunk::<4>() else { return };
        self.rounds = u32::from_le_bytes(*rounds);
        let numbers = poses.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b));
        let places =
            self.now.iter_mut().flat_map(|camera| camera.camera_to_world.as_flattened_mut());
        places.zip(numbers).for_each(|(place, number)| *place = number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use radiance::{Architecture, Field};
    use scene::{Bounds, Intrinsics};

    fn camera(x: f64) -> Camera {
        Camera {
            name: format!("at {x}"),
            intrinsics: Intrinsics::from_angle_x(24, 24, 0.69),
            camera_to_world: [[1., 0., 0., x], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        }
    }

    /// Rounds come at their times, each once, and a checkpoint knows how many there were and where
    /// they led.
    #[test]
    fn rounds_are_counted_and_kept() {
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 2.0, far: 6.0, ..Bounds::default() };
        let field = Field::new(
            Architecture { finest: 32, levels: 4, log2_entries: 10, ..Architecture::default() },
            bounds,
            3,
        );
        let image = Image::new(24, 24, 3, (0..24 * 24 * 3).map(|i| (i % 7) as f32 / 7.0).collect());
        let pyramids = || (0..2).map(|_| MovingCameras::pyramid(&image)).collect();
        let new = || MovingCameras::new(vec![camera(0.0), camera(0.5)], pyramids());
        let mut moving = new();
        assert!(!moving.are_due(0.01) && moving.are_due(0.02));
        moving.step(&field, 0.02, 1.0, |_| [1.0; 3]).unwrap();
        assert!(!moving.are_due(0.02) && moving.are_due(0.05));
        let mut count = 1;
        while moving.are_due(1.0) {
            (moving.rounds, count) = (moving.rounds + 1, count + 1);
        }
        assert_eq!(count, ROUNDS);
        moving.now[1].camera_to_world[2][3] = 4.25;
        let moved = moving.moved(&field, 2, 1.0).unwrap();
        assert!((moved.distance - 0.125).abs() < 0.05 && moved.pixels.is_finite(), "{moved:?}");
        let mut other = new();
        let bytes = moving.bytes();
        assert_eq!(bytes.len(), other.len());
        other.restore(&bytes);
        assert_eq!((other.rounds, &other.now), (moving.rounds, &moving.now));
    }
}
