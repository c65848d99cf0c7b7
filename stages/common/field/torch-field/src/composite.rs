use tch::{Kind, TchError, Tensor};

/// Length of a ray's last sample, which extends to infinity, as in NeRF's code.
pub(crate) const LAST_STEP: f32 = 1e10;

/// Samples of n rays (m each) composited along each ray.
#[derive(Debug)]
pub(crate) struct Composite {
    /// Colours over the background: n × 3.
    pub(crate) colour: Tensor,
    /// Premultiplied colours of the scene alone: n × 3.
    pub(crate) premultiplied: Tensor,
    /// Weights of the samples: n × m.
    pub(crate) weights: Tensor,
}

/// Composites samples at distances `t` (n × m) with `colour` (n × m × 3) and raw density (n × m,
/// noise already added) over a background (n × 3). The weights are computed from optical depths;
/// the last sample extends to infinity (Max 1995; Mildenhall et al. 2020, eq. 3).
pub(crate) fn composite(
    t: &Tensor,
    colour: &Tensor,
    raw: &Tensor,
    background: &Tensor,
) -> Result<Composite, TchError> {
    let m = t.size()[1];
    let gaps = t.f_narrow(1, 1, m - 1)?.f_sub(&t.f_narrow(1, 0, m - 1)?)?;
    let last = t.f_narrow(1, 0, 1)?.f_full_like(f64::from(LAST_STEP))?;
    let tau = raw.f_relu()?.f_mul(&Tensor::f_cat(&[&gaps, &last], 1)?)?;
    let tau_after = tau.f_narrow(1, 0, m - 1)?.f_cumsum(1, None::<Kind>)?;
    let zero = tau_after.f_narrow(1, 0, 1)?.f_zeros_like()?;
    let tau_before = Tensor::f_cat(&[&zero, &tau_after], 1)?;
    let weights = tau_before.f_neg()?.f_exp()?.f_mul(&tau.f_neg()?.f_expm1()?.f_neg()?)?;
    let premultiplied = weights.f_unsqueeze(-1)?.f_mul(colour)?.f_sum_dim_intlist(
        [1i64].as_slice(),
        false,
        None::<Kind>,
    )?;
    let opacity = weights.f_sum_dim_intlist([1i64].as_slice(), true, None::<Kind>)?;
    let colour = premultiplied.f_add(&background.f_mul(&opacity.f_neg()?.f_add_scalar(1)?)?)?;
    Ok(Composite { colour, premultiplied, weights })
}
