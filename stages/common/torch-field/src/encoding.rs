use tch::{TchError, Tensor};

/// Numbers that [`encode`] makes of `dims`.
pub(crate) fn encoded(dims: i64, octaves: u32) -> i64 {
    dims * (1 + 2 * i64::from(octaves))
}

/// Positional encoding of rows x: x, then sin(2ᵏx) and cos(2ᵏx) for k = 0, 1, …: the reference's
/// order, without the paper's π.
pub(crate) fn encode(x: &Tensor, octaves: u32) -> Result<Tensor, TchError> {
    let mut parts = vec![x.shallow_clone()];
    for k in 0..octaves {
        let scaled = x.f_mul_scalar(f64::from(k).exp2())?;
        parts.push(scaled.f_sin()?);
        parts.push(scaled.f_cos()?);
    }
    Tensor::f_cat(&parts, -1)
}
