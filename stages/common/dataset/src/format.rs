use std::fmt;

/// Forms of folders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// NeRF's synthetic scenes: `transforms_train.json`, `transforms_test.json` if there are test
    /// views, one angle for all, PNG.
    Blender,
    /// instant-ngp's and nerfstudio's: `transforms.json`, intrinsics for all or for each, lens
    /// distortion, masks.
    Transforms,
    /// LLFF's: `poses_bounds.npy` beside `images` (or `images_4`, `images_8`, …).
    Llff,
    /// COLMAP's: `sparse/0` and so on, binary or text, beside `images`; of several models the one
    /// with most images.
    Colmap,
}

/// What is known of a form.
struct Description {
    /// As `Display` has it.
    name: &'static str,
    /// What a folder that has it is called.
    title: &'static str,
    /// What a folder that has none should have.
    sign: &'static str,
    is_benchmark: bool,
}

impl Format {
    /// The most explicit first: a folder often has what its poses were made from, too.
    pub(crate) const ALL: [Self; 4] = [Self::Blender, Self::Transforms, Self::Llff, Self::Colmap];

    /// What to call it, with what it is found by: `COLMAP (sparse)`.
    pub fn title(self) -> &'static str {
        self.description().title
    }

    /// Whether benchmarks' scenes come so, whose images are HR truth rather than LR photographs.
    pub fn is_benchmark(self) -> bool {
        self.description().is_benchmark
    }

    fn description(self) -> Description {
        match self {
            Self::Blender => Description {
                name: "blender",
                title: "Blender's form (transforms_train.json)",
                sign: "transforms_train.json (Blender)",
                is_benchmark: true,
            },
            Self::Transforms => Description {
                name: "transforms",
                title: "transforms.json (instant-ngp, nerfstudio)",
                sign: "transforms.json (instant-ngp, nerfstudio)",
                is_benchmark: false,
            },
            Self::Llff => Description {
                name: "llff",
                title: "LLFF (poses_bounds.npy)",
                sign: "poses_bounds.npy (LLFF)",
                is_benchmark: true,
            },
            Self::Colmap => Description {
                name: "colmap",
                title: "COLMAP (sparse)",
                sign: "sparse/0 (COLMAP)",
                is_benchmark: false,
            },
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.description().name)
    }
}

/// What a folder should have one of, in words.
pub(crate) fn signs() -> String {
    let signs = Format::ALL.map(|format| format.description().sign);
    match signs.split_last() {
        Some((last, others)) => format!("{}, or {last}", others.join(", ")),
        None => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// A new form doesn't compile here, and then needs its place in the list, too.
    fn number(format: Format) -> usize {
        match format {
            Format::Blender => 0,
            Format::Transforms => 1,
            Format::Llff => 2,
            Format::Colmap => 3,
        }
    }

    #[test]
    fn forms_differ_and_all_are_told() {
        assert_eq!(Format::ALL.map(number), [0, 1, 2, 3]);
        let names: BTreeSet<String> = Format::ALL.iter().map(Format::to_string).collect();
        assert_eq!(names.len(), Format::ALL.len());
        let words = signs();
        assert!(Format::ALL.iter().all(|format| words.contains(format.description().sign)));
    }
}
