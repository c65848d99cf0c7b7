use std::path::{Path, PathBuf};

use artifact::{counted, relative_path};
use scene::{CameraError, Distortion, Intrinsics};
use serde::Deserialize;

use crate::dataset::Dataset;
use crate::error::DatasetError;
use crate::file_reason::FileReason;
use crate::format::Format;
use crate::found::{Found, find};
use crate::frame::{Frame, names};
use crate::frame_reason::FrameReason;
use crate::number::{Number, words_as_text};
use crate::photograph::{Stored, fitted, image_file, is_exr, look};
use crate::split::Split;
use crate::text::read_text;

/// `transforms.json`. What a frame doesn't say for itself holds for all.
#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    shared: LensEntry,
    frames: Vec<FrameEntry>,
    /// nerfstudio's own split, by file name.
    train_filenames: Option<Vec<String>>,
    test_filenames: Option<Vec<String>>,
    val_filenames: Option<Vec<String>>,
}

#[derive(Clone, Default, Deserialize)]
struct LensEntry {
    camera_model: Option<String>,
    camera_angle_x: Option<Number>,
    camera_angle_y: Option<Number>,
    fl_x: Option<Number>,
    fl_y: Option<Number>,
    cx: Option<Number>,
    cy: Option<Number>,
    w: Option<Number>,
    h: Option<Number>,
    k1: Option<Number>,
    k2: Option<Number>,
    k3: Option<Number>,
    k4: Option<Number>,
    p1: Option<Number>,
    p2: Option<Number>,
    is_fisheye: Option<bool>,
}

#[derive(Deserialize)]
struct FrameEntry {
    file_path: String,
    mask_path: Option<String>,
    depth_file_path: Option<String>,
    /// `None` is `null`: what some programs write for a NaN.
    transform_matrix: Vec<Vec<Option<Number>>>,
    #[serde(flatten)]
    own: LensEntry,
}

/// What to do about an image that isn't there.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Missing {
    /// It is an error.
    Refused,
    /// The frame is left out, and that is said.
    LeftOut,
}

/// A file's frames.
pub(crate) struct Read {
    pub(crate) frames: Vec<Frame>,
    /// The first of the frames whose image isn't there, and how many there are.
    missing: (Option<String>, usize),
    split: Option<Split>,
}

/// Reads `transforms.json`: instant-ngp's form and nerfstudio's.
pub(crate) fn read(folder: &Path) -> Result<Dataset, DatasetError> {
    let path = folder.join("transforms.json");
    let Read { frames, missing, split } =
        read_file(folder, &path, Missing::LeftOut)?.not_empty(&path)?;
    let mut notes = vec![format!(
        "transforms.json (instant-ngp, nerfstudio): {}",
        counted(frames.len(), "photograph")
    )];
    if let (Some(first), count) = missing {
        notes.push(format!(
            "{count} of {} frames have no picture and are left out, first {first}",
            frames.len() + count
        ));
    }
    let masked = frames.iter().filter(|f| f.mask.is_some()).count();
    if masked > 0 {
        let have = if masked == 1 { "has" } else { "have" };
        notes.push(format!(
            "{} {have} a mask: what is black there is neither trained on nor scored",
            counted(masked, "frame")
        ));
    }
    Ok(Dataset { format: Format::Transforms, frames, split, notes })
}

impl Read {
    /// Refuses a file without frames.
    pub(crate) fn not_empty(self, path: &Path) -> Result<Self, DatasetError> {
        if self.frames.is_empty() {
            return Err(DatasetError::format(path, FileReason::NoFrames));
        }
        Ok(self)
    }
}

/// Reads a file of frames; there may be none.
pub(crate) fn read_file(
    folder: &Path,
    path: &Path,
    on_missing: Missing,
) -> Result<Read, DatasetError> {
    let transforms = parse(&read_text(path)?).map_err(|e| DatasetError::format(path, e))?;
    let (mut frames, mut files) = (Vec::new(), Vec::new());
    let (mut first_missing, mut missing) = (None, 0);
    for (index, entry) in transforms.frames.iter().enumerate() {
        let of_frame = |reason| DatasetError::frame(path, index, &entry.file_path, reason);
        let file = image_file(folder, &entry.file_path).map_err(|e| of_frame(e.into()))?;
        match find(&folder.join(&file), "an image") {
            Found::File => {}
            Found::Nothing(found) if on_missing == Missing::Refused => {
                let remedy = "remove the frame or restore the file";
                return Err(of_frame(FrameReason::Place { found, remedy }));
            }
            Found::Nothing(_) => {
                first_missing.get_or_insert_with(|| entry.file_path.clone());
                missing += 1;
                continue;
            }
            Found::Other(found) => {
                let remedy = "remove the frame or name its image";
                return Err(of_frame(FrameReason::Place { found, remedy }));
            }
        }
        frames.push(read_frame(folder, &file, entry, &transforms.shared).map_err(of_frame)?);
        files.push(file);
    }
    if let Some(first) = first_missing.clone().filter(|_| frames.is_empty()) {
        let reason = FileReason::ImagesMissing { count: missing, folder: None, first };
        return Err(DatasetError::format(path, reason));
    }
    for (frame, name) in frames.iter_mut().zip(names(path, &files)?) {
        frame.name = name;
    }
    let split = given_split(&transforms, &files);
    Ok(Read { frames, missing: (first_missing, missing), split })
}

/// The split by file names, where there is one for both. What is for validation is for testing
/// where nothing else is.
fn given_split(transforms: &Transforms, files: &[PathBuf]) -> Option<Split> {
    let test = transforms.test_filenames.as_ref().or(transforms.val_filenames.as_ref());
    let train = numbers_of(transforms.train_filenames.as_ref()?, files);
    let test = numbers_of(test?, files);
    (!train.is_empty() && !test.is_empty()).then_some(Split { train, test })
}

fn numbers_of(names: &[String], files: &[PathBuf]) -> Vec<usize> {
    let named: Vec<PathBuf> = names.iter().filter_map(|n| relative_path(n).ok()).collect();
    files.iter().enumerate().filter(|(_, f)| named.contains(f)).map(|(i, _)| i).collect()
}

/// Parses the JSON; where it fails on Python's `NaN` and `Infinity`, those are taken for numbers,
/// so that the frame can be named.
fn parse(text: &str) -> Result<Transforms, serde_json::Error> {
    serde_json::from_str(text).or_else(|error| match words_as_text(text) {
        Some(readable) => serde_json::from_str(&readable).map_err(|_| error),
        None => Err(error),
    })
}

fn read_frame(
    folder: &Path,
    file: &Path,
    entry: &FrameEntry,
    shared: &LensEntry,
) -> Result<Frame, FrameReason> {
    let mut camera_to_world = [[0.0; 4]; 3];
    let matrix = &entry.transform_matrix;
    if !(3..=4).contains(&matrix.len()) || matrix.iter().any(|row| row.len() != 4) {
        return Err(FrameReason::Matrix);
    }
    for (row, values) in camera_to_world.iter_mut().enumerate() {
        for (column, value) in values.iter_mut().enumerate() {
            *value = matrix[row][column].map_or(f64::NAN, |number| number.0);
        }
    }
    let image = folder.join(file);
    let mask = image_beside(folder, entry.mask_path.as_deref())?;
    let depth = image_beside(folder, entry.depth_file_path.as_deref())?;
    // nerfstudio's depth, 16-bit PNG of an estimate, is no true depth.
    let depth = depth.filter(|path| is_exr(path));
    let (taken_with, turned) = intrinsics(&entry.own.or(shared), look(&image)?)?;
    let frame = Frame {
        name: String::new(),
        image,
        turned,
        mask,
        depth,
        taken_with,
        pinhole: None,
        camera_to_world,
        depths: None,
    };
    match frame.check() {
        Ok(()) => Ok(frame),
        Err(
            e @ (CameraError::Intrinsics { .. }
            | CameraError::Distortion(_)
            | CameraError::Empty { .. }),
        ) => Err(e.into()),
        Err(e) => Err(FrameReason::Pose(e)),
    }
}

/// The mask or depth that a frame names, if it names one.
fn image_beside(folder: &Path, text: Option<&str>) -> Result<Option<PathBuf>, FrameReason> {
    let Some(text) = text else { return Ok(None) };
    let path = folder.join(relative_path(text)?);
    match find(&path, "an image") {
        Found::File => Ok(Some(path)),
        Found::Nothing(found) | Found::Other(found) => {
            Err(FrameReason::Place { found, remedy: "remove the entry or restore the file" })
        }
    }
}

impl LensEntry {
    /// What is said here, and where nothing is, what `other` says.
    fn or(&self, other: &Self) -> Self {
        macro_rules! both {
            ($($name:ident),*) => {
                Self { $($name: self.$name.clone().or_else(|| other.$name.clone())),* }
            };
        }
        both!(
            camera_model,
            camera_angle_x,
            camera_angle_y,
            fl_x,
            fl_y,
            cx,
            cy,
            w,
            h,
            k1,
            k2,
            k3,
            k4,
            p1,
            p2,
            is_fisheye
        )
    }
}

/// What an image was taken with, and whether it has to be turned.
fn intrinsics(entry: &LensEntry, stored: Stored) -> Result<(Intrinsics, bool), FrameReason> {
    let model = entry.camera_model.as_deref().unwrap_or("OPENCV");
    if !["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"]
        .contains(&model)
    {
        return Err(FrameReason::Model { model: model.to_owned() });
    }
    if entry.is_fisheye == Some(true) || entry.k4.is_some_and(|k| k.0 != 0.0) {
        return Err(FrameReason::Fisheye);
    }
    // The size that the numbers are for; the stored image may be a smaller copy.
    let (width, height) =
        (whole(entry.w, "w", stored.size.0)?, whole(entry.h, "h", stored.size.1)?);
    let fx = focal(entry.fl_x, entry.camera_angle_x, "camera_angle_x", width)?;
    let fy = focal(entry.fl_y, entry.camera_angle_y, "camera_angle_y", height)?;
    let (Some(fx), Some(fy)) = (fx.or(fy), fy.or(fx)) else {
        return Err(FrameReason::NoFocalLength);
    };
    let or = |number: Option<Number>, otherwise: f64| number.map_or(otherwise, |number| number.0);
    let (cx, cy) = (or(entry.cx, 0.5 * f64::from(width)), or(entry.cy, 0.5 * f64::from(height)));
    let distortion = Distortion {
        radial: [entry.k1, entry.k2, entry.k3].map(|k| or(k, 0.0)),
        tangential: [entry.p1, entry.p2].map(|p| or(p, 0.0)),
    };
    fitted(Intrinsics { width, height, fx, fy, cx, cy, distortion }, stored)
}

fn whole(value: Option<Number>, name: &'static str, stored: u32) -> Result<u32, FrameReason> {
    match value {
        None => Ok(stored),
        Some(Number(v)) if v >= 1.0 && v <= f64::from(u32::MAX) => Ok(v.round() as u32),
        Some(Number(value)) => Err(FrameReason::Empty { name, value }),
    }
}

/// The focal length in pixels, as it is given or from the angle of view across `size` pixels.
fn focal(
    length: Option<Number>,
    angle: Option<Number>,
    name: &'static str,
    size: u32,
) -> Result<Option<f64>, FrameReason> {
    match (length, angle) {
        (Some(Number(length)), _) => Ok(Some(length)),
        (None, Some(Number(angle))) if angle > 0.0 && angle < std::f64::consts::PI => {
            Ok(Some(0.5 * f64::from(size) / (0.5 * angle).tan()))
        }
        (None, Some(Number(angle))) => {
            let focal = 0.5 / (0.5 * angle).tan();
            Err(FrameReason::Angle { name, angle, focal })
        }
        (None, None) => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photograph::tests::write_png;

    const POSE: &str = r#""transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]"#;

    fn set(json: &str) -> Result<Dataset, DatasetError> {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("transforms.json"), json).unwrap();
        std::fs::create_dir(dir.path().join("images")).unwrap();
        for name in ["a", "b"] {
            write_png(&dir.path().join(format!("images/{name}.png")), 40, 30);
        }
        Dataset::read(dir.path())
    }

    fn frames(head: &str, first: &str) -> String {
        format!(
            r#"{{{head}, "frames": [{{"file_path": "images/a.png", {first} {POSE}}},
                {{"file_path": "./images/b.png", {POSE}}},
                {{"file_path": "images/gone.png", {POSE}}}]}}"#
        )
    }

    #[test]
    fn what_a_frame_says_goes_before_what_holds_for_all() {
        let head = r#""fl_x": 50, "fl_y": 52, "cx": 21, "cy": 14, "w": 40, "h": 30, "k1": 0.1,
            "p2": 0.01, "camera_model": "OPENCV""#;
        let set = set(&frames(head, r#""fl_x": 60, "k1": 0,"#)).unwrap();
        let of = |i: usize| set.frames[i].taken_with;
        let distortion = Distortion { radial: [0.0; 3], tangential: [0.0, 0.01] };
        assert_eq!(
            of(0),
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
        assert_eq!(of(1).fx, 50.0);
        assert_eq!((of(0).distortion.radial[0], of(1).distortion.radial[0]), (0.0, 0.1));
        assert_eq!(of(1).distortion.tangential, [0.0, 0.01]);
        assert_eq!(set.frames.iter().map(|f| f.name.as_str()).collect::<Vec<_>>(), ["a", "b"]);
        assert!(
            set.notes
                .iter()
                .any(|n| n.contains("1 of 3 frames have no picture") && n.contains("gone.png")),
            "{:?}",
            set.notes
        );
    }

    /// Numbers for the original hold for a smaller copy of it.
    #[test]
    fn smaller_copies_keep_their_angle() {
        let set =
            set(&frames(r#""fl_x": 200, "cx": 80, "cy": 60, "w": 160, "h": 120"#, "")).unwrap();
        assert_eq!(
            set.frames[0].taken_with,
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
    fn a_split_of_its_own_is_kept() {
        let head = r#""fl_x": 50, "train_filenames": ["images/b.png"],
            "test_filenames": ["./images/a.png"]"#;
        assert_eq!(
            set(&frames(head, "")).unwrap().split,
            Some(Split { train: vec![1], test: vec![0] })
        );
        assert_eq!(set(&frames(r#""fl_x": 50"#, "")).unwrap().split, None);
    }

    #[test]
    fn mistakes_are_named() {
        for (head, first, words) in [
            (r#""w": 40"#, "", "no focal length"),
            (r#""fl_x": -5"#, "", "fx is -5"),
            (r#""fl_x": 50, "camera_model": "OPENCV_FISHEYE""#, "", "OPENCV_FISHEYE"),
            (r#""fl_x": 50, "k4": 0.1"#, "", "fisheye"),
            (r#""fl_x": 50, "w": 40, "h": 40"#, "", "another shape"),
            (r#""fl_x": 50, "w": 0"#, "", "w is 0"),
            (r#""fl_x": 50"#, r#""mask_path": "masks/a.png","#, "masks/a.png is not there"),
            (r#""fl_x": 50"#, r#""mask_path": "../a.png","#, "not a path inside"),
            (r#""camera_angle_x": 7"#, "", "between 0 and π"),
        ] {
            let message = set(&frames(head, first)).unwrap_err().to_string();
            assert!(
                message.contains(words) && message.contains("frame 0 (images/a.png)"),
                "{message}"
            );
        }
        let nothing = r#"{"fl_x": 50, "frames": [{"file_path": "x.png", "transform_matrix": []}]}"#;
        assert!(set(nothing).unwrap_err().to_string().contains("not one of its 1 images is there"));
    }
}
