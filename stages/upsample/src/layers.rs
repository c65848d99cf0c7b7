use nets::{Weights, WeightsError};
use tch::{Kind, TchError, Tensor};

/// A linear layer: `NAME.weight` (outputs × inputs) and `NAME.bias`.
pub(crate) struct Linear {
    weight: Tensor,
    bias: Tensor,
}

impl Linear {
    pub(crate) fn read(
        weights: &Weights,
        name: &str,
        shape: [i64; 2],
    ) -> Result<Self, WeightsError> {
        Ok(Self {
            weight: weights.tensor(&format!("{name}.weight"), &shape)?,
            bias: weights.tensor(&format!("{name}.bias"), &shape[..1])?,
        })
    }

    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_linear(&self.weight, Some(&self.bias))
    }

    /// The same from some of the inputs alone, from the `first` to before the `end`; without the
    /// bias.
    pub(crate) fn part(&self, x: &Tensor, first: i64, end: i64) -> Result<Tensor, TchError> {
        x.f_linear(&self.weight.f_narrow(1, first, end - first)?, None::<&Tensor>)
    }

    pub(crate) fn bias(&self) -> &Tensor {
        &self.bias
    }
}

/// Layer normalisation over the last dimension.
pub(crate) struct LayerNorm {
    scale: Tensor,
    shift: Tensor,
}

impl LayerNorm {
    pub(crate) fn read(weights: &Weights, name: &str, width: i64) -> Result<Self, WeightsError> {
        Ok(Self {
            scale: weights.tensor(&format!("{name}.weight"), &[width])?,
            shift: weights.tensor(&format!("{name}.bias"), &[width])?,
        })
    }

    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_layer_norm(self.scale.size(), Some(&self.scale), Some(&self.shift), 1e-5, false)
    }
}

/// ReLU that lets a part of what is negative through.
pub(crate) fn leaky(x: &Tensor, slope: f64) -> Result<Tensor, TchError> {
    x.f_maximum(&x.f_mul_scalar(slope)?)
}

/// How many numbered things there are, from `first` on: `name` says what their first tensor is
/// called.
pub(crate) fn count(weights: &Weights, first: usize, name: impl Fn(usize) -> String) -> usize {
    (first..).take_while(|&i| weights.has(&name(i))).count()
}

/// The whole number whose square is nearest.
pub(crate) fn root(square: i64) -> i64 {
    (square.max(0) as f64).sqrt().round() as i64
}

/// Standard deviation and mean of each channel over an image, added: the contrast that channel
/// attention looks at.
pub(crate) fn contrast(x: &Tensor) -> Result<Tensor, TchError> {
    let places: &[i64] = &[2, 3];
    let mean = x.f_mean_dim(places, true, Kind::Float)?;
    x.f_sub(&mean)?.f_square()?.f_mean_dim(places, true, Kind::Float)?.f_sqrt()?.f_add(&mean)
}
