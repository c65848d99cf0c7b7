use tch::{Kind, TchError, Tensor};

/// Distances of `count` samples from `near` to `far` (n × 1 each) at equal steps: n × count. With
/// `draws` in 0..1 (n × count) each moves within its share of the ray, between the middles to its
/// neighbours (Mildenhall et al. 2020, eq. 2, as the reference has it: the ends stay inside).
pub(crate) fn stratified(
    near: &Tensor,
    far: &Tensor,
    count: i64,
    draws: Option<&Tensor>,
) -> Result<Tensor, TchError> {
    let share = Tensor::f_linspace(0, 1, count, (near.kind(), near.device()))?;
    let t = near.f_mul(&share.f_neg()?.f_add_scalar(1)?)?.f_add(&far.f_mul(&share)?)?;
    let Some(draws) = draws else { return Ok(t) };
    let middles = middles(&t)?;
    let upper = Tensor::f_cat(&[&middles, &t.f_narrow(1, count - 1, 1)?], 1)?;
    let lower = Tensor::f_cat(&[&t.f_narrow(1, 0, 1)?, &middles], 1)?;
    upper.f_sub(&lower)?.f_mul(draws)?.f_add(&lower)
}

/// Middles between neighbours: n × (m - 1).
pub(crate) fn middles(t: &Tensor) -> Result<Tensor, TchError> {
    let m = t.size()[1];
    t.f_narrow(1, 1, m - 1)?.f_add(&t.f_narrow(1, 0, m - 1)?)?.f_mul_scalar(0.5)
}

/// Draws distances where `weights` (n × m) say that light is stopped, from the piecewise constant
/// density over `edges` (n × m + 1), by inverting its cumulative sum at `draws` in 0..1 (n × k): n
/// × k.
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
    let (below, above) = (above.f_sub_scalar(1)?.f_clamp_min(0)?, above.f_clamp_max(bins)?);
    let at = |of: &Tensor, index: &Tensor| of.f_gather(1, index, false);
    let (low, high) = (at(&cumulative, &below)?, at(&cumulative, &above)?);
    let width = high.f_sub(&low)?;
    // A bin that holds nothing is passed through at its lower edge's pace.
    let width = width.f_where_self(&width.f_ge(1e-5)?, &width.f_ones_like()?)?;
    let (first, last) = (at(edges, &below)?, at(edges, &above)?);
    draws.f_sub(&low)?.f_div(&width)?.f_mul(&last.f_sub(&first)?)?.f_add(&first)
}
