use std::path::Path;

use crate::transforms::{self, Missing};
use crate::{Dataset, DatasetError, Format, Split};

/// Reads `transforms_train.json` and `transforms_test.json`: NeRF's synthetic scenes. A picture that isn't there is an error, and names
/// may leave out `.png`.
pub(crate) fn read(folder: &Path) -> Result<Dataset, DatasetError> {
    let mut frames = Vec::new();
    let mut split = Split::default();
    for (name, numbers) in [("train", &mut split.train), ("test", &mut split.test)] {
        let path = folder.join(format!("transforms_{name}.json"));
        if !path.is_file() {
            return Err(DatasetError::format(
                &path,
                "is not there; a Blender data set has transforms_train.json and transforms_test.json",
            ));
        }
        let read = transforms::read_file(folder, &path, Missing::Refused)?;
        numbers.extend(frames.len()..frames.len() + read.frames.len());
        frames.extend(read.frames);
    }
    let notes = vec![format!("Blender's form: {} training views, {} test views", split.train.len(), split.test.len())];
    Ok(Dataset { format: Format::Blender, frames, split: Some(split), notes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photograph::tests::write_png;

    fn folder(train: &str) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("transforms_train.json"), train).unwrap();
        std::fs::write(dir.path().join("transforms_test.json"), with_pose("1")).unwrap();
        std::fs::create_dir(dir.path().join("train")).unwrap();
        write_png(&dir.path().join("train/r_0.png"), 10, 6);
        dir
    }

    fn with_pose(entry: &str) -> String {
        format!(
            r#"{{"camera_angle_x": 0.7, "frames": [{{"file_path": "./train/r_0", "transform_matrix": [[{entry},0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}}]}}"#
        )
    }

    #[test]
    fn a_good_one() {
        let set = Dataset::read(folder(&with_pose("1")).path()).unwrap();
        assert_eq!((set.format, set.frames.len()), (Format::Blender, 2));
        assert_eq!(set.split, Some(Split { train: vec![0], test: vec![1] }));
        let frame = &set.frames[0];
        assert_eq!(frame.name, "r_0");
        assert_eq!(frame.camera_to_world[2], [0., 0., 1., 4.]);
        assert_eq!(frame.taken_with, scene::Intrinsics::from_angle_x(10, 6, 0.7));
        // Both sides have an r_0.
        let merged = set.merged();
        assert_eq!([&merged.frames[0].name, &merged.frames[1].name], ["r_0", "test_r_0"]);
        assert_eq!(merged.split, None);
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
            (with_pose("1").replace("[0,1,0,0],", ""), "transform_matrix"),
        ] {
            let message = Dataset::read(folder(&json).path()).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
            assert!(message.contains("transforms_train.json"), "{message}");
        }
    }

    #[test]
    fn any_bytes_are_an_error_and_no_panic() {
        let whole = with_pose("1");
        for end in 0..whole.len() - 1 {
            assert!(Dataset::read(folder(&whole[..end]).path()).is_err());
        }
    }
}
