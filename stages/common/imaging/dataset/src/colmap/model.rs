//! Files of a COLMAP reconstruction (COLMAP's documentation, "Output format").

use std::collections::BTreeMap;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail, ensure};
use artifact::{format_number, shortened};
use glam::{DMat3, DQuat, DVec3};
use scene::Intrinsics;

use super::bytes::Bytes;
use super::camera::{CameraModel, UNDISTORT};
use super::points::{Reach, depth_range, removed_points_note};
use crate::file_status::{FileProblem, is_file, path_text};
use crate::frame::{Frame, pose_from_world_to_camera};
use crate::photograph::{fit_camera, read_header};
use crate::text::read_text;

/// COLMAP reconstruction.
#[derive(Debug, Default)]
pub(super) struct Model {
    pub(super) cameras: BTreeMap<u32, Intrinsics>,
    pub(super) images: Vec<Image>,
    points: BTreeMap<u64, DVec3>,
}

/// Registered image.
#[derive(Debug)]
pub(super) struct Image {
    /// Rotation from world to camera; axes right, down, forward.
    pub(super) rotation: DMat3,
    pub(super) translation: DVec3,
    camera: u32,
    pub(super) name: String,
    /// Ids of the observed points.
    pub(super) points: Vec<u64>,
}

impl Image {
    /// Returns the camera's centre in world space.
    fn centre(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
}

/// Finds the binary or, if there is none, the text file of a model's list; `None` if neither
/// exists.
pub(super) fn find_list(folder: &Path, name: &str) -> Result<Option<PathBuf>, FileProblem> {
    for extension in ["bin", "txt"] {
        let path = folder.join(name).with_extension(extension);
        if is_file(&path)? {
            return Ok(Some(path));
        }
    }
    Ok(None)
}

impl Model {
    /// Reads the model of a folder: each list from its binary file or, if there is none, from its
    /// text file. Points are optional.
    pub(super) fn read(folder: &Path) -> anyhow::Result<Self> {
        let mut model = Self::default();
        model.read_cameras(folder)?;
        model.read_images(folder)?;
        if let Some(path) = find_list(folder, "points3D")? {
            model.read_list(&path, Self::read_binary_points, Self::read_text_points)?;
        }
        Ok(model)
    }

    pub(super) fn read_cameras(&mut self, folder: &Path) -> anyhow::Result<()> {
        let path = find_list(folder, "cameras")?.with_context(|| {
            let problem = "neither cameras.bin nor cameras.txt found; copy all files of the model";
            format!("{}: {problem}", path_text(folder))
        })?;
        self.read_list(&path, Self::read_binary_cameras, Self::read_text_cameras)
    }

    pub(super) fn read_images(&mut self, folder: &Path) -> anyhow::Result<()> {
        let path = find_list(folder, "images")?.unwrap_or_else(|| folder.join("images.txt"));
        self.read_list(&path, Self::read_binary_images, Self::read_text_images)
    }

    /// Reads a list by the function for its format.
    fn read_list(
        &mut self,
        path: &Path,
        read_binary: fn(&mut Self, &mut Bytes<'_>) -> anyhow::Result<()>,
        read_lines: fn(&mut Self, &str) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let read = if path.extension().is_some_and(|extension| extension == "bin") {
            let bytes = std::fs::read(path).with_context(|| path_text(path))?;
            let mut bytes = Bytes::new(&bytes);
            read_binary(self, &mut bytes).and_then(|()| bytes.check_end())
        } else {
            read_lines(self, &read_text(path)?)
        };
        read.with_context(|| path_text(path))
    }

    fn read_binary_cameras(&mut self, bytes: &mut Bytes<'_>) -> anyhow::Result<()> {
        for _ in 0..bytes.count(24, "cameras")? {
            let (id, model) = (bytes.u32()?, bytes.u32()?);
            let (width, height) = (bytes.u64()?, bytes.u64()?);
            let Some(model) = CameraModel::with_number(model) else {
                let problem = format!("camera {id} has unknown model {model}");
                bail!(bytes.error(format!("{problem} (from a newer COLMAP?); {UNDISTORT}")));
            };
            let parameters: anyhow::Result<Vec<f64>> =
                model.parameters.iter().map(|_| bytes.f64()).collect();
            let intrinsics = model
                .intrinsics(width, height, &parameters?)
                .map_err(|reason| bytes.error(format!("camera {id}: {reason}")))?;
            self.cameras.insert(id, intrinsics);
        }
        Ok(())
    }

    fn read_binary_images(&mut self, bytes: &mut Bytes<'_>) -> anyhow::Result<()> {
        for _ in 0..bytes.count(73, "images")? {
            let id = bytes.u32()?;
            let quaternion = bytes.f64s::<4>()?;
            let translation = bytes.f64s::<3>()?.into();
            let camera = bytes.u32()?;
            let name = bytes.text()?.to_owned();
            let rotation = rotation_matrix(quaternion).map_err(|reason| {
                bytes.error(format!("image {id} ({}): {reason}", shortened(&name)))
            })?;
            let mut points = Vec::new();
            for _ in 0..bytes.count(24, "points of an image")? {
                bytes.take(16)?;
                points.push(bytes.u64()?);
            }
            self.images.push(Image { rotation, translation, camera, name, points });
        }
        Ok(())
    }

    fn read_binary_points(&mut self, bytes: &mut Bytes<'_>) -> anyhow::Result<()> {
        for _ in 0..bytes.count(51, "points")? {
            let id = bytes.u64()?;
            self.points.insert(id, bytes.f64s::<3>()?.into());
            bytes.take(11)?;
            let track = bytes.count(8, "images of a point")?;
            bytes.take(8 * track)?;
        }
        Ok(())
    }

    fn read_text_cameras(&mut self, text: &str) -> anyhow::Result<()> {
        for line in TextLine::all(text).filter(|line| !line.words.is_empty()) {
            let id = line.number(0, "camera id")?;
            let name = line.words.get(1).copied().unwrap_or_default();
            let (width, height) = (line.number(2, "width")?, line.number(3, "height")?);
            let parameters = (4..line.words.len())
                .map(|i| line.number(i, "parameter"))
                .collect::<anyhow::Result<Vec<f64>>>()?;
            let Some(model) = CameraModel::with_name(name) else {
                let name = shortened(name);
                let problem = format!("camera model {name:?} is unknown (from a newer COLMAP?)");
                bail!(line.error(format!("{problem}; {UNDISTORT}")));
            };
            let intrinsics = model
                .intrinsics(width, height, &parameters)
                .map_err(|reason| line.error(reason))?;
            self.cameras.insert(id, intrinsics);
        }
        Ok(())
    }

    fn read_text_images(&mut self, text: &str) -> anyhow::Result<()> {
        // Two lines per image; the second one, its points, may be empty.
        let mut lines = TextLine::all(text);
        while let Some(line) = lines.next() {
            if line.words.is_empty() {
                continue;
            }
            let [w, x, y, z] = [1, 2, 3, 4].map(|i| line.number(i, "rotation"));
            let rotation =
                rotation_matrix([w?, x?, y?, z?]).map_err(|reason| line.error(reason))?;
            let [x, y, z] = [5, 6, 7].map(|i| line.number(i, "translation"));
            let translation = DVec3::new(x?, y?, z?);
            let camera = line.number(8, "camera id")?;
            ensure!(line.words.len() >= 10, line.error("an image's name is missing"));
            let name = line.rest_after(9).to_owned();
            let points = match lines.next() {
                None => Vec::new(),
                Some(second) => second.points().ok_or_else(|| {
                    second.error(format!(
                        "expected the points of image {} (an empty line if there are none)",
                        line.words[0]
                    ))
                })?,
            };
            self.images.push(Image { rotation, translation, camera, name, points });
        }
        Ok(())
    }

    fn read_text_points(&mut self, text: &str) -> anyhow::Result<()> {
        for line in TextLine::all(text).filter(|line| !line.words.is_empty()) {
            let id = line.number(0, "point id")?;
            let [x, y, z] = [line.number(1, "x")?, line.number(2, "y")?, line.number(3, "z")?];
            self.points.insert(id, DVec3::new(x, y, z));
        }
        Ok(())
    }

    /// Removes points outside the cameras' [`Reach`]; returns a note on them, if any.
    pub(super) fn remove_far_points(&mut self) -> Option<String> {
        let centres: Vec<DVec3> = self.images.iter().map(Image::centre).collect();
        let focal = self.cameras.values().map(|k| k.fx.max(k.fy)).fold(0.0, f64::max);
        let before = self.points.len();
        let reach = Reach::new(&centres, focal)?;
        self.points.retain(|_, point| reach.contains(*point));
        let removed = before - self.points.len();
        (removed > 0).then(|| removed_points_note(removed, before))
    }

    /// Creates the frame of an image, without its name; `file` is its photograph.
    pub(super) fn frame(&self, image: &Image, file: PathBuf) -> anyhow::Result<Frame> {
        let id = image.camera;
        let camera = self.cameras.get(&id).with_context(|| format!("camera {id} not found"))?;
        let fitted =
            fit_camera(*camera, read_header(&file)?).with_context(|| format!("camera {id}"))?;
        let camera_to_world = pose_from_world_to_camera(image.rotation, image.translation);
        let mut frame = Frame::new(file, fitted, camera_to_world);
        frame.depth_range = depth_range(image, camera, &self.points);
        frame.check()?;
        Ok(frame)
    }
}

/// Returns the rotation matrix of a quaternion (w, x, y, z) of any positive length.
fn rotation_matrix([w, x, y, z]: [f64; 4]) -> anyhow::Result<DMat3> {
    let quaternion = DQuat::from_xyzw(x, y, z, w);
    let length = quaternion.length();
    ensure!(
        length.is_finite() && length > 1e-9,
        "({}) is not a rotation quaternion",
        [w, x, y, z].map(format_number).join(", ")
    );
    Ok(DMat3::from_quat(quaternion * (1.0 / length)))
}

/// Line of a text file.
struct TextLine<'a> {
    /// Line number, counted from 1.
    number: usize,
    text: &'a str,
    words: Vec<&'a str>,
}

impl<'a> TextLine<'a> {
    /// Returns the lines of a text without comments.
    fn all(text: &'a str) -> impl Iterator<Item = Self> {
        let lines = text.lines().enumerate().filter(|(_, line)| !line.starts_with('#'));
        lines.map(|(i, line)| Self {
            number: i + 1,
            text: line,
            words: line.split_whitespace().collect(),
        })
    }

    fn error(&self, reason: impl Display) -> anyhow::Error {
        anyhow!("line {}: {reason}", self.number)
    }

    /// Returns the rest of the line after a number of words: a file name, which may have spaces.
    fn rest_after(&self, words: usize) -> &'a str {
        let mut rest = self.text.trim();
        for word in &self.words[..words.min(self.words.len())] {
            rest = rest[word.len()..].trim_start();
        }
        rest
    }

    /// Parses an image's points (x, y, id) and returns their ids, without -1, which means no point.
    /// `None` if the line is something else.
    fn points(&self) -> Option<Vec<u64>> {
        let mut points = Vec::new();
        for point in self.words.chunks(3) {
            let [x, y, id] = point else { return None };
            x.parse::<f64>().ok()?;
            y.parse::<f64>().ok()?;
            points.extend(u64::try_from(id.parse::<i64>().ok()?).ok());
        }
        Some(points)
    }

    /// Parses the word with an index; `what` describes it in errors.
    fn number<T: std::str::FromStr>(&self, index: usize, what: &str) -> anyhow::Result<T> {
        let word = self.words.get(index).ok_or_else(|| self.error(format!("{what} is missing")))?;
        word.parse()
            .map_err(|_| self.error(format!("{what}: {:?} is not a valid number", shortened(word))))
    }
}
