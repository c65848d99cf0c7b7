use scene::Projection;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Angle of view across the shorter side, as in NeRF's Blender scenes: the things stay in every
/// view.
pub(crate) const CAMERA_ANGLE: f64 = 0.691_111_2;
/// Parameters of `demo-scene`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the images, in pixels; where `projection` or `angle` is given, of the test views.
    #[schemars(range(min = 1, max = 2048))]
    pub size: u32,
    /// Width over height.
    #[schemars(range(min = 0.25, max = 4.0))]
    pub aspect: f64,
    /// Number of training views.
    #[schemars(range(min = 1, max = 1000))]
    pub train: u32,
    /// Number of test views, which have depth in Blender's form.
    #[schemars(range(min = 1, max = 1000))]
    pub test: u32,
    /// Rays along each side of a pixel, against aliasing.
    #[schemars(range(min = 1, max = 16))]
    pub samples_per_axis: u32,
    /// Projection of the training views' lens. Test views are always a pinhole camera's. A
    /// `fisheye` lens has OpenCV's model, and black beyond 89° from its axis.
    pub projection: Projection,
    /// Angle of view of the training views across the shorter side, in degrees. They have as many
    /// pixels per degree in the middle as the test views. Default: that of the test views, 39.6, or
    /// 120 through a fisheye lens.
    #[schemars(range(min = 10.0, max = 170.0), extend("x-default" = "by `projection`"))]
    pub angle: Option<f64>,
    /// Where cameras stand.
    pub layout: Layout,
    /// Adds an unbounded background: ground, towers far away, a sky.
    pub backdrop: bool,
    /// Files that are written.
    pub form: Form,
    /// Seed of the objects' places and textures.
    pub seed: u32,
}

/// Files of a data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// NeRF's synthetic scenes: PNG with alpha, `transforms_train.json` and `transforms_test.json`,
    /// depth of test views.
    Blender,
    /// Photographs with poses: JPEG on white, one `transforms.json` with the focal length, no
    /// depth.
    Transforms,
}

/// Angle of view of a fisheye lens across the shorter side unless given, in degrees.
const FISHEYE_ANGLE: f64 = 120.0;

impl Params {
    /// Angle of view of the training views across the shorter side, in degrees; none where it is
    /// the test views'.
    pub(crate) fn training_angle(&self) -> Option<f64> {
        self.angle.or((self.projection == Projection::Fisheye).then_some(FISHEYE_ANGLE))
    }

    /// Width and height of the images.
    pub(crate) fn sides(&self) -> [u32; 2] {
        [self.size, ((f64::from(self.size) / self.aspect).round() as u32).max(1)]
    }

    /// Horizontal angle of view.
    pub(crate) fn angle_x(&self) -> f64 {
        let [width, height] = self.sides();
        if width <= height {
            return CAMERA_ANGLE;
        }
        2.0 * libm::atan(libm::tan(0.5 * CAMERA_ANGLE) * f64::from(width) / f64::from(height))
    }
}

impl Default for Params {
    fn default() -> Self {
        let (layout, form) = (Layout::Around, Form::Blender);
        Self {
            size: 200,
            aspect: 1.0,
            train: 80,
            test: 10,
            samples_per_axis: 4,
            projection: Projection::Perspective,
            angle: None,
            layout,
            backdrop: false,
            form,
            seed: 0,
        }
    }
}

/// Where cameras stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// All around the things, looking at their middle.
    Around,
    /// In front of them, a step to the sides, up and down, all looking one way.
    Forward,
}
