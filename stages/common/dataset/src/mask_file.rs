use std::path::PathBuf;

/// Mask of a photograph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskFile {
    /// Path of the image.
    pub path: PathBuf,
    /// Convention by which the mask was found.
    pub kind: MaskKind,
}

/// Convention for masks of photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum MaskKind {
    /// `mask_path` of a frame (nerfstudio). Black is left out.
    Listed,
    /// `masks/NAME.png` next to the images' folder. Black is left out.
    Named,
    /// `masks/NAME.EXT.png` next to the images' folder (COLMAP). Black is left out.
    NamedWithExtension,
    /// `dynamic_mask_NAME.png` next to the image (instant-ngp). White is left out.
    Dynamic,
}

impl MaskKind {
    /// True if white, not black, is left out.
    pub fn is_inverted(self) -> bool {
        self == Self::Dynamic
    }

    /// Returns the convention's name for the log.
    pub(crate) fn title(self) -> &'static str {
        match self {
            Self::Listed => "mask_path",
            Self::Named => "masks/NAME.png",
            Self::NamedWithExtension => "masks/NAME.EXT.png",
            Self::Dynamic => "dynamic_mask_NAME.png",
        }
    }
}
