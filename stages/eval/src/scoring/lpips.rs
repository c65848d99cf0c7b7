//! LPIPS v0.1 (Zhang et al. 2018): distances of a network's normalised features after each of its
//! stages, weighted by learned heads.

use std::path::Path;

use anyhow::Context as _;
use nets::{Conv, Weights, WeightsError};
use pixels::Image;
use tch::{Kind, TchError, Tensor, no_grad};

use super::lpips_network::LpipsNetwork;

/// A network and its heads.
pub struct Lpips {
    layers: Vec<LpipsLayer>,
    heads: Vec<Tensor>,
    /// Pixels along a side that its poolings need.
    least: usize,
}

enum LpipsLayer {
    /// A convolution and a ReLU.
    Conv { conv: Conv, stride: i64, padding: i64 },
    /// SqueezeNet's: squeezed to few channels, expanded by 1×1 and 3×3 side by side; a ReLU after
    /// each.
    Fire { squeeze: Conv, expand1: Conv, expand3: Conv },
    /// The largest of a square; at the border of what is left of one, or of whole ones alone.
    Pool { size: i64, border: bool },
    /// The end of a stage: features are compared here.
    Stage,
}

/// Reads a network's layers in order, and knows how many channels the next one takes.
struct LayerReader<'a> {
    weights: &'a Weights,
    layers: Vec<LpipsLayer>,
    channels: i64,
    /// Channels at the end of each stage.
    stages: Vec<i64>,
}

impl LayerReader<'_> {
    /// A convolution with torchvision's index in `features`.
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
        let (weights, name) = (self.weights, format!("features.{index}"));
        let conv = |part: &str, shape| Conv::read(weights, &format!("{name}.{part}"), shape);
        self.layers.push(LpipsLayer::Fire {
            squeeze: conv("squeeze", [squeezed, self.channels, 1, 1])?,
            expand1: conv("expand1x1", [expanded, squeezed, 1, 1])?,
            expand3: conv("expand3x3", [expanded, squeezed, 3, 3])?,
        });
        self.channels = 2 * expanded;
        Ok(())
    }

    fn pool(&mut self, size: i64, border: bool) {
        self.layers.push(LpipsLayer::Pool { size, border });
    }

    fn stage(&mut self) {
        self.layers.push(LpipsLayer::Stage);
        self.stages.push(self.channels);
    }

    /// SqueezeNet 1.1.
    fn squeeze(&mut self) -> Result<(), WeightsError> {
        self.conv(0, 64, 3, 2, 0)?;
        self.stage();
        for (fires, squeezed, expanded) in [([3, 4], 16, 64), ([6, 7], 32, 128)] {
            self.pool(3, true);
            fires.into_iter().try_for_each(|index| self.fire(index, squeezed, expanded))?;
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

    /// AlexNet, as torchvision has it.
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

    /// VGG-16.
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
            convs.iter().try_for_each(|&index| self.conv(index, outputs, 3, 1, 1))?;
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
            Self::Pool { size, border } => {
                x.f_max_pool2d([*size; 2], [2, 2], [0, 0], [1, 1], *border)
            }
            Self::Stage => Ok(x.shallow_clone()),
        }
    }
}

impl Lpips {
    /// Reads a network and its heads from a folder; [`LpipsNetwork::files`] has their names.
    pub fn read(folder: &Path, network: LpipsNetwork) -> Result<Self, WeightsError> {
        nets::deterministic();
        let [net, linear] = network.files();
        let (net, linear) =
            (Weights::read(&folder.join(net))?, Weights::read(&folder.join(linear))?);
        let mut reader =
            LayerReader { weights: &net, layers: Vec::new(), channels: 3, stages: Vec::new() };
        let least = match network {
            LpipsNetwork::Squeeze => reader.squeeze().map(|()| 17),
            LpipsNetwork::Alex => reader.alex().map(|()| 31),
            LpipsNetwork::Vgg => reader.vgg().map(|()| 16),
        }?;
        let heads = reader.stages.iter().enumerate().map(|(k, &channels)| {
            linear.tensor(&format!("lin{k}.model.1.weight"), &[1, channels, 1, 1])
        });
        let heads = heads.collect::<Result<_, _>>()?;
        Ok(Self { layers: reader.layers, heads, least })
    }

    /// Distance of two RGB images in [0, 1].
    pub fn distance(&self, a: &Image, b: &Image) -> anyhow::Result<f64> {
        let least = self.least;
        anyhow::ensure!(
            a.width >= least && a.height >= least,
            "LPIPS needs images of at least {least}×{least} pixels, not {}×{}",
            a.width,
            a.height
        );
        no_grad(|| self.sum_over_stages(a, b)).context("LPIPS")
    }

    fn sum_over_stages(&self, a: &Image, b: &Image) -> Result<f64, TchError> {
        let (mut a, mut b, mut sum) = (input(a)?, input(b)?, 0.0);
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

/// To [-1, 1], then by the method's own shift and scale; shape 1×3×H×W.
fn input(image: &Image) -> Result<Tensor, TchError> {
    let constant = |v: [f32; 3]| Tensor::f_from_slice(&v)?.f_reshape([1, 3, 1, 1]);
    let x = nets::tensor_of(image)?.f_mul_scalar(2.0)?.f_sub_scalar(1.0)?;
    x.f_sub(&constant([-0.030, -0.088, -0.188])?)?.f_div(&constant([0.458, 0.448, 0.450])?)
}

/// Unit length across channels.
fn normalised(x: &Tensor) -> Result<Tensor, TchError> {
    let length = x.f_square()?.f_sum_dim_intlist([1i64].as_slice(), true, Kind::Float)?.f_sqrt()?;
    x.f_div(&length.f_add_scalar(1e-10)?)
}
