use std::fmt;

use glam::DVec3;
use scene::{Bounds, Space};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Name of the file with an offset, next to the files that it belongs to.
pub const OFFSET_FILE: &str = "offset.json";

/// Files whose coordinates have single precision; the last two are the mesh.
const SINGLE_PRECISION_FILES: [&str; 4] = ["points.ply", "splats.ply", "mesh.glb", "mesh.ply"];

/// Maximum distance of a scene's middle from the origin, in scene sizes, up to which files need no
/// offset: single precision moves a point by less than a millionth of the size (design note 043).
const MAX_DISTANCE_SIZES: f64 = 8.0;

/// Content of `offset.json`: the offset of files with single precision, for scenes far from the
/// origin.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ExportOffset {
    /// Use of the offset, as text.
    pub note: String,
    /// Offset in scene units: added to a coordinate of the files, it gives the input's.
    pub offset: [f64; 3],
    /// Files from whose coordinates the offset is subtracted.
    pub files: Vec<String>,
}

/// Frame of the coordinates in files: the input's frame, moved if single precision is too coarse.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Coordinates {
    /// World point of the origin of files with single precision.
    pub(crate) offset: DVec3,
}

impl Coordinates {
    /// Chooses the frame for a field's bounds: the input's frame if single precision is fine
    /// enough.
    pub(crate) fn new(bounds: &Bounds) -> Self {
        let (middle, size) = match bounds.space {
            // A frustum is narrowest at its near plane, where rounding matters most.
            Space::Ndc(frustum) => (frustum.centre(), frustum.near),
            _ => (bounds.middle(), bounds.longest_side()),
        };
        if middle.abs().max_element() <= MAX_DISTANCE_SIZES * size {
            return Self::default();
        }
        Self { offset: middle.to_array().map(|x| round_coordinate(x, size)).into() }
    }

    /// True if an offset is subtracted in files with single precision.
    pub(crate) fn is_moved(&self) -> bool {
        self.offset != DVec3::ZERO
    }

    /// Returns the content of [`OFFSET_FILE`].
    pub(crate) fn offset_file(&self, has_mesh: bool) -> ExportOffset {
        let files = &SINGLE_PRECISION_FILES[..if has_mesh { 4 } else { 2 }];
        ExportOffset {
            note: "add the offset to the coordinates of these files for the input's coordinates"
                .to_owned(),
            offset: self.offset.to_array(),
            files: files.iter().map(|file| (*file).to_owned()).collect(),
        }
    }
}

impl fmt::Display for Coordinates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("coordinates, scale and orientation are those of the input's cameras")?;
        if self.is_moved() {
            let [x, y, z] = self.offset.to_array();
            write!(f, ", less the offset ({x}, {y}, {z}) of {OFFSET_FILE} where single precision")?;
            write!(f, " can't hold them ({})", SINGLE_PRECISION_FILES.join(", "))?;
        }
        Ok(())
    }
}

/// Rounds a coordinate to the number of decimals that the scene's size needs.
fn round_coordinate(value: f64, size: f64) -> f64 {
    let scientific = format!("{size:e}");
    let exponent = scientific.split_once('e').and_then(|(_, e)| e.parse::<i32>().ok());
    let decimals = exponent.map_or(0, |exponent| (-exponent).clamp(0, 300));
    let rounded: f64 = format!("{value:.*}", decimals as usize).parse().unwrap_or(value);
    // Turns -0 into 0.
    rounded + 0.0
}
