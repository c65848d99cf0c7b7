use scene::Projection;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Angle of view across the shorter side in radians, as in NeRF's Blender scenes: all objects are
/// inside every view.
pub(crate) const CAMERA_ANGLE: f64 = 0.691_111_2;

/// Parameters of `demo-scene`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the images in pixels. With `projection: fisheye` or `angle`, only test views have
    /// this width; that of training views follows from their angle of view.
    #[schemars(range(min = 1, max = 2048))]
    pub size: u32,
    /// Width of the images divided by their height.
    #[schemars(range(min = 0.25, max = 4.0))]
    pub aspect: f64,
    /// Number of training views.
    #[schemars(range(min = 1, max = 1000))]
    pub train: u32,
    /// Number of test views. With `form: blender`, they have depth.
    #[schemars(range(min = 1, max = 1000))]
    pub test: u32,
    /// Number of rays along each side of a pixel, against aliasing.
    #[schemars(range(min = 1, max = 16))]
    pub samples_per_axis: u32,
    /// Projection of the training views' lens; test views always have a pinhole camera. A `fisheye`
    /// lens follows OpenCV's model and is black beyond 89° from its axis.
    pub projection: Projection,
    /// Angle of view of the training views across the shorter side, in degrees. Training views have
    /// as many pixels per degree in the middle as test views. Default: 39.6, as for test views, or
    /// 120 for a fisheye lens.
    #[schemars(range(min = 10.0, max = 170.0), extend("x-default" = "by `projection`"))]
    pub angle: Option<f64>,
    /// Arrangement of the cameras.
    pub layout: Layout,
    /// Adds an unbounded background: ground, distant towers, and sky.
    pub backdrop: bool,
    /// Format of the data set.
    pub form: Form,
    /// Deviation of each training view's exposure from the mean: 0.1 makes views about 10 %
    /// brighter or darker. Test views have the mean exposure.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub exposure_difference: f64,
    /// Standard deviation of the errors in the training views' poses: rotation about each axis, in
    /// degrees.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub pose_error: f64,
    /// Seed of the objects' positions and textures.
    pub seed: u32,
}

/// Format of a data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// Format of NeRF's synthetic scenes: PNG with alpha, `transforms_train.json` and
    /// `transforms_test.json`, depth of test views.
    Blender,
    /// Photographs with poses: JPEG on white, one `transforms.json` with the focal length, no
    /// depth.
    Transforms,
}

/// Default angle of view of a fisheye lens across the shorter side, in degrees.
const DEFAULT_FISHEYE_ANGLE_DEGREES: f64 = 120.0;

impl Params {
    /// Returns the angle of view of the training views across the shorter side, in degrees; `None`
    /// if they have the test views' camera.
    pub(crate) fn training_angle(&self) -> Option<f64> {
        self.angle
            .or((self.projection == Projection::Fisheye).then_some(DEFAULT_FISHEYE_ANGLE_DEGREES))
    }

    /// Returns width and height of the test images in pixels.
    pub(crate) fn test_image_size(&self) -> [u32; 2] {
        [self.size, ((f64::from(self.size) / self.aspect).round() as u32).max(1)]
    }

    /// Returns the horizontal angle of view of the test images in radians.
    pub(crate) fn test_angle_x_radians(&self) -> f64 {
        let [width, height] = self.test_image_size();
        if width <= height {
            return CAMERA_ANGLE;
        }
        2.0 * libm::atan(libm::tan(0.5 * CAMERA_ANGLE) * f64::from(width) / f64::from(height))
    }
}

impl Default for Params {
    fn default() -> Self {
        Self {
            size: 200,
            aspect: 1.0,
            train: 80,
            test: 10,
            samples_per_axis: 4,
            projection: Projection::Perspective,
            angle: None,
            layout: Layout::Around,
            backdrop: false,
            form: Form::Blender,
            exposure_difference: 0.0,
            pose_error: 0.0,
            seed: 0,
        }
    }
}

/// Arrangement of the cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// All around the objects, looking at their middle.
    Around,
    /// In front of the objects, a step to the sides, up and down, all looking in one direction.
    Forward,
}
