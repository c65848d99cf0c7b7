use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use scene::{Camera, CameraError, Distortion, Intrinsics, Pose, pose_of, without_scale};

use crate::error::DatasetError;
use crate::frame_reason::FrameReason;
use crate::mask_file::MaskFile;
use crate::misplaced::shown;
use crate::turn::Turn;

/// A posed photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Unique within its side of the folder's own split; fit for a file's name.
    pub name: String,
    /// The image: PNG, JPEG or EXR.
    pub image: PathBuf,
    /// Treatment of its EXIF orientation.
    pub turn: Turn,
    /// Mask of the pixels that count.
    pub mask: Option<MaskFile>,
    /// True depth (EXR, channels `Z` and `A`), where the data has it.
    pub depth: Option<PathBuf>,
    /// What it was taken with; its size is the stored image's.
    pub taken_with: Intrinsics,
    /// Where distortion is to be undone, the pinhole camera as whose image it is read.
    pub pinhole: Option<Intrinsics>,
    /// `[R | t]`, row by row: camera axes (x right, y up, looking along -z) and centre in world
    /// space.
    pub camera_to_world: Pose,
    /// Depth of the nearest and of the farthest point that it is known to see, along its axis,
    /// where the data says so; through a fisheye lens their distances.
    pub depths: Option<[f64; 2]>,
}

impl Frame {
    /// The inside of its camera.
    pub fn intrinsics(&self) -> Intrinsics {
        self.pinhole.unwrap_or(self.taken_with)
    }

    /// Its camera; [`Frame::photograph`] reads what that sees.
    pub fn camera(&self) -> Camera {
        Camera {
            name: self.name.clone(),
            intrinsics: self.intrinsics(),
            camera_to_world: self.camera_to_world,
        }
    }

    /// True if some of its pixels may not count.
    pub fn is_masked(&self) -> bool {
        self.mask.is_some() || self.intrinsics().has_cut_rays()
    }

    /// Refuses what no camera can be, except a uniform scale of the rotation, which
    /// [`Dataset::read`](crate::Dataset::read) removes. Whether each place in a distorted image has
    /// its ray is asked
    /// where that matters.
    pub(crate) fn check(&self) -> Result<(), CameraError> {
        let distortion = self.taken_with.distortion;
        if !distortion.is_finite() {
            return Err(CameraError::Distortion(distortion));
        }
        let mut camera = self.camera();
        camera.intrinsics.distortion = Distortion::default();
        if let Some((rigid, _)) = without_scale(&camera.camera_to_world) {
            camera.camera_to_world = rigid;
        }
        camera.check()
    }
}

/// The pose of a world-to-camera motion x' = R·x + t with axes right, down, forward (COLMAP,
/// OpenCV).
pub(crate) fn pose_from_world_to_camera(rotation: DMat3, translation: DVec3) -> Pose {
    let back = rotation.transpose();
    let axes = DMat3::from_cols(back.x_axis, -back.y_axis, -back.z_axis);
    pose_of(axes, -(back * translation))
}

/// Separators between the parts of a name with folders; the second tells `a/b` from `a_b`.
const SEPARATORS: [&str; 2] = ["_", "__"];

/// Names for images, by their paths inside the data set: the files' names alone where those differ,
/// otherwise with their folders.
pub(crate) fn names(list: &Path, paths: &[PathBuf]) -> Result<Vec<String>, DatasetError> {
    let mut names = each_name(list, paths, |path| text(path.file_stem()))?;
    for separator in SEPARATORS {
        if first_twice(&names).is_none() {
            return Ok(names);
        }
        names = each_name(list, paths, |path| name_with_folders(path, separator))?;
    }
    match first_twice(&names) {
        None => Ok(names),
        Some((first, second)) => {
            let (name, first) = (names[second].clone(), shown(&paths[first]));
            let reason = FrameReason::SecondName { name, first };
            Err(DatasetError::frame(list, second, &shown(&paths[second]), reason))
        }
    }
}

fn each_name(
    list: &Path,
    paths: &[PathBuf],
    name: impl Fn(&Path) -> Result<String, FrameReason>,
) -> Result<Vec<String>, DatasetError> {
    let mut names = Vec::with_capacity(paths.len());
    for (index, path) in paths.iter().enumerate() {
        let of_frame = |reason| DatasetError::frame(list, index, &shown(path), reason);
        names.push(name(path).map_err(of_frame)?);
    }
    Ok(names)
}

fn name_with_folders(path: &Path, separator: &str) -> Result<String, FrameReason> {
    let whole = path.with_extension("");
    let parts = whole.iter().map(|part| text(Some(part))).collect::<Result<Vec<_>, _>>()?;
    Ok(parts.join(separator))
}

/// A part of a path as text. Names become files' names and are printed everywhere: no control
/// characters.
fn text(part: Option<&OsStr>) -> Result<String, FrameReason> {
    let name = part.and_then(OsStr::to_str).ok_or(FrameReason::NoName)?;
    Ok(name.replace(char::is_control, "_"))
}

/// Returns the indices of the first two frames that share a name.
fn first_twice(names: &[String]) -> Option<(usize, usize)> {
    let mut seen = BTreeMap::new();
    for (index, name) in names.iter().enumerate() {
        if let Some(first) = seen.insert(name, index) {
            return Some((first, index));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names_of(paths: &[&str]) -> Result<Vec<String>, DatasetError> {
        names("list".as_ref(), &paths.iter().map(PathBuf::from).collect::<Vec<_>>())
    }

    #[test]
    fn names_are_as_short_as_can_be() {
        for (paths, names) in [
            (&["images/a.jpg", "images/b.png"][..], &["a", "b"][..]),
            (&["left/a.jpg", "right/a.jpg"], &["left_a", "right_a"]),
            (&["a/b.png", "c/b.png", "a_b.png"], &["a__b", "c__b", "a_b"]),
            (&["a\u{1b}[31m\n.png", "b.png"], &["a_[31m_", "b"]),
        ] {
            assert_eq!(names_of(paths).unwrap(), names);
        }
        for (paths, words) in [
            (
                &["x/a.jpg", "x/a.png"][..],
                "frame 1 (x/a.png): its view would be named \"x__a\", as that of x/a.jpg; rename",
            ),
            (
                &["a\n.png", "a\t.png"],
                "frame 1 (a\\t.png): its view would be named \"a_\", as that of a\\n.png; rename",
            ),
        ] {
            let message = names_of(paths).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
        let odd =
            <std::ffi::OsStr as std::os::unix::ffi::OsStrExt>::from_bytes(b"images/\xff\xfe.png");
        let message = names("list".as_ref(), &[PathBuf::from(odd)]).unwrap_err().to_string();
        assert_eq!(
            message,
            "list: frame 0 (images/\\xFF\\xFE.png): its name is not UTF-8; rename the file"
        );
    }

    /// A point in front of an OpenCV camera is seen by ours at the same pixel.
    #[test]
    fn axes_are_turned() {
        let rotation = DMat3::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 1.1);
        let translation = DVec3::new(0.2, -0.4, 3.0);
        let point = DVec3::new(0.3, 0.1, -0.2);
        let seen = rotation * point + translation;
        let intrinsics = scene::Intrinsics {
            width: 100,
            height: 80,
            fx: 90.0,
            fy: 95.0,
            cx: 48.0,
            cy: 41.0,
            distortion: Default::default(),
        };
        let camera = Camera {
            name: "c".into(),
            intrinsics,
            camera_to_world: pose_from_world_to_camera(rotation, translation),
        };
        let (x, y, depth) = camera.project(point).unwrap();
        assert!((x - (48.0 + 90.0 * seen.x / seen.z)).abs() < 1e-9);
        assert!((y - (41.0 + 95.0 * seen.y / seen.z)).abs() < 1e-9);
        assert!((depth - seen.z).abs() < 1e-9);
    }
}
