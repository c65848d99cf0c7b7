//! Camera paths in nerfstudio's format, which the page of `viewer` records, too.

use artifact::{Failure, FailureExt as _, GivenInput};
use scene::{Camera, Intrinsics, Pose};
use serde::Deserialize;

/// Name of the file in the input `path`.
const PATH_FILE: &str = "camera_path.json";

/// Content of `camera_path.json`: the parts that determine the images.
#[derive(Debug, Deserialize)]
struct RecordedPath {
    #[serde(default = "perspective")]
    camera_type: String,
    render_width: u32,
    render_height: u32,
    /// Frames in their order.
    camera_path: Vec<RecordedFrame>,
}

/// Frame of a recorded path.
#[derive(Debug, Deserialize)]
struct RecordedFrame {
    /// 4×4 matrix, row by row; OpenGL's axes.
    camera_to_world: [f64; 16],
    /// Vertical angle of view in degrees.
    fov: f64,
}

fn perspective() -> String {
    "perspective".to_owned()
}

/// Reads the cameras of a recorded path: one per frame, of the recorded size.
///
/// # Errors
/// [`Failure::BadInput`] with the file, the frame and the remedy.
pub(crate) fn read_cameras(input: &GivenInput) -> Result<Vec<Camera>, Failure> {
    let path: RecordedPath = input.read_json(PATH_FILE)?;
    let file = input.path(PATH_FILE).display().to_string();
    let bad = |message: String| Failure::BadInput(format!("{file}: {message}"));
    if path.camera_type != perspective() {
        let message = format!(
            "camera_type {} isn't supported; record the path with perspective",
            path.camera_type
        );
        return Err(bad(message));
    }
    if path.render_width == 0 || path.render_height == 0 {
        return Err(bad("render_width and render_height must be at least 1".to_owned()));
    }
    if path.camera_path.is_empty() {
        return Err(bad("camera_path has no frame; add a key in the viewer".to_owned()));
    }
    let mut cameras = Vec::with_capacity(path.camera_path.len());
    for (index, frame) in path.camera_path.iter().enumerate() {
        let context = || format!("{file}: camera_path[{index}]");
        if !(frame.fov > 0.0 && frame.fov < 180.0) {
            let message = format!("{}: fov {} isn't between 0 and 180", context(), frame.fov);
            return Err(Failure::BadInput(message));
        }
        let camera = frame.camera(index, [path.render_width, path.render_height]);
        camera.check().bad_input(context())?;
        cameras.push(camera);
    }
    Ok(cameras)
}

impl RecordedFrame {
    /// Returns the frame's camera for images of the given size.
    fn camera(&self, index: usize, [width, height]: [u32; 2]) -> Camera {
        let slope = (0.5 * self.fov.to_radians()).tan() * f64::from(width) / f64::from(height);
        let m = &self.camera_to_world;
        let camera_to_world: Pose =
            [0, 4, 8].map(|row| [m[row], m[row + 1], m[row + 2], m[row + 3]]);
        Camera {
            name: crate::frame_name(index),
            intrinsics: Intrinsics::from_angle_x(width, height, 2.0 * slope.atan()),
            camera_to_world,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the cameras of a file's text, or the failure's message.
    fn read(text: &str) -> Result<Vec<Camera>, String> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(PATH_FILE), text).unwrap();
        let input = GivenInput::open("path", folder.path()).unwrap();
        read_cameras(&input).map_err(|failure| failure.to_string())
    }

    /// A file with a frame, as nerfstudio writes it.
    const FILE: &str = r#"{"camera_type": "perspective", "render_height": 30, "render_width": 40,
        "fps": 24, "seconds": 4, "is_cycle": false, "keyframes": [], "camera_path": [
        {"camera_to_world": [0,0,1,5, 1,0,0,6, 0,1,0,7, 0,0,0,1], "fov": 60, "aspect": 1.3333}]}"#;

    #[test]
    fn frames_are_cameras() {
        let cameras = read(FILE).unwrap();
        let [camera] = &cameras[..] else { panic!("{cameras:?}") };
        assert_eq!(camera.camera_to_world, [[0., 0., 1., 5.], [1., 0., 0., 6.], [0., 1., 0., 7.]]);
        let k = camera.intrinsics;
        assert_eq!((k.width, k.height, k.cx, k.cy), (40, 30, 20.0, 15.0));
        // The angle is that of the height.
        let focal = 15.0 / 30f64.to_radians().tan();
        assert!((k.fx - focal).abs() < 1e-9 && (k.fy - focal).abs() < 1e-9, "{k:?}");
    }

    #[test]
    fn faults_are_named_with_their_place() {
        for (from, to, said) in [
            ("perspective", "equirectangular", "camera_type equirectangular isn't supported"),
            ("\"render_width\": 40", "\"render_width\": 0", "must be at least 1"),
            ("\"fov\": 60", "\"fov\": 180", "camera_path[0]: fov 180 isn't between"),
            ("[0,0,1,5,", "[0,0,2,5,", "camera_path[0]"),
            ("0,0,0,1]", "0,0,0]", "camera_path[0].camera_to_world"),
        ] {
            let message = read(&FILE.replace(from, to)).unwrap_err();
            assert!(message.contains(said) && message.contains(PATH_FILE), "{message}");
        }
        let none = r#"{"render_height": 3, "render_width": 4, "camera_path": []}"#;
        assert!(read(none).unwrap_err().contains("no frame"));
    }
}
