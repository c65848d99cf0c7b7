use nets::{Conv, Weights, WeightsError};
use tch::{TchError, Tensor};

use crate::network::{Network, contrast, count_parts, integer_root, leaky_relu};

/// IMDN (Hui et al. 2019, "Lightweight Image Super-Resolution with Information Multi-distillation
/// Network"). Layers are read under the names in the released weights; width and scale are read
/// from the file.
pub(crate) struct Imdn {
    first: Conv,
    blocks: Vec<Block>,
    fuse: Conv,
    last: Conv,
    up: Conv,
    scale: i64,
}

/// Information multi-distillation block: each of the first three layers distils a quarter of its
/// channels and passes the rest on; the fourth layer's output is the last quarter. Then channel
/// attention weights all channels by their contrast.
struct Block {
    layers: [Conv; 4],
    attention: [Conv; 2],
    fuse: Conv,
    /// Number of channels that each of the first three layers distils.
    distilled: i64,
}

/// Negative slope of the leaky ReLUs.
const SLOPE: f64 = 0.05;

impl Imdn {
    /// Reads the network.
    pub(crate) fn read(weights: &Weights) -> Result<Self, WeightsError> {
        let prefix = if weights.has("module.fea_conv.weight") { "module." } else { "" };
        let name = |part: &str| format!("{prefix}{part}");
        let [width, ..] = weights.shape::<4>(&name("fea_conv.weight"))?;
        let blocks = count_parts(weights, 1, |i| name(&format!("IMDB{i}.c1.weight")));
        let [outputs, ..] = weights.shape::<4>(&name("upsampler.0.weight"))?;
        let scale = integer_root(outputs / 3);
        Ok(Self {
            first: Conv::read(weights, &name("fea_conv"), [width, 3, 3, 3])?,
            blocks: (1..=blocks)
                .map(|i| Block::read(weights, &name(&format!("IMDB{i}")), width))
                .collect::<Result<_, _>>()?,
            fuse: Conv::read(weights, &name("c.0"), [width, width * blocks as i64, 1, 1])?,
            last: Conv::read(weights, &name("LR_conv"), [width, width, 3, 3])?,
            up: Conv::read(weights, &name("upsampler.0"), [3 * scale * scale, width, 3, 3])?,
            scale,
        })
    }
}

impl Network for Imdn {
    fn scale(&self) -> Option<i64> {
        Some(self.scale)
    }

    fn enlarge(&self, image: &Tensor, _: [i64; 2]) -> Result<Tensor, TchError> {
        let first = self.first.forward(image, 1, 1)?;
        let mut outputs = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let x = block.forward(outputs.last().unwrap_or(&first))?;
            outputs.push(x);
        }
        let fused = leaky_relu(&self.fuse.forward(&Tensor::f_cat(&outputs, 1)?, 1, 0)?, SLOPE)?;
        let deep = self.last.forward(&fused, 1, 1)?.f_add(&first)?;
        self.up.forward(&deep, 1, 1)?.f_pixel_shuffle(self.scale)
    }
}

impl Block {
    fn read(weights: &Weights, name: &str, width: i64) -> Result<Self, WeightsError> {
        let distilled = width / 4;
        let rest = width - distilled;
        let conv = |part: &str, shape| Conv::read(weights, &format!("{name}.{part}"), shape);
        let [narrow, ..] = weights.shape::<4>(&format!("{name}.cca.conv_du.0.weight"))?;
        Ok(Self {
            layers: [
                conv("c1", [width, width, 3, 3])?,
                conv("c2", [width, rest, 3, 3])?,
                conv("c3", [width, rest, 3, 3])?,
                conv("c4", [distilled, rest, 3, 3])?,
            ],
            attention: [
                conv("cca.conv_du.0", [narrow, 4 * distilled, 1, 1])?,
                conv("cca.conv_du.2", [4 * distilled, narrow, 1, 1])?,
            ],
            fuse: conv("c5", [width, 4 * distilled, 1, 1])?,
            distilled,
        })
    }

    fn forward(&self, input: &Tensor) -> Result<Tensor, TchError> {
        let [layers @ .., last] = &self.layers;
        let mut distilled = Vec::with_capacity(4);
        let mut rest = input.shallow_clone();
        for layer in layers {
            let x = leaky_relu(&layer.forward(&rest, 1, 1)?, SLOPE)?;
            let channels = x.size()[1];
            distilled.push(x.f_narrow(1, 0, self.distilled)?);
            rest = x.f_narrow(1, self.distilled, channels - self.distilled)?;
        }
        distilled.push(last.forward(&rest, 1, 1)?);
        let all = Tensor::f_cat(&distilled, 1)?;
        let narrow = self.attention[0].forward(&contrast(&all)?, 1, 0)?.f_relu()?;
        let weight = self.attention[1].forward(&narrow, 1, 0)?.f_sigmoid()?;
        self.fuse.forward(&all.f_mul(&weight)?, 1, 0)?.f_add(input)
    }
}
