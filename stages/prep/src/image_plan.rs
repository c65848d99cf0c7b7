use artifact::{Failure, bail_usage, format_count};
use dataset::{Dataset, Split};
use pixels::Kernel;
use scene::{Camera, Intrinsics};

use crate::params::{LrSource, Params};
use crate::sizes::{Sizes, downscaled_sizes, enlarged_sizes, scaled_length};

/// Images that are created from photographs: whether HR truth exists, sizes and kernel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ImagePlan {
    /// True if LR images are downscaled from HR images.
    pub(crate) has_truth: bool,
    /// Kernel that creates LR images, or is assumed to have created them.
    pub(crate) kernel: Kernel,
    /// LR and HR size of the first training view.
    pub(crate) sizes: Sizes,
    /// Size of the first training view's photograph.
    pub(crate) native: (u32, u32),
}

impl ImagePlan {
    /// Derives the plan from a data set and parameters; fails if they contradict each other.
    pub(crate) fn new(set: &Dataset, split: &Split, params: &Params) -> Result<Self, Failure> {
        let has_truth = match params.lr_source {
            Some(source) => source == LrSource::Downscaled,
            None => set.format.is_benchmark() || params.lr_width.is_some(),
        };
        if !has_truth && params.kernel == Some(Kernel::Average) {
            bail_usage!("parameter kernel: photographs cannot have kernel average; choose box");
        }
        let kernel = params.kernel.unwrap_or(if has_truth { Kernel::Lanczos } else { Kernel::Box });
        let first = set.frames[split.train[0]].intrinsics();
        let native = (first.width, first.height);
        let sizes = if has_truth {
            downscaled_sizes(native, params.lr_width, params.scale)?
        } else {
            enlarged_sizes(native, params.scale)
        };
        let plan = Self { has_truth, kernel, sizes, native };
        if kernel == Kernel::Average {
            for &i in split.train.iter().chain(&split.test) {
                let sizes = plan.sizes_of(&set.frames[i].intrinsics());
                if !sizes.has_integer_scale() {
                    let Sizes { lr, hr } = sizes;
                    bail_usage!(
                        "parameter kernel: average requires an integer scale, found {}×{} → \
                        {}×{}; choose box",
                        hr.0,
                        hr.1,
                        lr.0,
                        lr.1
                    );
                }
            }
        }
        Ok(plan)
    }

    /// Returns LR and HR size of a view: views of other sizes are scaled by the first view's
    /// factors.
    pub(crate) fn sizes_of(&self, native: &Intrinsics) -> Sizes {
        let Sizes { lr, hr } = self.sizes;
        Sizes { lr: self.scaled_like_first(native, lr), hr: self.scaled_like_first(native, hr) }
    }

    /// Scales a view's size as the first view's native size was scaled to `first`.
    fn scaled_like_first(&self, native: &Intrinsics, first: (u32, u32)) -> (u32, u32) {
        let (width, height) = self.native;
        (scaled_length(native.width, width, first.0), scaled_length(native.height, height, first.1))
    }

    /// Resizes a camera to LR size.
    pub(crate) fn lr_camera(&self, camera: &Camera) -> Camera {
        let (width, height) = self.sizes_of(&camera.intrinsics).lr;
        camera.resized(width, height)
    }

    /// Resizes a camera to HR size.
    pub(crate) fn hr_camera(&self, camera: &Camera) -> Camera {
        let (width, height) = self.sizes_of(&camera.intrinsics).hr;
        camera.resized(width, height)
    }

    /// Returns the size of an LR image downscaled once more by the same factor.
    pub(crate) fn downscaled_size(&self, (width, height): (u32, u32)) -> (u32, u32) {
        let Sizes { lr, hr } = self.sizes;
        (scaled_length(width, hr.0, lr.0), scaled_length(height, hr.1, lr.1))
    }

    /// Returns the ratio of the photographs' width to that of the LR images.
    pub(crate) fn lr_factor(&self) -> f64 {
        f64::from(self.native.0) / f64::from(self.sizes.lr.0)
    }

    /// Describes views, sizes and kernel for the log.
    pub(crate) fn note(&self, split: &Split) -> String {
        let Sizes { lr, hr } = self.sizes;
        let kernel = format!("{:?}", self.kernel).to_lowercase();
        let shared = split.train.iter().filter(|i| split.test.contains(i)).count();
        let train = format_count(split.train.len(), "training view");
        let mut views = format!("{train}, {}", format_count(split.test.len(), "test view"));
        if shared > 0 {
            views += &format!(" ({shared} in both)");
        }
        if self.has_truth {
            format!(
                "{views}; LR images ({}×{}) are downscaled from HR images ({}×{}) by {kernel}",
                lr.0, lr.1, hr.0, hr.1
            )
        } else {
            format!(
                "{views}; the photographs are the LR images ({}×{}), with assumed kernel {kernel}; \
                HR is {}×{}",
                lr.0, lr.1, hr.0, hr.1
            )
        }
    }
}
