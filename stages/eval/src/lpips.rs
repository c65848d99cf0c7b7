//! LPIPS v0.1 with SqueezeNet 1.1 (Zhang et al. 2018): distances of normalised features after seven stages, weighted by
//! learned heads.

use std::path::Path;

use anyhow::Context as _;
use nets::{Weights, WeightsError};
use pixels::Picture;
use tch::{Kind, Tensor, no_grad};

/// The network and its heads.
pub struct Lpips {
    first: Conv,
    fires: Vec<Fire>,
    heads: Vec<Tensor>,
}

struct Conv {
    weight: Tensor,
    bias: Tensor,
}

/// Squeeze to few channels, expand by 1×1 and 3×3 side by side.
struct Fire {
    squeeze: Conv,
    expand1: Conv,
    expand3: Conv,
}

/// (index in torchvision's `features`, inputs, squeezed, expanded each way)
const FIRES: [(usize, i64, i64, i64); 8] = [
    (3, 64, 16, 64),
    (4, 128, 16, 64),
    (6, 128, 32, 128),
    (7, 256, 32, 128),
    (9, 256, 48, 192),
    (10, 384, 48, 192),
    (11, 384, 64, 256),
    (12, 512, 64, 256),
];
/// Channels after each of the seven stages.
const STAGES: [i64; 7] = [64, 128, 256, 384, 384, 512, 512];

fn conv(weights: &Weights, name: &str, shape: [i64; 4]) -> Result<Conv, WeightsError> {
    Ok(Conv {
        weight: weights.tensor(&format!("{name}.weight"), &shape)?,
        bias: weights.tensor(&format!("{name}.bias"), &shape[..1])?,
    })
}

impl Conv {
    fn relu(&self, x: &Tensor, stride: i64, padding: i64) -> Tensor {
        x.conv2d(&self.weight, Some(&self.bias), [stride; 2], [padding; 2], [1, 1], 1).relu()
    }
}

impl Fire {
    fn forward(&self, x: &Tensor) -> Tensor {
        let squeezed = self.squeeze.relu(x, 1, 0);
        Tensor::cat(&[self.expand1.relu(&squeezed, 1, 0), self.expand3.relu(&squeezed, 1, 1)], 1)
    }
}

fn pool(x: &Tensor) -> Tensor {
    x.max_pool2d([3, 3], [2, 2], [0, 0], [1, 1], true)
}

impl Lpips {
    /// Reads `squeezenet1_1.safetensors` and `lpips_linear_squeeze_v0.1.safetensors` from a folder.
    pub fn read(folder: &Path) -> Result<Self, WeightsError> {
        nets::deterministic();
        let net = Weights::read(&folder.join("squeezenet1_1.safetensors"))?;
        let linear = Weights::read(&folder.join("lpips_linear_squeeze_v0.1.safetensors"))?;
        let fire = |&(index, inputs, squeezed, expanded): &(usize, i64, i64, i64)| {
            let name = |part: &str| format!("features.{index}.{part}");
            Ok(Fire {
                squeeze: conv(&net, &name("squeeze"), [squeezed, inputs, 1, 1])?,
                expand1: conv(&net, &name("expand1x1"), [expanded, squeezed, 1, 1])?,
                expand3: conv(&net, &name("expand3x3"), [expanded, squeezed, 3, 3])?,
            })
        };
        let head = |(k, &channels): (usize, &i64)| linear.tensor(&format!("lin{k}.model.1.weight"), &[1, channels, 1, 1]);
        Ok(Self {
            first: conv(&net, "features.0", [64, 3, 3, 3])?,
            fires: FIRES.iter().map(fire).collect::<Result<_, _>>()?,
            heads: STAGES.iter().enumerate().map(head).collect::<Result<_, _>>()?,
        })
    }

    /// Distance of two RGB pictures in [0, 1].
    pub fn distance(&self, a: &Picture, b: &Picture) -> anyhow::Result<f64> {
        // Three poolings by 2 need this much.
        anyhow::ensure!(
            a.width >= 17 && a.height >= 17,
            "LPIPS needs pictures of at least 17×17 pixels, not {}×{}",
            a.width,
            a.height
        );
        let distance = no_grad(|| {
            let (a, b) = (self.features(&input(a)), self.features(&input(b)));
            let stage = |((a, b), head): ((&Tensor, &Tensor), &Tensor)| {
                let difference = normalised(a) - normalised(b);
                (difference.square().conv2d::<Tensor>(head, None, [1, 1], [0, 0], [1, 1], 1)).mean(Kind::Float)
            };
            a.iter().zip(&b).zip(&self.heads).map(stage).reduce(|a, b| a + b)
        });
        f64::try_from(distance.context("there are seven stages")?).context("LPIPS gives one number")
    }

    fn features(&self, x: &Tensor) -> Vec<Tensor> {
        let f = &self.fires;
        let one = self.first.relu(x, 2, 0);
        let two = f[1].forward(&f[0].forward(&pool(&one)));
        let three = f[3].forward(&f[2].forward(&pool(&two)));
        let four = f[4].forward(&pool(&three));
        let five = f[5].forward(&four);
        let six = f[6].forward(&five);
        let seven = f[7].forward(&six);
        vec![one, two, three, four, five, six, seven]
    }
}

/// To [-1, 1], then by the method's own shift and scale; shape 1×3×H×W.
fn input(picture: &Picture) -> Tensor {
    let shape = [picture.height as i64, picture.width as i64, 3];
    let x = Tensor::from_slice(&picture.data).reshape(shape).permute([2, 0, 1]).unsqueeze(0) * 2.0 - 1.0;
    let constant = |v: [f32; 3]| Tensor::from_slice(&v).reshape([1, 3, 1, 1]);
    (x - constant([-0.030, -0.088, -0.188])) / constant([0.458, 0.448, 0.450])
}

/// Unit length across channels.
fn normalised(x: &Tensor) -> Tensor {
    let length = x.square().sum_dim_intlist([1i64].as_slice(), true, Kind::Float).sqrt();
    x / (length + 1e-10)
}
