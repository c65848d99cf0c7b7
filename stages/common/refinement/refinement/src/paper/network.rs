use std::path::Path;

use crate::RefinementError;
use nets::Weights;
use numerics::CounterRng;
use tch::{TchError, Tensor};

/// NeRF-SR's refinement network, of any width.
#[derive(Debug)]
pub struct PaperRefiner {
    encoder: Vec<ConvLayer>,
    decoder: Vec<ConvLayer>,
}

/// 3×3 convolution with zero padding, and optional batch normalisation. An activation follows: tanh
/// after the last layer of the decoder, otherwise ReLU.
#[derive(Debug)]
struct ConvLayer {
    /// Tensors in the order of [`TENSORS`]; without batch normalisation only the first
    /// [`UNNORMALISED_TENSORS`]. Trainable ones require gradients.
    tensors: Vec<Tensor>,
    stride: i64,
}

/// Inputs and outputs of a layer in multiples of the width (`None`: colours), stride, and true if
/// the layer is normalised.
type LayerSpec = (Option<i64>, Option<i64>, i64, bool);

const ENCODER: [LayerSpec; 7] = [
    (None, Some(1), 1, false),
    (Some(1), Some(1), 1, true),
    (Some(1), Some(2), 2, true),
    (Some(2), Some(2), 1, true),
    (Some(2), Some(4), 2, true),
    (Some(4), Some(4), 1, true),
    (Some(4), Some(4), 2, true),
];
/// Three layers per size, coarsest size first. The first layer of a size takes the previous size's
/// output, the view's features, and the maximum of the references' features. The inputs are 4 + 4
/// widths (the coarsest size has no previous one), 4 + 4 + 4, 2 + 2 + 2 and 1 + 1 + 1.
const DECODER: [LayerSpec; 12] = [
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
/// Name of a convolution's kernel in a weights file.
const KERNEL: &str = "weight";
/// Name of a convolution's bias.
const BIAS: &str = "bias";
/// Name of batch normalisation's factors.
const SCALE: &str = "norm.weight";
/// Name of batch normalisation's summands.
const SHIFT: &str = "norm.bias";
/// Name of batch normalisation's running means, which aren't trained.
const MEAN: &str = "norm.running_mean";
/// Name of batch normalisation's running variances, which aren't trained.
const VARIANCE: &str = "norm.running_var";
/// Names of a layer's tensors, in the order of [`ConvLayer::tensors`].
const TENSORS: [&str; 6] = [KERNEL, BIAS, SCALE, SHIFT, MEAN, VARIANCE];
/// Number of tensors of a layer without batch normalisation: kernel and bias.
const UNNORMALISED_TENSORS: usize = 2;
/// Indices of the encoder layers whose features the decoder takes.
const TAPS: [usize; 4] = [1, 3, 5, 6];
/// Number of colour channels.
pub(crate) const COLOURS: i64 = 3;
/// The side of a patch in pixels must be a multiple of this, since the encoder halves it three
/// times.
pub(crate) const PATCH_MULTIPLE: usize = 8;
/// PyTorch's defaults for batch normalisation.
const MOMENTUM: f64 = 0.1;
const EPSILON: f64 = 1e-5;
/// Maximum width of a network that is read from a file; chosen by hand.
const MAX_WIDTH: u32 = 1024;
/// Stream of random numbers for the initial weights.
const WEIGHTS_STREAM: u64 = 320;

impl PaperRefiner {
    /// Creates an untrained network, initialised as in the authors' code (He et al. 2015; scales of
    /// batch normalisation around 1). The published width is 128.
    pub fn new(width: u32, seed: u64) -> Result<Self, RefinementError> {
        let mut number = 0;
        Self::build(width, |_, shape, part| {
            number += 1;
            let mut rng = CounterRng::new(seed, WEIGHTS_STREAM, number);
            let count = shape.iter().product::<i64>();
            let inputs = shape[1..].iter().product::<i64>() as f64;
            let values: Vec<f32> = match part {
                KERNEL => {
                    (0..count).map(|_| ((2.0 / inputs).sqrt() * rng.normal()) as f32).collect()
                }
                SCALE => (0..count).map(|_| (1.0 + 0.02 * rng.normal()) as f32).collect(),
                VARIANCE => vec![1.0; count as usize],
                // Biases, summands and means.
                _ => vec![0.0; count as usize],
            };
            Ok(Tensor::f_from_slice(&values)?.f_reshape(shape)?)
        })
    }

    /// Reads weights that [`PaperRefiner::write`] wrote.
    pub fn read(path: &Path, width: u32) -> Result<Self, RefinementError> {
        // Checked before anything of this size is allocated.
        if !(1..=MAX_WIDTH).contains(&width) {
            let problem = format!("unsupported network: {width} channels");
            return Err(RefinementError::Unusable(problem));
        }
        let weights = Weights::read(path)?;
        Self::build(width, |name, shape, _| Ok(weights.tensor(name, shape)?))
    }

    /// Writes the weights.
    pub fn write(&self, path: &Path) -> Result<(), RefinementError> {
        Ok(nets::write(path, &self.named_tensors())?)
    }

    /// Returns the number of trainable parameters.
    pub fn parameter_count(&self) -> usize {
        self.parameters().map(|p| p.numel()).sum()
    }

    /// Builds a network from tensors that `tensor` returns by full name, shape and name in
    /// [`TENSORS`].
    fn build(
        width: u32,
        mut tensor: impl FnMut(&str, &[i64], &str) -> Result<Tensor, RefinementError>,
    ) -> Result<Self, RefinementError> {
        let encoder = build_layers("encoder", &ENCODER, width, &mut tensor)?;
        let decoder = build_layers("decoder", &DECODER, width, &mut tensor)?;
        Ok(Self { encoder, decoder })
    }

    /// Returns all tensors with their names, including running means.
    pub(crate) fn named_tensors(&self) -> Vec<(String, Tensor)> {
        let mut all = Vec::new();
        for (name, layers) in [("encoder", &self.encoder), ("decoder", &self.decoder)] {
            for (i, layer) in layers.iter().enumerate() {
                for (part, tensor) in TENSORS.iter().zip(&layer.tensors) {
                    all.push((format!("{name}.{i}.{part}"), tensor.shallow_clone()));
                }
            }
        }
        all
    }

    /// Returns handles to the trainable parameters.
    pub(crate) fn parameters(&self) -> impl Iterator<Item = Tensor> {
        let layers = self.encoder.iter().chain(&self.decoder);
        let tensors = layers.flat_map(|layer| &layer.tensors);
        // `build_layers` has set this for trainable tensors only.
        tensors.filter(|tensor| tensor.requires_grad()).map(Tensor::shallow_clone)
    }

    /// Returns another handle to the same tensors, for another thread.
    pub(crate) fn shallow_clone(&self) -> Self {
        Self {
            encoder: self.encoder.iter().map(ConvLayer::shallow_clone).collect(),
            decoder: self.decoder.iter().map(ConvLayer::shallow_clone).collect(),
        }
    }

    /// Returns features of patches (count × 3 × rows × columns, -1..1) at four sizes, finest first.
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

    /// Redraws rendered patches (count × 3 × rows × columns, -1..1), given equally many reference
    /// patches for each (count · references × 3 × rows × columns).
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
        // The last layer's outputs are colours.
        for (size, layers) in self.decoder.chunks_exact(3).enumerate() {
            let tap = TAPS.len() - 1 - size;
            let features = [own[tap].shallow_clone(), max_over_references(&theirs[tap], count)?];
            let mut y = Tensor::f_cat(&x.into_iter().chain(features).collect::<Vec<_>>(), 1)?;
            for (i, layer) in layers.iter().enumerate() {
                let is_last = tap == 0 && i == 2;
                // The next size has twice as many rows and columns: nearest neighbour.
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
        Ok(x.expect("the decoder has layers"))
    }
}

/// Builds the layers of the encoder or decoder; trainable tensors require gradients.
fn build_layers(
    name: &str,
    specs: &[LayerSpec],
    width: u32,
    tensor: &mut impl FnMut(&str, &[i64], &str) -> Result<Tensor, RefinementError>,
) -> Result<Vec<ConvLayer>, RefinementError> {
    let mut layers = Vec::with_capacity(specs.len());
    for (i, &(inputs, outputs, stride, normalised)) in specs.iter().enumerate() {
        let [inputs, outputs] = [inputs, outputs]
            .map(|multiple| multiple.map_or(COLOURS, |multiple| multiple * i64::from(width)));
        let parts = if normalised { &TENSORS[..] } else { &TENSORS[..UNNORMALISED_TENSORS] };
        let mut tensors = Vec::with_capacity(parts.len());
        for &part in parts {
            let is_kernel = part == KERNEL;
            let kernel_shape = [outputs, inputs, 3, 3];
            // All other tensors have a value for each output.
            let shape = if is_kernel { &kernel_shape[..] } else { &[outputs] };
            let is_trainable = part != MEAN && part != VARIANCE;
            let tensor = tensor(&format!("{name}.{i}.{part}"), shape, part)?;
            tensors.push(tensor.set_requires_grad(is_trainable));
        }
        layers.push(ConvLayer { tensors, stride });
    }
    Ok(layers)
}

/// Converts square patches to a tensor (count × 3 × rows × columns), channels last in memory.
pub(crate) fn patch_tensor(samples: &[f32], count: usize, side: usize) -> Result<Tensor, TchError> {
    let (count, side) = (count as i64, side as i64);
    Tensor::f_from_slice(samples)?.f_reshape([count, side, side, COLOURS])?.f_permute([0, 3, 1, 2])
}

/// Returns the maximum of the features over the references of each of `count` patches.
fn max_over_references(features: &Tensor, count: i64) -> Result<Tensor, TchError> {
    let [all, channels, rows, columns] = features.size()[..] else {
        return Err(TchError::Shape("expected features of four dimensions".to_owned()));
    };
    features.f_reshape([count, all / count.max(1), channels, rows, columns])?.f_amax([1], false)
}

impl ConvLayer {
    /// Applies the layer without its activation.
    fn forward(&self, x: &Tensor, training: bool) -> Result<Tensor, TchError> {
        let y = x.f_conv2d(
            &self.tensors[0],
            Some(&self.tensors[1]),
            [self.stride; 2],
            [1, 1],
            [1, 1],
            1,
        )?;
        let [_, _, scale, shift, mean, variance] = &self.tensors[..] else { return Ok(y) };
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

    /// Returns another handle to the same tensors.
    fn shallow_clone(&self) -> Self {
        let tensors = self.tensors.iter().map(Tensor::shallow_clone);
        Self { tensors: tensors.collect(), stride: self.stride }
    }
}
