use tch::{TchError, Tensor};

use crate::weights::{Weights, WeightsError};

/// A convolution with zeros beyond the border, as PyTorch names and lays it out: `NAME.weight`
/// (outputs × inputs × rows × columns) and `NAME.bias`.
#[derive(Debug)]
pub struct Conv {
    kernel: Tensor,
    bias: Tensor,
}

impl Conv {
    /// Reads one of that shape.
    pub fn read(weights: &Weights, name: &str, shape: [i64; 4]) -> Result<Self, WeightsError> {
        Ok(Self {
            kernel: weights.tensor(&format!("{name}.weight"), &shape)?,
            bias: weights.tensor(&format!("{name}.bias"), &shape[..1])?,
        })
    }

    /// Of images (count × inputs × rows × columns).
    pub fn forward(&self, x: &Tensor, stride: i64, padding: i64) -> Result<Tensor, TchError> {
        x.f_conv2d(&self.kernel, Some(&self.bias), [stride; 2], [padding; 2], [1, 1], 1)
    }
}
