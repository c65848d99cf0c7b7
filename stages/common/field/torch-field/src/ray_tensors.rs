use radiance::{NormalizedRay, Ray, RayMap, clip};
use scene::{Bounds, Space};
use tch::{Device, IndexOp as _, Kind, TchError, Tensor};

/// Rays in the unit cube as tensors, from `radiance`'s [`NormalizedRay`]s, which are clipped on the
/// host in f64.
#[derive(Debug)]
pub(crate) struct RayTensors {
    origin: Tensor,
    direction: Tensor,
    /// View directions in the world, of unit length, on which colours depend (n × 3).
    pub(crate) view: Tensor,
    /// Parameters t at which rays enter and leave the cube (n × 1 each), equal if they miss it.
    pub(crate) enter: Tensor,
    pub(crate) leave: Tensor,
    /// Coefficients of the map from t to distance (n × 1 each): start, scale, perspective and end.
    /// In a contraction: start, scale, radii, which only positions need, and 0.
    distance: Vec<Tensor>,
    is_contracted: bool,
}

impl RayTensors {
    /// Clips rays to the unit cube of `bounds`.
    pub(crate) fn new(bounds: &Bounds, rays: &[Ray], device: Device) -> Result<Self, TchError> {
        let rays: Vec<NormalizedRay> = rays.iter().map(|r| clip(bounds, r)).collect();
        Ok(Self {
            origin: columns(&rays, device, |r| r.origin)?,
            direction: columns(&rays, device, |r| r.direction)?,
            view: columns(&rays, device, view_direction)?,
            enter: columns(&rays, device, |r| [r.enter])?,
            leave: columns(&rays, device, |r| [r.leave.max(r.enter)])?,
            distance: columns(&rays, device, distance_map)?.f_split(1, 1)?,
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
        let [start, scale] = [&self.distance[0], &self.distance[1]];
        if self.is_contracted {
            return sinh4(t)?.f_mul(scale)?.f_add(start);
        }
        let divisor = self.leave.f_sub(t)?.f_mul(&self.distance[2])?.f_add(&self.distance[3])?;
        t.f_mul(scale)?.f_div(&divisor)?.f_add(start)
    }

    /// Returns whether each ray hits the cube: n.
    pub(crate) fn hits(&self) -> Result<Tensor, TchError> {
        self.enter.i((.., 0)).f_lt_tensor(&self.leave.i((.., 0)))
    }
}

/// Returns a ray's view direction; zero if it isn't finite, since NaN would spoil the sums of other
/// rays.
fn view_direction(ray: &NormalizedRay) -> [f32; 3] {
    if ray.view.iter().all(|x| x.is_finite()) { ray.view } else { [0.0; 3] }
}

/// Computes a·b + c in f64 and rounds it to f32: except for rare double rounding, the fused
/// multiply-add of crate `radiance`.
pub(crate) fn multiply_add(a: &Tensor, b: &Tensor, c: &Tensor) -> Result<Tensor, TchError> {
    a.f_to_kind(Kind::Double)?
        .f_mul(&b.f_to_kind(Kind::Double)?)?
        .f_add(&c.f_to_kind(Kind::Double)?)?
        .f_to_kind(Kind::Float)
}

/// Returns the coefficients of a ray's map from t to distance, as in [`RayTensors::distance`].
fn distance_map(ray: &NormalizedRay) -> [f32; 4] {
    match ray.map {
        RayMap::Straight { start, scale, perspective, end } => [start, scale, perspective, end],
        RayMap::Contracted { start, scale, radii } => [start, scale, radii, 0.0],
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
