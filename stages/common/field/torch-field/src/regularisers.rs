use radiance::Regularisers;
use radiance::spec::MAX_FLOATER_COLOUR_DISTANCE;
use tch::{Kind, TchError, Tensor};

use crate::grid::GridForward;

/// Adds the regularisers' losses for the rays of `forward` to `surrogate`. The gradient of
/// `surrogate` is these rays' part of the gradient of the training step's mean loss. `rays` is the
/// number of rays of the whole training step; `march_step` is the length in t of a step along a
/// ray.
pub(crate) fn add_regularisers(
    mut surrogate: Tensor,
    regularisers: &Regularisers,
    forward: &GridForward,
    backgrounds: &Tensor,
    march_step: f64,
    rays: usize,
) -> Result<Tensor, TchError> {
    let Regularisers { distortion, floater_loss } = *regularisers;
    if distortion > 0.0 {
        let loss = distortion_sum(forward, march_step)?;
        let weight = distortion / rays as f64;
        surrogate = surrogate.f_add(&loss.f_mul_scalar(weight)?)?;
    }
    if floater_loss > 0.0 {
        let loss = floater_sum(forward, backgrounds)?;
        let weight = floater_loss / rays as f64;
        surrogate = surrogate.f_add(&loss.f_mul_scalar(weight)?)?;
    }
    Ok(surrogate)
}

/// Computes the distortion loss (Barron et al. 2022, "Mip-NeRF 360", eq. 15), summed over
/// the rays of `forward`: Σ_ij w_i·w_j·|t_i - t_j| + ⅓·step·Σ_i w_i². Unlike in eq. 15, a sample of
/// a double stride counts as one step long, too.
fn distortion_sum(forward: &GridForward, step: f64) -> Result<Tensor, TchError> {
    let weights = forward.weights.f_mul(&forward.counted)?;
    let moments = weights.f_mul(&forward.t)?;
    let weights_before = weights.f_cumsum(1, None::<Kind>)?.f_sub(&weights)?;
    let moments_before = moments.f_cumsum(1, None::<Kind>)?.f_sub(&moments)?;
    let distances = forward.t.f_mul(&weights_before)?.f_sub(&moments_before)?;
    let pairs = weights.f_mul(&distances)?.f_mul_scalar(2.0)?;
    pairs.f_add(&weights.f_square()?.f_mul_scalar(step / 3.0)?)?.f_sum(None::<Kind>)
}

/// Computes the floater loss, summed over the rays of `forward`:
/// T·Σ_i w_i·(1 - |c_i - b|² / d²)₊ with a ray's transmittance T, its background b and the distance
/// d = [`MAX_FLOATER_COLOUR_DISTANCE`]. No gradients go through the colours c or T.
fn floater_sum(forward: &GridForward, backgrounds: &Tensor) -> Result<Tensor, TchError> {
    let background = backgrounds.f_index_select(0, &forward.shaded_ray)?;
    let squared = forward
        .shaded_colour
        .f_detach()?
        .f_sub(&background)?
        .f_square()?
        .f_sum_dim_intlist([1i64].as_slice(), true, None::<Kind>)?;
    let likeness = squared
        .f_mul_scalar(-1.0 / f64::from(MAX_FLOATER_COLOUR_DISTANCE).powi(2))?
        .f_add_scalar(1.0)?
        .f_relu()?;
    let transmittance = forward
        .transmittance
        .f_detach()?
        .f_index_select(0, &forward.shaded_ray)?
        .f_unsqueeze(-1)?;
    forward.shaded_weight.f_mul(&likeness)?.f_mul(&transmittance)?.f_sum(None::<Kind>)
}

/// Weights with which tests check every regulariser.
#[cfg(test)]
pub(crate) const ALL: Regularisers = Regularisers { distortion: 0.02, floater_loss: 0.01 };
