use std::path::Path;

use counter_rng::CounterRng;
use nets::Weights;
use refinement::RefinementError;
use tch::{TchError, Tensor};

/// The published network, or one as it with other widths.
#[derive(Debug)]
pub struct PaperRefiner {
    encoder: Vec<ConvLayer>,
    decoder: Vec<ConvLayer>,
    width: u32,
}

/// A convolution of 3×3 with zeros around, normalisation by batch where there is one, ReLU (the
/// last layer has tanh).
#[derive(Debug)]
struct ConvLayer {
    kernel: Tensor,
    bias: Tensor,
    norm: Option<BatchNorm>,
    stride: i64,
}

/// Batch normalisation: the mean and variance of a batch while training, their running means
/// afterwards.
#[derive(Debug)]
struct BatchNorm {
    scale: Tensor,
    shift: Tensor,
    mean: Tensor,
    variance: Tensor,
}

/// Inputs and outputs in multiples of the width (colours where there are none), stride, and whether
/// it is normalised.
type Spec = (Option<i64>, Option<i64>, i64, bool);

const ENCODER: [Spec; 7] = [
    (None, Some(1), 1, false),
    (Some(1), Some(1), 1, true),
    (Some(1), Some(2), 2, true),
    (Some(2), Some(2), 1, true),
    (Some(2), Some(4), 2, true),
    (Some(4), Some(4), 1, true),
    (Some(4), Some(4), 2, true),
];
const DECODER: [Spec; 12] = [
    (Some(8), Some(4), 1, true),
    (Some(4), Some(4), 1, true),
    (Some(4), Some(4), 1, true),
    (Some(12), Some(4), 1, true),
    (Some(4), Some(4), 1, true),
    (Some(4), Some(2), 1, true),
    (Some(6), Some(2), 1, true),
    (Some(2), Some(2), 1, true),
    (Some(2), Some(1), 1, true),
    (Some(3), Some(1), 1, true),
    (Some(1), Some(1), 1, true),
    (Some(1), None, 1, false),
];
/// After which of the encoder's layers the decoder takes features.
const TAPS: [usize; 4] = [1, 3, 5, 6];
/// Channels of a colour.
pub(crate) const COLOURS: i64 = 3;
/// Pixels of a patch's side are a multiple of this.
pub(crate) const PATCH_MULTIPLE: usize = 8;
/// PyTorch's defaults.
const MOMENTUM: f64 = 0.1;
const EPSILON: f64 = 1e-5;
/// Widest network that is read.
const MOST_WIDTH: u32 = 1024;
/// Purpose of draws.
const WEIGHTS: u64 = 320;

impl PaperRefiner {
    /// A network that hasn't learnt anything, initialised as the reference does (He et al. 2015;
    /// scales of normalisation about 1). The published width is 128.
    pub fn new(width: u32, seed: u64) -> Result<Self, RefinementError> {
        let mut number = 0;
        Self::build(width, |_, shape, part| {
            number += 1;
            let mut rng = CounterRng::new(seed, WEIGHTS, number);
            let count = shape.iter().product::<i64>();
            let inputs = shape[1..].iter().product::<i64>() as f64;
            let values: Vec<f32> = match part {
                LayerTensor::Kernel => {
                    (0..count).map(|_| ((2.0 / inputs).sqrt() * normal(&mut rng)) as f32).collect()
                }
                LayerTensor::Scale => {
                    (0..count).map(|_| (1.0 + 0.02 * normal(&mut rng)) as f32).collect()
                }
                LayerTensor::Variance => vec![1.0; count as usize],
                LayerTensor::Bias | LayerTensor::Shift | LayerTensor::Mean => {
                    vec![0.0; count as usize]
                }
            };
            Ok(Tensor::f_from_slice(&values)?.f_reshape(shape)?)
        })
    }

    /// Reads weights that [`PaperRefiner::write`] wrote.
    pub fn read(path: &Path, width: u32) -> Result<Self, RefinementError> {
        // Before anything is made of such a number.
        if !(1..=MOST_WIDTH).contains(&width) {
            return Err(RefinementError::Architecture { channels: width, blocks: 0 });
        }
        let weights = Weights::read(path)?;
        Self::build(width, |name, shape, _| Ok(weights.tensor(name, shape)?))
    }

    /// Writes the weights.
    pub fn write(&self, path: &Path) -> Result<(), RefinementError> {
        Ok(nets::write(path, &self.named())?)
    }

    /// Features of the first layer.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// How many numbers are learnt.
    pub fn weights(&self) -> usize {
        self.parameters().map(|p| p.numel()).sum()
    }

    fn build(
        width: u32,
        mut tensor: impl FnMut(&str, &[i64], LayerTensor) -> Result<Tensor, RefinementError>,
    ) -> Result<Self, RefinementError> {
        let encoder = layers("encoder", &ENCODER, width, &mut tensor)?;
        let decoder = layers("decoder", &DECODER, width, &mut tensor)?;
        Ok(Self { encoder, decoder, width })
    }

    /// All tensors by name, running means among them.
    pub(crate) fn named(&self) -> Vec<(String, Tensor)> {
        let mut all = Vec::new();
        for (name, layers) in [("encoder", &self.encoder), ("decoder", &self.decoder)] {
            for (i, layer) in layers.iter().enumerate() {
                for (part, tensor) in layer.tensors() {
                    all.push((format!("{name}.{i}.{}", part.name()), tensor));
                }
            }
        }
        all
    }

    /// What is learnt.
    pub(crate) fn parameters(&self) -> impl Iterator<Item = Tensor> {
        self.encoder
            .iter()
            .chain(&self.decoder)
            .flat_map(ConvLayer::tensors)
            .filter(|(part, _)| part.is_learnt())
            .map(|(_, t)| t)
    }

    /// Another handle on the same tensors, for another thread.
    pub(crate) fn share(&self) -> Self {
        let of = |layers: &[ConvLayer]| layers.iter().map(ConvLayer::share).collect();
        Self { encoder: of(&self.encoder), decoder: of(&self.decoder), width: self.width }
    }

    /// Features of patches (count × 3 × rows × columns, -1..1) at four sizes, the finest first.
    pub(crate) fn encode(&self, patches: &Tensor, training: bool) -> Result<Vec<Tensor>, TchError> {
        let (mut x, mut features) = (patches.shallow_clone(), Vec::with_capacity(TAPS.len()));
        for (i, layer) in self.encoder.iter().enumerate() {
            x = layer.forward(&x, training)?.f_relu()?;
            if TAPS.contains(&i) {
                features.push(x.shallow_clone());
            }
        }
        Ok(features)
    }

    /// What patches should look like, -1..1: rendered ones (count × 3 × rows × columns) beside as
    /// many references for each (count · references × 3 × rows × columns).
    pub(crate) fn forward(
        &self,
        rendered: &Tensor,
        references: &Tensor,
        training: bool,
    ) -> Result<Tensor, TchError> {
        let count = rendered.size()[0];
        let own = self.encode(rendered, training)?;
        let theirs = self.encode(references, training)?;
        let mut x = None::<Tensor>;
        // From the coarsest on, three layers a size; the last ends in colours.
        for (size, layers) in self.decoder.chunks_exact(3).enumerate() {
            let at = TAPS.len() - 1 - size;
            let known = [own[at].shallow_clone(), best(&theirs[at], count)?];
            let mut y = Tensor::f_cat(&x.into_iter().chain(known).collect::<Vec<_>>(), 1)?;
            for (i, layer) in layers.iter().enumerate() {
                let is_last = at == 0 && i == 2;
                if i == 2 && !is_last {
                    y = y
                        .f_repeat_interleave_self_int(2, 2, None)?
                        .f_repeat_interleave_self_int(2, 3, None)?;
                }
                y = layer.forward(&y, training)?;
                y = if is_last { y.f_tanh()? } else { y.f_relu()? };
            }
            x = Some(y);
        }
        x.ok_or_else(|| TchError::Shape("a decoder without layers".to_owned()))
    }
}

/// A standard normal draw (Box and Muller 1958).
fn normal(rng: &mut CounterRng) -> f64 {
    // A uniform of 0 would be infinitely far.
    let (u, v) = (1.0 - f64::from(rng.uniform()), f64::from(rng.uniform()));
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Layers of tensors, which are had by name and shape; what is learnt takes gradients.
fn layers(
    name: &str,
    specs: &[Spec],
    width: u32,
    tensor: &mut impl FnMut(&str, &[i64], LayerTensor) -> Result<Tensor, RefinementError>,
) -> Result<Vec<ConvLayer>, RefinementError> {
    let channels = |of: Option<i64>| of.map_or(COLOURS, |multiple| multiple * i64::from(width));
    let mut layers = Vec::with_capacity(specs.len());
    for (i, &(inputs, outputs, stride, normalised)) in specs.iter().enumerate() {
        let (name, inputs, outputs) = (format!("{name}.{i}"), channels(inputs), channels(outputs));
        let mut of = |part: LayerTensor, shape: &[i64]| layer_tensor(&name, part, shape, tensor);
        let kernel = of(LayerTensor::Kernel, &[outputs, inputs, 3, 3])?;
        let bias = of(LayerTensor::Bias, &[outputs])?;
        let norm = if normalised {
            Some(BatchNorm {
                scale: of(LayerTensor::Scale, &[outputs])?,
                shift: of(LayerTensor::Shift, &[outputs])?,
                mean: of(LayerTensor::Mean, &[outputs])?,
                variance: of(LayerTensor::Variance, &[outputs])?,
            })
        } else {
            None
        };
        layers.push(ConvLayer { kernel, bias, norm, stride });
    }
    Ok(layers)
}

fn layer_tensor(
    layer: &str,
    part: LayerTensor,
    shape: &[i64],
    tensor: &mut impl FnMut(&str, &[i64], LayerTensor) -> Result<Tensor, RefinementError>,
) -> Result<Tensor, RefinementError> {
    let tensor = tensor(&format!("{layer}.{}", part.name()), shape, part)?;
    Ok(if part.is_learnt() { tensor.set_requires_grad(true) } else { tensor })
}

/// The largest features of the references of each of `count` patches.
fn best(features: &Tensor, count: i64) -> Result<Tensor, TchError> {
    let [all, channels, rows, columns] = features.size()[..] else {
        return Err(TchError::Shape("features have four dimensions".to_owned()));
    };
    features.f_reshape([count, all / count.max(1), channels, rows, columns])?.f_amax([1], false)
}

/// What a tensor of a layer is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LayerTensor {
    Kernel,
    Bias,
    Scale,
    Shift,
    Mean,
    Variance,
}

impl LayerTensor {
    fn name(self) -> &'static str {
        match self {
            Self::Kernel => "weight",
            Self::Bias => "bias",
            Self::Scale => "norm.weight",
            Self::Shift => "norm.bias",
            Self::Mean => "norm.running_mean",
            Self::Variance => "norm.running_var",
        }
    }

    fn is_learnt(self) -> bool {
        !matches!(self, Self::Mean | Self::Variance)
    }
}

impl ConvLayer {
    fn forward(&self, x: &Tensor, training: bool) -> Result<Tensor, TchError> {
        let y = x.f_conv2d(&self.kernel, Some(&self.bias), [self.stride; 2], [1, 1], [1, 1], 1)?;
        let Some(BatchNorm { scale, shift, mean, variance }) = &self.norm else { return Ok(y) };
        y.f_batch_norm(
            Some(scale),
            Some(shift),
            Some(mean),
            Some(variance),
            training,
            MOMENTUM,
            EPSILON,
            false,
        )
    }

    fn tensors(&self) -> Vec<(LayerTensor, Tensor)> {
        let norm = self.norm.iter().flat_map(|norm| {
            let BatchNorm { scale, shift, mean, variance } = norm;
            [
                (LayerTensor::Scale, scale),
                (LayerTensor::Shift, shift),
                (LayerTensor::Mean, mean),
                (LayerTensor::Variance, variance),
            ]
        });
        let all = [(LayerTensor::Kernel, &self.kernel), (LayerTensor::Bias, &self.bias)]
            .into_iter()
            .chain(norm);
        all.map(|(part, tensor)| (part, tensor.shallow_clone())).collect()
    }

    fn share(&self) -> Self {
        let norm = self.norm.as_ref().map(|norm| BatchNorm {
            scale: norm.scale.shallow_clone(),
            shift: norm.shift.shallow_clone(),
            mean: norm.mean.shallow_clone(),
            variance: norm.variance.shallow_clone(),
        });
        Self {
            kernel: self.kernel.shallow_clone(),
            bias: self.bias.shallow_clone(),
            norm,
            stride: self.stride,
        }
    }
}
