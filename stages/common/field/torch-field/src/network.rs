use std::sync::LazyLock;

use numerics::CounterRng;
use tch::{Device, Kind, TchError, Tensor};

use crate::architecture::MlpArchitecture;
use crate::error::TorchFieldError;

/// Coarse or fine network of a field. The trunk computes density and a feature from a position; the
/// colour branch computes colour from this feature and a direction.
#[derive(Debug)]
pub(crate) struct MlpNetwork {
    architecture: MlpArchitecture,
    /// Weight and bias of each layer, in the order of [`MlpNetwork::layers`].
    pub(crate) parameters: Vec<Tensor>,
}

/// Linear layer: name in the reference implementation's checkpoints, inputs, outputs.
type Layer = (String, i64, i64);

/// Index of the layer that also takes the encoded position (Mildenhall et al. 2020).
const SKIP_LAYER: u32 = 4;

/// Stream of random numbers for the initial weights.
const WEIGHTS_STREAM: u64 = 200;

/// Returns the number of outputs of [`encode`] for `dims` inputs.
fn encoded_dims(dims: i64, octaves: u32) -> i64 {
    dims * (1 + 2 * i64::from(octaves))
}

/// Encodes rows x as x, then sin(2ᵏx) and cos(2ᵏx) for k = 0, 1, …: in the order of the reference
/// implementation, and without the paper's π.
pub(crate) fn encode(x: &Tensor, octaves: u32) -> Result<Tensor, TchError> {
    let mut parts = vec![x.shallow_clone()];
    for k in 0..octaves {
        let scaled = x.f_mul_scalar(f64::from(k).exp2())?;
        parts.push(scaled.f_sin()?);
        parts.push(scaled.f_cos()?);
    }
    Tensor::f_cat(&parts, -1)
}

impl MlpNetwork {
    /// Returns the layers from input to output.
    pub(crate) fn layers(architecture: &MlpArchitecture) -> Vec<Layer> {
        let width = i64::from(architecture.hidden_dim);
        let position = encoded_dims(3, architecture.position_frequencies);
        let direction = encoded_dims(3, architecture.direction_frequencies);
        let trunk = (0..architecture.layers).map(|i| {
            let inputs = match i {
                0 => position,
                SKIP_LAYER => position + width,
                _ => width,
            };
            (format!("xyz_encoding_{}.0", i + 1), inputs, width)
        });
        let heads = [
            ("sigma", width, 1),
            ("xyz_encoding_final", width, width),
            ("dir_encoding.0", width + direction, width / 2),
            ("rgb.0", width / 2, 3),
        ];
        trunk
            .chain(heads.map(|(name, inputs, outputs)| (name.to_owned(), inputs, outputs)))
            .collect()
    }

    /// Returns the parameters' names and shapes.
    pub(crate) fn parameter_shapes(
        architecture: &MlpArchitecture,
    ) -> impl Iterator<Item = (String, Vec<i64>)> {
        Self::layers(architecture).into_iter().flat_map(|(name, inputs, outputs)| {
            [
                (format!("{name}.weight"), vec![outputs, inputs]),
                (format!("{name}.bias"), vec![outputs]),
            ]
        })
    }

    /// Initialises every layer like the reference implementation: weights by He et al. 2015
    /// (normal), biases 0. Networks of one seed differ in `index`.
    pub(crate) fn new(
        architecture: MlpArchitecture,
        seed: u64,
        index: u64,
        device: Device,
    ) -> Result<Self, TchError> {
        let mut rng = CounterRng::new(seed, WEIGHTS_STREAM, index);
        let mut parameters = Vec::new();
        for (_, inputs, outputs) in Self::layers(&architecture) {
            let deviation = (2.0 / inputs as f64).sqrt();
            let values: Vec<f32> =
                (0..inputs * outputs).map(|_| (deviation * rng.normal()) as f32).collect();
            parameters.push(Tensor::f_from_slice(&values)?.f_reshape([outputs, inputs])?);
            parameters.push(Tensor::f_zeros([outputs], (Kind::Float, Device::Cpu))?);
        }
        Self { architecture, parameters }.to(device, Kind::Float)
    }

    /// Creates a network from parameters that `tensor` returns by name and shape.
    pub(crate) fn read(
        architecture: MlpArchitecture,
        mut tensor: impl FnMut(&str, &[i64]) -> Result<Tensor, TorchFieldError>,
    ) -> Result<Self, TorchFieldError> {
        let parameters = Self::parameter_shapes(&architecture)
            .map(|(name, shape)| tensor(&name, &shape))
            .collect::<Result<_, _>>()?;
        Ok(Self { architecture, parameters })
    }

    /// Copies the network to a device and precision; the copies require gradients.
    pub(crate) fn to(&self, device: Device, kind: Kind) -> Result<Self, TchError> {
        let moved = self.parameters.iter().map(|t| trainable_copy(t, device, kind));
        Ok(Self { architecture: self.architecture, parameters: moved.collect::<Result<_, _>>()? })
    }

    /// Returns another handle to the same parameters, for another thread.
    pub(crate) fn shallow_clone(&self) -> Self {
        Self {
            architecture: self.architecture,
            parameters: self.parameters.iter().map(Tensor::shallow_clone).collect(),
        }
    }

    /// Returns colours (n × 3, in 0..1) and raw densities (n) at encoded positions and directions.
    pub(crate) fn forward(
        &self,
        position: &Tensor,
        direction: &Tensor,
    ) -> Result<(Tensor, Tensor), TchError> {
        let trunk = self.trunk(position)?;
        let density = self.raw_density(&trunk)?;
        let colour = self.raw_colour(&self.feature(&trunk)?, direction)?.f_sigmoid()?;
        Ok((colour, density))
    }

    /// Returns the outputs of the layers before the branch (n × width) at encoded positions.
    pub(crate) fn trunk(&self, position: &Tensor) -> Result<Tensor, TchError> {
        let mut x = position.shallow_clone();
        for i in 0..self.architecture.layers as usize {
            if i == SKIP_LAYER as usize {
                x = Tensor::f_cat(&[position, &x], -1)?;
            }
            x = self.layer(&x, i)?.f_relu()?;
        }
        Ok(x)
    }

    /// Returns raw densities (n) from the trunk's outputs.
    pub(crate) fn raw_density(&self, trunk: &Tensor) -> Result<Tensor, TchError> {
        self.head(trunk, 0)?.f_squeeze_dim(-1)
    }

    /// Returns the colour branch's features (n × width) from the trunk's outputs.
    pub(crate) fn feature(&self, trunk: &Tensor) -> Result<Tensor, TchError> {
        self.head(trunk, 1)
    }

    /// Returns colours before the sigmoid (n × 3) from features and encoded directions.
    pub(crate) fn raw_colour(
        &self,
        feature: &Tensor,
        direction: &Tensor,
    ) -> Result<Tensor, TchError> {
        let input = Tensor::f_cat(&[feature, direction], -1)?;
        self.head(&self.head(&input, 2)?.f_relu()?, 3)
    }

    /// Applies the layer with this index after the trunk.
    fn head(&self, x: &Tensor, i: usize) -> Result<Tensor, TchError> {
        self.layer(x, self.architecture.layers as usize + i)
    }

    /// Applies the layer with this index.
    fn layer(&self, x: &Tensor, i: usize) -> Result<Tensor, TchError> {
        linear(x, &self.parameters[2 * i], &self.parameters[2 * i + 1])
    }
}

/// Copies a tensor to a device and precision; the copy requires gradients.
fn trainable_copy(tensor: &Tensor, device: Device, kind: Kind) -> Result<Tensor, TchError> {
    Ok(tensor.f_to_device(device)?.f_to_kind(kind)?.f_detach_copy()?.set_requires_grad(true))
}

/// Applies a linear layer, in f32 on a CPU through oneDNN if libtorch has it: on processors of
/// other makers than Intel, MKL uses only half of the vector width (92 against 216 GFLOP/s per core
/// where this was measured), and oneDNN is as accurate (design note 022).
fn linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor, TchError> {
    static HAS_ONEDNN: LazyLock<bool> = LazyLock::new(|| {
        let one = Tensor::ones([1, 1], (Kind::Float, Device::Cpu));
        onednn_linear(&one, &one, &one.reshape([1])).is_ok()
    });
    if x.kind() == Kind::Float && x.device() == Device::Cpu && *HAS_ONEDNN {
        onednn_linear(x, weight, bias)
    } else {
        x.f_linear(weight, Some(bias))
    }
}

fn onednn_linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor, TchError> {
    x.f_to_mkldnn(None)?.f_mkldnn_linear(weight, Some(bias))?.f_to_dense(None, false)
}
