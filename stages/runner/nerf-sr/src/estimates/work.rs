//! Facts on which a node's cost depends.

use radiance::{Architecture, GivenSizes};
use serde::Deserialize as _;
use serde_json::Value;
use store::SceneKind;

use super::scene::SceneImages;

/// Number and sizes of the images of a folder.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Images {
    pub(crate) count: u64,
    /// Pixels of all images.
    pub(crate) pixels: u64,
    /// Width and height of the largest image.
    pub(crate) largest_size: (u64, u64),
}

impl Images {
    /// Returns the number of pixels of the largest image.
    pub(crate) fn largest_pixels(&self) -> u64 {
        self.largest_size.0 * self.largest_size.1
    }

    /// Returns the first images; `pixels` stays.
    pub(crate) fn limited(self, max_count: u64) -> Self {
        Self { count: self.count.min(max_count), ..self }
    }

    /// Returns the same number of images, scaled to the width of the parameter `size` if that is
    /// set.
    pub(crate) fn with_size(self, parameters: &Value) -> Self {
        let Some(width) = parameters["size"].as_f64() else { return self };
        let factor = width / self.largest_size.0.max(1) as f64;
        let scaled = |side: u64| (side as f64 * factor).round() as u64;
        let pixels = (self.pixels as f64 * factor.powi(2)) as u64;
        let largest_size = (scaled(self.largest_size.0), scaled(self.largest_size.1));
        Self { count: self.count, pixels, largest_size }
    }
}

/// Facts on which a stage's cost depends: its inputs, parameters, program and machine.
#[derive(Clone, Debug, Default)]
pub(crate) struct Work {
    pub(crate) kind: SceneKind,
    /// Number of LR pixels across the field's cube.
    pub(crate) pixels_across: f64,
    /// True if the kernel of the LR images is a mean.
    pub(crate) has_box_kernel: bool,
    /// Images that the stage reads or renders.
    pub(crate) images: Images,
    /// HR references that the stage may use.
    pub(crate) references: Images,
    /// Parameters of the training of the refiner that the stage applies.
    pub(crate) refiner: Option<Value>,
    /// Peak memory of preparing a view.
    pub(crate) preparation_bytes: u64,
    /// Parameters of the training of the field that is rendered.
    pub(crate) field: Option<Value>,
    /// True if a training is initialised from a field.
    pub(crate) is_fine_tuning: bool,
    /// True if views are scored by LPIPS.
    pub(crate) computes_lpips: bool,
    /// True if the stage's program contains libtorch.
    pub(crate) has_libtorch: bool,
    /// Number of threads.
    pub(crate) threads: u64,
}

impl Work {
    /// Returns the work of rendering the demo scene.
    pub(crate) fn of_demo(scene: &SceneImages, threads: u64) -> Self {
        Self { kind: scene.kind, images: scene.photographs, threads, ..Self::default() }
    }

    /// Returns the architecture of a grid that is trained with some parameters.
    fn architecture(&self, training: &Value) -> Option<Architecture> {
        let sizes = GivenSizes::deserialize(training).ok()?;
        Some(sizes.for_scene(self.pixels_across, self.kind == SceneKind::Frustum))
    }

    /// Returns the ratio of a field's number of cells per LR pixel, by area, to the default number.
    /// The ratio is at most 1; parameters and the maximum resolution can make the ratio smaller.
    pub(crate) fn resolved_part(&self, training: &Value) -> Option<f64> {
        let default = radiance::CELLS_PER_PIXEL * self.pixels_across.max(1.0);
        let resolution = f64::from(self.architecture(training)?.max_resolution);
        Some((resolution / default).powi(2).min(1.0))
    }

    /// Returns the number of floats of a grid that is trained with some parameters.
    pub(crate) fn grid_floats(&self, training: &Value) -> Option<u64> {
        let architecture = self.architecture(training)?;
        // A plan may contain sizes that the stage will refuse.
        architecture.check().ok()?;
        Some(architecture.grid_len() as u64)
    }
}
