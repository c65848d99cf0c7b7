use artifact::{Failure, counted};
use dataset::{Dataset, Split};
use pixels::Kernel;
use scene::{Camera, Intrinsics};

use crate::error::ParameterError;
use crate::params::{LrSource, Params};
use crate::sizes::{Sizes, enlarged, scaled, sizes};

/// Which images are made of photographs: whether there is HR truth, at which sizes, by which
/// kernel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ImagePlan {
    /// Whether LR images are made from HR ones.
    pub(crate) has_truth: bool,
    /// The kernel that makes LR images, or is taken to have made them.
    pub(crate) kernel: Kernel,
    /// Sizes of the first training view, and its own.
    pub(crate) sizes: Sizes,
    pub(crate) native: (u32, u32),
}

impl ImagePlan {
    /// Of a data set's training and test views. What parameters can't have is said.
    pub(crate) fn new(set: &Dataset, split: &Split, params: &Params) -> Result<Self, Failure> {
        let has_truth = match params.lr_source {
            Some(source) => source == LrSource::Downscaled,
            None => set.format.is_benchmark() || params.lr_width.is_some(),
        };
        if !has_truth && params.lr_width.is_some() {
            return Err(ParameterError::WidthOfPhotographs.into());
        }
        if !has_truth && params.kernel == Some(Kernel::Average) {
            return Err(ParameterError::AssumedAverage.into());
        }
        let kernel = params.kernel.unwrap_or(if has_truth { Kernel::Lanczos } else { Kernel::Box });
        let first = set.frames[split.train[0]].intrinsics();
        let native = (first.width, first.height);
        let sizes = if has_truth {
            sizes(native, params.lr_width, params.hr_width, params.scale)
        } else {
            enlarged(native, params.hr_width, params.scale)
        };
        let sizes = sizes.map_err(ParameterError::Sizes)?;
        let plan = Self { has_truth, kernel, sizes, native };
        if kernel == Kernel::Average {
            let mut all = split
                .train
                .iter()
                .chain(&split.test)
                .map(|&i| plan.sizes_of(&set.frames[i].intrinsics()));
            if let Some(odd) = all.find(|sizes| !sizes.is_integer()) {
                return Err(ParameterError::UnevenAverage(odd).into());
            }
        }
        Ok(plan)
    }

    /// LR and HR size of a view: other shapes are shrunk as much as the first view is.
    pub(crate) fn sizes_of(&self, native: &Intrinsics) -> Sizes {
        let Sizes { lr, hr } = self.sizes;
        Sizes { lr: self.size_beside(lr, native), hr: self.size_beside(hr, native) }
    }

    /// Size of a view beside the first view's.
    fn size_beside(&self, first: (u32, u32), native: &Intrinsics) -> (u32, u32) {
        let (width, height) = self.native;
        (scaled(native.width, width, first.0), scaled(native.height, height, first.1))
    }

    /// A camera at LR size.
    pub(crate) fn at_lr(&self, camera: &Camera) -> Camera {
        let (width, height) = self.sizes_of(&camera.intrinsics).lr;
        camera.resized(width, height)
    }

    /// A camera at HR size.
    pub(crate) fn at_hr(&self, camera: &Camera) -> Camera {
        let (width, height) = self.sizes_of(&camera.intrinsics).hr;
        camera.resized(width, height)
    }

    /// Size of an LR image shrunk as HR images were to make LR ones.
    pub(crate) fn one_size_down(&self, (width, height): (u32, u32)) -> (u32, u32) {
        let Sizes { lr, hr } = self.sizes;
        (scaled(width, hr.0, lr.0), scaled(height, hr.1, lr.1))
    }

    /// What was chosen, in a line.
    pub(crate) fn choice(&self, split: &Split) -> String {
        let Sizes { lr, hr } = self.sizes;
        let kernel = format!("{:?}", self.kernel).to_lowercase();
        let both = split.train.iter().filter(|i| split.test.contains(i)).count();
        let (train, test) = (counted(split.train.len(), "view"), split.test.len());
        let parts = match both {
            0 => format!("{train} to train on, {} for testing", counted(test, "other")),
            _ => format!("{train} to train on, {test} for testing, {both} of them for both"),
        };
        if self.has_truth {
            format!(
                "{parts}; LR images of {}×{} are made from HR ones of {}×{} by {kernel}",
                lr.0, lr.1, hr.0, hr.1
            )
        } else {
            format!(
                "{parts}; the photographs are the LR images ({}×{}), as if made by {kernel}; HR \
                is {}×{}",
                lr.0, lr.1, hr.0, hr.1
            )
        }
    }
}
