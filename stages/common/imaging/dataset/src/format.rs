use std::fmt;

/// Format of a data set's folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// NeRF's synthetic scenes: `transforms_train.json`, `transforms_test.json` if there are test
    /// views, one angle of view for all frames, PNG.
    Blender,
    /// instant-ngp and nerfstudio: `transforms.json` with intrinsics for all frames or for each,
    /// lens distortion, masks.
    Transforms,
    /// LLFF: `poses_bounds.npy` next to `images` (or `images_4`, `images_8`, …).
    Llff,
    /// COLMAP: `sparse/0` and so on, binary or text, next to `images`; among several models the one
    /// with most images.
    Colmap,
}

impl Format {
    /// All formats, in the order in which they are tried. COLMAP comes after `transforms.json`,
    /// which is often made from a COLMAP model in the same folder.
    pub(crate) const ALL: [Self; 4] = [Self::Blender, Self::Transforms, Self::Llff, Self::Colmap];

    /// Returns the format's name with the file that identifies it: `COLMAP (sparse)`.
    pub fn title(self) -> &'static str {
        match self {
            Self::Blender => "Blender (transforms_train.json)",
            Self::Transforms => "transforms.json (instant-ngp, nerfstudio)",
            Self::Llff => "LLFF (poses_bounds.npy)",
            Self::Colmap => "COLMAP (sparse)",
        }
    }

    /// True for formats of benchmarks, whose images are HR truth rather than LR photographs.
    pub fn is_benchmark(self) -> bool {
        matches!(self, Self::Blender | Self::Llff)
    }

    /// Returns the file that identifies the format by itself, if any.
    pub(crate) fn file(self) -> Option<&'static str> {
        match self {
            Self::Blender => Some("transforms_train.json"),
            Self::Transforms => Some("transforms.json"),
            Self::Llff => Some("poses_bounds.npy"),
            Self::Colmap => None,
        }
    }

    /// True if an image's mask is looked up by name in the folder `masks`.
    pub(crate) fn has_masks_folder(self) -> bool {
        matches!(self, Self::Llff | Self::Colmap)
    }
}

/// Formats the name in artifacts.
impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Blender => "blender",
            Self::Transforms => "transforms",
            Self::Llff => "llff",
            Self::Colmap => "colmap",
        })
    }
}

/// Lists the formats with the files that identify them.
pub(crate) fn expected_files() -> String {
    let [others @ .., last] = Format::ALL.map(Format::title);
    format!("{}, or {last}", others.join(", "))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Returns the index of a format in [`Format::ALL`]. The match doesn't compile until a
    /// new format has an index.
    fn index_of(format: Format) -> usize {
        match format {
            Format::Blender => 0,
            Format::Transforms => 1,
            Format::Llff => 2,
            Format::Colmap => 3,
        }
    }

    #[test]
    fn formats_differ_and_are_all_listed() {
        assert_eq!(Format::ALL.map(index_of), [0, 1, 2, 3]);
        let names: BTreeSet<String> = Format::ALL.iter().map(Format::to_string).collect();
        assert_eq!(names.len(), Format::ALL.len());
        let message = expected_files();
        assert!(Format::ALL.iter().all(|format| message.contains(format.title())));
    }
}
