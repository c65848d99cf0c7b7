use radiance::{NormalizedRay, Ray, RayMap, clip};
use scene::{Bounds, Space};
use tch::{Device, IndexOp as _, Kind, TchError, Tensor};

use crate::transfer::columns;

/// How rays run through the unit cube, as tensors: `radiance`'s [`NormalizedRay`]s, which it clips
/// in f64 and on the host.
#[derive(Debug)]
pub(crate) struct RayMaps {
    origin: Tensor,
    direction: Tensor,
    /// What colours depend on: n × 3. The direction in the world, of unit length, or that in NDC,
    /// of which z goes from -1 to 1.
    pub(crate) view: Tensor,
    /// Where they enter and leave, by their parameter t: n × 1. Equal where they meet nothing.
    pub(crate) enter: Tensor,
    pub(crate) leave: Tensor,
    /// Distance where t is 0, its growth, and its perspective or its radii: n × 1 each.
    distance: [Tensor; 3],
    contracted: bool,
}

impl RayMaps {
    pub(crate) fn new(
        bounds: &Bounds,
        rays: &[Ray],
        device: Device,
        ndc_directions: bool,
    ) -> Result<Self, TchError> {
        let rays: Vec<NormalizedRay> = rays.iter().map(|r| clip(bounds, r)).collect();
        let of_map = |k: usize| columns(&rays, device, |r| [distance_map(r)[k]]);
        let is_ndc = ndc_directions && matches!(bounds.space, Space::Ndc(_));
        let in_ndc = |r: &NormalizedRay| r.direction.map(|d| 2.0 * d / r.direction[2]);
        // What isn't finite meets nothing; its view must not spoil the others' sums.
        let tame = |v: [f32; 3]| if v.iter().all(|x| x.is_finite()) { v } else { [0.0; 3] };
        Ok(Self {
            origin: columns(&rays, device, |r| r.origin)?,
            direction: columns(&rays, device, |r| r.direction)?,
            view: columns(&rays, device, |r| tame(if is_ndc { in_ndc(r) } else { r.view }))?,
            enter: columns(&rays, device, |r| [r.enter])?,
            leave: columns(&rays, device, |r| [r.leave.max(r.enter)])?,
            distance: [of_map(0)?, of_map(1)?, of_map(2)?],
            contracted: bounds.space == Space::Contraction,
        })
    }

    /// Places in the unit cube at t (n × m): n × m × 3.
    pub(crate) fn positions(&self, t: &Tensor) -> Result<Tensor, TchError> {
        let (origin, direction) = (self.origin.f_unsqueeze(1)?, self.direction.f_unsqueeze(1)?);
        if !self.contracted {
            return fused(&direction, &t.f_unsqueeze(-1)?, &origin);
        }
        let along = sinh4(t)?.f_mul(&self.distance[2])?;
        let u = fused(&direction, &along.f_unsqueeze(-1)?, &origin)?;
        let length = u
            .f_square()?
            .f_sum_dim_intlist([-1i64].as_slice(), true, None::<Kind>)?
            .f_sqrt()?
            .f_clamp_min(1.0)?;
        // (2 - 1 / length) / length, which is 1 where the length is.
        let factor = length.f_reciprocal()?.f_neg()?.f_add_scalar(2.0)?.f_div(&length)?;
        u.f_mul(&factor)?.f_mul_scalar(0.25)?.f_add_scalar(0.5)
    }

    /// Distances in scene units at t (n × m).
    pub(crate) fn distances(&self, t: &Tensor) -> Result<Tensor, TchError> {
        let [start, scale, perspective] = &self.distance;
        if self.contracted {
            return sinh4(t)?.f_mul(scale)?.f_add(start);
        }
        t.f_mul(scale)?.f_div(&t.f_mul(perspective)?.f_neg()?.f_add_scalar(1.0)?)?.f_add(start)
    }

    /// Which rays meet the cube: n.
    pub(crate) fn hits(&self) -> Result<Tensor, TchError> {
        self.enter.i((.., 0)).f_lt_tensor(&self.leave.i((.., 0)))
    }
}

/// a·b + c rounded once, as the hand-written field does it by fused multiply-adds, for which f64
/// stands here.
pub(crate) fn fused(a: &Tensor, b: &Tensor, c: &Tensor) -> Result<Tensor, TchError> {
    let wide = |t: &Tensor| t.f_to_kind(Kind::Double);
    wide(a)?.f_mul(&wide(b)?)?.f_add(&wide(c)?)?.f_to_kind(Kind::Float)
}

/// Distance where t is 0, its growth, and its perspective or its radii.
fn distance_map(ray: &NormalizedRay) -> [f32; 3] {
    match ray.map {
        RayMap::Straight { start, scale, perspective } => [start, scale, perspective],
        RayMap::Contracted { start, scale, radii } => [start, scale, radii],
    }
}

/// sinh(4t).
fn sinh4(t: &Tensor) -> Result<Tensor, TchError> {
    t.f_mul_scalar(4.0)?.f_sinh()
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

    /// In NDC a direction goes from the near to the far plane, as the reference computes it: d' =
    /// to - from with z from -1 to 1.
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
