use poses::{CameraMotion, MeanMotion, Options, Pyramid, refine, remove_common_motion};
use radiance::{RayField, RenderError};
use scene::Camera;
use serde::{Deserialize, Serialize};

use crate::photographs::{PackedPhotograph, Photographs};

/// Number of rounds in a training run; every camera moves in each round (design note 025).
const ROUNDS: u32 = 24;
/// Training progress at the first round, before the field fits wrong poses with floaters (design
/// note 025).
const FIRST_PROGRESS: f64 = 0.02;
/// Training progress after the last round: before weights are averaged (design note 025).
const LAST_PROGRESS: f64 = 0.7;
/// Training progress from which photographs are compared at full size. Until then they are smaller,
/// since the residuals of a blurred field have a wider basin of convergence (design note 025).
const FULL_SIZE_PROGRESS: f64 = 0.4;
/// Maximum number of renders per camera and round, enough for two Gauss-Newton steps (design note
/// 025).
const MAX_RENDERS_PER_ROUND: u32 = 3;
/// Maximum number of times that the photographs are halved at first (design note 025).
const FIRST_HALVINGS: u32 = 3;

/// Cameras that move during training so that the field's renders fit their photographs.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct MovingCameras {
    /// Cameras at the start; empty in a state read from a checkpoint.
    #[serde(skip)]
    given: Vec<Camera>,
    current: Vec<Camera>,
    /// Photographs of the cameras; empty in a state read from a checkpoint.
    #[serde(skip)]
    photographs: Vec<Pyramid>,
    /// Number of rounds done.
    rounds: u32,
}

impl MovingCameras {
    /// Creates moving cameras of photographs, which are copied as pyramids.
    pub(crate) fn new<'a>(photographs: impl Iterator<Item = &'a Photographs>) -> Self {
        let (mut cameras, mut pyramids) = (Vec::new(), Vec::new());
        for photographs in photographs {
            cameras.extend(photographs.views.views.iter().map(|view| view.camera.clone()));
            let images = photographs.images.iter().map(PackedPhotograph::masked);
            pyramids.extend(images.map(|image| Pyramid::new(&image, FIRST_HALVINGS)));
        }
        Self { given: cameras.clone(), current: cameras, photographs: pyramids, rounds: 0 }
    }

    /// Returns the current cameras.
    pub(crate) fn cameras(&self) -> &[Camera] {
        &self.current
    }

    /// True if the next round is due at `progress`, the fraction of the training that is done.
    pub(crate) fn is_round_due(&self, progress: f64) -> bool {
        let range = LAST_PROGRESS - FIRST_PROGRESS;
        self.rounds < ROUNDS
            && progress >= FIRST_PROGRESS + range * f64::from(self.rounds) / f64::from(ROUNDS)
    }

    /// Optimises the pose of every camera for one round. `exposure` returns, for a view's index,
    /// the factors per channel that convert the photograph's colours to the field's.
    pub(crate) fn step(
        &mut self,
        field: &dyn RayField,
        progress: f64,
        background: f32,
        exposure: impl Fn(usize) -> [f32; 3],
    ) -> Result<(), RenderError> {
        for (i, camera) in self.current.iter_mut().enumerate() {
            let photograph = &self.photographs[i];
            let halvings =
                f64::from(photograph.smaller_levels()) * (1.0 - progress / FULL_SIZE_PROGRESS);
            let options =
                Options { max_renders: MAX_RENDERS_PER_ROUND, background, exposure: exposure(i) };
            let level = halvings.max(0.0).ceil() as u32;
            *camera = refine(field, camera, photograph, level, &options)?.camera;
        }
        remove_common_motion(&mut self.current, &self.given);
        self.rounds += 1;
        Ok(())
    }

    /// Measures the motion of the first `count` cameras since the start, relative to the depth that
    /// the field renders for each camera.
    pub(crate) fn mean_motion(
        &self,
        field: &dyn RayField,
        count: usize,
        background: f32,
    ) -> Result<MeanMotion, RenderError> {
        let options = Options { max_renders: 1, background, ..Options::default() };
        let mut moves = Vec::with_capacity(count);
        for (i, to) in self.current.iter().enumerate().take(count) {
            let depth = refine(field, to, &self.photographs[i], 0, &options)?.depth;
            moves.push(CameraMotion { from: &self.given[i], to, depth });
        }
        Ok(MeanMotion::of_cameras(moves.into_iter()))
    }

    /// Restores the rounds and cameras of a checkpoint.
    pub(crate) fn restore(&mut self, saved: Self) {
        (self.rounds, self.current) = (saved.rounds, saved.current);
    }
}

#[cfg(test)]
mod tests {
    use pixels::Image;

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

    /// Each round is due once, and a checkpoint restores the number of rounds and the poses.
    #[test]
    fn rounds_are_counted_and_restored() {
        let bounds = Bounds::cube(1.0, 2.0, 6.0);
        let field = Field::new(
            Architecture {
                max_resolution: 32,
                n_levels: 4,
                log2_hashmap_size: 10,
                ..Architecture::default()
            },
            bounds,
            3,
        );
        let image = Image::new(24, 24, 3, (0..24 * 24 * 3).map(|i| (i % 7) as f32 / 7.0).collect());
        let photographs =
            [0.0, 0.5].map(|x| Photographs::taken_by(camera(x), image.clone()).over_background());
        let new_cameras = || MovingCameras::new(photographs.iter());
        let mut moving = new_cameras();
        assert!(!moving.is_round_due(0.01) && moving.is_round_due(0.02));
        moving.step(&field, 0.02, 1.0, |_| [1.0; 3]).unwrap();
        assert!(!moving.is_round_due(0.02) && moving.is_round_due(0.05));
        let mut count = 1;
        while moving.is_round_due(1.0) {
            (moving.rounds, count) = (moving.rounds + 1, count + 1);
        }
        assert_eq!(count, ROUNDS);
        moving.current[1].camera_to_world[2][3] = 4.25;
        let moved = moving.mean_motion(&field, 2, 1.0).unwrap();
        assert!((moved.distance - 0.125).abs() < 0.05 && moved.pixels.is_finite(), "{moved:?}");
        let mut restored = new_cameras();
        let saved = serde_json::to_string(&moving).unwrap();
        restored.restore(serde_json::from_str(&saved).unwrap());
        assert_eq!((restored.rounds, &restored.current), (moving.rounds, &moving.current));
    }
}
