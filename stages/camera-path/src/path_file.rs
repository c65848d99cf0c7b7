//! Camera paths in nerfstudio's format, which the page of `viewer` records, too.

use anyhow::{Context as _, bail, ensure};
use artifact::{Failure, FailureExt as _, GivenInput};
use scene::{Camera, Intrinsics, Pose};
use serde::de::{Deserializer, Error, Unexpected};
use serde::{Deserialize, Serialize, Serializer};
use serde_json::Value;

/// Name of the file in the input `path` and in the artifact.
pub(crate) const PATH_FILE: &str = "camera_path.json";

/// Frames per second of computed paths; also the default of stage `video`.
const FRAMES_PER_SECOND: f64 = 30.0;

/// Frames per second of recorded paths that don't state them, as in nerfstudio's viewer.
const RECORDED_FRAMES_PER_SECOND: f64 = 24.0;

/// Maximum width and height of frames; also the maximum of the parameter `size`.
pub(crate) const MAX_SIDE: u32 = 65536;

/// Content of `camera_path.json`. Fields that don't determine the images, such as `crop`, are
/// ignored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct PathFile {
    #[serde(default = "perspective")]
    camera_type: String,
    /// Width of the frames in pixels.
    #[serde(deserialize_with = "read_side")]
    render_width: u32,
    /// Height of the frames in pixels.
    #[serde(deserialize_with = "read_side")]
    render_height: u32,
    /// Frames per second.
    #[serde(default = "recorded_rate", serialize_with = "write_rate")]
    fps: f64,
    /// Duration, from the number of frames and `fps`.
    #[serde(skip_deserializing)]
    seconds: f64,
    /// True if the path is a loop: the first frame follows the last. nerfstudio's add-on for
    /// Blender writes a string.
    #[serde(default)]
    is_cycle: Value,
    #[serde(default)]
    smoothness_value: f64,
    /// Angle of view of new keys in nerfstudio's viewer, in degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    default_fov: Option<f64>,
    /// Seconds between keys.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    default_transition_sec: Option<f64>,
    /// Keys, from which nerfstudio's viewer computes the frames.
    #[serde(default)]
    keyframes: Vec<Value>,
    /// Frames in their order.
    #[serde(default)]
    camera_path: Vec<PathFrame>,
}

/// Frame of a path.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct PathFrame {
    /// 4×4 matrix, row by row; OpenGL's axes.
    camera_to_world: [f64; 16],
    /// Vertical angle of view in degrees.
    fov: f64,
    /// Width over height; nerfstudio uses `render_width` and `render_height` instead.
    #[serde(default)]
    aspect: f64,
}

fn perspective() -> String {
    "perspective".to_owned()
}

fn recorded_rate() -> f64 {
    RECORDED_FRAMES_PER_SECOND
}

/// Reads a width or height in pixels; programs may write 1920.0.
fn read_side<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    let side = f64::deserialize(deserializer)?;
    if (1.0..=f64::from(MAX_SIDE)).contains(&side) && side.fract() == 0.0 {
        Ok(side as u32)
    } else {
        let expected = format!("a whole number from 1 to {MAX_SIDE}");
        Err(D::Error::invalid_value(Unexpected::Float(side), &expected.as_str()))
    }
}

/// Writes a rate, as a whole number if possible: nerfstudio expects one.
fn write_rate<S: Serializer>(rate: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    if rate.fract() == 0.0 && *rate < f64::from(u32::MAX) {
        serializer.serialize_u32(*rate as u32)
    } else {
        serializer.serialize_f64(*rate)
    }
}

impl PathFile {
    /// Creates a path whose frames have the size and focal length of a camera. Every frame is a
    /// key. Frames have square pixels and the principal point in the middle, since the format has
    /// only one angle of view. This angle isn't wider than the camera's.
    pub(crate) fn new(camera: &Intrinsics, poses: &[Pose], is_cycle: bool) -> Self {
        let height = f64::from(camera.height);
        let fov = 2.0 * (0.5 * height / camera.fx.max(camera.fy)).atan().to_degrees();
        let aspect = f64::from(camera.width) / height;
        let camera_path: Vec<PathFrame> = (poses.iter())
            .map(|pose| PathFrame { camera_to_world: matrix_of(pose), fov, aspect })
            .collect();
        // As nerfstudio's viewer reads it.
        let key = |frame: &PathFrame| {
            serde_json::json!({
                "matrix": frame.camera_to_world,
                "fov": fov,
                "aspect": frame.aspect,
                "override_transition_enabled": false,
                "override_transition_sec": null,
            })
        };
        Self {
            camera_type: perspective(),
            render_width: camera.width,
            render_height: camera.height,
            fps: FRAMES_PER_SECOND,
            seconds: 0.0,
            is_cycle: Value::Bool(is_cycle),
            smoothness_value: 0.0,
            default_fov: Some(fov),
            default_transition_sec: Some(1.0 / FRAMES_PER_SECOND),
            keyframes: camera_path.iter().map(key).collect(),
            camera_path,
        }
        .with_derived_fields()
    }

    /// Reads and checks a recorded path.
    ///
    /// # Errors
    /// [`Failure::BadInput`] with the file, the field and the remedy.
    pub(crate) fn read(input: &GivenInput) -> Result<Self, Failure> {
        let path: Self = input.read_json(PATH_FILE)?;
        path.check().bad_input(input.path(PATH_FILE).display())?;
        Ok(path.with_derived_fields())
    }

    fn check(&self) -> anyhow::Result<()> {
        ensure!(
            self.camera_type == perspective(),
            "camera_type {} isn't supported; record the path with perspective",
            self.camera_type
        );
        ensure!(self.fps > 0.0 && self.fps.is_finite(), "fps {} isn't above 0", self.fps);
        if self.camera_path.is_empty() {
            ensure!(
                !self.keyframes.is_empty(),
                "camera_path has no frame; add a key in the viewer"
            );
            bail!(
                "camera_path has no frame, only {} in keyframes; record the path again with its \
                frames, in nerfstudio's viewer by Generate Command",
                artifact::format_count(self.keyframes.len(), "key")
            );
        }
        for (index, (frame, camera)) in self.camera_path.iter().zip(self.cameras()).enumerate() {
            ensure!(
                frame.fov > 0.0 && frame.fov < 180.0,
                "camera_path[{index}]: fov {} isn't between 0 and 180 degrees",
                frame.fov
            );
            camera.check().with_context(|| format!("camera_path[{index}]"))?;
        }
        Ok(())
    }

    /// Returns the path with another width and, up to a pixel, the same aspect.
    #[must_use]
    pub(crate) fn resized(mut self, width: u32) -> Self {
        let height = f64::from(width) / self.aspect();
        self.render_width = width;
        self.render_height = height.round().clamp(1.0, f64::from(MAX_SIDE)) as u32;
        self.with_derived_fields()
    }

    /// Returns width over height.
    fn aspect(&self) -> f64 {
        f64::from(self.render_width) / f64::from(self.render_height)
    }

    /// Sets the fields that follow from others.
    fn with_derived_fields(mut self) -> Self {
        self.seconds = self.camera_path.len() as f64 / self.fps;
        let aspect = self.aspect();
        for frame in &mut self.camera_path {
            frame.aspect = aspect;
        }
        self
    }

    /// Returns a camera per frame.
    pub(crate) fn cameras(&self) -> Vec<Camera> {
        let (width, height) = (self.render_width, self.render_height);
        let cameras = self.camera_path.iter().enumerate().map(|(index, frame)| {
            let slope = (0.5 * frame.fov.to_radians()).tan() * self.aspect();
            Camera {
                name: format!("frame_{index:05}"),
                intrinsics: Intrinsics::from_angle_x(width, height, 2.0 * slope.atan()),
                camera_to_world: pose_of(&frame.camera_to_world),
            }
        });
        cameras.collect()
    }
}

/// Returns a pose's 4×4 matrix, row by row.
fn matrix_of(pose: &Pose) -> [f64; 16] {
    let mut matrix = [0.0; 16];
    for (row, values) in matrix.chunks_exact_mut(4).zip(pose) {
        row.copy_from_slice(values);
    }
    matrix[15] = 1.0;
    matrix
}

/// Returns the pose in a 4×4 matrix.
fn pose_of(m: &[f64; 16]) -> Pose {
    [0, 4, 8].map(|row| [m[row], m[row + 1], m[row + 2], m[row + 3]])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads the path in a file with this text, or returns the error's message.
    fn read(text: &str) -> Result<PathFile, String> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(PATH_FILE), text).unwrap();
        let input = GivenInput::open("path", folder.path()).unwrap();
        PathFile::read(&input).map_err(|failure| failure.to_string())
    }

    /// Path file with one frame, as written by nerfstudio.
    const FILE: &str = r#"{"default_fov": 60, "default_transition_sec": 4.0, "keyframes": [
        {"matrix": [0,0,1,5, 1,0,0,6, 0,1,0,7, 0,0,0,1], "fov": 60, "aspect": 1.3333,
        "override_transition_enabled": false, "override_transition_sec": null}],
        "camera_type": "perspective", "render_height": 30.0, "render_width": 40, "fps": 30,
        "seconds": 4, "is_cycle": false, "smoothness_value": 0.0, "crop": null, "camera_path": [
        {"camera_to_world": [0,0,1,5, 1,0,0,6, 0,1,0,7, 0,0,0,1], "fov": 60, "aspect": 1.3333,
        "render_time": 0.5}]}"#;

    #[test]
    fn frames_are_cameras() {
        let cameras = read(FILE).unwrap().cameras();
        let [camera] = &cameras[..] else { panic!("{cameras:?}") };
        assert_eq!(camera.camera_to_world, [[0., 0., 1., 5.], [1., 0., 0., 6.], [0., 1., 0., 7.]]);
        let k = camera.intrinsics;
        assert_eq!((k.width, k.height, k.cx, k.cy), (40, 30, 20.0, 15.0));
        // `fov` is the vertical angle of view.
        let focal = 15.0 / 30f64.to_radians().tan();
        assert!((k.fx - focal).abs() < 1e-9 && (k.fy - focal).abs() < 1e-9, "{k:?}");
    }

    /// Checks that a path is equal after writing and reading; returns the file's JSON.
    fn round_trip(path: &PathFile) -> Value {
        let text = serde_json::to_string(path).unwrap();
        let reread = read(&text).unwrap();
        assert_eq!(&reread, path);
        assert_eq!(reread.cameras(), path.cameras());
        serde_json::from_str(&text).unwrap()
    }

    /// Files have the fields that nerfstudio's viewer writes and its `get_path_from_json` reads.
    #[test]
    fn files_have_nerfstudios_fields_and_round_trip() {
        let camera = Intrinsics { fy: 61.0, cx: 18.0, ..Intrinsics::from_angle_x(40, 30, 0.7) };
        let poses = [0.1, 0.2, 0.3].map(|x| {
            scene::looking_at(glam::DVec3::new(x, x * x, 3.0), glam::DVec3::ZERO, glam::DVec3::Y)
        });
        let path = PathFile::new(&camera, &poses, true);
        let file = round_trip(&path);
        let numbers = ["render_width", "render_height", "fps", "seconds", "smoothness_value"];
        assert_eq!(numbers.map(|name| file[name].as_f64().unwrap()), [40., 30., 30., 0.1, 0.]);
        assert_eq!(
            (&file["is_cycle"], &file["camera_type"]),
            (&true.into(), &"perspective".into())
        );
        for list in ["camera_path", "keyframes"] {
            assert_eq!(file[list].as_array().unwrap().len(), 3, "{list}");
        }
        let (frame, key) = (&file["camera_path"][1], &file["keyframes"][1]);
        assert_eq!(frame["camera_to_world"], key["matrix"]);
        assert_eq!(frame["camera_to_world"].as_array().unwrap()[12..], [0., 0., 0., 1.]);
        assert_eq!((&frame["fov"], &frame["aspect"]), (&key["fov"], &key["aspect"]));
        let k = path.cameras()[2].intrinsics;
        assert!((k.fx - 61.0).abs() < 1e-9 && (k.fy - 61.0).abs() < 1e-9 && k.cx == 20.0, "{k:?}");
    }

    #[test]
    fn the_largest_frames_are_read_back() {
        let portrait = Intrinsics::from_angle_x(30, 40, 0.7);
        let height = crate::height_at(MAX_SIDE, &portrait);
        assert_eq!(crate::height_at(60, &portrait), 80);
        let pose = scene::looking_at(glam::DVec3::Z, glam::DVec3::ZERO, glam::DVec3::Y);
        let path = PathFile::new(&portrait.resized(MAX_SIDE, height), &[pose], true);
        assert_eq!(round_trip(&path)["render_height"], MAX_SIDE);
    }

    /// A recorded path keeps its keys, frame rate and angles of view, also at another size.
    #[test]
    fn recorded_paths_round_trip() {
        let path = read(FILE).unwrap();
        round_trip(&path);
        let file = round_trip(&path.resized(80));
        assert_eq!((&file["fps"], &file["render_height"]), (&30.into(), &60.into()));
        assert_eq!(file["seconds"].as_f64(), Some(1.0 / 30.0));
        assert_eq!(file["camera_path"][0]["fov"], 60.0);
        assert_eq!(file["keyframes"].as_array().unwrap().len(), 1);
        // nerfstudio's add-on for Blender writes `is_cycle` as a string.
        read(&FILE.replace("\"is_cycle\": false", "\"is_cycle\": \"false\"")).unwrap();
    }

    #[test]
    fn errors_name_the_file_and_the_field() {
        for (from, to, expected) in [
            ("perspective", "equirectangular", "camera_type equirectangular isn't supported"),
            (
                "\"render_width\": 40",
                "\"render_width\": 0",
                "render_width: expected a whole number from 1 to 65536, found 0",
            ),
            ("30.0", "30.5", "expected a whole number from 1 to 65536"),
            ("\"fps\": 30", "\"fps\": 0", "fps 0 isn't above 0"),
            (
                "\"fov\": 60, \"aspect\": 1.3333,\n        \"r",
                "\"fov\": 180, \"r",
                "camera_path[0]: fov 180 isn't between",
            ),
            ("_world\": [0,0,1,5,", "_world\": [0,0,2,5,", "camera_path[0]"),
            (
                "0,0,0,1], \"fov\": 60, \"aspect\": 1.3333,\n        \"r",
                "0,0,0], \"r",
                "camera_path[0].camera_to_world",
            ),
            ("\"camera_path\"", "\"other\"", "no frame, only 1 key in keyframes"),
        ] {
            let changed = FILE.replace(from, to);
            assert_ne!(changed, FILE, "{from}");
            let message = read(&changed).unwrap_err();
            assert!(message.contains(expected) && message.contains(PATH_FILE), "{message}");
        }
        let no_frames = r#"{"render_height": 3, "render_width": 4, "camera_path": []}"#;
        assert!(read(no_frames).unwrap_err().contains("no frame; add a key"));
    }
}
