//! `camera-path`: creates cameras along a path through a scene, for `render-depth` and `video`.
//!
//! * [`Params`]: [`Kind`] of the path, number of frames, and more.
//! * [`poses`]: computes the poses of a path from the scene's cameras and bounds.
//! * `coverage`: finds what the scene's cameras observe of a frame.
//! * `orbit`: finds the part of a circle along which the scene's cameras are.
//! * `path_file`: reads and writes a path in nerfstudio's format.

mod coverage;
mod orbit;
mod path_file;
mod paths;

use artifact::{Failure, GivenInput};
use pixels::{DEGRADATION_FILE, Degradation};
use scene::{Camera, Intrinsics, VIEWS_FILE, View, Views, common_direction};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};

use crate::path_file::{MAX_SIDE, PATH_FILE, PathFile};
pub use crate::paths::poses;

/// Parameters of `camera-path`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Kind of path; `between` passes through all cameras of the scene, in order. Default: `spiral`
    /// for cameras that look in one direction, otherwise `orbit`.
    #[schemars(extend("x-default" = "by cameras"))]
    pub kind: Option<Kind>,
    /// Number of frames.
    #[schemars(range(min = 1, max = 10000))]
    pub frames: u32,
    /// Width of the frames in pixels; the height follows from the first camera's aspect. Default:
    /// the width of the scene's HR images, or that of input `path`.
    #[schemars(range(min = 1, max = 65536), extend("x-default" = "by scene"))]
    pub size: Option<u32>,
}

impl Default for Params {
    fn default() -> Self {
        Self { kind: None, frames: 120, size: None }
    }
}

/// Kind of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Spiral around the cameras' mean position, at most as wide as the positions of most cameras,
    /// for forward-facing photographs. Its frames show almost only what the cameras observed.
    Spiral,
    /// Circle around the middle of the scene's box, at the cameras' mean distance and height, or
    /// the arc along which cameras are.
    Orbit,
    /// Closed curve through all cameras, in their order.
    Between,
}

/// The stage.
pub struct CameraPath;

impl Stage for CameraPath {
    type Params = Params;
    const NAME: &'static str = "camera-path";
    const SUMMARY: &'static str = "Creates cameras along a path through a scene.";

    fn inputs() -> Vec<(&'static str, Input)> {
        let kinds =
            ["scene/train", "scene/cameras", "scene/truth", "scene/references", "cameras", "views"];
        let path = "folder with camera_path.json, as the viewer, nerfstudio or this stage writes \
            it; used instead of `kind` and `frames`";
        vec![
            ("cameras", Input::required(&kinds, "folder with views.json: the scene's cameras")),
            ("path", Input::optional(&["cameras"], path)),
        ]
    }

    fn output() -> Output {
        Output::kind("cameras")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let input = context.input("cameras")?;
        let scene = Views::read(input)?;
        let (path, kind) = match context.optional_input("path") {
            Some(path) => (recorded_path(path, params)?, "recorded".to_owned()),
            None => computed_path(input, &scene, params)?,
        };
        let views = path.cameras().into_iter().map(View::camera_only).collect();
        let views = Views::new(scene.background, scene.bounds, views);
        context.write_json(PATH_FILE, &path)?;
        context.write_json(VIEWS_FILE, &views)?;
        let size = views.views[0].camera.intrinsics;
        context.write_summary(&format!(
            "{} of {}×{}, {kind}",
            artifact::format_count(views.views.len(), "frame"),
            size.width,
            size.height,
        ))
    }
}

/// Returns the height of an image with another width and the same aspect; at most [`MAX_SIDE`].
fn height_at(width: u32, intrinsics: &Intrinsics) -> u32 {
    let aspect = f64::from(intrinsics.height) / f64::from(intrinsics.width);
    (f64::from(width) * aspect).round().clamp(1.0, f64::from(MAX_SIDE)) as u32
}

/// Reads a recorded path, with the width of the parameters, if given.
fn recorded_path(input: &GivenInput, params: &Params) -> Result<PathFile, Failure> {
    let path = PathFile::read(input)?;
    Ok(match params.size {
        Some(width) => path.resized(width),
        None => path,
    })
}

/// Computes a path, and the name of its kind.
fn computed_path(
    input: &GivenInput,
    scene: &Views,
    params: &Params,
) -> Result<(PathFile, String), Failure> {
    let mut template = scene.views[0].camera.clone();
    // Frames have no lens distortion, unless no pinhole camera fits into the lens's view.
    template.intrinsics = template.intrinsics.pinhole().unwrap_or(template.intrinsics);
    let degradation: Option<Degradation> = input.read_optional_json(DEGRADATION_FILE)?;
    let hr_width = degradation.map(|degradation| degradation.hr[0]);
    let width = params.size.or(hr_width).unwrap_or(template.intrinsics.width);
    let template = template.resized(width, height_at(width, &template.intrinsics));
    let cameras: Vec<Camera> = scene.views.iter().map(|v| v.camera.clone()).collect();
    let kind = params.kind.unwrap_or_else(|| default_kind(&cameras));
    let poses = poses(kind, params.frames, &template, &cameras, &scene.bounds);
    let path = PathFile::new(&template.intrinsics, &poses, true);
    Ok((path, format!("{kind:?}").to_lowercase()))
}

/// Chooses the kind of path if the parameter isn't given.
fn default_kind(cameras: &[Camera]) -> Kind {
    if common_direction(cameras.iter()).is_some() { Kind::Spiral } else { Kind::Orbit }
}
