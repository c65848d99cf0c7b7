use tch::{Kind, TchError, Tensor};

/// Returns `count` distances from `near` to `far` (n × 1 each) at equal steps: n × count. With
/// `draws` in 0..1 (n × count), each distance is drawn between the midpoints to its neighbours
/// (Mildenhall et al. 2020, eq. 2). As in the reference implementation, the first and the last
/// distance stay between `near` and `far`.
pub(crate) fn stratified(
    near: &Tensor,
    far: &Tensor,
    count: i64,
    draws: Option<&Tensor>,
) -> Result<Tensor, TchError> {
    let fraction = Tensor::f_linspace(0, 1, count, (near.kind(), near.device()))?;
    let t = near.f_mul(&fraction.f_neg()?.f_add_scalar(1)?)?.f_add(&far.f_mul(&fraction)?)?;
    let Some(draws) = draws else { return Ok(t) };
    let midpoints = midpoints(&t)?;
    let upper = Tensor::f_cat(&[&midpoints, &t.f_narrow(1, count - 1, 1)?], 1)?;
    let lower = Tensor::f_cat(&[&t.f_narrow(1, 0, 1)?, &midpoints], 1)?;
    upper.f_sub(&lower)?.f_mul(draws)?.f_add(&lower)
}

/// Returns the midpoints between neighbours: n × (m - 1).
pub(crate) fn midpoints(t: &Tensor) -> Result<Tensor, TchError> {
    let m = t.size()[1];
    t.f_narrow(1, 1, m - 1)?.f_add(&t.f_narrow(1, 0, m - 1)?)?.f_mul_scalar(0.5)
}

/// Draws distances (n × k) from the piecewise constant density of `weights` (n × m) over `edges`
/// (n × m + 1), by inverting its cumulative sum at `draws` in 0..1 (n × k).
pub(crate) fn importance(
    edges: &Tensor,
    weights: &Tensor,
    draws: &Tensor,
) -> Result<Tensor, TchError> {
    let weights = weights.f_add_scalar(1e-5)?;
    let density =
        weights.f_div(&weights.f_sum_dim_intlist([-1i64].as_slice(), true, None::<Kind>)?)?;
    let cumulative = density.f_cumsum(-1, None::<Kind>)?;
    let zero = cumulative.f_narrow(1, 0, 1)?.f_zeros_like()?;
    let cumulative = Tensor::f_cat(&[&zero, &cumulative], -1)?;
    let bins = weights.size()[1];
    let above = draws.f_searchsorted(&cumulative, false, true, "right", None::<Tensor>)?;
    let below = above.f_sub_scalar(1)?.f_clamp_min(0)?;
    let above = above.f_clamp_max(bins)?;
    let low = cumulative.f_gather(1, &below, false)?;
    let width = cumulative.f_gather(1, &above, false)?.f_sub(&low)?;
    // In a nearly empty bin the divisor is 1, as in the reference implementation: distances stay
    // near the lower edge.
    let width = width.f_where_self(&width.f_ge(1e-5)?, &width.f_ones_like()?)?;
    let first = edges.f_gather(1, &below, false)?;
    let last = edges.f_gather(1, &above, false)?;
    draws.f_sub(&low)?.f_div(&width)?.f_mul(&last.f_sub(&first)?)?.f_add(&first)
}
