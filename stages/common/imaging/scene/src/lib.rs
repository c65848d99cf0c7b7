//! Cameras, poses, rays and bounds; `views.json`, the list of views that stages exchange, and the
//! views' image files.
//!
//! # Conventions
//!
//! Every `views.json` has these conventions as text ([`Conventions`]):
//!
//! * **Camera**: OpenGL axes, x right, y up, looking along -z. `camera_to_world` is the 3×4 matrix
//!   `[R | t]`, row by row.
//! * **Pixels**: pixel (i, j) is column i of row j, row 0 on top, and covers the square [i, i+1) ×
//!   [j, j+1): its **centre** is (i + 0.5, j + 0.5). The principal point of a centred camera is
//!   (width/2, height/2). So resizing from W×H to W'×H' multiplies `fx`, `cx` by W'/W and `fy`,
//!   `cy` by H'/H, without an offset; a half-pixel offset caps PSNR at 25–28 dB at 200 pixels.
//! * **Distortion** is part of the intrinsics: [`Camera::ray`] and [`Camera::project`] apply it, so
//!   photographs aren't resampled. Pixels more than 89° from the axis of a fisheye lens are masked,
//!   so that depth is positive.
//! * **Rays**: directions have unit length; t is the distance along the ray. **Depth** is
//!   camera-space z-depth in scene units, -z of the point in camera space, in EXR channel `Z`.
//! * **Colours**: display-encoded sRGB in [0, 1], as the paper trains and scores.
//!
//! ```
//! use scene::{Camera, Intrinsics};
//! let intrinsics = Intrinsics::from_angle_x(200, 200, 0.69);
//! let camera_to_world = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]];
//! let camera = Camera { name: "r_0".into(), intrinsics, camera_to_world };
//! let ray = camera.ray(100.0, 100.0);
//! assert_eq!(ray.direction, glam::DVec3::NEG_Z);
//! let (x, y, depth) = camera.project(ray.at(3.0)).unwrap();
//! assert_eq!((x, y, depth), (100.0, 100.0, 3.0));
//! ```

mod bounds;
mod camera;
mod intrinsics;
mod lens;
mod pose;
mod projection;
mod space;
mod view_image;
mod views;
mod warp;

pub use bounds::{Bounds, format_length};
pub use camera::{Camera, CameraError, CameraRay, CameraRays, common_direction};
pub use intrinsics::{Intrinsics, undistort_image};
pub use lens::Distortion;
pub use pose::{Pose, looking_at, pose_of, without_scale};
pub use projection::Projection;
pub use space::{Frustum, Space, power_of_two_floor};
pub use view_image::{VIEW_CHANNELS, image_file, mask_file, preview_file, write_view_image};
pub use views::{Background, Conventions, Photograph, VIEWS_FILE, View, Views, ViewsError};
pub use warp::{PointProjection, SurfaceMap};
