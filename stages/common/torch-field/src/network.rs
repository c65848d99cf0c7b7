use std::sync::LazyLock;

use counter_rng::CounterRng;
use radiance::MlpArchitecture;
use tch::{Device, Kind, TchError, Tensor};

use crate::encoding::encoded;
use crate::error::TorchFieldError;

/// One of the two networks: position → density and a feature, that and direction → colour.
/// Parameters are weight and bias of each layer, in the order of [`MlpNetwork::layers`].
#[derive(Debug)]
pub(crate) struct MlpNetwork {
    architecture: MlpArchitecture,
    pub(crate) parameters: Vec<Tensor>,
}

/// A linear layer: its name in the reference's checkpoints, inputs, outputs.
type Layer = (String, i64, i64);

/// The encoded position joins in again at this layer, counted from 0.
const SKIP: u32 = 4;

impl MlpNetwork {
    /// Layers from front to back.
    pub(crate) fn layers(architecture: &MlpArchitecture) -> Vec<Layer> {
        let width = i64::from(architecture.width);
        let position = encoded(3, architecture.position_octaves);
        let direction = encoded(3, architecture.direction_octaves);
        let trunk = (0..architecture.depth).map(|i| {
            let inputs = match i {
                0 => position,
                SKIP => position + width,
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

    /// Names of the parameters.
    pub(crate) fn names(
        architecture: &MlpArchitecture,
    ) -> impl Iterator<Item = (String, Vec<i64>)> {
        Self::layers(architecture).into_iter().flat_map(|(name, inputs, outputs)| {
            [
                (format!("{name}.weight"), vec![outputs, inputs]),
                (format!("{name}.bias"), vec![outputs]),
            ]
        })
    }

    /// He et al. 2015, normal, for every layer, with biases of 0: the reference's. `index` tells
    /// the networks of a seed apart.
    pub(crate) fn new(
        architecture: MlpArchitecture,
        seed: u64,
        index: u64,
        device: Device,
    ) -> Result<Self, TchError> {
        let mut rng = CounterRng::new(seed, WEIGHTS, index);
        let mut parameters = Vec::new();
        for (_, inputs, outputs) in Self::layers(&architecture) {
            let deviation = (2.0 / inputs as f64).sqrt();
            let values: Vec<f32> =
                (0..inputs * outputs).map(|_| (deviation * normal(&mut rng)) as f32).collect();
            parameters.push(Tensor::f_from_slice(&values)?.f_reshape([outputs, inputs])?);
            parameters.push(Tensor::f_zeros([outputs], (Kind::Float, Device::Cpu))?);
        }
        Self { architecture, parameters }.to(device, Kind::Float)
    }

    /// From parameters by name, each with its shape.
    pub(crate) fn read(
        architecture: MlpArchitecture,
        mut tensor: impl FnMut(&str, &[i64]) -> Result<Tensor, TorchFieldError>,
    ) -> Result<Self, TorchFieldError> {
        let parameters = Self::names(&architecture)
            .map(|(name, shape)| tensor(&name, &shape))
            .collect::<Result<_, _>>()?;
        Ok(Self { architecture, parameters })
    }

    /// The same network elsewhere or in another precision; its parameters take gradients.
    pub(crate) fn to(&self, device: Device, kind: Kind) -> Result<Self, TchError> {
        let moved = self.parameters.iter().map(|t| learnable(t, device, kind));
        Ok(Self { architecture: self.architecture, parameters: moved.collect::<Result<_, _>>()? })
    }

    /// Another handle on the same parameters, for another thread.
    pub(crate) fn share(&self) -> Self {
        Self {
            architecture: self.architecture,
            parameters: self.parameters.iter().map(Tensor::shallow_clone).collect(),
        }
    }

    /// Colour (n × 3, in 0..1) and raw density (n) of encoded positions and directions.
    pub(crate) fn forward(
        &self,
        position: &Tensor,
        direction: &Tensor,
    ) -> Result<(Tensor, Tensor), TchError> {
        let depth = self.architecture.depth as usize;
        let linear =
            |x: &Tensor, i: usize| linear(x, &self.parameters[2 * i], &self.parameters[2 * i + 1]);
        let mut x = position.shallow_clone();
        for i in 0..depth {
            if i == SKIP as usize {
                x = Tensor::f_cat(&[position, &x], -1)?;
            }
            x = linear(&x, i)?.f_relu()?;
        }
        let density = linear(&x, depth)?.f_squeeze_dim(-1)?;
        let feature = linear(&x, depth + 1)?;
        let shaded = linear(&Tensor::f_cat(&[&feature, direction], -1)?, depth + 2)?.f_relu()?;
        Ok((linear(&shaded, depth + 3)?.f_sigmoid()?, density))
    }
}

/// A copy elsewhere or in another precision, which takes gradients.
fn learnable(tensor: &Tensor, device: Device, kind: Kind) -> Result<Tensor, TchError> {
    Ok(tensor.f_to_device(device)?.f_to_kind(kind)?.f_detach_copy()?.set_requires_grad(true))
}

/// A linear layer. In f32 on a CPU by oneDNN, where libtorch has it: MKL's products use half of the
/// vectors on processors that aren't Intel's (92 against 216 GFLOP/s on a core of the machine this
/// was measured on), and oneDNN's are as exact.
fn linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor, TchError> {
    static HAS_ONEDNN: LazyLock<bool> = LazyLock::new(|| {
        let one = Tensor::ones([1, 1], (Kind::Float, Device::Cpu));
        by_onednn(&one, &one, &one.reshape([1])).is_ok()
    });
    if x.kind() == Kind::Float && x.device() == Device::Cpu && *HAS_ONEDNN {
        by_onednn(x, weight, bias)
    } else {
        x.f_linear(weight, Some(bias))
    }
}

fn by_onednn(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor, TchError> {
    x.f_to_mkldnn(None)?.f_mkldnn_linear(weight, Some(bias))?.f_to_dense(None, false)
}

/// Purposes of draws.
const WEIGHTS: u64 = 200;

/// A standard normal draw (Box and Muller 1958).
pub(crate) fn normal(rng: &mut CounterRng) -> f64 {
    let radius = (-2.0 * (1.0 - f64::from(rng.uniform())).ln()).sqrt();
    radius * (std::f64::consts::TAU * f64::from(rng.uniform())).cos()
}
