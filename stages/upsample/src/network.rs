use nets::{Weights, WeightsError};
use tch::{Kind, TchError, Tensor};

/// Network that enlarges images.
pub(crate) trait Network: Send {
    /// Returns the network's scale factor, or `None` if it enlarges by any factor.
    fn scale(&self) -> Option<i64>;

    /// Enlarges an image (1 × 3 × rows × columns, 0..1) to `size`, rows and columns. A network with
    /// a scale ignores `size`.
    fn enlarge(&self, image: &Tensor, size: [i64; 2]) -> Result<Tensor, TchError>;
}

/// Linear layer: `NAME.weight` (outputs × inputs) and `NAME.bias`.
pub(crate) struct Linear {
    weight: Tensor,
    bias: Tensor,
}

impl Linear {
    /// Reads the layer; `shape` is outputs × inputs.
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

    /// Applies the layer.
    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_linear(&self.weight, Some(&self.bias))
    }

    /// Applies the columns `first..end` of the weight to these inputs alone, without the bias.
    pub(crate) fn forward_columns(
        &self,
        x: &Tensor,
        first: i64,
        end: i64,
    ) -> Result<Tensor, TchError> {
        x.f_linear(&self.weight.f_narrow(1, first, end - first)?, None::<&Tensor>)
    }

    /// Returns the bias.
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
    /// Reads the layer for `width` channels.
    pub(crate) fn read(weights: &Weights, name: &str, width: i64) -> Result<Self, WeightsError> {
        Ok(Self {
            scale: weights.tensor(&format!("{name}.weight"), &[width])?,
            shift: weights.tensor(&format!("{name}.bias"), &[width])?,
        })
    }

    /// Applies the layer.
    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_layer_norm(self.scale.size(), Some(&self.scale), Some(&self.shift), 1e-5, false)
    }
}

/// Computes the leaky ReLU, which multiplies negative values by `slope`.
pub(crate) fn leaky_relu(x: &Tensor, slope: f64) -> Result<Tensor, TchError> {
    x.f_maximum(&x.f_mul_scalar(slope)?)
}

/// Counts numbered parts of a network, from number `first`; `name` returns the name of a tensor of
/// each part.
pub(crate) fn count_parts(
    weights: &Weights,
    first: usize,
    name: impl Fn(usize) -> String,
) -> usize {
    (first..).take_while(|&i| weights.has(&name(i))).count()
}

/// Returns the square root, rounded to an integer.
pub(crate) fn integer_root(square: i64) -> i64 {
    (square.max(0) as f64).sqrt().round() as i64
}

/// Returns the sum of standard deviation and mean of each channel over an image: the contrast that
/// IMDN's channel attention takes.
pub(crate) fn contrast(x: &Tensor) -> Result<Tensor, TchError> {
    let axes: &[i64] = &[2, 3];
    let mean = x.f_mean_dim(axes, true, Kind::Float)?;
    x.f_sub(&mean)?.f_square()?.f_mean_dim(axes, true, Kind::Float)?.f_sqrt()?.f_add(&mean)
}
