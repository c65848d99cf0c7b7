use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use artifact::shortened;
use glam::{DMat3, DVec3};
use scene::{Camera, CameraError, Distortion, Intrinsics, Pose, pose_of, without_scale};

use crate::error::frame_label;
use crate::file_status::path_text;
use crate::masks::MaskFile;

/// Treatment of a photograph's EXIF orientation. Poses usually refer to stored images, so that a
/// photograph is turned only if its camera has the turned shape (docs/design/005).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Turn {
    /// Stored pixels: EXIF requires no turn, or the camera has the stored shape.
    #[default]
    Stored,
    /// Pixels turned as EXIF requires.
    Upright,
    /// Stored pixels by assumption: EXIF requires a turn, and both shapes fit the camera.
    AssumedStored,
}

/// Posed photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Name of the view: a valid file name, unique among the training or the test views of the
    /// folder's own split.
    pub name: String,
    /// Path of the image: PNG, JPEG or EXR.
    pub image: PathBuf,
    /// Treatment of the image's EXIF orientation.
    pub turn: Turn,
    /// Mask of the pixels that count.
    pub mask: Option<MaskFile>,
    /// Path of the true depth (EXR, channels `Z` and `A`), if any.
    pub depth_file: Option<PathBuf>,
    /// Intrinsics of the image as read, before a resampling to `pinhole`.
    pub lens_intrinsics: Intrinsics,
    /// Pinhole camera to which the image is resampled, if distortion is removed.
    pub pinhole: Option<Intrinsics>,
    /// Pose `[R | t]`, row by row: camera axes (x right, y up, looking along -z) and centre in
    /// world space.
    pub camera_to_world: Pose,
    /// Smallest and largest depth of observed points along the optical axis, if known. For a
    /// fisheye lens that is followed, the points' distances from the camera.
    pub depth_range: Option<[f64; 2]>,
}

impl Frame {
    /// Creates a frame without name, mask and depth.
    pub(crate) fn new(
        image: PathBuf,
        (lens_intrinsics, turn): (Intrinsics, Turn),
        camera_to_world: Pose,
    ) -> Self {
        Self {
            name: String::new(),
            image,
            turn,
            mask: None,
            depth_file: None,
            lens_intrinsics,
            pinhole: None,
            camera_to_world,
            depth_range: None,
        }
    }

    /// Returns the intrinsics of [`Frame::camera`].
    pub fn intrinsics(&self) -> Intrinsics {
        self.pinhole.unwrap_or(self.lens_intrinsics)
    }

    /// Returns the camera of [`Frame::photograph`].
    pub fn camera(&self) -> Camera {
        Camera {
            name: self.name.clone(),
            intrinsics: self.intrinsics(),
            camera_to_world: self.camera_to_world,
        }
    }

    /// True if some pixels may not count.
    pub fn is_masked(&self) -> bool {
        self.mask.is_some() || self.intrinsics().has_clamped_rays()
    }

    pub(crate) fn has_distortion(&self) -> bool {
        !self.lens_intrinsics.distortion.is_none()
    }

    /// Fails if the camera is invalid. A uniform scale of the rotation is valid, because
    /// [`Dataset::read`](crate::Dataset::read) removes the scale. Pixels without a ray are valid,
    /// because only some callers need a ray through every pixel.
    pub(crate) fn check(&self) -> Result<(), CameraError> {
        let distortion = self.lens_intrinsics.distortion;
        if !distortion.is_finite() {
            return Err(CameraError::distortion(distortion));
        }
        let mut camera = self.camera();
        camera.intrinsics.distortion = Distortion::default();
        if let Some((rigid, _)) = without_scale(&camera.camera_to_world) {
            camera.camera_to_world = rigid;
        }
        camera.check()
    }
}

/// Converts a world-to-camera transform x' = R·x + t with axes right, down, forward (COLMAP,
/// OpenCV) to a pose.
pub(crate) fn pose_from_world_to_camera(rotation: DMat3, translation: DVec3) -> Pose {
    let inverse = rotation.transpose();
    let axes = DMat3::from_cols(inverse.x_axis, -inverse.y_axis, -inverse.z_axis);
    pose_of(axes, -(inverse * translation))
}

/// Separators between the parts of a name with folders; the second one tells `a/b` from `a_b`.
const SEPARATORS: [&str; 2] = ["_", "__"];

/// Names frames by the paths of their images inside the data set: by file names if those are
/// unique, otherwise with their folders. `list` is the file that lists the frames.
pub(crate) fn assign_names(
    frames: &mut [Frame],
    list: &Path,
    paths: &[PathBuf],
) -> anyhow::Result<()> {
    for (i, name) in unique_names(list, paths)?.into_iter().enumerate() {
        frames[i].name = name;
    }
    Ok(())
}

/// Returns unique names of images, see [`assign_names`]: all file names, or all names with folders.
pub(crate) fn unique_names(list: &Path, paths: &[PathBuf]) -> anyhow::Result<Vec<String>> {
    let mut names = each_name(list, paths, |path| printable_part(path.file_stem()))?;
    for separator in SEPARATORS {
        if first_duplicate(&names).is_none() {
            return Ok(names);
        }
        names = each_name(list, paths, |path| name_with_folders(path, separator))?;
    }
    let Some((first, second)) = first_duplicate(&names) else { return Ok(names) };
    let [first_path, path] = [first, second].map(|i| path_text(&paths[i]));
    let label = frame_label(list, second, &path);
    if first_path == path {
        bail!("{label}: the photograph is listed twice; remove one of the two entries");
    }
    let (name, first) = (shortened(&names[second]), shortened(&first_path));
    bail!("{label}: view name {name:?} is already that of {first}; rename one of the two files")
}

fn each_name(
    list: &Path,
    paths: &[PathBuf],
    name: impl Fn(&Path) -> anyhow::Result<String>,
) -> anyhow::Result<Vec<String>> {
    (paths.iter().enumerate())
        .map(|(index, path)| name(path).with_context(|| frame_label(list, index, &path_text(path))))
        .collect()
}

fn name_with_folders(path: &Path, separator: &str) -> anyhow::Result<String> {
    let path = path.with_extension("");
    let parts =
        path.iter().map(|part| printable_part(Some(part))).collect::<Result<Vec<_>, _>>()?;
    Ok(parts.join(separator))
}

/// Returns a part of a path as text without control characters: names become file names and are
/// printed. Fails for the folders `.` and `..`, the stems of `..png` and `...png`.
fn printable_part(part: Option<&OsStr>) -> anyhow::Result<String> {
    let name = part.and_then(OsStr::to_str).context("file name is not UTF-8; rename the file")?;
    ensure!(
        ![".", ".."].contains(&name),
        "file name has only dots before its extension; rename the file"
    );
    Ok(name.replace(char::is_control, "_"))
}

/// Returns the indices of the first two equal names.
fn first_duplicate(names: &[String]) -> Option<(usize, usize)> {
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

    fn names_of(paths: &[&str]) -> Result<Vec<String>, crate::DatasetError> {
        Ok(unique_names("list".as_ref(), &paths.iter().map(PathBuf::from).collect::<Vec<_>>())?)
    }

    #[test]
    fn names_are_as_short_as_possible() {
        for (paths, names) in [
            (&["images/a.jpg", "images/b.png"][..], &["a", "b"][..]),
            (&["left/a.jpg", "right/a.jpg"], &["left_a", "right_a"]),
            (&["a/b.png", "c/b.png", "a_b.png"], &["a__b", "c__b", "a_b"]),
            (&["a\u{1b}[31m\n.png", "b.png"], &["a_[31m_", "b"]),
        ] {
            assert_eq!(names_of(paths).unwrap(), names);
        }
        for (paths, expected) in [
            (
                &["x/a.jpg", "x/a.png"][..],
                "frame 1 (x/a.png): view name \"x__a\" is already that of x/a.jpg; rename",
            ),
            (
                &["a\n.png", "a\t.png"],
                "frame 1 (a\\t.png): view name \"a_\" is already that of a\\n.png; rename",
            ),
            (
                &["x/b.jpg", "x/a.jpg", "x/a.jpg"],
                "frame 2 (x/a.jpg): the photograph is listed twice; remove one of the two entries",
            ),
            (&["a.png", "x/..png"], "frame 1 (x/..png): file name has only dots before its"),
            (&["...png"], "frame 0 (...png): file name has only dots before its extension;"),
        ] {
            let message = names_of(paths).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        let path =
            <std::ffi::OsStr as std::os::unix::ffi::OsStrExt>::from_bytes(b"images/\xff\xfe.png");
        let error = unique_names("list".as_ref(), &[PathBuf::from(path)]).unwrap_err();
        assert_eq!(
            format!("{error:#}"),
            "list: frame 0 (images/\\xFF\\xFE.png): file name is not UTF-8; rename the file"
        );
    }

    /// The converted OpenCV camera projects a point to the same pixel.
    #[test]
    fn opencv_axes_are_converted() {
        let rotation = DMat3::from_axis_angle(DVec3::new(0.3, -0.5, 0.8).normalize(), 1.1);
        let translation = DVec3::new(0.2, -0.4, 3.0);
        let point = DVec3::new(0.3, 0.1, -0.2);
        let in_camera = rotation * point + translation;
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
        assert!((x - (48.0 + 90.0 * in_camera.x / in_camera.z)).abs() < 1e-9);
        assert!((y - (41.0 + 95.0 * in_camera.y / in_camera.z)).abs() < 1e-9);
        assert!((depth - in_camera.z).abs() < 1e-9);
    }
}
