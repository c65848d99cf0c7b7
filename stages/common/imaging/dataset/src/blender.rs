use std::path::Path;

use artifact::{WARNING, format_count};

use crate::dataset::Dataset;
use crate::file_status::is_file;
use crate::format::Format;
use crate::frame_file::{FrameFile, MissingImages, lookup_of};
use crate::nearby::find_misspelt_test_file;
use crate::split::Split;

/// Reads `transforms_train.json` and, if it exists, `transforms_test.json`: NeRF's synthetic
/// scenes. A missing image is an error; names may omit `.png`. Without test views the data set has
/// no split.
pub(crate) fn read(folder: &Path) -> anyhow::Result<Dataset> {
    let train_file = FrameFile::read(&folder.join("transforms_train.json"))?;
    let test_path = folder.join("transforms_test.json");
    let test_file = is_file(&test_path)?.then(|| FrameFile::read(&test_path)).transpose()?;
    let files: Vec<&FrameFile> =
        [Some(&train_file), test_file.as_ref()].into_iter().flatten().collect();
    let mut lookup = lookup_of(folder, &files);
    let (mut frames, mut counts, mut depth_notes) = (Vec::new(), Vec::new(), Vec::new());
    for file in &files {
        let read = file.frames(&mut lookup, MissingImages::Refused)?;
        depth_notes.extend(read.depth_note());
        counts.push(read.frames.len());
        frames.extend(read.frames);
    }
    if counts[0] == 0 {
        return Err(train_file.no_frames());
    }
    let (train, test) = (0..counts[0], counts[0]..frames.len());
    let mut notes = vec![if test.is_empty() {
        format!("Blender format: {}, no test views", format_count(train.len(), "view"))
    } else {
        format!(
            "Blender format: {}, {}",
            format_count(train.len(), "training view"),
            format_count(test.len(), "test view")
        )
    }];
    notes.extend(lookup.notes());
    notes.extend(depth_notes);
    if let Some(found) = find_misspelt_test_file(folder).filter(|_| test_file.is_none()) {
        notes.push(format!(
            "{WARNING}found {found}, which is not read; did you mean transforms_test.json?"
        ));
    }
    let split = (!test.is_empty()).then(|| Split { train: train.collect(), test: test.collect() });
    Ok(Dataset { format: Format::Blender, frames, split, notes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photograph::tests::write_png;

    /// Writes a data set with one image; both splits have a frame of it.
    fn write_dataset(train_json: &str) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("transforms_train.json"), train_json).unwrap();
        std::fs::write(dir.path().join("transforms_test.json"), transforms("1")).unwrap();
        std::fs::create_dir(dir.path().join("train")).unwrap();
        write_png(&dir.path().join("train/r_0.png"), 10, 6);
        dir
    }

    /// Returns the JSON of one frame whose pose has the given upper left entry.
    fn transforms(first_entry: &str) -> String {
        format!(
            r#"{{"camera_angle_x": 0.7, "frames": [{{"file_path": "./train/r_0",
                "transform_matrix": [[{first_entry},0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]}}]}}"#
        )
    }

    #[test]
    fn valid_splits_are_read() {
        let set = Dataset::read(write_dataset(&transforms("1")).path()).unwrap();
        assert_eq!((set.format, set.frames.len()), (Format::Blender, 2));
        assert_eq!(set.split, Some(Split { train: vec![0], test: vec![1] }));
        let frame = &set.frames[0];
        assert_eq!(frame.name, "r_0");
        assert_eq!(frame.camera_to_world[2], [0., 0., 1., 4.]);
        assert_eq!(frame.lens_intrinsics, scene::Intrinsics::from_angle_x(10, 6, 0.7));
        // Both splits have a frame r_0.
        let merged = set.without_split();
        assert_eq!([&merged.frames[0].name, &merged.frames[1].name], ["r_0", "test_r_0"]);
        assert_eq!(merged.split, None);
    }

    /// A missing and an empty file of test views give equal data sets.
    #[test]
    fn test_views_are_optional() {
        let dir = write_dataset(&transforms("1"));
        let test = dir.path().join("transforms_test.json");
        std::fs::write(&test, r#"{"camera_angle_x": 0.7, "frames": []}"#).unwrap();
        let empty = Dataset::read(dir.path()).unwrap();
        std::fs::remove_file(&test).unwrap();
        let missing = Dataset::read(dir.path()).unwrap();
        assert_eq!((missing.frames.len(), &missing.split), (1, &None));
        assert_eq!(missing, empty);
        assert_eq!(missing.notes, ["Blender format: 1 view, no test views"]);
        assert_eq!(missing.clone().without_split(), missing);
        std::fs::create_dir(&test).unwrap();
        let message = Dataset::read(dir.path()).unwrap_err().to_string();
        assert!(message.contains("transforms_test.json is a folder, not a file"), "{message}");
    }

    #[test]
    fn byte_order_marks_and_crlf_are_accepted() {
        let json = transforms("1").replace(", ", ",\r\n");
        let dir = write_dataset(&format!("\u{feff}{json}"));
        assert_eq!(Dataset::read(dir.path()).unwrap(), {
            std::fs::write(dir.path().join("transforms_train.json"), transforms("1")).unwrap();
            Dataset::read(dir.path()).unwrap()
        });
    }

    #[test]
    fn missing_and_unusable_images_are_named() {
        let dir = write_dataset(&transforms("1"));
        let image = dir.path().join("train/r_0.png");
        std::fs::remove_file(&image).unwrap();
        let message = || Dataset::read(dir.path()).unwrap_err().to_string();
        assert!(
            message()
                .ends_with("r_0.png not found; restore or rename the file, or remove its entry"),
            "{}",
            message()
        );
        std::os::unix::fs::symlink("r_0.png", &image).unwrap();
        assert!(
            message().contains("r_0.png is a symbolic link that cannot be followed"),
            "{}",
            message()
        );
        std::fs::remove_file(&image).unwrap();
        std::fs::create_dir(&image).unwrap();
        assert!(message().contains("r_0.png is a folder, not an image"), "{}", message());
    }

    /// Control characters in a frame's name neither break a message's line nor move the cursor.
    #[test]
    fn names_are_printed_without_control_characters() {
        let title = r"\u001b]0;PWN\u0007\n";
        let dir = write_dataset(&transforms("1").replace("r_0", title));
        let message = Dataset::read(dir.path()).unwrap_err().to_string();
        assert!(
            !message.contains(char::is_control)
                && message.contains(r"(./train/\u{1b}]0;PWN\u{7}\n)"),
            "{message}"
        );
        write_png(&dir.path().join("train/\u{1b}]0;PWN\u{7}\n.png"), 10, 6);
        assert_eq!(Dataset::read(dir.path()).unwrap().frames[0].name, "_]0;PWN__");
    }

    #[test]
    fn invalid_transforms_are_refused() {
        for (json, expected) in [
            (
                transforms("NaN"),
                "frame 0 (./train/r_0): transform_matrix: camera_to_world[0][0] is NaN",
            ),
            (
                transforms("Infinity"),
                "frame 0 (./train/r_0): transform_matrix: camera_to_world[0][0] is infinite",
            ),
            (transforms("-Infinity"), "camera_to_world[0][0] is infinite"),
            (transforms("-1"), "transform_matrix: camera_to_world is a reflection"),
            (
                transforms("1").replace("1,4]", "1,1e30]"),
                "transform_matrix: the camera's centre (0e0, 0e0, 1e30)",
            ),
            (transforms("1").replace("0.7", "NaN"), "camera_angle_x is NaN"),
            (format!("\u{feff}\u{feff}{}", transforms("1")), "line 1"),
            (transforms("2"), "not a rigid motion"),
            (transforms("1").replace("0.7", "0"), "camera_angle_x is 0; the angle must be between"),
            (transforms("1").replace("0.7", "3.2"), "between 0 and π"),
            (transforms("1").replace("./train/r_0", "../r_0"), "not a path inside"),
            (transforms("1").replace("r_0", "r_1"), "r_1.png not found"),
            (r#"{"camera_angle_x": 0.7, "frames": []}"#.to_owned(), "`frames` is empty"),
            (transforms("1")[..60].to_owned(), "line 1"),
            (transforms("1").replace("[0,1,0,0],", ""), "transform_matrix"),
        ] {
            let message = Dataset::read(write_dataset(&json).path()).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
            assert!(message.contains("transforms_train.json"), "{message}");
        }
    }

    /// Returns the JSON of one frame whose pose has the given rotation part, row by row.
    fn with_rotation(rotation: [[f64; 3]; 3]) -> String {
        let [x, y, z] = rotation.map(|[a, b, c]| format!("[{a},{b},{c}"));
        let pose = format!("[{x},7],{y},8],{z},4],[0,0,0,1]]");
        transforms("1").replace("[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]", &pose)
    }

    /// Users of instant-ngp scale the whole pose matrix, or its rotation part alone.
    #[test]
    fn a_uniform_scale_is_removed_and_reported() {
        let dir =
            write_dataset(&with_rotation([[0.0, 0.0, 0.25], [0.25, 0.0, 0.0], [0.0, 0.25, 0.0]]));
        let set = Dataset::read(dir.path()).unwrap();
        let rigid = [[0.0, 0.0, 1.0, 7.0], [1.0, 0.0, 0.0, 8.0], [0.0, 1.0, 0.0, 4.0]];
        assert_eq!(set.frames[0].camera_to_world, rigid);
        let note = "warning: rotations of 1 of 2 views have a scale of 0.25, which is removed; \
            centres are unchanged";
        assert!(set.notes.iter().any(|found| found == note), "{:?}", set.notes);
        let plain = Dataset::read(write_dataset(&transforms("1.004")).path()).unwrap();
        assert_eq!(plain.notes.len(), 1, "rounding is not a scale: {:?}", plain.notes);
    }

    #[test]
    fn poses_that_are_not_rigid_are_refused() {
        let half_scale =
            |[a, b, c]: [f64; 3]| [[0.5 * a, 0.0, 0.0], [0.0, 0.5 * b, 0.0], [0.0, 0.0, 0.5 * c]];
        let sheared = [[1.0, 0.2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        for (rotation, expected) in [
            (
                half_scale([1.0, 1.0, -1.0]),
                "camera_to_world is a reflection (its determinant is -1.000)",
            ),
            (half_scale([1.0, 1.0, 1.2]), "camera_to_world is not a rigid motion"),
            (half_scale([0.0; 3]), "camera_to_world is not a rigid motion"),
            (sheared, "camera_to_world is not a rigid motion"),
            (sheared.map(|row| row.map(|x| 0.1 * x)), "camera_to_world is not a rigid motion"),
        ] {
            let message = Dataset::read(write_dataset(&with_rotation(rotation)).path())
                .unwrap_err()
                .to_string();
            let prefix = "transforms_train.json: frame 0 (./train/r_0): transform_matrix: ";
            assert!(message.contains(&format!("{prefix}{expected}")), "{message}");
        }
    }

    #[test]
    fn truncated_json_is_refused() {
        let json = transforms("1");
        for end in 0..json.len() - 1 {
            assert!(Dataset::read(write_dataset(&json[..end]).path()).is_err());
        }
    }
}
