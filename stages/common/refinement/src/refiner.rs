use std::path::Path;

use counter_rng::CounterRng;
use pixels::Image;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tch::{TchError, Tensor, no_grad};

use crate::channels::{INPUTS, OUTPUTS, REFERENCE_INPUTS};
use crate::error::RefinementError;
use crate::folded::{FOLD, Square, Turn, samples};
use crate::guidance::Guidance;

/// Size of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RefinerArchitecture {
    /// Features of the hidden layers.
    pub channels: u32,
    /// Residual blocks of two layers each.
    pub blocks: u32,
    /// How it sees what references know; without it they aren't looked at.
    pub guidance: Option<Guidance>,
}

impl RefinerArchitecture {
    /// Channels of what it takes.
    pub(crate) fn inputs(self) -> usize {
        if self.guidance.is_some() { REFERENCE_INPUTS } else { INPUTS }
    }
}

/// Which network a refiner is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Network {
    /// Ours: [`Refiner`].
    Compact(RefinerArchitecture),
    /// The paper's (crate `paper-refiner`).
    Paper {
        /// Features of its first layer; 128 are published.
        width: u32,
        /// Reference patches that each patch gets; 8 are published.
        patches: u32,
    },
}

/// Name of the file that describes a refiner.
pub const REFINER_FILE: &str = "refiner.json";
/// Name of the file with its weights: safetensors; ours has kernels as outputs × rows × columns ×
/// inputs.
pub const WEIGHTS_FILE: &str = "refiner.safetensors";

/// `refiner.json`: what a folder with a refiner says of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RefinerFile {
    /// The network.
    pub network: Network,
    /// Share of what it predicts that is added: what was best for the views that training left out,
    /// from 0 to 1.
    pub strength: f64,
    /// Mean PSNR of those views as they were rendered, in dB.
    pub rendered_psnr: f64,
    /// Mean PSNR of those views refined, in dB.
    pub refined_psnr: f64,
    /// Confidence in references, as a share of what they saw of those views, where the network
    /// knows references.
    #[serde(default)]
    pub trusted: Option<f64>,
    /// Whether the network takes views that are consistent with LR photographs of their own.
    #[serde(default)]
    pub agreeing: bool,
}

/// A network of 3×3 convolutions on folds of 2×2 pixels: one in, `blocks` residual blocks of two
/// (Lim et al. 2017), one out. It pads nothing: borders are gone on with before it, and what it
/// predicts depends on nothing but what it sees.
#[derive(Debug)]
pub struct Refiner {
    architecture: RefinerArchitecture,
    /// Kernel and bias of each layer.
    parameters: Vec<Tensor>,
}

/// Pixels along a tile's side: with what a network sees around it small enough for the cache, large
/// enough that little is seen twice.
const TILE_SIDE: usize = 128;
/// Most channels of a network that is read.
const MOST_CHANNELS: u32 = 4096;
/// Most blocks of a network that is read.
const MOST_BLOCKS: u32 = 4096;
/// Purpose of draws.
const WEIGHTS: u64 = 300;

impl Refiner {
    /// A network that hasn't learnt anything: it adds nothing.
    pub fn new(architecture: RefinerArchitecture, seed: u64) -> Result<Self, RefinementError> {
        let mut rng = CounterRng::new(seed, WEIGHTS, 0);
        let layers = layers(architecture);
        let mut parameters = Vec::with_capacity(2 * layers.len());
        for (i, (_, inputs, outputs)) in layers.iter().enumerate() {
            // As PyTorch draws them: blocks that begin by adding little. The last layer, and with
            // it the prediction, starts at 0.
            let reach =
                if i + 1 == layers.len() { 0.0 } else { (1.0 / (9 * inputs) as f64).sqrt() };
            let kernel: Vec<f32> = (0..outputs * 9 * inputs)
                .map(|_| (reach * (2.0 * f64::from(rng.uniform()) - 1.0)) as f32)
                .collect();
            parameters.push(
                Tensor::f_from_slice(&kernel)?
                    .f_reshape(kernel_shape(*inputs, *outputs))?
                    .set_requires_grad(true),
            );
            parameters.push(Tensor::f_from_slice(&vec![0.0f32; *outputs])?.set_requires_grad(true));
        }
        Ok(Self { architecture, parameters })
    }

    /// Reads weights that [`Refiner::write`] wrote.
    pub fn read(path: &Path, architecture: RefinerArchitecture) -> Result<Self, RefinementError> {
        let RefinerArchitecture { channels, blocks, .. } = architecture;
        // Before anything is made of such numbers.
        if !(1..=MOST_CHANNELS).contains(&channels) || blocks > MOST_BLOCKS {
            return Err(RefinementError::Architecture { channels, blocks });
        }
        let weights = nets::Weights::read(path)?;
        let tensors =
            shapes(architecture).into_iter().map(|(name, shape)| weights.tensor(&name, &shape));
        Ok(Self { architecture, parameters: tensors.collect::<Result<_, _>>()? })
    }

    /// Writes the weights.
    pub fn write(&self, path: &Path) -> Result<(), RefinementError> {
        Ok(nets::write(path, &self.named())?)
    }

    /// The network's size.
    pub fn architecture(&self) -> RefinerArchitecture {
        self.architecture
    }

    /// The parameters by name.
    pub(crate) fn named(&self) -> Vec<(String, Tensor)> {
        shapes(self.architecture).into_iter().map(|(name, _)| name).zip(self.parameters()).collect()
    }

    /// The parameters.
    pub(crate) fn parameters(&self) -> impl Iterator<Item = Tensor> {
        self.parameters.iter().map(Tensor::shallow_clone)
    }

    /// Another handle on the same parameters, for another thread.
    pub(crate) fn share(&self) -> Self {
        Self { architecture: self.architecture, parameters: self.parameters().collect() }
    }

    /// Folds that it sees on each side of one.
    pub(crate) fn reach(&self) -> usize {
        2 * self.architecture.blocks as usize + 2
    }

    /// What to add to the colours of squares, from the squares grown by [`Refiner::reach`].
    pub(crate) fn forward(&self, input: &Tensor) -> Result<Tensor, TchError> {
        let mut x = self.layer(input, 0)?;
        for block in 0..self.architecture.blocks as usize {
            let inner = self.layer(&x, 1 + 2 * block)?.f_relu()?;
            let [_, _, height, width] = x.size()[..] else {
                unreachable!("a convolution's output has four dimensions")
            };
            let middle = x.f_narrow(2, 2, height - 4)?.f_narrow(3, 2, width - 4)?;
            x = middle.f_add(&self.layer(&inner, 2 + 2 * block)?)?;
        }
        self.layer(&x, 1 + 2 * self.architecture.blocks as usize)
    }

    fn layer(&self, x: &Tensor, i: usize) -> Result<Tensor, TchError> {
        let kernel = self.parameters[2 * i].f_permute([0, 3, 1, 2])?;
        x.f_conv2d(&kernel, Some(&self.parameters[2 * i + 1]), 1, 0, 1, 1)
    }

    /// The view with `strength` times what the network adds; a reference-based network takes it
    /// from [`with_references`](crate::with_references). An image of three channels in 0..1. The
    /// network is asked `turns` times, 1 to 8, each time with the view turned or mirrored another
    /// way, and the mean of its answers is added (Timofte et al. 2016).
    pub fn refine_by(
        &self,
        view: &Image,
        strength: f32,
        turns: u32,
    ) -> Result<Image, RefinementError> {
        let inputs = self.architecture.inputs();
        if view.channels != inputs {
            return Err(RefinementError::Channels { channels: view.channels, expected: inputs });
        }
        let turns = &Turn::ALL[..(turns as usize).clamp(1, Turn::ALL.len())];
        let (width, height) = (view.width, view.height);
        let tiles: Vec<(usize, usize, Self)> = (0..height)
            .step_by(TILE_SIDE)
            .flat_map(|y| (0..width).step_by(TILE_SIDE).map(move |x| (x, y)))
            .map(|(x, y)| (x, y, self.share()))
            .collect();
        let refined: Vec<(Square, Vec<f32>)> = tiles
            .into_par_iter()
            .map(|(x, y, refiner)| -> Result<_, TchError> {
                let side =
                    |from: usize, size: usize| (size - from).min(TILE_SIDE).next_multiple_of(FOLD);
                let square = Square {
                    x: x as isize,
                    y: y as isize,
                    size: (side(x, width), side(y, height)),
                };
                Ok((square, refiner.added(view, square, turns)?))
            })
            .collect::<Result<_, _>>()?;
        let mut data = vec![0.0; width * height * OUTPUTS];
        for (square, added) in &refined {
            for (i, added) in added.chunks_exact(OUTPUTS).enumerate() {
                let (column, row) =
                    (square.x as usize + i % square.size.0, square.y as usize + i / square.size.0);
                if column < width && row < height {
                    let at = row * width + column;
                    for c in 0..OUTPUTS {
                        data[at * OUTPUTS + c] =
                            (view.data[at * inputs + c] + strength * added[c]).clamp(0.0, 1.0);
                    }
                }
            }
        }
        Ok(Image::new(width, height, OUTPUTS, data))
    }

    /// What the network adds to a square of a view, the mean over turns: row by row, channels
    /// interleaved.
    fn added(&self, view: &Image, square: Square, turns: &[Turn]) -> Result<Vec<f32>, TchError> {
        let around = square.grown(self.reach());
        let inputs = self.architecture.inputs();
        let mut sum = vec![0.0; square.size.0 * square.size.1 * OUTPUTS];
        let mut input = Vec::with_capacity(around.size.0 * around.size.1 * inputs);
        for turn in turns {
            input.clear();
            let turned = turn.of(around);
            turned.fold(|x, y| {
                let (x, y) = turn.source(around, x, y);
                input.extend_from_slice(around.of(view, x, y));
            });
            let added = samples(&no_grad(|| self.forward(&turned.tensor(&input, inputs)?))?)?;
            turn.of(square).unfold(&added, OUTPUTS, |x, y, added| {
                let (x, y) = turn.source(square, x, y);
                let at = (y * square.size.0 + x) * OUTPUTS;
                sum[at..at + OUTPUTS].iter_mut().zip(added).for_each(|(sum, a)| *sum += a);
            });
        }
        sum.iter_mut().for_each(|sum| *sum /= turns.len() as f32);
        Ok(sum)
    }

    /// The view with all that the network adds to it as it is.
    pub fn refine(&self, view: &Image) -> Result<Image, RefinementError> {
        self.refine_by(view, 1.0, 1)
    }
}

/// Name, inputs and outputs of each layer.
fn layers(architecture: RefinerArchitecture) -> Vec<(String, usize, usize)> {
    let width = architecture.channels as usize;
    let blocks = (0..architecture.blocks).flat_map(|i| {
        [(format!("block_{i}.first"), width, width), (format!("block_{i}.second"), width, width)]
    });
    let first = ("first".to_owned(), architecture.inputs() * FOLD * FOLD, width);
    let last = ("last".to_owned(), width, OUTPUTS * FOLD * FOLD);
    std::iter::once(first).chain(blocks).chain([last]).collect()
}

fn kernel_shape(inputs: usize, outputs: usize) -> [i64; 4] {
    [outputs as i64, 3, 3, inputs as i64]
}

/// Names and shapes of the parameters.
fn shapes(architecture: RefinerArchitecture) -> Vec<(String, Vec<i64>)> {
    let shapes = layers(architecture).into_iter().flat_map(|(name, inputs, outputs)| {
        [
            (format!("{name}.kernel"), kernel_shape(inputs, outputs).to_vec()),
            (format!("{name}.bias"), vec![outputs as i64]),
        ]
    });
    shapes.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: usize, height: usize) -> Image {
        let mut rng = CounterRng::new(1, 2, 3);
        Image::new(
            width,
            height,
            INPUTS,
            (0..width * height * INPUTS).map(|_| rng.uniform()).collect(),
        )
    }

    /// A network whose every weight says something.
    fn random(architecture: RefinerArchitecture) -> Refiner {
        let mut refiner = Refiner::new(architecture, 5).unwrap();
        let mut rng = CounterRng::new(5, 6, 7);
        for parameter in &mut refiner.parameters {
            let values: Vec<f32> =
                (0..parameter.numel()).map(|_| 0.2 * (rng.uniform() - 0.5)).collect();
            *parameter = Tensor::from_slice(&values).reshape(parameter.size());
        }
        refiner
    }

    /// Tiles meet exactly: a view of several is what one convolution of the whole gives.
    #[test]
    fn tiles_leave_no_seams() {
        nets::deterministic();
        let architecture = RefinerArchitecture { channels: 6, blocks: 2, guidance: None };
        let refiner = random(architecture);
        for (width, height) in [(131, 257), (128, 128), (3, 1), (260, 5)] {
            let view = image(width, height);
            let square = Square {
                x: 0,
                y: 0,
                size: (width.next_multiple_of(FOLD), height.next_multiple_of(FOLD)),
            };
            let around = square.grown(refiner.reach());
            let mut input = Vec::new();
            around.fold(|x, y| input.extend_from_slice(around.of(&view, x, y)));
            let added = samples(
                &no_grad(|| refiner.forward(&around.tensor(&input, INPUTS).unwrap())).unwrap(),
            )
            .unwrap();
            let refined = refiner.refine(&view).unwrap();
            square.unfold(&added, OUTPUTS, |x, y, added| {
                if x < width && y < height {
                    for c in 0..OUTPUTS {
                        let whole =
                            (view.data[(y * width + x) * INPUTS + c] + added[c]).clamp(0.0, 1.0);
                        let tiled = refined.data[(y * width + x) * OUTPUTS + c];
                        assert!(
                            (whole - tiled).abs() < 1e-5,
                            "{width}×{height} at {x}, {y}: {tiled} where {whole} is right"
                        );
                    }
                }
            });
        }
    }

    fn added_to(refiner: &Refiner, view: &Image) -> Vec<f32> {
        refiner.added(view, Square { x: 4, y: 4, size: (8, 8) }, &Turn::ALL[..1]).unwrap()
    }

    /// Internal learning from little pushes features below 0 everywhere. What the network adds must
    /// still follow what it sees, or it would never learn again.
    #[test]
    fn a_network_does_not_fall_silent() {
        nets::deterministic();
        let mut refiner = random(RefinerArchitecture { channels: 6, blocks: 1, guidance: None });
        refiner.parameters[1] = Tensor::from_slice(&[-10f32; 6]);
        let (dark, view) = (Image::new(16, 16, INPUTS, vec![0.0; 16 * 16 * INPUTS]), image(16, 16));
        let apart = added_to(&refiner, &dark)
            .iter()
            .zip(added_to(&refiner, &view))
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(apart > 0.01, "{apart}");
    }

    fn mirrored(p: &Image) -> Image {
        let data = p
            .data
            .chunks_exact(p.width * p.channels)
            .flat_map(|row| row.chunks_exact(p.channels).rev().flatten().copied());
        Image::new(p.width, p.height, p.channels, data.collect())
    }

    fn apart_by(refiner: &Refiner, view: &Image, turns: u32) -> f32 {
        let straight = mirrored(&refiner.refine_by(view, 1.0, turns).unwrap());
        let turned = refiner.refine_by(&mirrored(view), 1.0, turns).unwrap();
        straight.data.iter().zip(&turned.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    /// Asked in all eight ways, a network treats a turned view as it treats the view itself.
    #[test]
    fn all_turns_together_prefer_no_direction() {
        nets::deterministic();
        let refiner = random(RefinerArchitecture { channels: 6, blocks: 1, guidance: None });
        let view = image(150, 10);
        assert!(apart_by(&refiner, &view, 8) < 1e-5, "{}", apart_by(&refiner, &view, 8));
        assert!(apart_by(&refiner, &view, 1) > 0.01, "{}", apart_by(&refiner, &view, 1));
    }

    #[test]
    fn what_is_written_is_read_and_other_networks_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(WEIGHTS_FILE);
        let architecture =
            RefinerArchitecture { channels: 6, blocks: 1, guidance: Some(Guidance::default()) };
        let refiner = random(architecture);
        refiner.write(&path).unwrap();
        let again = Refiner::read(&path, architecture).unwrap();
        assert!(
            refiner.named().iter().zip(again.named()).all(|((a, s), (b, t))| *a == b && *s == t)
        );
        for other in [
            RefinerArchitecture { channels: 7, ..architecture },
            RefinerArchitecture { blocks: 2, ..architecture },
        ] {
            assert!(Refiner::read(&path, other).is_err());
        }
        for other in [
            RefinerArchitecture { channels: 0, ..architecture },
            RefinerArchitecture { blocks: u32::MAX, ..architecture },
        ] {
            assert!(
                Refiner::read(&path, other).unwrap_err().to_string().contains("not one of ours")
            );
        }
        assert!(matches!(
            again.refine(&image(8, 8)),
            Err(RefinementError::Channels { channels: 4, expected: REFERENCE_INPUTS })
        ));
        let bytes = std::fs::read(&path).unwrap();
        for end in [0, 7, 100, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..end]).unwrap();
            assert!(Refiner::read(&path, architecture).is_err());
        }
    }
}
