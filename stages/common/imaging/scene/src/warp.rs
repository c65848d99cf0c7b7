use glam::DVec3;
use pixels::DepthMap;

use crate::camera::Camera;

/// Depth and opacity of a view's surfaces, with the view's camera.
#[derive(Clone, Copy, Debug)]
pub struct SurfaceMap<'a> {
    /// Camera of the view, with the map's size.
    pub camera: &'a Camera,
    /// Depth and opacity at each pixel's centre.
    pub map: DepthMap<'a>,
}

/// Projection of a view's surface point to another view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointProjection {
    /// Position in the other image, in pixels from the top left corner.
    pub position: [f32; 2],
    /// Cosine of the angle between both lines of sight.
    pub cosine: f32,
    /// Resolution of the other view relative to this one at the point, in pixels per pixel; slant
    /// is ignored.
    pub relative_resolution: f32,
}

/// Maximum relative difference between two depths of one surface; chosen by hand.
const MAX_DEPTH_DIFFERENCE: f64 = 0.02;
/// Maximum reprojection error at which two views' points count as one surface, even if their depths
/// differ by more than [`MAX_DEPTH_DIFFERENCE`]; chosen by hand. Nearby cameras determine the depth
/// of a far wall poorly, but such an error of depth hardly moves the wall in the image.
const MAX_REPROJECTION_ERROR_PIXELS: f64 = 0.5;

impl SurfaceMap<'_> {
    /// Returns, row by row, the position of each pixel's surface point in another view; `None`
    /// where [`SurfaceMap::visible_projection`] returns `None`.
    ///
    /// # Panics
    /// If the map doesn't have one number per pixel.
    pub fn positions_in(&self, other: &SurfaceMap<'_>) -> Vec<Option<[f32; 2]>> {
        let k = &self.camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        (0..width * height)
            .map(|i| self.visible_projection(i % width, i / width, other).map(|p| p.position))
            .collect()
    }

    /// Returns the projection of a pixel's surface point to another view. `None` if the pixel has
    /// no surface, or the point is outside the other image or occluded.
    ///
    /// # Panics
    /// If the map doesn't have one number per pixel, or the pixel is outside.
    pub fn visible_projection(
        &self,
        column: usize,
        row: usize,
        other: &SurfaceMap<'_>,
    ) -> Option<PointProjection> {
        let (projection, point) = self.project(column, row, other.camera)?;
        let pixel = [column as f64 + 0.5, row as f64 + 0.5];
        other
            .has_point(point, projection.position.map(f64::from), (self.camera, pixel))
            .then_some(projection)
    }

    /// Returns the projection of a pixel's surface point to another camera, even if the point is
    /// occluded there. `None` if the pixel has no surface, or the point is outside the camera's
    /// image.
    ///
    /// # Panics
    /// If the map doesn't have one number per pixel, or the pixel is outside.
    pub fn projection_ignoring_occlusion(
        &self,
        column: usize,
        row: usize,
        other: &Camera,
    ) -> Option<PointProjection> {
        self.project(column, row, other).map(|(projection, _)| projection)
    }

    /// Projects a pixel's surface point to another camera, even if the point is occluded there.
    /// Returns the world point, too.
    fn project(
        &self,
        column: usize,
        row: usize,
        other: &Camera,
    ) -> Option<(PointProjection, DVec3)> {
        let i = row * self.camera.intrinsics.width as usize + column;
        if !self.map.has_surface(i) {
            return None;
        }
        let ray = self.camera.ray(column as f64 + 0.5, row as f64 + 0.5);
        let distance = f64::from(self.map.depth[i]) / self.camera.depth_per_distance(&ray);
        let point = ray.at(distance);
        let (x, y, _) = other.project(point)?;
        let [width, height] = [other.intrinsics.width, other.intrinsics.height].map(f64::from);
        // NaN is outside.
        let is_inside = (0.0..=width).contains(&x) && (0.0..=height).contains(&y);
        let line = point - other.centre();
        let projection = PointProjection {
            position: [x as f32, y as f32],
            cosine: (ray.direction.dot(line) / line.length()) as f32,
            relative_resolution: (other.intrinsics.fx * distance
                / (self.camera.intrinsics.fx * line.length()))
                as f32,
        };
        is_inside.then_some((projection, point))
    }

    /// Returns whether this view's surface at position (x, y) contains `point`, which the camera
    /// `observer` observes at `pixel`. One of the four pixels around (x, y) must have the depth of
    /// `point`, or a depth at which the point on the same line of sight is also observed at
    /// `pixel`.
    fn has_point(
        &self,
        point: DVec3,
        [x, y]: [f64; 2],
        (observer, pixel): (&Camera, [f64; 2]),
    ) -> bool {
        let k = &self.camera.intrinsics;
        let line = point - self.camera.centre();
        let depth = line.dot(self.camera.forward());
        for row in nearest_pixels(y, k.height as usize) {
            for column in nearest_pixels(x, k.width as usize) {
                let i = row * k.width as usize + column;
                let own = f64::from(self.map.depth[i]);
                let own_point = self.camera.centre() + line * (own / depth);
                if self.map.has_surface(i)
                    && ((own - depth).abs() <= MAX_DEPTH_DIFFERENCE * depth
                        || observes_at(observer, own_point, pixel))
                {
                    return true;
                }
            }
        }
        false
    }
}

/// Returns the pixels on either side of a position along one axis, clamped to the image.
fn nearest_pixels(v: f64, size: usize) -> [usize; 2] {
    let low = (v - 0.5).floor().max(0.0) as usize;
    [low.min(size - 1), (low + 1).min(size - 1)]
}

/// Returns whether a camera observes a point near an image position.
fn observes_at(camera: &Camera, point: DVec3, [x, y]: [f64; 2]) -> bool {
    camera
        .project(point)
        .is_some_and(|(u, v, _)| (u - x).hypot(v - y) <= MAX_REPROJECTION_ERROR_PIXELS)
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::intrinsics::Intrinsics;

    fn camera(centre: DVec3, angle: f64) -> Camera {
        let r = DMat3::from_axis_angle(DVec3::Y, angle);
        Camera {
            name: "c".into(),
            intrinsics: Intrinsics::from_angle_x(64, 48, 0.9),
            camera_to_world: crate::pose::pose_of(r, centre),
        }
    }

    /// Returns the depth along each pixel's ray of a wall at z = 0 and, if `has_plate`, of a plate
    /// before the wall, at z = 1 over x in -0.3..=0.3.
    fn depths(camera: &Camera, has_plate: bool) -> Vec<f32> {
        (0..64 * 48)
            .map(|i| {
                let ray = camera.ray(f64::from(i % 64) + 0.5, f64::from(i / 64) + 0.5);
                let to = |z: f64| (z - ray.origin.z) / ray.direction.z;
                let on_plate = has_plate && ray.at(to(1.0)).x.abs() <= 0.3;
                (to(f64::from(u8::from(on_plate))) * camera.depth_per_distance(&ray)) as f32
            })
            .collect()
    }

    #[test]
    fn positions_are_those_of_the_same_surface_point() {
        let (a, b) =
            (camera(DVec3::new(-0.3, 0.0, 4.0), -0.05), camera(DVec3::new(0.5, 0.2, 4.5), 0.1));
        let opacity = vec![1.0; 64 * 48];
        for has_plate in [false, true] {
            let (da, db) = (depths(&a, has_plate), depths(&b, has_plate));
            let (from_a, from_b) = (
                SurfaceMap { camera: &a, map: DepthMap { depth: &da, opacity: &opacity } },
                SurfaceMap { camera: &b, map: DepthMap { depth: &db, opacity: &opacity } },
            );
            let mut visible_count = 0;
            for (i, found) in from_a.positions_in(&from_b).into_iter().enumerate() {
                let ray = a.ray((i % 64) as f64 + 0.5, (i / 64) as f64 + 0.5);
                let point = ray.at(f64::from(da[i]) / a.depth_per_distance(&ray));
                let (x, y, _) = b.project(point).unwrap();
                let inside = (0.0..=64.0).contains(&x) && (0.0..=48.0).contains(&y);
                // From b, the plate hides the wall where the line of sight passes it.
                let line_of_sight = point - b.centre();
                let at_plate =
                    b.centre() + line_of_sight * ((1.0 - b.centre().z) / line_of_sight.z);
                let hidden = has_plate && point.z < 0.5 && at_plate.x.abs() <= 0.3;
                let at_edge = has_plate && (at_plate.x.abs() - 0.3).abs() < 0.1;
                let projected = from_a
                    .projection_ignoring_occlusion(i % 64, i / 64, &b)
                    .map(|projection| projection.position);
                assert!(
                    projected.is_some() == inside && (found.is_none() || found == projected),
                    "pixel {i} without occlusion"
                );
                match found {
                    Some([px, py]) => {
                        assert!(
                            (f64::from(px) - x).abs() < 1e-3 && (f64::from(py) - y).abs() < 1e-3
                        );
                        assert!(inside && (!hidden || at_edge), "pixel {i} is hidden");
                        visible_count += 1;
                    }
                    None => assert!(!inside || hidden || at_edge, "pixel {i} isn't hidden"),
                }
            }
            assert!(visible_count > 1000, "{visible_count}");
        }
        let transparent = vec![0.0; 64 * 48];
        let (da, db) = (depths(&a, false), depths(&b, false));
        let empty = SurfaceMap { camera: &a, map: DepthMap { depth: &da, opacity: &transparent } };
        let other = SurfaceMap { camera: &b, map: DepthMap { depth: &db, opacity: &opacity } };
        assert!(empty.positions_in(&other).iter().all(Option::is_none));
    }

    /// Returns the number of pixels that are visible to a second camera at the distance `baseline`,
    /// whose depth is multiplied by `factor`.
    fn visible_pixels(baseline: f64, factor: f32) -> usize {
        let opacity = vec![1.0; 64 * 48];
        let a = camera(DVec3::new(0.0, 0.0, 4.0), 0.0);
        let b = camera(DVec3::new(baseline, 0.0, 4.0), 0.0);
        let (da, db): (Vec<f32>, Vec<f32>) =
            (depths(&a, false), depths(&b, false).into_iter().map(|d| d * factor).collect());
        let other = SurfaceMap { camera: &b, map: DepthMap { depth: &db, opacity: &opacity } };
        let from = SurfaceMap { camera: &a, map: DepthMap { depth: &da, opacity: &opacity } };
        from.positions_in(&other).iter().flatten().count()
    }

    /// Depths that differ by 5 % are of two surfaces, unless the cameras are so close that the
    /// difference moves a point by less than a pixel.
    #[test]
    fn depth_errors_matter_if_they_move_a_point_in_the_image() {
        let all = 64 * 48;
        // The focal length is 66 pixels. 5 % of the depth of 4 units moves a point by 0.4 pixels
        // with a baseline of 0.5 units, and by 1.6 pixels with a baseline of 2 units.
        assert!(
            visible_pixels(0.5, 1.05) > all * 3 / 4
                && visible_pixels(0.5, 1.05) == visible_pixels(0.5, 1.0)
        );
        assert_eq!(visible_pixels(2.0, 1.05), 0);
        assert!(visible_pixels(2.0, 1.015) > 0);
    }

    #[test]
    fn no_depth_panics() {
        let (a, b) =
            (camera(DVec3::new(0.0, 0.0, 4.0), 0.0), camera(DVec3::new(0.5, 0.2, 4.5), 3.0));
        let opacity = vec![1.0; 64 * 48];
        for depth in [f32::NAN, f32::INFINITY, -1.0, 0.0, 1e38, 1e-38] {
            let map = DepthMap { depth: &vec![depth; 64 * 48], opacity: &opacity };
            SurfaceMap { camera: &a, map }.positions_in(&SurfaceMap { camera: &b, map });
        }
    }
}
