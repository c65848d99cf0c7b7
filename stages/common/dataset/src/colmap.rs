use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use artifact::counted;
use glam::{DMat3, DQuat, DVec3};
use scene::Intrinsics;

use crate::bytes::Bytes;
use crate::colmap_camera::CameraModel;
use crate::dataset::Dataset;
use crate::error::DatasetError;
use crate::file_reason::FileReason;
use crate::format::Format;
use crate::found::{check_link, is_file, is_hidden};
use crate::frame::{Frame, names, pose_from_world_to_camera};
use crate::frame_reason::FrameReason;
use crate::lookup::{Listings, Located, Lookup, reduced_copies};
use crate::photograph::{fitted, look};
use crate::reach::Reach;
use crate::text::read_text;

/// A reconstruction as COLMAP writes it (its documentation, "Output format").
#[derive(Debug, Default)]
struct Model {
    cameras: BTreeMap<u32, Intrinsics>,
    images: Vec<Image>,
    points: BTreeMap<u64, DVec3>,
}

#[derive(Debug)]
struct Image {
    /// World to camera; axes right, down, forward.
    rotation: DMat3,
    translation: DVec3,
    camera: u32,
    name: String,
    /// Points that it sees.
    points: Vec<u64>,
}

impl Image {
    /// Centre of its camera in world space.
    fn centre(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }
}

/// Returns the folders below `sparse` that contain a model, by name. Where there are none, and the
/// data set's folder has images, those below `sparse` in its sub-folders without images: nerfstudio
/// writes `colmap/sparse/0`.
pub(crate) fn models(folder: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let found = with_list(folder, "images")?;
    if !found.is_empty() || !has_images(folder) {
        return Ok(found);
    }
    let mut below: Vec<PathBuf> =
        std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
    below.retain(|path| !is_hidden(path) && !has_images(path));
    below.sort();
    let mut models = Vec::new();
    for path in &below {
        models.extend(with_list(path, "images")?);
    }
    Ok(models)
}

/// True if a folder has photographs as COLMAP's users keep them: `images` or a reduced copy.
fn has_images(folder: &Path) -> bool {
    folder.join("images").is_dir() || !reduced_copies(&mut Listings::new(folder)).is_empty()
}

/// Returns the names of the images of the first model below `sparse`, if there is one.
pub(crate) fn image_names(folder: &Path) -> Result<Vec<String>, DatasetError> {
    let mut model = Model::default();
    if let Some(first) = with_list(folder, "images")?.first() {
        model.read_images(first)?;
    }
    Ok(model.images.into_iter().map(|image| image.name).collect())
}

/// The camera of the first model below `sparse`, where that has one alone. What images the model
/// has isn't looked at.
pub(crate) fn only_camera(folder: &Path) -> Result<Option<Intrinsics>, DatasetError> {
    let mut model = Model::default();
    if let Some(first) = with_list(folder, "cameras")?.first() {
        model.read_cameras(first)?;
    }
    let mut cameras = model.cameras.into_values();
    Ok(cameras.next().filter(|_| cameras.next().is_none()))
}

/// `sparse` and the folders in it that have a list of such things, binary or as text, in order.
fn with_list(folder: &Path, things: &str) -> Result<Vec<PathBuf>, DatasetError> {
    let sparse = folder.join("sparse");
    check_link(&sparse)?;
    let mut found: Vec<PathBuf> =
        std::fs::read_dir(&sparse).into_iter().flatten().flatten().map(|e| e.path()).collect();
    found.retain(|path| !is_hidden(path));
    found.sort();
    found.insert(0, sparse);
    let mut with_list = Vec::new();
    for path in found {
        let list = path.join(things);
        if is_file(&list.with_extension("bin"))? || is_file(&list.with_extension("txt"))? {
            with_list.push(path);
        }
    }
    Ok(with_list)
}

/// Reads the model with most images, the first of several, and the images that it names.
pub(crate) fn read(folder: &Path) -> Result<Dataset, DatasetError> {
    let models = models(folder)?;
    let (path, mut model, mut notes) = largest_model(folder, &models)?;
    notes.extend(model.remove_wild_points());
    // By name: the order in which COLMAP happened to register them means nothing.
    model.images.sort_by(|a, b| a.name.cmp(&b.name));
    let list =
        path.join(if path.join("images.bin").is_file() { "images.bin" } else { "images.txt" });
    check_link(&folder.join("images"))?;
    let named: Vec<&str> = model.images.iter().map(|image| image.name.as_str()).collect();
    let mut lookup = Lookup::in_images(folder, &named);
    let (mut frames, mut labels, mut missing) = (Vec::new(), Vec::new(), Vec::new());
    for (index, image) in model.images.iter().enumerate() {
        let of_frame = |reason| DatasetError::frame(&list, index, &image.name, reason);
        match lookup.find(&image.name).map_err(|e| of_frame(e.into()))? {
            Located::File(file) => {
                frames.push(model.frame(image, folder.join(&file.path)).map_err(of_frame)?);
                labels.push(lookup.without_base(&file.label));
            }
            Located::Nothing(_) => missing.push(&image.name),
            Located::Other(found) => {
                let remedy = "put the photograph there";
                return Err(of_frame(FrameReason::Place { found, remedy }));
            }
        }
    }
    if frames.is_empty() {
        let reason = match missing.first() {
            Some(first) => FileReason::ImagesMissing {
                count: missing.len(),
                folder: Some(lookup.base()),
                first: first.to_string(),
            },
            None => FileReason::NoImages,
        };
        return Err(DatasetError::format(&list, reason));
    }
    if let Some(first) = missing.first() {
        notes.push(format!(
            "{} of {} images have no picture and are left out, first {first}",
            missing.len(),
            model.images.len()
        ));
    }
    notes.extend(lookup.notes());
    for (frame, name) in frames.iter_mut().zip(names(&list, &labels)?) {
        frame.name = name;
    }
    Ok(Dataset { format: Format::Colmap, frames, split: None, notes })
}

/// The first model with most images: its folder, itself, and notes on the choice.
fn largest_model<'a>(
    folder: &Path,
    models: &'a [PathBuf],
) -> Result<(&'a Path, Model, Vec<String>), DatasetError> {
    let mut largest: Option<(&Path, Model)> = None;
    let mut sizes = Vec::new();
    for path in models {
        let model = Model::read(path)?;
        let name = path.strip_prefix(folder).unwrap_or(path).display();
        sizes.push(format!("{name} has {}", model.images.len()));
        if largest.as_ref().is_none_or(|(_, best)| model.images.len() > best.images.len()) {
            largest = Some((path, model));
        }
    }
    let (path, model) = largest
        .ok_or_else(|| DatasetError::Unknown { path: folder.to_path_buf(), nearby: None })?;
    let photographs = counted(model.images.len(), "photograph");
    let name = path.strip_prefix(folder).unwrap_or(path).display();
    let mut notes = vec![format!("COLMAP: {photographs} of {name}")];
    if models.len() > 1 {
        notes.push(format!(
            "of {} models the one with most images is taken: {}",
            models.len(),
            sizes.join(", ")
        ));
    }
    Ok((path, model, notes))
}

/// A file of a folder, if it is there.
fn bytes_of(folder: &Path, name: &str) -> Result<Option<(PathBuf, Vec<u8>)>, DatasetError> {
    let path = folder.join(name);
    if !is_file(&path)? {
        return Ok(None);
    }
    let bytes =
        std::fs::read(&path).map_err(|source| DatasetError::Io { path: path.clone(), source })?;
    Ok(Some((path, bytes)))
}

impl Model {
    fn read(folder: &Path) -> Result<Self, DatasetError> {
        let mut model = Self::default();
        model.read_cameras(folder)?;
        model.read_images(folder)?;
        if let Some((path, points)) = bytes_of(folder, "points3D.bin")? {
            model.binary_points(&mut Bytes::new(&path, &points))?;
        } else if is_file(&folder.join("points3D.txt"))? {
            model.text_points(&folder.join("points3D.txt"))?;
        }
        Ok(model)
    }

    fn read_cameras(&mut self, folder: &Path) -> Result<(), DatasetError> {
        match bytes_of(folder, "cameras.bin")? {
            Some((path, cameras)) => self.binary_cameras(&mut Bytes::new(&path, &cameras)),
            None => self.text_cameras(&folder.join("cameras.txt")),
        }
    }

    fn read_images(&mut self, folder: &Path) -> Result<(), DatasetError> {
        match bytes_of(folder, "images.bin")? {
            Some((path, images)) => self.binary_images(&mut Bytes::new(&path, &images)),
            None => self.text_images(&folder.join("images.txt")),
        }
    }

    fn binary_cameras(&mut self, bytes: &mut Bytes<'_>) -> Result<(), DatasetError> {
        for _ in 0..bytes.count(24, "cameras")? {
            let id = bytes.u32("a camera")?;
            let model = bytes.u32("a camera")?;
            let (width, height) = (bytes.u64("a camera")?, bytes.u64("a camera")?);
            let Some(model) = CameraModel::of_number(model) else {
                return Err(bytes.error(FileReason::ModelNumber { id, model }));
            };
            let parameters = (0..model.parameters)
                .map(|_| bytes.f64("a camera"))
                .collect::<Result<Vec<_>, _>>()?;
            let intrinsics = model
                .intrinsics(width, height, &parameters)
                .map_err(|reason| bytes.error(reason.of_camera(id)))?;
            self.cameras.insert(id, intrinsics);
        }
        end(bytes, "cameras")
    }

    fn binary_images(&mut self, bytes: &mut Bytes<'_>) -> Result<(), DatasetError> {
        for _ in 0..bytes.count(73, "images")? {
            let id = bytes.u32("an image")?;
            let (turn, translation) = (bytes.f64s::<4>("an image")?, bytes.f64s::<3>("an image")?);
            let camera = bytes.u32("an image")?;
            let name = bytes.text("an image's name")?.to_owned();
            let rotation =
                rotation(turn).map_err(|reason| bytes.error(reason.of_image(id, &name)))?;
            let mut points = Vec::new();
            for _ in 0..bytes.count(24, "points of an image")? {
                bytes.take(16, "a point of an image")?;
                points.push(bytes.u64("a point of an image")?);
            }
            self.images.push(Image {
                rotation,
                translation: translation.into(),
                camera,
                name,
                points,
            });
        }
        end(bytes, "images")
    }

    fn binary_points(&mut self, bytes: &mut Bytes<'_>) -> Result<(), DatasetError> {
        for _ in 0..bytes.count(51, "points")? {
            let id = bytes.u64("a point")?;
            self.points.insert(id, bytes.f64s::<3>("a point")?.into());
            bytes.take(11, "a point")?;
            let track = bytes.count(8, "images of a point")?;
            bytes.take(8 * track, "a point's images")?;
        }
        end(bytes, "points")
    }

    fn text_cameras(&mut self, path: &Path) -> Result<(), DatasetError> {
        for line in Line::all(path, &read_text(path)?).filter(|l| !l.words.is_empty()) {
            let id = line.number(0, "camera id")?;
            let name = line.words.get(1).copied().unwrap_or_default();
            let (width, height) = (line.number(2, "width")?, line.number(3, "height")?);
            let parameters = (4..line.words.len())
                .map(|i| line.number(i, "parameter"))
                .collect::<Result<Vec<f64>, _>>()?;
            let Some(model) = CameraModel::of_name(name) else {
                return Err(line.error(FileReason::ModelName { model: name.to_owned() }));
            };
            let intrinsics = model
                .intrinsics(width, height, &parameters)
                .map_err(|reason| line.error(reason))?;
            self.cameras.insert(id, intrinsics);
        }
        Ok(())
    }

    fn text_images(&mut self, path: &Path) -> Result<(), DatasetError> {
        let text = read_text(path)?;
        // Two lines an image; the second, its points, may be empty.
        let mut lines = Line::all(path, &text);
        while let Some(line) = lines.next() {
            if line.words.is_empty() {
                continue;
            }
            let turn = [1, 2, 3, 4].map(|i| line.number(i, "rotation"));
            let [w, x, y, z] = turn;
            let rotation = rotation([w?, x?, y?, z?]).map_err(|reason| line.error(reason))?;
            let translation = DVec3::new(
                line.number(5, "translation")?,
                line.number(6, "translation")?,
                line.number(7, "translation")?,
            );
            let camera = line.number(8, "camera id")?;
            if line.words.len() < 10 {
                return Err(line.error(FileReason::Missing { what: "an image's name" }));
            }
            let name = line.after(9).to_owned();
            let points = match lines.next() {
                None => Vec::new(),
                Some(second) => second.points().ok_or_else(|| {
                    let reason = FileReason::PointsExpected {
                        line: second.number,
                        image: line.words[0].to_owned(),
                    };
                    DatasetError::format(path, reason)
                })?,
            };
            self.images.push(Image { rotation, translation, camera, name, points });
        }
        Ok(())
    }

    fn text_points(&mut self, path: &Path) -> Result<(), DatasetError> {
        for line in Line::all(path, &read_text(path)?).filter(|l| !l.words.is_empty()) {
            let id = line.number(0, "point id")?;
            let at = DVec3::new(line.number(1, "x")?, line.number(2, "y")?, line.number(3, "z")?);
            self.points.insert(id, at);
        }
        Ok(())
    }

    /// Removes points whose depth no two of the photographs can tell, and says how many.
    fn remove_wild_points(&mut self) -> Option<String> {
        let centres: Vec<DVec3> = self.images.iter().map(Image::centre).collect();
        let focal = self.cameras.values().map(|k| k.fx.max(k.fy)).fold(0.0, f64::max);
        let before = self.points.len();
        let reach = Reach::new(&centres, focal)?;
        self.points.retain(|_, point| reach.contains(*point));
        let wild = before - self.points.len();
        (wild > 0).then(|| reach.note(wild, before))
    }

    fn frame(&self, image: &Image, file: PathBuf) -> Result<Frame, FrameReason> {
        let id = image.camera;
        let camera = self.cameras.get(&id).ok_or(FrameReason::NoCamera { id })?;
        let (taken_with, turn) = fitted(*camera, look(&file)?)
            .map_err(|reason| FrameReason::OfCamera { id, reason: Box::new(reason) })?;
        let camera_to_world = pose_from_world_to_camera(image.rotation, image.translation);
        let depths = depths(image, camera, &self.points);
        let frame = Frame {
            name: String::new(),
            image: file,
            turn,
            mask: None,
            depth: None,
            taken_with,
            pinhole: None,
            camera_to_world,
            depths,
        };
        frame.check()?;
        Ok(frame)
    }
}

/// Returns the 0.1 and 99.9 % quantiles of the depths of what an image sees, or of the distances
/// through a fisheye lens: a few points are always wrong.
fn depths(image: &Image, camera: &Intrinsics, points: &BTreeMap<u64, DVec3>) -> Option<[f64; 2]> {
    let seen: BTreeSet<u64> = image.points.iter().copied().collect();
    let in_camera = |id: &u64| points.get(id).map(|p| image.rotation * *p + image.translation);
    let is_fisheye = camera.distortion.is_fisheye();
    let depth = |id: &u64| in_camera(id).map(|p| if is_fisheye { p.length() } else { p.z });
    let mut depths: Vec<f64> =
        seen.iter().filter_map(depth).filter(|d| d.is_finite() && *d > 0.0).collect();
    depths.sort_unstable_by(f64::total_cmp);
    let last = depths.len().checked_sub(1)?;
    let share = |s: f64| depths[(s * last as f64).round() as usize];
    let (near, far) = (share(0.001), share(0.999));
    (near < far).then_some([near, far])
}

/// The rotation of a quaternion (w, x, y, z), which needn't have unit length.
fn rotation([w, x, y, z]: [f64; 4]) -> Result<DMat3, FileReason> {
    let quaternion = DQuat::from_xyzw(x, y, z, w);
    let length = quaternion.length();
    if !(length.is_finite() && length > 1e-9) {
        return Err(FileReason::Rotation([w, x, y, z]));
    }
    Ok(DMat3::from_quat(quaternion * (1.0 / length)))
}

fn end(bytes: &Bytes<'_>, what: &'static str) -> Result<(), DatasetError> {
    if bytes.is_empty() { Ok(()) } else { Err(bytes.error(FileReason::More { what })) }
}

/// A line of a text file, without those that begin with `#`.
struct Line<'a> {
    path: &'a Path,
    number: usize,
    text: &'a str,
    words: Vec<&'a str>,
}

impl<'a> Line<'a> {
    fn all(path: &'a Path, text: &'a str) -> impl Iterator<Item = Self> {
        let lines = text.lines().enumerate().filter(|(_, line)| !line.starts_with('#'));
        lines.map(move |(i, line)| Self {
            path,
            number: i + 1,
            text: line,
            words: line.split_whitespace().collect(),
        })
    }

    fn error(&self, reason: FileReason) -> DatasetError {
        DatasetError::format(self.path, reason.on_line(self.number))
    }

    /// Returns the rest of the line after a number of words, with the spaces in it: a file's name.
    fn after(&self, words: usize) -> &'a str {
        let mut rest = self.text.trim();
        for word in &self.words[..words.min(self.words.len())] {
            rest = rest[word.len()..].trim_start();
        }
        rest
    }

    /// Returns the numbers of an image's points, listed as x, y and number; nothing where the line
    /// is something else. -1 is no point of the model.
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

    fn number<T: std::str::FromStr>(
        &self,
        index: usize,
        what: &'static str,
    ) -> Result<T, DatasetError> {
        let Some(word) = self.words.get(index) else {
            return Err(self.error(FileReason::Missing { what }));
        };
        word.parse()
            .map_err(|_| self.error(FileReason::NoNumber { what, word: (*word).to_owned() }))
    }
}

#[cfg(test)]
mod tests {
    use scene::Distortion;

    use super::*;
    use crate::photograph::tests::write_png;

    const CAMERAS: &str = "# Camera list\n1 SIMPLE_RADIAL 80 60 70 40 30 -0.1\n2 OPENCV 80 60 70 \
        71 41 29 0.1 0.01 0.001 -0.002\n";
    const IMAGES: &str = "# Image list\n7 1 0 0 0 0 0 3 1 b 1.png\n10 10 5 20 20 6 30 30 -1\n3 0 \
        0 0 2 1 2 3 2 a.png\n\n";
    const POINTS: &str = "5 0 0 1 255 0 0 0.1 7 0\n6 0 0 2 255 0 0 0.1 7 1\n";

    fn binary() -> [Vec<u8>; 3] {
        let mut cameras = 2u64.to_le_bytes().to_vec();
        for (id, model, parameters) in [
            (1u32, 2u32, &[70., 40., 30., -0.1][..]),
            (2, 4, &[70., 71., 41., 29., 0.1, 0.01, 0.001, -0.002]),
        ] {
            cameras.extend([id.to_le_bytes(), model.to_le_bytes()].concat());
            cameras.extend([80u64.to_le_bytes(), 60u64.to_le_bytes()].concat());
            cameras.extend(parameters.iter().flat_map(|p: &f64| p.to_le_bytes()));
        }
        let mut images = 2u64.to_le_bytes().to_vec();
        for (id, pose, camera, name, points) in [
            (7u32, [1., 0., 0., 0., 0., 0., 3.0f64], 1u32, "b 1.png", &[5u64, 6, u64::MAX][..]),
            (3, [0., 0., 0., 2., 1., 2., 3.], 2, "a.png", &[]),
        ] {
            images.extend(id.to_le_bytes());
            images.extend(pose.iter().flat_map(|p| p.to_le_bytes()));
            images.extend(camera.to_le_bytes());
            images.extend(name.as_bytes());
            images.push(0);
            images.extend((points.len() as u64).to_le_bytes());
            for (i, point) in points.iter().enumerate() {
                images.extend([10.0 * (i + 1) as f64; 2].iter().flat_map(|p| p.to_le_bytes()));
                images.extend(point.to_le_bytes());
            }
        }
        let mut points = 2u64.to_le_bytes().to_vec();
        for (id, z) in [(5u64, 1.0f64), (6, 2.0)] {
            points.extend(id.to_le_bytes());
            points.extend([0.0, 0.0, z].iter().flat_map(|p| p.to_le_bytes()));
            points.extend([255, 0, 0]);
            points.extend(0.1f64.to_le_bytes());
            points.extend(1u64.to_le_bytes());
            points.extend([7u32.to_le_bytes(), 0u32.to_le_bytes()].concat());
        }
        [cameras, images, points]
    }

    fn folder(model: &str, files: &[(&str, &[u8])]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        add(&dir, model, files);
        std::fs::create_dir(dir.path().join("images")).unwrap();
        for name in ["a.png", "b 1.png"] {
            write_png(&dir.path().join("images").join(name), 40, 30);
        }
        dir
    }

    fn add(dir: &tempfile::TempDir, model: &str, files: &[(&str, &[u8])]) {
        let sparse = dir.path().join(model);
        std::fs::create_dir_all(&sparse).unwrap();
        files.iter().for_each(|(name, bytes)| std::fs::write(sparse.join(name), bytes).unwrap());
    }

    fn text<'a>(
        cameras: &'a str,
        images: &'a str,
        points: &'a str,
    ) -> [(&'static str, &'a [u8]); 3] {
        [
            ("cameras.txt", cameras.as_bytes()),
            ("images.txt", images.as_bytes()),
            ("points3D.txt", points.as_bytes()),
        ]
    }

    fn with_relative_images(set: &Dataset) -> Vec<Frame> {
        set.frames
            .iter()
            .map(|f| Frame { image: f.image.file_name().unwrap().into(), ..f.clone() })
            .collect()
    }

    #[test]
    fn binary_and_text_are_the_same() {
        let [cameras, images, points] = binary();
        let binary = folder(
            "sparse/0",
            &[("cameras.bin", &cameras), ("images.bin", &images), ("points3D.bin", &points)],
        );
        let text = folder("sparse/0", &text(CAMERAS, IMAGES, POINTS));
        let (one, other) =
            (Dataset::read(binary.path()).unwrap(), Dataset::read(text.path()).unwrap());
        assert_eq!(one.notes, other.notes);
        assert!(
            one.notes.contains(&"2 photographs have lens distortion".to_owned()),
            "{:?}",
            one.notes
        );
        assert_eq!(with_relative_images(&one), with_relative_images(&other));
        let [a, b] = &one.frames[..] else { panic!("two frames") };
        assert_eq!((a.name.as_str(), b.name.as_str()), ("a", "b 1"));
        // Images of half the size; a turn by 180° about z; a camera that looks along +z sees (0, 0,
        // 1) at depth 1 + 3.
        assert_eq!(
            b.taken_with,
            Intrinsics {
                width: 40,
                height: 30,
                fx: 35.0,
                fy: 35.0,
                cx: 20.0,
                cy: 15.0,
                distortion: Distortion::brown([-0.1, 0.0, 0.0], [0.0; 2])
            }
        );
        assert_eq!(b.depths, Some([4.0, 5.0]));
        assert_eq!(b.camera_to_world, [[1., 0., 0., 0.], [0., -1., 0., 0.], [0., 0., -1., -3.]]);
        assert_eq!(a.taken_with.distortion, Distortion::brown([0.1, 0.01, 0.0], [0.001, -0.002]));
        assert_eq!(a.depths, None);
        assert!(
            (a.camera_to_world[0][3] - 1.0).abs() < 1e-12
                && (a.camera_to_world[2][3] + 3.0).abs() < 1e-12
        );
    }

    fn read_frames(dir: &Path) -> Vec<(String, Intrinsics, scene::Pose, Option<[f64; 2]>)> {
        let frames = Dataset::read(dir).unwrap().frames;
        frames.into_iter().map(|f| (f.name, f.taken_with, f.camera_to_world, f.depths)).collect()
    }

    /// As an editor on Windows leaves them.
    #[test]
    fn text_may_have_a_mark_and_other_line_ends() {
        let changed =
            [CAMERAS, IMAGES, POINTS].map(|text| format!("\u{feff}{}", text.replace('\n', "\r\n")));
        let (plain, other) = (
            folder("sparse/0", &text(CAMERAS, IMAGES, POINTS)),
            folder("sparse/0", &text(&changed[0], &changed[1], &changed[2])),
        );
        assert_eq!(read_frames(plain.path()), read_frames(other.path()));
        let latin = folder(
            "sparse/0",
            &[
                ("cameras.txt", CAMERAS.as_bytes()),
                ("images.txt", b"1 1 0 0 0 0 0 3 1 \xe4.png\n\n"),
            ],
        );
        let message = Dataset::read(latin.path()).unwrap_err().to_string();
        assert!(message.contains(r"images.txt: line 1: \xe4.png is not UTF-8"), "{message}");
    }

    /// Depths are those without the wild points, which are counted.
    #[test]
    fn wild_points_are_left_out() {
        let plain = folder("sparse/0", &text(CAMERAS, IMAGES, POINTS));
        for place in ["0 0 1e300", "0 0 1e6", "-1e6 0 1e6", "0 0 inf", "nan 0 1"] {
            let points = format!("{POINTS}8 {place} 255 0 0 0.1 7 0\n");
            let images = IMAGES.replace("30 30 -1", "30 30 8");
            let wild = folder("sparse/0", &text(CAMERAS, &images, &points));
            assert_eq!(read_frames(wild.path()), read_frames(plain.path()), "{place}");
            let notes = Dataset::read(wild.path()).unwrap().notes;
            assert!(notes[1].starts_with("1 of 3 points is left out: too far away"), "{notes:?}");
        }
        let notes = Dataset::read(plain.path()).unwrap().notes;
        assert!(!notes.iter().any(|note| note.contains("left out")), "{notes:?}");
    }

    /// What a link to nothing stands for is needed, or might be.
    #[test]
    fn links_to_nothing_are_named() {
        let files = text(CAMERAS, IMAGES, POINTS);
        for link in
            ["sparse", "images", "sparse/0/images.bin", "sparse/0/points3D.txt", "images/a.png"]
        {
            let dir = folder("sparse/0", &files);
            let path = dir.path().join(link);
            if path.is_dir() {
                std::fs::remove_dir_all(&path).unwrap();
            } else if path.is_file() {
                std::fs::remove_file(&path).unwrap();
            }
            std::os::unix::fs::symlink("gone", &path).unwrap();
            let message = Dataset::read(dir.path()).unwrap_err().to_string();
            let words =
                format!("{} is a symbolic link to gone, which is not there", path.display());
            assert!(message.contains(&words), "{message}");
        }
    }

    #[test]
    fn the_largest_model_is_taken_and_said() {
        let small = "1 1 0 0 0 0 0 3 1 a.png\n\n";
        let dir = folder("sparse/0", &text(CAMERAS, small, ""));
        add(&dir, "sparse/1", &text(CAMERAS, IMAGES, POINTS));
        let set = Dataset::read(dir.path()).unwrap();
        assert_eq!(set.frames.len(), 2);
        assert!(set.notes[0].contains("sparse/1"), "{:?}", set.notes);
        assert!(set.notes[1].contains("sparse/0 has 1, sparse/1 has 2"), "{:?}", set.notes);
    }

    fn read_texts(cameras: &str, images: &str) -> Result<Dataset, DatasetError> {
        Dataset::read(folder("sparse/0", &text(cameras, images, POINTS)).path())
    }

    #[test]
    fn mistakes_are_named() {
        for (from, to, words) in [
            ("SIMPLE_RADIAL", "FOV", "line 2: FOV has 5 parameters"),
            (
                "SIMPLE_RADIAL 80 60 70 40 30 -0.1",
                "FOV 80 60 70 70 40 30 -0.1",
                "camera model FOV is not supported; undistort with colmap image_undistorter",
            ),
            ("SIMPLE_RADIAL", "ROUND", "camera model \"ROUND\" is unknown"),
            ("1 SIMPLE_RADIAL", "9 SIMPLE_RADIAL", "frame 1 (b 1.png): there is no camera 1"),
            ("80 60 70 40", "0 60 70 40", "its size is 0×60"),
            ("80 60 70 40", "80 80 70 40", "another shape"),
            ("70 40 30 -0.1", "nan 40 30 -0.1", "fx is NaN"),
            ("30 -0.1", "30 inf", "lens distortion (k1 inf,"),
            ("70 40 30", "70 x 30", "line 2: parameter: \"x\""),
        ] {
            let message = read_texts(&CAMERAS.replace(from, to), IMAGES).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
        for (from, to, words) in [
            ("7 1 0 0 0", "7 0 0 0 0", "line 2: its rotation (0, 0, 0, 0) is none"),
            ("a.png", "../a.png", "not a path inside"),
            (" 1 b 1.png", "", "line 2: camera id is missing"),
            (" b 1.png", "", "line 2: an image's name is missing"),
        ] {
            let message = read_texts(CAMERAS, &IMAGES.replace(from, to)).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
        let gone = read_texts(CAMERAS, &IMAGES.replace("a.png", "gone.png")).unwrap();
        assert!(
            gone.frames.len() == 1 && gone.notes[1].contains("1 of 2 images have no picture"),
            "{:?}",
            gone.notes
        );
        let forged = read_texts(CAMERAS, &IMAGES.replace("a.png", "\u{1b}[31m.png")).unwrap();
        assert!(forged.notes[1].ends_with(r"first \u{1b}[31m.png"), "{:?}", forged.notes);
        let none = read_texts(CAMERAS, &IMAGES.replace(".png", ".jpg")).unwrap_err().to_string();
        assert!(none.contains("none of the 2 images exists in "), "{none}");
        assert!(
            read_texts(CAMERAS, "# nothing\n")
                .unwrap_err()
                .to_string()
                .contains("it has no images")
        );
    }

    fn with_number(number: u8) -> [Vec<u8>; 3] {
        let mut files = binary();
        files[0][12] = number;
        files
    }

    #[test]
    fn unknown_model_numbers_are_named() {
        for number in [11, 12, 13, 16, 17, 200] {
            let message = read_binaries(&with_number(number)).unwrap_err().to_string();
            let words = format!(
                "camera 1 has model {number}, which this program doesn't know (a newer COLMAP's?); \
                undistort with colmap image_undistorter"
            );
            assert!(message.ends_with(&words), "{message}");
        }
        // A fisheye model with as many parameters.
        let set = read_binaries(&with_number(8)).unwrap();
        assert_eq!(set.frames[1].taken_with.distortion, Distortion::fisheye([-0.1, 0.0, 0.0, 0.0]));
        assert!(
            set.notes.contains(&"1 photograph was taken with a fisheye lens".to_owned()),
            "{:?}",
            set.notes
        );
    }

    fn read_binaries(files: &[Vec<u8>; 3]) -> Result<Dataset, DatasetError> {
        let named = [
            ("cameras.bin", &files[0][..]),
            ("images.bin", &files[1][..]),
            ("points3D.bin", &files[2][..]),
        ];
        Dataset::read(folder("sparse/0", &named).path())
    }

    #[test]
    fn binaries_cut_anywhere_or_with_other_bytes_are_errors_and_no_panic() {
        let whole = binary();
        assert!(read_binaries(&whole).is_ok());
        for file in 0..3 {
            for end in 0..whole[file].len() {
                let mut cut = whole.clone();
                cut[file].truncate(end);
                assert!(read_binaries(&cut).is_err(), "{file} {end}");
            }
            for place in 0..whole[file].len() {
                let mut other = whole.clone();
                other[file][place] ^= 0xff;
                // Many are still a model; none may panic or allocate what isn't there.
                drop(read_binaries(&other));
            }
            let mut longer = whole.clone();
            longer[file].push(0);
            assert!(
                read_binaries(&longer)
                    .unwrap_err()
                    .to_string()
                    .contains("there is more after the last")
            );
        }
        let mut huge = whole.clone();
        huge[1][..8].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(read_binaries(&huge).unwrap_err().to_string().contains("can't be in the"));
    }
}
