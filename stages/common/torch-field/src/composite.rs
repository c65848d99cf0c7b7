use tch::{Kind, TchError, Tensor};

/// What rays see of their samples.
#[derive(Debug)]
pub(crate) struct Composite {
    /// n × 3, over the background.
    pub(crate) colour: Tensor,
    /// n × 3, of the scene alone.
    pub(crate) premultiplied: Tensor,
    /// n × m.
    pub(crate) weights: Tensor,
}

/// Composites samples at distances `t` (n × m) with `colour` (n × m × 3) and raw density (n × m,
/// noise already added) over a background (n × 3), in optical depth: the last sample reaches to
/// infinity (Max 1995; Mildenhall et al. 2020, eq. 3).
pub(crate) fn composite(
    t: &Tensor,
    colour: &Tensor,
    raw: &Tensor,
    background: &Tensor,
) -> Result<Composite, TchError> {
    let m = t.size()[1];
    let gaps = t.f_narrow(1, 1, m - 1)?.f_sub(&t.f_narrow(1, 0, m - 1)?)?;
    let last = t.f_narrow(1, 0, 1)?.f_full_like(1e10)?;
    let tau = raw.f_relu()?.f_mul(&Tensor::f_cat(&[&gaps, &last], 1)?)?;
    let through = tau.f_narrow(1, 0, m - 1)?.f_cumsum(1, None::<Kind>)?;
    let before = Tensor::f_cat(&[&through.f_narrow(1, 0, 1)?.f_zeros_like()?, &through], 1)?;
    let weights = before.f_neg()?.f_exp()?.f_mul(&tau.f_neg()?.f_expm1()?.f_neg()?)?;
    let premultiplied = weights.f_unsqueeze(-1)?.f_mul(colour)?.f_sum_dim_intlist(
        [1i64].as_slice(),
        false,
        None::<Kind>,
    )?;
    let opacity = weights.f_sum_dim_intlist([1i64].as_slice(), true, None::<Kind>)?;
    let colour = premultiplied.f_add(&background.f_mul(&opacity.f_neg()?.f_add_scalar(1)?)?)?;
    Ok(Composite { colour, premultiplied, weights })
}
