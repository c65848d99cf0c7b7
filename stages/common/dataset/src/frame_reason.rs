use artifact::{number, shortened};
use scene::CameraError;

use crate::lookup::LookupError;
use crate::misplaced::Misplaced;

/// Why a frame can't be used. Text of a file is as it is there; [`DatasetError`] escapes it.
///
/// [`DatasetError`]: crate::DatasetError
#[derive(Debug, thiserror::Error)]
pub enum FrameReason {
    /// The name of its image, mask or depth.
    #[error(transparent)]
    Lookup(#[from] LookupError),
    /// Its image can't be read.
    #[error(transparent)]
    Pixels(#[from] pixels::PixelError),
    /// It has no camera that can be.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Its pose is none.
    #[error("transform_matrix: {0}")]
    Pose(CameraError),
    /// A pose of another size.
    #[error("transform_matrix must have 4 rows of 4 numbers")]
    Matrix,
    /// An image, mask or depth isn't where it should be.
    #[error("{found}; {remedy}")]
    Place {
        /// What stands there.
        found: Misplaced,
        /// What to do.
        remedy: &'static str,
    },
    /// Its camera isn't listed.
    #[error("there is no camera {id}")]
    NoCamera {
        /// The camera's number.
        id: u32,
    },
    /// Something about a camera that is listed.
    #[error("{reason} (camera {id})")]
    OfCamera {
        /// The camera's number.
        id: u32,
        /// What is wrong.
        reason: Box<Self>,
    },
    /// Image and camera have different shapes.
    #[error(
        "the image has {}×{} pixels, its camera {}×{}: another shape",
        image.0, image.1, camera.0, camera.1
    )]
    Shape {
        /// The image's columns and rows.
        image: (u32, u32),
        /// The camera's.
        camera: (u32, u32),
    },
    /// A side of an image without pixels.
    #[error("{name} is {}; an image has 1 to {} pixels a side", number(*value), u32::MAX)]
    Empty {
        /// Which.
        name: &'static str,
        /// Its length.
        value: f64,
    },
    /// Depths that contradict each other.
    #[error(
        "bounds {} and {}, expected 0 < near < far; LLFF's imgs2poses orders views otherwise \
        than their names where COLMAP registered them in another order: run COLMAP again on images \
        sorted by name, or give COLMAP's model without poses_bounds.npy",
        number(*near), number(*far)
    )]
    Depths {
        /// Of the nearest point.
        near: f64,
        /// Of the farthest.
        far: f64,
    },
    /// A camera model that isn't read.
    #[error(
        "camera_model {:?} is not supported; undistort the images first (colmap \
        image_undistorter)",
        shortened(model)
    )]
    Model {
        /// Its name.
        model: String,
    },
    /// Nothing says how wide it looks.
    #[error("no focal length: neither fl_x nor camera_angle_x is given")]
    NoFocalLength,
    /// An angle of view that no pinhole has.
    #[error(
        "{name} is {}: focal length {}; the angle must lie between 0 and π",
        number(*angle), number(*focal)
    )]
    Angle {
        /// What says it.
        name: &'static str,
        /// The angle.
        angle: f64,
        /// The focal length that follows, in image sides.
        focal: f64,
    },
    /// Another frame has its name.
    #[error(
        "its view would be named {:?}, as that of {}; rename one of the two files",
        shortened(name),
        shortened(first)
    )]
    SecondName {
        /// The name.
        name: String,
        /// Path of the other frame's image.
        first: String,
    },
    /// A name that isn't text.
    #[error("its name is not UTF-8; rename the file")]
    NoName,
}
