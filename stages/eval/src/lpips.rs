//! LPIPS v0.1 with SqueezeNet 1.1 (Zhang et al. 2018): distances of normalised features after seven stages, weighted by
//! learned heads.

use std::path::Path;

use anyhow::Context as _;
use nets::{Conv, Weights, WeightsError};
use pixels::Picture;
use tch::{Kind, TchError, Tensor, no_grad};

/// The network and its heads.
pub struct Lpips {
    first: Conv,
    fires: Vec<Fire>,
    heads: Vec<Tensor>,
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

fn relu(conv: &Conv, x: &Tensor, stride: i64, padding: i64) -> Result<Tensor, TchError> {
    conv.forward(x, stride, padding)?.f_relu()
}

impl Fire {
    fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let squeezed = relu(&self.squeeze, x, 1, 0)?;
        Tensor::f_cat(&[relu(&self.expand1, &squeezed, 1, 0)?, relu(&self.expand3, &squeezed, 1, 1)?], 1)
    }
}

fn pool(x: &Tensor) -> Result<Tensor, TchError> {
    x.f_max_pool2d([3, 3], [2, 2], [0, 0], [1, 1], true)
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
                squeeze: Conv::read(&net, &name("squeeze"), [squeezed, inputs, 1, 1])?,
                expand1: Conv::read(&net, &name("expand1x1"), [expanded, squeezed, 1, 1])?,
                expand3: Conv::read(&net, &name("expand3x3"), [expanded, squeezed, 3, 3])?,
            })
        };
        let head = |(k, &channels): (usize, &i64)| linear.tensor(&format!("lin{k}.model.1.weight"), &[1, channels, 1, 1]);
        Ok(Self {
            first: Conv::read(&net, "features.0", [64, 3, 3, 3])?,
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
        let distance = no_grad(|| -> Result<f64, TchError> {
            let (a, b) = (self.features(&input(a)?)?, self.features(&input(b)?)?);
            let mut sum = 0.0;
            for ((a, b), head) in a.iter().zip(&b).zip(&self.heads) {
                let difference = normalised(a)?.f_sub(&normalised(b)?)?.f_square()?;
                let weighted = difference.f_conv2d::<Tensor>(head, None, [1, 1], [0, 0], [1, 1], 1)?;
                sum += weighted.f_mean(Kind::Float)?.f_double_value(&[])?;
            }
            Ok(sum)
        });
        distance.context("LPIPS")
    }

    fn features(&self, x: &Tensor) -> Result<[Tensor; 7], TchError> {
        let f = &self.fires;
        let one = relu(&self.first, x, 2, 0)?;
        let two = f[1].forward(&f[0].forward(&pool(&one)?)?)?;
        let three = f[3].forward(&f[2].forward(&pool(&two)?)?)?;
        let four = f[4].forward(&pool(&three)?)?;
        let five = f[5].forward(&four)?;
        let six = f[6].forward(&five)?;
        let seven = f[7].forward(&six)?;
        Ok([one, two, three, four, five, six, seven])
    }
}

/// To [-1, 1], then by the method's own shift and scale; shape 1×3×H×W.
fn input(picture: &Picture) -> Result<Tensor, TchError> {
    let constant = |v: [f32; 3]| Tensor::f_from_slice(&v)?.f_reshape([1, 3, 1, 1]);
    let x = nets::tensor_of(picture)?.f_mul_scalar(2.0)?.f_sub_scalar(1.0)?;
    x.f_sub(&constant([-0.030, -0.088, -0.188])?)?.f_div(&constant([0.458, 0.448, 0.450])?)
}

/// Unit length across channels.
fn normalised(x: &Tensor) -> Result<Tensor, TchError> {
    let length = x.f_square()?.f_sum_dim_intlist([1i64].as_slice(), true, Kind::Float)?.f_sqrt()?;
    x.f_div(&length.f_add_scalar(1e-10)?)
}
