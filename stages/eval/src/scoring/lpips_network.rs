/// Network whose features LPIPS compares. Distances of different networks aren't comparable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LpipsNetwork {
    /// SqueezeNet 1.1.
    Squeeze,
    /// AlexNet in torchvision's form, the network of LPIPS in most papers.
    Alex,
    /// VGG-16.
    Vgg,
}

impl LpipsNetwork {
    /// All networks, in order of display.
    pub const ALL: [Self; 3] = [Self::Squeeze, Self::Alex, Self::Vgg];

    /// Returns the names of the files with the network's weights (torchvision's tensor names) and
    /// with the learned heads.
    pub fn files(self) -> [&'static str; 2] {
        match self {
            Self::Squeeze => ["squeezenet1_1.safetensors", "lpips_linear_squeeze_v0.1.safetensors"],
            Self::Alex => ["alexnet.safetensors", "lpips_linear_alex_v0.1.safetensors"],
            Self::Vgg => ["vgg16.safetensors", "lpips_linear_vgg_v0.1.safetensors"],
        }
    }

    /// Returns the minimum width and height of images in pixels, for the network's pooling layers.
    pub(super) fn min_size(self) -> usize {
        match self {
            Self::Squeeze => 17,
            Self::Alex => 31,
            Self::Vgg => 16,
        }
    }

    pub(super) fn labels(self) -> Labels {
        let [key, table, summary, convention] = match self {
            Self::Squeeze => ["lpips", "LPIPS ↓", "LPIPS", "SqueezeNet 1.1 (lpips)"],
            Self::Alex => {
                ["lpips_alex", "LPIPS ↓ AlexNet", "LPIPS (AlexNet)", "AlexNet (lpips_alex)"]
            }
            Self::Vgg => ["lpips_vgg", "LPIPS ↓ VGG-16", "LPIPS (VGG-16)", "VGG-16 (lpips_vgg)"],
        };
        Labels { key, table, summary, convention }
    }
}

/// Labels of a network's score.
pub(super) struct Labels {
    /// Name of the score in `metrics.json`.
    pub(super) key: &'static str,
    /// Label in a table.
    pub(super) table: &'static str,
    /// Label in the summary.
    pub(super) summary: &'static str,
    /// Names of the network and of its score in the convention.
    pub(super) convention: &'static str,
}
