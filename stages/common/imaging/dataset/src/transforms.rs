use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use artifact::{format_count, format_number};
use scene::{CameraError, Intrinsics};
use serde_json::Value;

use crate::dataset::Dataset;
use crate::entry::{Entry, parse_number};
use crate::file_status::path_text;
use crate::format::Format;
use crate::frame::{Frame, Turn};
use crate::frame_file::{FrameFile, MissingImages, lookup_of};
use crate::lens_entry::{distortion, frame_lens, lens_part};
use crate::photograph::{ImageHeader, fit_camera, read_header};

/// Frame of `transforms.json`.
pub(crate) struct FrameEntry {
    pub(crate) file_path: String,
    pub(crate) mask_path: Option<String>,
    pub(crate) depth_file_path: Option<String>,
    /// Pose, row by row.
    transform_matrix: Value,
    /// Lens values of the frame itself, which override the file's.
    own_lens: Entry,
}

impl FrameEntry {
    /// Reads a frame's values.
    pub(crate) fn new(entry: &Entry) -> anyhow::Result<Self> {
        let [image, mask, depth] = ["file_path", "mask_path", "depth_file_path"]
            .map(|key| entry.text(key).map(|name| name.map(str::to_owned)));
        let matrix = entry.value("transform_matrix");
        Ok(Self {
            file_path: image?.context("missing field `file_path`")?,
            mask_path: mask?,
            depth_file_path: depth?,
            transform_matrix: matrix.context("missing field `transform_matrix`")?.clone(),
            own_lens: lens_part(entry)?,
        })
    }
}

/// Reads `transforms.json`, the format of instant-ngp and nerfstudio.
pub(crate) fn read(folder: &Path) -> anyhow::Result<Dataset> {
    let file = FrameFile::read(&folder.join("transforms.json"))?;
    let mut lookup = lookup_of(folder, &[&file]);
    let read = file.frames(&mut lookup, MissingImages::Skipped)?;
    if read.frames.is_empty() {
        return Err(file.no_frames());
    }
    let (split, split_notes) = file
        .split_lists
        .split(read.frames.len(), &read.names, &mut lookup)
        .with_context(|| path_text(file.path()))?;
    let mut notes = vec![format!(
        "transforms.json (instant-ngp, nerfstudio): {}",
        format_count(read.frames.len(), "photograph")
    )];
    notes.extend(read.missing_note());
    notes.extend(lookup.notes());
    notes.extend(split_notes);
    notes.extend(read.depth_note());
    Ok(Dataset { format: Format::Transforms, frames: read.frames, split, notes })
}

/// Reads a frame without its name, mask and depth; `lens` is the file's.
pub(crate) fn read_frame(
    image: PathBuf,
    entry: &FrameEntry,
    lens: &Entry,
) -> anyhow::Result<Frame> {
    let rows = matrix_rows(&entry.transform_matrix);
    let (camera_to_world, last) = match rows.as_deref() {
        Some([x, y, z]) => ([*x, *y, *z], None),
        Some([x, y, z, last]) => ([*x, *y, *z], Some(*last)),
        _ => bail!("transform_matrix must have 3 or 4 rows of 4 numbers"),
    };
    let fitted = intrinsics(&frame_lens(&entry.own_lens, lens), read_header(&image)?)?;
    let frame = Frame::new(image, fitted, camera_to_world);
    match frame.check() {
        Err(CameraError::Pose(problem)) => bail!("transform_matrix: {problem}"),
        other => other?,
    }
    last.map_or(Ok(()), check_last_row)?;
    Ok(frame)
}

/// Returns a matrix's rows of 4 numbers, written as lists or as one flat list; `None` for anything
/// else. `null`, which some programs write for NaN, is NaN.
fn matrix_rows(matrix: &Value) -> Option<Vec<[f64; 4]>> {
    let mut numbers = Vec::new();
    let rows = matrix.as_array()?;
    let is_flat = !rows.iter().any(Value::is_array);
    for row in rows {
        let values = if is_flat { std::slice::from_ref(row) } else { row.as_array()? };
        if !is_flat && values.len() != 4 {
            return None;
        }
        for value in values {
            numbers.push(if value.is_null() { f64::NAN } else { parse_number(value)? });
        }
    }
    let (rows, rest) = numbers.as_chunks::<4>();
    rest.is_empty().then(|| rows.to_vec())
}

/// Maximum error of a number in a matrix's last row, so that numbers rounded to four decimals are
/// accepted.
const MAX_ROW_ERROR: f64 = 1e-4;

/// Fails if a matrix's last row isn't (0, 0, 0, 1).
fn check_last_row(row: [f64; 4]) -> anyhow::Result<()> {
    let expected = [0.0, 0.0, 0.0, 1.0];
    ensure!(
        (0..4).all(|i| (row[i] - expected[i]).abs() <= MAX_ROW_ERROR),
        "transform_matrix: last row is {}, not 0 0 0 1; is the matrix transposed (column-major)?",
        row.map(format_number).join(" ")
    );
    Ok(())
}

/// Returns an image's intrinsics and the treatment of its EXIF orientation.
fn intrinsics(entry: &Entry, stored: ImageHeader) -> anyhow::Result<(Intrinsics, Turn)> {
    let distortion = distortion(entry)?;
    // The size to which the intrinsics refer; the stored image may be a smaller copy.
    let width = entry.number("w")?.map_or(Ok(stored.size.0), |w| side_length(w, "w"))?;
    let height = entry.number("h")?.map_or(Ok(stored.size.1), |h| side_length(h, "h"))?;
    let fx = focal_length(entry, "fl_x", "camera_angle_x", width)?;
    let fy = focal_length(entry, "fl_y", "camera_angle_y", height)?;
    let (Some(fx), Some(fy)) = (fx.or(fy), fy.or(fx)) else {
        bail!("no focal length: neither fl_x nor camera_angle_x is given");
    };
    let cx = entry.number("cx")?.unwrap_or(0.5 * f64::from(width));
    let cy = entry.number("cy")?.unwrap_or(0.5 * f64::from(height));
    let (k, turn) = fit_camera(Intrinsics { width, height, fx, fy, cx, cy, distortion }, stored)?;
    // Without `w` or `h`, a side of the stored image is assumed, so the fit doesn't tell whether
    // the image must be turned.
    let is_assumed = turn == Turn::Stored && !(entry.has("w") && entry.has("h"));
    Ok((k, if is_assumed { stored.turn_if_both_fit() } else { turn }))
}

/// Converts a side of an image to a number of pixels; fails if there is no such image.
pub(crate) fn side_length(value: f64, name: &str) -> anyhow::Result<u32> {
    ensure!(
        (1.0..=f64::from(u32::MAX)).contains(&value),
        "{name} is {}; an image has 1 to {} pixels per side",
        format_number(value),
        u32::MAX
    );
    Ok(value.round() as u32)
}

/// Returns the focal length in pixels, given directly or by the angle of view across `size` pixels.
fn focal_length(
    entry: &Entry,
    length: &str,
    angle: &str,
    size: u32,
) -> anyhow::Result<Option<f64>> {
    if let Some(length) = entry.number(length)? {
        return Ok(Some(length));
    }
    let Some(value) = entry.number(angle)? else { return Ok(None) };
    let unit = if value > PI { " (is it in degrees?)" } else { "" };
    ensure!(
        value > 0.0 && value < PI,
        "{angle} is {}; the angle must be between 0 and π{unit}",
        format_number(value)
    );
    Ok(Some(0.5 * f64::from(size) / libm::tan(0.5 * value)))
}

#[cfg(test)]
mod tests {
    use scene::Distortion;

    use super::*;
    use crate::photograph::tests::write_png;
    use crate::split::Split;

    const POSE: &str = r#""transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]"#;

    /// Reads a data set with the given `transforms.json` and two images.
    fn read(json: &str) -> Result<Dataset, crate::DatasetError> {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("transforms.json"), json).unwrap();
        std::fs::create_dir(dir.path().join("images")).unwrap();
        for name in ["a", "b"] {
            write_png(&dir.path().join(format!("images/{name}.png")), 40, 30);
        }
        Dataset::read(dir.path())
    }

    /// Returns three frames with shared keys `head` and the first frame's keys `first`. The third
    /// frame's image doesn't exist.
    fn frames(head: &str, first: &str) -> String {
        format!(
            r#"{{{head}, "frames": [{{"file_path": "images/a.png", {first} {POSE}}},
                {{"file_path": "./images/b.png", {POSE}}},
                {{"file_path": "images/gone.png", {POSE}}}]}}"#
        )
    }

    #[test]
    fn a_frames_intrinsics_override_the_shared_ones() {
        let head = r#""fl_x": 50, "fl_y": 52, "cx": 21, "cy": 14, "w": 40, "h": 30, "k1": 0.1,
            "p2": 0.01, "camera_model": "OPENCV""#;
        let set = read(&frames(head, r#""fl_x": 60, "k1": 0,"#)).unwrap();
        let [first, second] = [0, 1].map(|i| set.frames[i].lens_intrinsics);
        let distortion = Distortion::brown([0.0; 3], [0.0, 0.01]);
        assert_eq!(
            first,
            Intrinsics {
                width: 40,
                height: 30,
                fx: 60.0,
                fy: 52.0,
                cx: 21.0,
                cy: 14.0,
                distortion
            }
        );
        assert_eq!(second.fx, 50.0);
        assert_eq!((first.distortion.radial[0], second.distortion.radial[0]), (0.0, 0.1));
        assert_eq!(second.distortion.tangential, [0.0, 0.01]);
        assert_eq!(set.frames.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["a", "b"]);
        assert!(
            set.notes
                .iter()
                .any(|n| n.contains("1 of 3 frames have no image file") && n.contains("gone.png")),
            "{:?}",
            set.notes
        );
    }

    #[test]
    fn a_frames_angle_of_view_overrides_the_shared_focal_length() {
        for (first, expected) in [
            (r#""camera_angle_x": 0.8,"#, [20.0 / f64::tan(0.4), 52.0]),
            (r#""camera_angle_y": 0.8,"#, [50.0, 15.0 / f64::tan(0.4)]),
            (r#""camera_angle_x": 0.8, "fl_x": 60,"#, [60.0, 52.0]),
        ] {
            let set = read(&frames(r#""fl_x": 50, "fl_y": 52"#, first)).unwrap();
            let focal_lengths =
                [0, 1].map(|i| &set.frames[i].lens_intrinsics).map(|k| [k.fx, k.fy]);
            assert_eq!(focal_lengths, [expected, [50.0, 52.0]], "{first}");
        }
    }

    /// Only the lens is shared, not the names of files, and `null` is no value.
    #[test]
    fn frames_share_the_lens_alone() {
        let head = r#""fl_x": 50, "mask_path": "gone.png", "depth_file_path": "gone.exr""#;
        let set = read(&frames(head, r#""fl_x": null,"#)).unwrap();
        assert!(set.frames.iter().all(|f| f.mask.is_none() && f.depth_file.is_none()));
        assert_eq!(set.frames[0].lens_intrinsics.fx, 50.0);
    }

    /// Intrinsics of the original image are scaled to its smaller copy.
    #[test]
    fn smaller_copies_keep_the_angle_of_view() {
        let set =
            read(&frames(r#""fl_x": 200, "cx": 80, "cy": 60, "w": 160, "h": 120"#, "")).unwrap();
        assert_eq!(
            set.frames[0].lens_intrinsics,
            Intrinsics {
                width: 40,
                height: 30,
                fx: 50.0,
                fy: 50.0,
                cx: 20.0,
                cy: 15.0,
                distortion: Default::default()
            }
        );
    }

    #[test]
    fn a_given_split_is_read() {
        let head = r#""fl_x": 50, "train_filenames": ["images/b.png"],
            "test_filenames": ["./images/a.png"]"#;
        assert_eq!(
            read(&frames(head, "")).unwrap().split,
            Some(Split { train: vec![1], test: vec![0] })
        );
        assert_eq!(read(&frames(r#""fl_x": 50"#, "")).unwrap().split, None);
    }

    #[test]
    fn flat_matrices_are_read_row_by_row() {
        let head = r#""fl_x": 50"#;
        let rows = read(&frames(head, "")).unwrap().frames;
        for flat in ["[1,0,0,0,0,1,0,0,0,0,1,4,0,0,0,1]", "[1,0,0,0,0,1,0,0,0,0,1,4]"] {
            let json = frames(head, "").replace(POSE, &format!(r#""transform_matrix": {flat}"#));
            let found = read(&json).unwrap().frames;
            assert_eq!(found[0].camera_to_world, rows[0].camera_to_world);
        }
    }

    fn lens(head: &str) -> Distortion {
        read(&frames(&format!(r#""fl_x": 50, {head}"#), "")).unwrap().frames[0]
            .lens_intrinsics
            .distortion
    }

    /// A key such as `k4` has different meanings in different camera models.
    #[test]
    fn coefficients_belong_to_their_model() {
        let all = r#""k1": 0.1, "k2": -0.02, "k3": 0.003, "k4": -0.0004, "p1": 0.01, "p2": 0.002"#;
        let radial = [0.1, -0.02, 0.003, -0.0004];
        let tangential = [0.01, 0.002];
        let brown = Distortion { radial, tangential, ..Distortion::default() };
        let fisheye = Distortion { tangential, ..Distortion::fisheye(radial) };
        let rational = |k5, k6| Distortion {
            denominator: [-0.0004, k5, k6],
            ..Distortion::brown([0.1, -0.02, 0.003], tangential)
        };
        for (head, expected) in [
            ("", brown),
            (r#""camera_model": "OPENCV", "is_fisheye": false,"#, brown),
            (r#""camera_model": "PINHOLE","#, brown),
            (r#""camera_model": "Opencv","#, brown),
            (r#""camera_model": "FULL_OPENCV","#, rational(0.0, 0.0)),
            (r#""camera_model": "FULL_OPENCV", "k5": 0.5, "k6": 0.25,"#, rational(0.5, 0.25)),
            (r#""camera_model": "OPENCV", "k6": 0.25,"#, rational(0.0, 0.25)),
            (r#""camera_model": "OPENCV_FISHEYE","#, fisheye),
            (r#""camera_model": "OPENCV", "is_fisheye": true,"#, fisheye),
            (r#""is_fisheye": true,"#, fisheye),
            (r#""camera_model": "RADIAL_FISHEYE", "is_fisheye": false,"#, fisheye),
        ] {
            assert_eq!(lens(&format!("{head} {all}")), expected, "{head}");
        }
        assert_eq!(lens(r#""is_fisheye": true"#), Distortion::fisheye([0.0; 4]));
        assert_eq!(lens(r#""is_fisheye": false, "latlong": false"#), Distortion::default());
    }

    #[test]
    fn mistakes_are_named() {
        for (head, first, expected) in [
            (r#""w": 40"#, "", "no focal length"),
            (r#""fl_x": -5"#, "", "fx is -5"),
            (
                r#""fl_x": 50, "camera_model": "EQUIRECTANGULAR""#,
                "",
                "--camera-type equirectangular",
            ),
            (
                r#""fl_x": 50, "camera_model": "FISHEYE624""#,
                "",
                "\"FISHEYE624\" is not supported; undistort",
            ),
            (r#""fl_x": 50, "latlong": true"#, "", "latlong"),
            (r#""fl_x": 50, "k4": Infinity"#, "", "k4 inf"),
            (r#""fl_x": 50, "w": 40, "h": 40"#, "", "aspect ratios must match"),
            (r#""fl_x": 50, "w": 0"#, "", "w is 0"),
            (r#""fl_x": 50"#, r#""mask_path": "masks/a.png","#, "masks/a.png not found"),
            (r#""fl_x": 50"#, r#""mask_path": "../a.png","#, "not a path inside"),
            (r#""camera_angle_x": 7"#, "", "between 0 and π (is it in degrees?)"),
            (r#""camera_angle_x": -1"#, "", "between 0 and π"),
            (r#""fl_x": 50"#, r#""k1": [1],"#, "k1: expected a number, found [1]"),
            (r#""fl_x": 50"#, r#""mask_path": 7,"#, "mask_path: expected text, found 7"),
            (r#""fl_x": 50"#, r#""fl_x": "wide","#, "fl_x: expected a number, found \"wide\""),
        ] {
            let message = read(&frames(head, first)).unwrap_err().to_string();
            assert!(
                message.contains(expected) && message.contains("frame 0 (images/a.png)"),
                "{message}"
            );
        }
        for (pose, expected) in [
            (
                "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[1,2.5,3,1]]",
                "transform_matrix: last row is 1 2.5 3 1, not 0 0 0 1; is the matrix transposed",
            ),
            (
                "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,null]]",
                "transform_matrix: last row is 0 0 0 NaN, not",
            ),
            ("[[1,0,0],[0,1,0],[0,0,1]]", "transform_matrix must have 3 or 4 rows of 4 numbers"),
            ("[1,0,0,0,1,0,0,0,1]", "transform_matrix must have 3 or 4 rows of 4 numbers"),
            ("{}", "transform_matrix must have 3 or 4 rows of 4 numbers"),
        ] {
            let json = frames(r#""fl_x": 50"#, "")
                .replace(POSE, &format!(r#""transform_matrix": {pose}"#));
            let message = read(&json).unwrap_err().to_string();
            assert!(message.contains(&format!("frame 0 (images/a.png): {expected}")), "{message}");
        }
        for (json, expected) in [
            ("", "transforms.json: file is empty"),
            ("[]", "transforms.json: expected a mapping, found []"),
            (
                r#"{"frames": [{"file_path": "a.png"}]}"#,
                "frame 0 (a.png): missing field `transform_matrix`",
            ),
            (
                r#"{"frames": [{"transform_matrix": []}]}"#,
                "frame 0 (unnamed): missing field `file_path`",
            ),
            (r#"{"frames": [1]}"#, "frame 0 (unnamed): expected a mapping, found 1"),
            (
                r#"{"fl_x": "wide", "frames": []}"#,
                "transforms.json: fl_x: expected a number, found \"wide\"",
            ),
            (
                r#"{"k1": [-0.3], "frames": [{}]}"#,
                "transforms.json: k1: expected a number, found [-0.3]",
            ),
            (r#"{"test_filenames": [7], "frames": []}"#, "test_filenames: expected text, found 7"),
            (
                r#"{"file_path": "images/a.png", "frames": [{"transform_matrix": []}]}"#,
                "frame 0 (unnamed): missing field `file_path`",
            ),
        ] {
            let message = read(json).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        let message = read(&frames(r#""camera_angle_x": -1"#, "")).unwrap_err().to_string();
        assert!(!message.contains("degrees"), "{message}");
        let missing = r#"{"fl_x": 50, "frames": [{"file_path": "x.png", "transform_matrix": []}]}"#;
        assert!(
            read(missing)
                .unwrap_err()
                .to_string()
                .contains("1 image listed, none found (first missing: x.png)")
        );
    }
}
