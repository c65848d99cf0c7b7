use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::pillow_resample::Filter;

/// How LR images are made from HR ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kernel {
    /// Pillow's Lanczos, as the paper does.
    Lanczos,
    /// Pillow's bicubic.
    Bicubic,
    /// Pillow's box: the mean of whole pixels, premultiplied.
    Box,
    /// The paper code's average: colour and alpha apart, never rounded. Needs a whole scale.
    Average,
}

impl Kernel {
    /// The filter it resizes with; `Average` isn't one, but a box is nearly the same.
    pub fn filter(self) -> Filter {
        match self {
            Self::Lanczos => Filter::Lanczos,
            Self::Bicubic => Filter::Bicubic,
            Self::Box | Self::Average => Filter::Box,
        }
    }
}

/// Name of the file, beside the LR images, that says how they were made.
pub const DEGRADATION_FILE: &str = "degradation.json";

/// `degradation.json`: what made LR images of HR ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Degradation {
    /// The kernel.
    pub kernel: Kernel,
    /// Width and height of the HR images.
    pub hr: [u32; 2],
}
