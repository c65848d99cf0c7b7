use glam::DVec3;
use scene::{Bounds, Frustum, Space};

/// The world point at a place of a field's unit cube: the inverse of what rays are mapped by.
pub(crate) fn to_world(bounds: &Bounds, place: DVec3) -> DVec3 {
    let min = DVec3::from(bounds.min);
    match &bounds.space {
        Space::Box => min + bounds.longest_side() * place,
        Space::Ndc(frustum) => from_frustum(frustum, place),
        Space::Contraction => {
            let radius = 0.5 * bounds.longest_side();
            let centre = 0.5 * (min + DVec3::from(bounds.max));
            let contracted = 4.0 * (place - 0.5);
            let length = contracted.length();
            // Beyond a length of 2 there is nothing; just below it lies what is very far.
            let factor = if length > 1.0 { 1.0 / (length * (2.0 - length).max(1e-3)) } else { 1.0 };
            centre + radius * factor * contracted
        }
    }
}

fn from_frustum(frustum: &Frustum, place: DVec3) -> DVec3 {
    let side = (frustum.max[0] - frustum.min[0]).max(frustum.max[1] - frustum.min[1]);
    let disparity = 1.0 / frustum.near - place.z * (1.0 / frustum.near - 1.0 / frustum.far);
    let depth = 1.0 / disparity;
    let [x, y] = [frustum.min[0] + side * place.x, frustum.min[1] + side * place.y];
    let own = [x * depth, y * depth, -depth];
    DVec3::from(
        frustum.camera_to_world.map(|row| row[3] + (0..3).map(|i| row[i] * own[i]).sum::<f64>()),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use radiance::{Ray, clip};

    /// A place on a ray is the world point at its distance, in every space.
    #[test]
    fn places_are_the_world_points_that_rays_map_there() {
        let turned = glam::DMat3::from_axis_angle(DVec3::new(0.6, 0.8, 0.0), 0.4);
        let row = |i: usize| [turned.x_axis[i], turned.y_axis[i], turned.z_axis[i], 0.1];
        let frustum = Frustum {
            camera_to_world: [row(0), row(1), row(2)],
            min: [-0.9, -0.6],
            max: [0.8, 0.7],
            near: 0.8,
            far: 50.0,
        };
        for space in [Space::Box, Space::Ndc(frustum), Space::Contraction] {
            let bounds =
                Bounds { min: [-1.0, -2.0, -1.5], max: [2.0; 3], near: 0.1, far: 20.0, space };
            let direction = (-turned.z_axis + DVec3::new(0.1, -0.05, 0.2)).normalize();
            let origin = DVec3::new(0.2, 0.1, -0.3);
            let ray = Ray {
                origin: origin.as_vec3().to_array(),
                direction: direction.as_vec3().to_array(),
                background: [0.0; 3],
            };
            let clipped = clip(&bounds, &ray);
            assert!(clipped.enter < clipped.leave, "{space:?}");
            for k in 1..20 {
                let t = clipped.enter + (clipped.leave - clipped.enter) * k as f32 / 20.0;
                let place = DVec3::from(clipped.position(t).map(f64::from));
                let distance = f64::from(clipped.distance(t));
                let error = (to_world(&bounds, place) - (origin + distance * direction)).length();
                assert!(error < 2e-3 * distance.max(1.0).powi(2), "{space:?} {k}: {error}");
            }
        }
    }
}
