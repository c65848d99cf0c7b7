use radiance::{NormalizedRay, Ray, RayMap, clip};
use scene::{Bounds, Space};
use tch::{Device, IndexOp as _, Kind, TchError, Tensor};

/// Rays in the unit cube as tensors, from `radiance`'s [`NormalizedRay`]s, which are clipped on the
/// host in f64.
#[derive(Debug)]
pub(crate) struct RayMaps {
    origin: Tensor,
    direction: Tensor,
    /// View directions, on which colours depend (n × 3): in the world with unit length, or in NDC
    /// scaled so that z runs from -1 to 1.
    pub(crate) view: Tensor,
    /// Parameters t at which rays enter and leave the cube (n × 1 each), equal if they miss it.
    pub(crate) enter: Tensor,
    pub(crate) leave: Tensor,
    /// Coefficients of the map from t to distance (n × 1 each): start, scale, and perspective or
    /// radii.
    distance: [Tensor; 3],
    is_contracted: bool,
}

impl RayMaps {
    /// Clips rays to the unit cube of `bounds`.
    pub(crate) fn new(
        bounds: &Bounds,
        rays: &[Ray],
        device: Device,
        ndc_directions: bool,
    ) -> Result<Self, TchError> {
        let rays: Vec<NormalizedRay> = rays.iter().map(|r| clip(bounds, r)).collect();
        let is_ndc = ndc_directions && matches!(bounds.space, Space::Ndc(_));
        Ok(Self {
            origin: columns(&rays, device, |r| r.origin)?,
            direction: columns(&rays, device, |r| r.direction)?,
            view: columns(&rays, device, |r| view_direction(r, is_ndc))?,
            enter: columns(&rays, device, |r| [r.enter])?,
            leave: columns(&rays, device, |r| [r.leave.max(r.enter)])?,
            distance: [
                columns(&rays, device, |r| [distance_map(r)[0]])?,
                columns(&rays, device, |r| [distance_map(r)[1]])?,
                columns(&rays, device, |r| [distance_map(r)[2]])?,
            ],
            is_contracted: bounds.space == Space::Contraction,
        })
    }

    /// Returns positions in the unit cube at t (n × m): n × m × 3.
    pub(crate) fn positions(&self, t: &Tensor) -> Result<Tensor, TchError> {
        let (origin, direction) = (self.origin.f_unsqueeze(1)?, self.direction.f_unsqueeze(1)?);
        if !self.is_contracted {
            return multiply_add(&direction, &t.f_unsqueeze(-1)?, &origin);
        }
        let along = sinh4(t)?.f_mul(&self.distance[2])?;
        let u = multiply_add(&direction, &along.f_unsqueeze(-1)?, &origin)?;
        let length = u
            .f_square()?
            .f_sum_dim_intlist([-1i64].as_slice(), true, None::<Kind>)?
            .f_sqrt()?
            .f_clamp_min(1.0)?;
        // (2 - 1 / length) / length, which is 1 if the length is 1.
        let factor = length.f_reciprocal()?.f_neg()?.f_add_scalar(2.0)?.f_div(&length)?;
        u.f_mul(&factor)?.f_mul_scalar(0.25)?.f_add_scalar(0.5)
    }

    /// Returns distances in scene units at t (n × m).
    pub(crate) fn distances(&self, t: &Tensor) -> Result<Tensor, TchError> {
        let [start, scale, perspective] = &self.distance;
        if self.is_contracted {
            return sinh4(t)?.f_mul(scale)?.f_add(start);
        }
        t.f_mul(scale)?.f_div(&t.f_mul(perspective)?.f_neg()?.f_add_scalar(1.0)?)?.f_add(start)
    }

    /// Returns whether each ray hits the cube: n.
    pub(crate) fn hits(&self) -> Result<Tensor, TchError> {
        self.enter.i((.., 0)).f_lt_tensor(&self.leave.i((.., 0)))
    }
}

/// Returns a ray's view direction; zero if it isn't finite, since NaN would spoil the sums of other
/// rays.
fn view_direction(ray: &NormalizedRay, is_ndc: bool) -> [f32; 3] {
    let view = if is_ndc { ray.direction.map(|d| 2.0 * d / ray.direction[2]) } else { ray.view };
    if view.iter().all(|x| x.is_finite()) { view } else { [0.0; 3] }
}

/// Computes a·b + c rounded once, through f64, like the fused multiply-add of the hand-written
/// field.
pub(crate) fn multiply_add(a: &Tensor, b: &Tensor, c: &Tensor) -> Result<Tensor, TchError> {
    a.f_to_kind(Kind::Double)?
        .f_mul(&b.f_to_kind(Kind::Double)?)?
        .f_add(&c.f_to_kind(Kind::Double)?)?
        .f_to_kind(Kind::Float)
}

/// Returns the coefficients of a ray's map from t to distance: start, scale, perspective or radii.
fn distance_map(ray: &NormalizedRay) -> [f32; 3] {
    match ray.map {
        RayMap::Straight { start, scale, perspective } => [start, scale, perspective],
        RayMap::Contracted { start, scale, radii } => [start, scale, radii],
    }
}

/// Computes sinh(4t).
fn sinh4(t: &Tensor) -> Result<Tensor, TchError> {
    t.f_mul_scalar(4.0)?.f_sinh()
}

/// Copies values to a device as a matrix.
pub(crate) fn matrix(values: &[f32], shape: [i64; 2], device: Device) -> Result<Tensor, TchError> {
    Tensor::f_from_slice(values)?.f_reshape(shape)?.f_to_device(device)
}

/// Returns a matrix (n × `N`) of `N` values for each of n rays.
pub(crate) fn columns<T, const N: usize>(
    rays: &[T],
    device: Device,
    values: impl Fn(&T) -> [f32; N],
) -> Result<Tensor, TchError> {
    let values: Vec<f32> = rays.iter().flat_map(values).collect();
    matrix(&values, [rays.len() as i64, N as i64], device)
}

/// Copies a tensor's elements to the host, in f32.
pub(crate) fn to_host(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    let flat = tensor
        .f_detach()?
        .f_to_device(Device::Cpu)?
        .f_to_kind(Kind::Float)?
        .f_contiguous()?
        .f_view([-1])?;
    Vec::<f32>::try_from(flat)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use scene::Frustum;

    use super::*;

    fn view_of(bounds: &Bounds, ray: Ray, ndc: bool) -> [f64; 3] {
        let maps = RayMaps::new(bounds, &[ray], Device::Cpu, ndc).unwrap();
        [0, 1, 2].map(|i| maps.view.double_value(&[0, i]))
    }

    /// In NDC a direction points from the near to the far plane, as in the reference
    /// implementation: d' = to - from with z from -1 to 1.
    #[test]
    fn ndc_directions_are_the_references() {
        let camera_to_world = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.]];
        let frustum =
            Frustum { camera_to_world, min: [-0.5, -0.4], max: [0.5, 0.4], near: 1.0, far: 1e9 };
        let bounds =
            Bounds { min: [-9.; 3], max: [9.; 3], near: 0.0, far: 1e9, space: Space::Ndc(frustum) };
        let (origin, direction) =
            (DVec3::new(0.05, -0.02, 0.1), DVec3::new(0.1, 0.05, -1.0).normalize());
        let ray = Ray {
            origin: origin.to_array(),
            direction: direction.to_array(),
            background: [1.0; 3],
        };
        // Shifted to the near plane, then as Mildenhall et al. 2020 have it, appendix C; f / (W /
        // 2) is 1 / 0.5, which our NDC, as wide as high, has for y, too.
        let start = origin + direction * ((-1.0 - origin.z) / direction.z);
        let slope = [
            direction.x / direction.z - start.x / start.z,
            direction.y / direction.z - start.y / start.z,
        ];
        let expected = [-slope[0] / 0.5, -slope[1] / 0.5, 2.0];
        assert!(
            view_of(&bounds, ray, true).iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5),
            "{:?} {expected:?}",
            view_of(&bounds, ray, true)
        );
        assert!(
            view_of(&bounds, ray, false)
                .iter()
                .zip(direction.to_array())
                .all(|(a, b)| (a - b).abs() < 1e-6)
        );
    }
}
