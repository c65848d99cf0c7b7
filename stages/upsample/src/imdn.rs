use nets::{Conv, Weights, WeightsError};
use tch::{TchError, Tensor};

use crate::layers::{contrast, count, leaky, root};
use crate::network::Network;

/// IMDN (Hui et al. 2019, "Lightweight Image Super-Resolution with Information Multi-distillation
/// Network"), by the names of its released weights. Width and scale are what the file says.
pub(crate) struct Imdn {
    first: Conv,
    blocks: Vec<Block>,
    fuse: Conv,
    last: Conv,
    up: Conv,
    scale: i64,
}

/// Keeps a quarter of the channels after each of three layers and works on with the rest; then
/// weighs the channels by their contrast.
struct Block {
    layers: [Conv; 4],
    attention: [Conv; 2],
    fuse: Conv,
    kept: i64,
}

/// What leaks through its ReLUs.
const SLOPE: f64 = 0.05;

impl Imdn {
    pub(crate) fn read(weights: &Weights) -> Result<Self, WeightsError> {
        let prefix = if weights.has("module.fea_conv.weight") { "module." } else { "" };
        let name = |part: &str| format!("{prefix}{part}");
        let [width, ..] = weights.shape::<4>(&name("fea_conv.weight"))?;
        let blocks = count(weights, 1, |i| name(&format!("IMDB{i}.c1.weight")));
        let [outputs, ..] = weights.shape::<4>(&name("upsampler.0.weight"))?;
        let scale = root(outputs / 3);
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
        let fused = leaky(&self.fuse.forward(&Tensor::f_cat(&outputs, 1)?, 1, 0)?, SLOPE)?;
        let deep = self.last.forward(&fused, 1, 1)?.f_add(&first)?;
        self.up.forward(&deep, 1, 1)?.f_pixel_shuffle(self.scale)
    }
}

impl Block {
    fn read(weights: &Weights, name: &str, width: i64) -> Result<Self, WeightsError> {
        let kept = width / 4;
        let rest = width - kept;
        let conv = |part: &str, shape| Conv::read(weights, &format!("{name}.{part}"), shape);
        let [narrow, ..] = weights.shape::<4>(&format!("{name}.cca.conv_du.0.weight"))?;
        Ok(Self {
            layers: [
                conv("c1", [width, width, 3, 3])?,
                conv("c2", [width, rest, 3, 3])?,
                conv("c3", [width, rest, 3, 3])?,
                conv("c4", [kept, rest, 3, 3])?,
            ],
            attention: [
                conv("cca.conv_du.0", [narrow, 4 * kept, 1, 1])?,
                conv("cca.conv_du.2", [4 * kept, narrow, 1, 1])?,
            ],
            fuse: conv("c5", [width, 4 * kept, 1, 1])?,
            kept,
        })
    }

    fn forward(&self, input: &Tensor) -> Result<Tensor, TchError> {
        let [one, two, three, four] = &self.layers;
        let (mut kept, mut rest) = (Vec::with_capacity(4), input.shallow_clone());
        for layer in [one, two, three] {
            let x = leaky(&layer.forward(&rest, 1, 1)?, SLOPE)?;
            let channels = x.size()[1];
            kept.push(x.f_narrow(1, 0, self.kept)?);
            rest = x.f_narrow(1, self.kept, channels - self.kept)?;
        }
        kept.push(four.forward(&rest, 1, 1)?);
        let all = Tensor::f_cat(&kept, 1)?;
        let narrow = self.attention[0].forward(&contrast(&all)?, 1, 0)?.f_relu()?;
        let weight = self.attention[1].forward(&narrow, 1, 0)?.f_sigmoid()?;
        self.fuse.forward(&all.f_mul(&weight)?, 1, 0)?.f_add(input)
    }
}
