//! LPIPS v0.1 (Zhang et al. 2018): distance of a network's normalised features after each stage of
//! the network, weighted by learned heads.

use std::path::Path;

use anyhow::Context as _;
use nets::{Conv, Weights, WeightsError};
use pixels::Image;
use tch::{Kind, TchError, Tensor, no_grad};

use super::lpips_network::LpipsNetwork;

/// Network with its heads.
pub struct Lpips {
    layers: Vec<LpipsLayer>,
    heads: Vec<Tensor>,
    /// [`LpipsNetwork::min_size`].
    min_size: usize,
}

enum LpipsLayer {
    /// Convolution and ReLU.
    Conv { conv: Conv, stride: i64, padding: i64 },
    /// SqueezeNet's module: squeezes to few channels and expands by parallel 1×1 and 3×3
    /// convolutions, with a ReLU after each.
    Fire { squeeze: Conv, expand1: Conv, expand3: Conv },
    /// Maximum over a square with stride 2; `partial` includes incomplete squares at the border.
    Pool { size: i64, partial: bool },
    /// End of a stage, where features are compared.
    Stage,
}

/// Reader of a network's layers in order.
struct LayerReader<'a> {
    weights: &'a Weights,
    layers: Vec<LpipsLayer>,
    /// Channels of the next layer's input.
    channels: i64,
    /// Channels at the end of each stage.
    stages: Vec<i64>,
}

impl LayerReader<'_> {
    /// Reads a convolution by torchvision's index in `features`.
    fn conv(
        &mut self,
        index: usize,
        outputs: i64,
        size: i64,
        stride: i64,
        padding: i64,
    ) -> Result<(), WeightsError> {
        let conv = Conv::read(
            self.weights,
            &format!("features.{index}"),
            [outputs, self.channels, size, size],
        )?;
        self.layers.push(LpipsLayer::Conv { conv, stride, padding });
        self.channels = outputs;
        Ok(())
    }

    fn fire(&mut self, index: usize, squeezed: i64, expanded: i64) -> Result<(), WeightsError> {
        let read = |part: &str, shape| {
            Conv::read(self.weights, &format!("features.{index}.{part}"), shape)
        };
        let layer = LpipsLayer::Fire {
            squeeze: read("squeeze", [squeezed, self.channels, 1, 1])?,
            expand1: read("expand1x1", [expanded, squeezed, 1, 1])?,
            expand3: read("expand3x3", [expanded, squeezed, 3, 3])?,
        };
        self.layers.push(layer);
        self.channels = 2 * expanded;
        Ok(())
    }

    fn pool(&mut self, size: i64, partial: bool) {
        self.layers.push(LpipsLayer::Pool { size, partial });
    }

    fn stage(&mut self) {
        self.layers.push(LpipsLayer::Stage);
        self.stages.push(self.channels);
    }

    /// Reads SqueezeNet 1.1.
    fn squeeze(&mut self) -> Result<(), WeightsError> {
        self.conv(0, 64, 3, 2, 0)?;
        self.stage();
        for (fires, squeezed, expanded) in [([3, 4], 16, 64), ([6, 7], 32, 128)] {
            self.pool(3, true);
            for index in fires {
                self.fire(index, squeezed, expanded)?;
            }
            self.stage();
        }
        self.pool(3, true);
        for (index, squeezed, expanded) in
            [(9, 48, 192), (10, 48, 192), (11, 64, 256), (12, 64, 256)]
        {
            self.fire(index, squeezed, expanded)?;
            self.stage();
        }
        Ok(())
    }

    /// Reads AlexNet in torchvision's form.
    fn alex(&mut self) -> Result<(), WeightsError> {
        self.conv(0, 64, 11, 4, 2)?;
        self.stage();
        self.pool(3, false);
        self.conv(3, 192, 5, 1, 2)?;
        self.stage();
        self.pool(3, false);
        for (index, outputs) in [(6, 384), (8, 256), (10, 256)] {
            self.conv(index, outputs, 3, 1, 1)?;
            self.stage();
        }
        Ok(())
    }

    /// Reads VGG-16.
    fn vgg(&mut self) -> Result<(), WeightsError> {
        let blocks: [(i64, &[usize]); 5] = [
            (64, &[0, 2]),
            (128, &[5, 7]),
            (256, &[10, 12, 14]),
            (512, &[17, 19, 21]),
            (512, &[24, 26, 28]),
        ];
        for (block, (outputs, convs)) in blocks.into_iter().enumerate() {
            if block > 0 {
                self.pool(2, false);
            }
            for &index in convs {
                self.conv(index, outputs, 3, 1, 1)?;
            }
            self.stage();
        }
        Ok(())
    }
}

fn relu(conv: &Conv, x: &Tensor, stride: i64, padding: i64) -> Result<Tensor, TchError> {
    conv.forward(x, stride, padding)?.f_relu()
}

impl LpipsLayer {
    fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        match self {
            Self::Conv { conv, stride, padding } => relu(conv, x, *stride, *padding),
            Self::Fire { squeeze, expand1, expand3 } => {
                let squeezed = relu(squeeze, x, 1, 0)?;
                Tensor::f_cat(
                    &[relu(expand1, &squeezed, 1, 0)?, relu(expand3, &squeezed, 1, 1)?],
                    1,
                )
            }
            Self::Pool { size, partial } => {
                x.f_max_pool2d([*size; 2], [2, 2], [0, 0], [1, 1], *partial)
            }
            Self::Stage => Ok(x.shallow_clone()),
        }
    }
}

impl Lpips {
    /// Reads a network and its heads from the files [`LpipsNetwork::files`] in a folder.
    pub fn read(folder: &Path, network: LpipsNetwork) -> Result<Self, WeightsError> {
        nets::deterministic();
        let [weights_file, heads_file] = network.files();
        let weights = Weights::read(&folder.join(weights_file))?;
        let linear = Weights::read(&folder.join(heads_file))?;
        let mut reader =
            LayerReader { weights: &weights, layers: Vec::new(), channels: 3, stages: Vec::new() };
        match network {
            LpipsNetwork::Squeeze => reader.squeeze(),
            LpipsNetwork::Alex => reader.alex(),
            LpipsNetwork::Vgg => reader.vgg(),
        }?;
        let mut heads = Vec::with_capacity(reader.stages.len());
        for (k, &channels) in reader.stages.iter().enumerate() {
            let name = format!("lin{k}.model.1.weight");
            heads.push(linear.tensor(&name, &[1, channels, 1, 1])?);
        }
        Ok(Self { layers: reader.layers, heads, min_size: network.min_size() })
    }

    /// Returns the distance of two RGB images in 0..1.
    pub fn distance(&self, a: &Image, b: &Image) -> anyhow::Result<f64> {
        let min_size = self.min_size;
        anyhow::ensure!(
            a.width >= min_size && a.height >= min_size,
            "LPIPS needs images of at least {min_size}×{min_size} pixels, found {}×{}",
            a.width,
            a.height
        );
        no_grad(|| self.sum_over_stages(a, b)).context("LPIPS")
    }

    fn sum_over_stages(&self, a: &Image, b: &Image) -> Result<f64, TchError> {
        let (mut a, mut b, mut sum) = (input_tensor(a)?, input_tensor(b)?, 0.0);
        let mut heads = self.heads.iter();
        for layer in &self.layers {
            (a, b) = (layer.forward(&a)?, layer.forward(&b)?);
            if let LpipsLayer::Stage = layer
                && let Some(head) = heads.next()
            {
                let difference = normalised(&a)?.f_sub(&normalised(&b)?)?.f_square()?;
                let weighted =
                    difference.f_conv2d::<Tensor>(head, None, [1, 1], [0, 0], [1, 1], 1)?;
                sum += weighted.f_mean(Kind::Float)?.f_double_value(&[])?;
            }
        }
        Ok(sum)
    }
}

/// Converts an image to the network's input, 1×3×H×W: scales it to [-1, 1] and normalises it with
/// LPIPS's constants.
fn input_tensor(image: &Image) -> Result<Tensor, TchError> {
    let shift = Tensor::f_from_slice(&[-0.030f32, -0.088, -0.188])?.f_reshape([1, 3, 1, 1])?;
    let scale = Tensor::f_from_slice(&[0.458f32, 0.448, 0.450])?.f_reshape([1, 3, 1, 1])?;
    let x = nets::tensor_of(image)?.f_mul_scalar(2.0)?.f_sub_scalar(1.0)?;
    x.f_sub(&shift)?.f_div(&scale)
}

/// Normalises features to unit length across channels.
fn normalised(x: &Tensor) -> Result<Tensor, TchError> {
    let length = x.f_square()?.f_sum_dim_intlist([1i64].as_slice(), true, Kind::Float)?.f_sqrt()?;
    x.f_div(&length.f_add_scalar(1e-10)?)
}
