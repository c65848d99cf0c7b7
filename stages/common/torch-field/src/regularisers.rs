use radiance::Regularisers;
use radiance::spec::LIKE_BACKGROUND;
use tch::{Kind, TchError, Tensor};

use crate::grid::GridSeen;

/// Adds what is asked of the rays that are `seen`, beside their colours, to a number whose gradient
/// is that of the step's loss. The step has so many `rays`; they are marched by `march_step`.
pub(crate) fn add_regularisers(
    mut towards: Tensor,
    regularisers: &Regularisers,
    seen: &GridSeen,
    backgrounds: &Tensor,
    march_step: f64,
    rays: usize,
) -> Result<Tensor, TchError> {
    let Regularisers { distortion, floater_loss } = *regularisers;
    let share = |weight: f32| f64::from(weight) / rays as f64;
    if distortion > 0.0 {
        let sum = distortion_sum(seen, march_step)?;
        towards = towards.f_add(&sum.f_mul_scalar(share(distortion))?)?;
    }
    if floater_loss > 0.0 {
        let sum = floater_sum(seen, backgrounds)?;
        towards = towards.f_add(&sum.f_mul_scalar(share(floater_loss))?)?;
    }
    Ok(towards)
}

/// The distortion loss (Barron et al. 2022, "Mip-NeRF 360", eq. 15), summed over all rays: Σ_ij
/// w_i·w_j·|t_i - t_j| + ⅓·step·Σ_i w_i².
fn distortion_sum(seen: &GridSeen, step: f64) -> Result<Tensor, TchError> {
    let weights = seen.weights.f_mul(&seen.counted)?;
    let moments = weights.f_mul(&seen.t)?;
    let before = |of: &Tensor| of.f_cumsum(1, None::<Kind>)?.f_sub(of);
    let apart = seen.t.f_mul(&before(&weights)?)?.f_sub(&before(&moments)?)?;
    let pairs = weights.f_mul(&apart)?.f_mul_scalar(2.0)?;
    pairs.f_add(&weights.f_square()?.f_mul_scalar(step / 3.0)?)?.f_sum(None::<Kind>)
}

/// The floater loss, summed over all rays: T·Σ_i w_i·(1 - |c_i - b|² / reach²)₊, with no gradient
/// by the colours or the transmittance T.
fn floater_sum(seen: &GridSeen, backgrounds: &Tensor) -> Result<Tensor, TchError> {
    let behind = backgrounds.f_index_select(0, &seen.shaded_ray)?;
    let squared = seen.shaded_colour.f_detach()?.f_sub(&behind)?.f_square()?.f_sum_dim_intlist(
        [1i64].as_slice(),
        true,
        None::<Kind>,
    )?;
    let likeness = squared
        .f_mul_scalar(-1.0 / f64::from(LIKE_BACKGROUND).powi(2))?
        .f_add_scalar(1.0)?
        .f_relu()?;
    let through =
        seen.transmittance.f_detach()?.f_index_select(0, &seen.shaded_ray)?.f_unsqueeze(-1)?;
    seen.shaded_weight.f_mul(&likeness)?.f_mul(&through)?.f_sum(None::<Kind>)
}

/// What tests ask of rays: of every regulariser something.
#[cfg(test)]
pub(crate) const ALL: Regularisers = Regularisers { distortion: 0.02, floater_loss: 0.01 };
