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

/// Names and properties of a format.
struct Description {
    /// Name in artifacts.
    name: &'static str,
    /// Name for the log, with the file that identifies the format.
    title: &'static str,
    /// File that identifies the format, with the format's name, for the message about a folder
    /// without a data set.
    sign: &'static str,
    /// File that identifies the format by itself, if any.
    file: Option<&'static str>,
    is_benchmark: bool,
    /// True if images that name no mask may have one in the folder `masks`.
    has_masks_folder: bool,
}

impl Format {
    /// All formats in order of recognition: next to `transforms.json` is often the COLMAP model
    /// from which it was made.
    pub(crate) const ALL: [Self; 4] = [Self::Blender, Self::Transforms, Self::Llff, Self::Colmap];

    /// Returns the format's name with the file that identifies it: `COLMAP (sparse)`.
    pub fn title(self) -> &'static str {
        self.description().title
    }

    /// True for formats of benchmarks, whose images are HR truth rather than LR photographs.
    pub fn is_benchmark(self) -> bool {
        self.description().is_benchmark
    }

    /// Returns the file that identifies the format by itself, if any.
    pub(crate) fn file(self) -> Option<&'static str> {
        self.description().file
    }

    /// True if images that name no mask may have one in the folder `masks`.
    pub(crate) fn has_masks_folder(self) -> bool {
        self.description().has_masks_folder
    }

    fn description(self) -> Description {
        match self {
            Self::Blender => Description {
                name: "blender",
                title: "Blender (transforms_train.json)",
                sign: "transforms_train.json (Blender)",
                file: Some("transforms_train.json"),
                is_benchmark: true,
                has_masks_folder: false,
            },
            Self::Transforms => Description {
                name: "transforms",
                title: "transforms.json (instant-ngp, nerfstudio)",
                sign: "transforms.json (instant-ngp, nerfstudio)",
                file: Some("transforms.json"),
                is_benchmark: false,
                has_masks_folder: false,
            },
            Self::Llff => Description {
                name: "llff",
                title: "LLFF (poses_bounds.npy)",
                sign: "poses_bounds.npy (LLFF)",
                file: Some("poses_bounds.npy"),
                is_benchmark: true,
                has_masks_folder: true,
            },
            Self::Colmap => Description {
                name: "colmap",
                title: "COLMAP (sparse)",
                sign: "sparse/0 (COLMAP)",
                file: None,
                is_benchmark: false,
                has_masks_folder: true,
            },
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.description().name)
    }
}

/// Lists the files that identify a data set.
pub(crate) fn expected_files() -> String {
    let [others @ .., last] = Format::ALL.map(|format| format.description().sign);
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
        assert!(Format::ALL.iter().all(|format| message.contains(format.description().sign)));
    }
}
