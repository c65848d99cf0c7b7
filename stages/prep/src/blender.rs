use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use artifact::relative_path;
use scene::{Camera, CameraError, Intrinsics};
use serde::Deserialize;

/// A split of a Blender-format data set (NeRF's `transforms_SPLIT.json`).
#[derive(Clone, Debug)]
pub struct Dataset {
    /// Horizontal angle of view in radians.
    pub camera_angle_x: f64,
    /// The frames, in the file's order.
    pub frames: Vec<Frame>,
}

/// A posed image.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Name of the view: the file's name without folder and extension.
    pub name: String,
    /// The PNG.
    pub image: PathBuf,
    /// True depth (EXR, channels `Z` and `A`), where the data has it.
    pub depth: Option<PathBuf>,
    /// The upper three rows of `transform_matrix`: Blender's axes are OpenGL's.
    pub camera_to_world: [[f64; 4]; 3],
}

/// A data set that can't be used.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder or a file is not there.
    #[error("{path}: {source}; expected a folder with transforms_train.json and transforms_test.json")]
    Missing {
        /// What is missing.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The JSON isn't one, or not of this form.
    #[error("{path}: {reason}")]
    Json {
        /// The file.
        path: PathBuf,
        /// What is wrong, with line and column.
        reason: String,
    },
    /// No frames.
    #[error("{path}: `frames` is empty; at least one view is needed")]
    NoFrames {
        /// The file.
        path: PathBuf,
    },
    /// An angle no camera has; the focal length would be 0 or infinite.
    #[error("{path}: camera_angle_x is {angle}: focal length {focal}; the angle must lie between 0 and π")]
    Angle {
        /// The file.
        path: PathBuf,
        /// The angle.
        angle: f64,
        /// In units of the image's width.
        focal: f64,
    },
    /// Something about one frame.
    #[error("{path}: frame {index} ({file}): {reason}")]
    Frame {
        /// The file.
        path: PathBuf,
        /// The frame, counted from 0.
        index: usize,
        /// Its `file_path`.
        file: String,
        /// What is wrong and what to do.
        reason: String,
    },
}

#[derive(Deserialize)]
struct Transforms {
    camera_angle_x: Option<f64>,
    frames: Vec<FrameEntry>,
}

#[derive(Deserialize)]
struct FrameEntry {
    file_path: String,
    depth_file_path: Option<String>,
    /// `None` is a NaN: Python writes them, JSON has none.
    transform_matrix: Vec<Vec<Option<f64>>>,
}

impl Dataset {
    /// Reads `folder/transforms_SPLIT.json` and checks every frame: pose, path, that the picture is there.
    pub fn read(folder: &Path, split: &str) -> Result<Self, DatasetError> {
        let path = folder.join(format!("transforms_{split}.json"));
        let text = fs::read_to_string(&path).map_err(|source| DatasetError::Missing { path: path.clone(), source })?;
        let transforms = parse(&text).map_err(|e| DatasetError::Json { path: path.clone(), reason: e.to_string() })?;
        let angle = transforms.camera_angle_x.unwrap_or(f64::NAN);
        if !(angle > 0.0 && angle < std::f64::consts::PI) {
            return Err(DatasetError::Angle { path, angle, focal: 0.5 / (0.5 * angle).tan() });
        }
        if transforms.frames.is_empty() {
            return Err(DatasetError::NoFrames { path });
        }
        let mut names = BTreeSet::new();
        let mut frames = Vec::with_capacity(transforms.frames.len());
        for (index, entry) in transforms.frames.iter().enumerate() {
            let frame = read_frame(folder, entry).and_then(|frame| {
                let fresh = names.insert(frame.name.clone());
                if fresh { Ok(frame) } else { Err(format!("a second view named {:?}; file names must differ", frame.name)) }
            });
            match frame {
                Ok(frame) => frames.push(frame),
                Err(reason) => return Err(DatasetError::Frame { path, index, file: entry.file_path.clone(), reason }),
            }
        }
        Ok(Self { camera_angle_x: angle, frames })
    }
}

/// Parses the JSON; where it fails on Python's `NaN` and `Infinity`, those become `null`, so that the frame can be named.
fn parse(text: &str) -> Result<Transforms, serde_json::Error> {
    serde_json::from_str(text).or_else(|error| {
        if text.contains("NaN") || text.contains("Infinity") {
            let readable = text.replace("-Infinity", "null").replace("Infinity", "null").replace("NaN", "null");
            serde_json::from_str(&readable).map_err(|_| error)
        } else {
            Err(error)
        }
    })
}

fn read_frame(folder: &Path, entry: &FrameEntry) -> Result<Frame, String> {
    let mut camera_to_world = [[0.0; 4]; 3];
    let matrix = &entry.transform_matrix;
    if !(3..=4).contains(&matrix.len()) || matrix.iter().any(|row| row.len() != 4) {
        return Err("transform_matrix must have 4 rows of 4 numbers".to_owned());
    }
    for (row, values) in camera_to_world.iter_mut().enumerate() {
        for (column, value) in values.iter_mut().enumerate() {
            *value = matrix[row][column].unwrap_or(f64::NAN);
        }
    }
    let mut file = relative_path(&entry.file_path)?;
    if file.extension().is_none_or(|e| !e.eq_ignore_ascii_case("png")) {
        // NeRF's files leave the extension out. `set_extension` would cut a name like `r.0`.
        file.as_mut_os_string().push(".png");
    }
    let name = file.file_stem().and_then(|n| n.to_str()).ok_or("its name is not UTF-8")?.to_owned();
    // Any size will do for the check of the pose.
    let camera = Camera { name: name.clone(), intrinsics: Intrinsics::from_angle_x(1, 1, 1.0), camera_to_world };
    camera.check().map_err(|e: CameraError| format!("transform_matrix: {e}"))?;
    let existing = |path: &Path| {
        let path = folder.join(path);
        if path.is_file() {
            Ok(path)
        } else {
            Err(format!("{} is not there; remove the frame or restore the file", path.display()))
        }
    };
    let image = existing(&file)?;
    let depth = entry.depth_file_path.as_ref().map(|p| existing(&relative_path(p)?)).transpose()?;
    Ok(Frame { name, image, depth, camera_to_world })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(json: &str) -> Result<Dataset, DatasetError> {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("transforms_train.json"), json).unwrap();
        fs::create_dir(dir.path().join("train")).unwrap();
        fs::write(dir.path().join("train/r_0.png"), "").unwrap();
        Dataset::read(dir.path(), "train")
    }

    fn with_pose(entry: &str) -> String {
        format!(
            r#"{{"camera_angle_x": 0.7, "frames": [{{"file_path": "./train/r_0", "transform_matrix": [[{entry},0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}}]}}"#
        )
    }

    #[test]
    fn a_good_one() {
        let set = read(&with_pose("1")).unwrap();
        assert_eq!(set.frames[0].name, "r_0");
        assert_eq!(set.frames[0].camera_to_world[2], [0., 0., 1., 4.]);
    }

    #[test]
    fn bad_ones_are_named() {
        for (json, words) in [
            (with_pose("NaN"), "frame 0 (./train/r_0): transform_matrix: camera_to_world[0][0] is NaN"),
            (with_pose("2"), "no rigid motion"),
            (with_pose("1").replace("0.7", "0"), "focal length inf"),
            (with_pose("1").replace("0.7", "3.2"), "between 0 and π"),
            (with_pose("1").replace("./train/r_0", "../r_0"), "not a path inside"),
            (with_pose("1").replace("r_0", "r_1"), "r_1.png is not there"),
            (r#"{"camera_angle_x": 0.7, "frames": []}"#.to_owned(), "`frames` is empty"),
            (with_pose("1")[..60].to_owned(), "line 1"),
            (with_pose("1").replace("[0,1,0,0],", ""), ""),
        ] {
            let outcome = read(&json);
            if words.is_empty() {
                // Three rows are a pose, too, but these three are none.
                assert!(outcome.is_err());
                continue;
            }
            let message = outcome.unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
            assert!(message.contains("transforms_train.json"), "{message}");
        }
    }

    #[test]
    fn any_bytes_are_an_error_and_no_panic() {
        let whole = with_pose("1");
        for end in 0..whole.len() - 1 {
            assert!(read(&whole[..end]).is_err());
        }
    }
}
