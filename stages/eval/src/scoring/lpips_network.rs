/// Networks whose features LPIPS compares. Their distances differ: name the network beside the
/// figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LpipsNetwork {
    /// SqueezeNet 1.1.
    Squeeze,
    /// AlexNet, as torchvision has it; what most papers mean by LPIPS.
    Alex,
    /// VGG-16.
    Vgg,
}

impl LpipsNetwork {
    /// All of them, in the order in which their distances are given.
    pub const ALL: [Self; 3] = [Self::Squeeze, Self::Alex, Self::Vgg];

    /// Names of the files with its weights (torchvision's names of tensors) and with the learned
    /// heads.
    pub fn files(self) -> [&'static str; 2] {
        match self {
            Self::Squeeze => ["squeezenet1_1.safetensors", "lpips_linear_squeeze_v0.1.safetensors"],
            Self::Alex => ["alexnet.safetensors", "lpips_linear_alex_v0.1.safetensors"],
            Self::Vgg => ["vgg16.safetensors", "lpips_linear_vgg_v0.1.safetensors"],
        }
    }

    /// Its score's name.
    pub(super) fn key(self) -> &'static str {
        match self {
            Self::Squeeze => "lpips",
            Self::Alex => "lpips_alex",
            Self::Vgg => "lpips_vgg",
        }
    }

    /// Its score's label in a table.
    pub(super) fn label(self) -> &'static str {
        match self {
            Self::Squeeze => "LPIPS ↓",
            Self::Alex => "LPIPS ↓ AlexNet",
            Self::Vgg => "LPIPS ↓ VGG-16",
        }
    }

    /// Its score in a sentence.
    pub(super) fn short(self) -> &'static str {
        match self {
            Self::Squeeze => "LPIPS",
            Self::Alex => "LPIPS (AlexNet)",
            Self::Vgg => "LPIPS (VGG-16)",
        }
    }

    /// What it is called, and its score.
    pub(super) fn title(self) -> &'static str {
        match self {
            Self::Squeeze => "SqueezeNet 1.1 (lpips)",
            Self::Alex => "AlexNet (lpips_alex)",
            Self::Vgg => "VGG-16 (lpips_vgg)",
        }
    }
}
