use std::path::Path;

use numerics::CounterRng;
use pixels::Image;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tch::{TchError, Tensor};

use crate::convolution::Convolution;
use crate::error::RefinementError;
use crate::folded::{FOLD, Orientation, Window};
use crate::network::Pass;
use crate::view::{INPUTS, OUTPUTS, REFERENCE_INPUTS};
use crate::warped_reference::WarpOptions;

/// Size and inputs of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RefinerArchitecture {
    /// Number of features of the hidden layers.
    pub channels: u32,
    /// Number of residual blocks of two layers each.
    pub blocks: u32,
    /// Warping of references; `None` if the network takes no references.
    pub guidance: Option<WarpOptions>,
}

impl RefinerArchitecture {
    /// Returns the number of input channels.
    pub(crate) fn input_channels(self) -> usize {
        if self.guidance.is_some() { REFERENCE_INPUTS } else { INPUTS }
    }

    /// Returns the radius of the receptive field in folds.
    pub(crate) fn receptive_radius(self) -> usize {
        2 * self.blocks as usize + 2
    }
}

/// Kind of a refiner's network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Network {
    /// This project's network: [`Refiner`].
    Compact(RefinerArchitecture),
    /// The paper's network (`refinement::paper`).
    Paper {
        /// Number of features of the first layer; 128 as published.
        width: u32,
        /// Number of reference patches per patch; 8 as published.
        patches: u32,
    },
}

/// Name of the file that describes a refiner.
pub const REFINER_FILE: &str = "refiner.json";
/// Name of a refiner's weights file: safetensors. Kernels of [`Refiner`] are outputs × rows ×
/// columns × inputs.
pub const WEIGHTS_FILE: &str = "refiner.safetensors";

/// Content of `refiner.json`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RefinerFile {
    /// Kind and size of the network.
    pub network: Network,
    /// Fraction of the predicted residual that is added, from 0 to 1: the best one for the
    /// validation views.
    pub residual_weight: f64,
    /// Mean PSNR of the rendered validation views, in dB.
    pub rendered_psnr: f64,
    /// Mean PSNR of the refined validation views, in dB.
    pub refined_psnr: f64,
    /// Ratio of the summed confidence to the summed visibility of references in the validation
    /// views: 1 if references agree with renders. Absent if the network takes no references.
    #[serde(default)]
    pub confidence: Option<f64>,
    /// True if the network's input views are made consistent with their own LR photographs.
    #[serde(default)]
    pub data_consistent: bool,
}

/// Network of 3×3 convolutions on folds of 2×2 pixels: one input layer, `blocks` residual blocks of
/// two layers (Lim et al. 2017), one output layer. The layers don't pad; image borders are extended
/// before the first layer, so predictions don't depend on tile borders (design note 015).
#[derive(Debug)]
pub struct Refiner {
    architecture: RefinerArchitecture,
    /// Kernel (outputs × rows × columns × inputs) and bias of each layer.
    pub(crate) parameters: Vec<Vec<f32>>,
}

/// Side of a tile in pixels. A tile with its receptive field fits in the cache, and little of the
/// work is repeated in overlaps (design note 015).
const TILE_SIDE: usize = 128;
/// Maximum number of channels of a network that is read from a file; chosen by hand.
const MAX_CHANNELS: u32 = 4096;
/// Maximum number of blocks of a network that is read from a file; chosen by hand.
const MAX_BLOCKS: u32 = 4096;
/// Stream of random numbers for the initial weights.
const WEIGHTS_STREAM: u64 = 300;

impl Refiner {
    /// Creates an untrained network, whose residual is 0.
    pub fn new(architecture: RefinerArchitecture, seed: u64) -> Self {
        let mut rng = CounterRng::new(seed, WEIGHTS_STREAM, 0);
        let layers = layer_sizes(architecture);
        let mut parameters = Vec::with_capacity(2 * layers.len());
        for (i, (_, inputs, outputs)) in layers.iter().enumerate() {
            // PyTorch's initialisation, so that blocks start with small residuals. The last layer
            // starts at 0.
            let range =
                if i + 1 == layers.len() { 0.0 } else { (1.0 / (9 * inputs) as f64).sqrt() };
            let kernel = (0..outputs * 9 * inputs)
                .map(|_| (range * (2.0 * f64::from(rng.uniform()) - 1.0)) as f32);
            parameters.push(kernel.collect());
            parameters.push(vec![0.0; *outputs]);
        }
        Self { architecture, parameters }
    }

    /// Reads weights that [`Refiner::write`] wrote.
    pub fn read(path: &Path, architecture: RefinerArchitecture) -> Result<Self, RefinementError> {
        let RefinerArchitecture { channels, blocks, .. } = architecture;
        // Checked before anything of this size is allocated.
        if !(1..=MAX_CHANNELS).contains(&channels) || blocks > MAX_BLOCKS {
            let problem = format!("unsupported network: {channels} channels, {blocks} blocks");
            return Err(RefinementError::Unusable(problem));
        }
        Self::from_weights(&nets::Weights::read(path)?, architecture)
    }

    /// Takes the weights of a network of this architecture.
    pub(crate) fn from_weights(
        weights: &nets::Weights,
        architecture: RefinerArchitecture,
    ) -> Result<Self, RefinementError> {
        let mut parameters = Vec::new();
        for (name, shape) in parameter_shapes(architecture) {
            parameters.push(Vec::<f32>::try_from(weights.tensor(&name, &shape)?.f_view([-1])?)?);
        }
        Ok(Self { architecture, parameters })
    }

    /// Writes the weights.
    pub fn write(&self, path: &Path) -> Result<(), RefinementError> {
        Ok(nets::write(path, &self.named_parameters()?)?)
    }

    /// Returns the network's size and inputs.
    pub fn architecture(&self) -> RefinerArchitecture {
        self.architecture
    }

    /// Returns the parameters as tensors with their names.
    pub(crate) fn named_parameters(&self) -> Result<Vec<(String, Tensor)>, TchError> {
        let parameters = parameter_shapes(self.architecture).into_iter().zip(&self.parameters);
        parameters
            .map(|((name, shape), parameter)| {
                Ok((name, Tensor::f_from_slice(parameter)?.f_reshape(shape)?))
            })
            .collect()
    }

    /// Returns the layers, transformed for convolution.
    pub(crate) fn layers(&self) -> Vec<Convolution> {
        let layers = self.parameters.par_chunks_exact(2);
        layers.map(|layer| Convolution::new(&layer[0], &layer[1])).collect()
    }

    /// Adds `residual_weight` times the network's residual to a view, and clamps colours to 0..1. A
    /// reference-based network takes a view from [`with_references`](crate::with_references). The
    /// residual is the mean over the view's first `orientations` orientations, 1 to 8 (geometric
    /// self-ensemble, Timofte et al. 2016).
    pub fn refine_weighted(
        &self,
        view: &Image,
        residual_weight: f32,
        orientations: u32,
    ) -> Result<Image, RefinementError> {
        let architecture = self.architecture;
        let inputs = architecture.input_channels();
        if view.channels != inputs {
            let found = view.channels;
            let problem = format!("expected a view of {inputs} channels, found {found}");
            return Err(RefinementError::Unusable(problem));
        }
        let count = (orientations as usize).clamp(1, Orientation::ALL.len());
        let orientations = &Orientation::ALL[..count];
        let (width, height) = (view.width, view.height);
        let tiles: Vec<(usize, usize)> = (0..height)
            .step_by(TILE_SIDE)
            .flat_map(|y| (0..width).step_by(TILE_SIDE).map(move |x| (x, y)))
            .collect();
        let layers = self.layers();
        let residuals: Vec<(Window, Vec<f32>)> = tiles
            .into_par_iter()
            .map_init(Pass::default, |pass, (x, y)| {
                let size = [width - x, height - y]
                    .map(|remaining| remaining.min(TILE_SIDE).next_multiple_of(FOLD));
                let window = Window { x: x as isize, y: y as isize, size: size.into() };
                (window, predict_residual(architecture, &layers, pass, view, window, orientations))
            })
            .collect();
        let mut data = vec![0.0; width * height * OUTPUTS];
        for (window, residual) in &residuals {
            for (i, pixel_residual) in residual.chunks_exact(OUTPUTS).enumerate() {
                let column = window.x as usize + i % window.size.0;
                let row = window.y as usize + i / window.size.0;
                if column < width && row < height {
                    let index = row * width + column;
                    for c in 0..OUTPUTS {
                        let colour =
                            view.data[index * inputs + c] + residual_weight * pixel_residual[c];
                        data[index * OUTPUTS + c] = colour.clamp(0.0, 1.0);
                    }
                }
            }
        }
        Ok(Image::new(width, height, OUTPUTS, data))
    }

    /// Adds the network's full residual to a view, without self-ensemble.
    pub fn refine(&self, view: &Image) -> Result<Image, RefinementError> {
        self.refine_weighted(view, 1.0, 1)
    }
}

/// Predicts the residual in a window of a view, the mean over orientations: row by row,
/// channels interleaved. Without references, the residual is 0 if the view is transparent in the
/// window and its receptive field.
fn predict_residual(
    architecture: RefinerArchitecture,
    layers: &[Convolution],
    pass: &mut Pass,
    view: &Image,
    window: Window,
    orientations: &[Orientation],
) -> Vec<f32> {
    let around = window.grown(architecture.receptive_radius());
    let inputs = architecture.input_channels();
    let mut sum = vec![0.0; window.size.0 * window.size.1 * OUTPUTS];
    if inputs == INPUTS && around.is_transparent(view) {
        return sum;
    }
    let mut residual = Vec::new();
    let mut input = Vec::with_capacity(around.size.0 * around.size.1 * inputs);
    for orientation in orientations {
        input.clear();
        let oriented = orientation.oriented(around);
        oriented.fold(|x, y| {
            let (x, y) = orientation.source(around, x, y);
            input.extend_from_slice(around.pixel(view, x, y));
        });
        let output = pass.forward(layers, oriented.folds(), &input);
        output.copy_samples(OUTPUTS * FOLD * FOLD, &mut residual);
        orientation.oriented(window).unfold(&residual, OUTPUTS, |x, y, residual| {
            let (x, y) = orientation.source(window, x, y);
            let start = (y * window.size.0 + x) * OUTPUTS;
            for c in 0..OUTPUTS {
                sum[start + c] += residual[c];
            }
        });
    }
    for value in &mut sum {
        *value /= orientations.len() as f32;
    }
    sum
}

/// Returns name, inputs and outputs of each layer.
pub(crate) fn layer_sizes(architecture: RefinerArchitecture) -> Vec<(String, usize, usize)> {
    let width = architecture.channels as usize;
    let blocks = (0..architecture.blocks).flat_map(|i| {
        [(format!("block_{i}.first"), width, width), (format!("block_{i}.second"), width, width)]
    });
    let first = ("first".to_owned(), architecture.input_channels() * FOLD * FOLD, width);
    let last = ("last".to_owned(), width, OUTPUTS * FOLD * FOLD);
    std::iter::once(first).chain(blocks).chain([last]).collect()
}

/// Returns names and shapes of the parameters.
fn parameter_shapes(architecture: RefinerArchitecture) -> Vec<(String, Vec<i64>)> {
    let shapes = layer_sizes(architecture).into_iter().flat_map(|(name, inputs, outputs)| {
        [
            (format!("{name}.kernel"), vec![outputs as i64, 3, 3, inputs as i64]),
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

    /// Returns a refiner with random weights, none of which is 0.
    fn random_refiner(architecture: RefinerArchitecture) -> Refiner {
        let mut refiner = Refiner::new(architecture, 5);
        let mut rng = CounterRng::new(5, 6, 7);
        for parameter in &mut refiner.parameters {
            parameter.fill_with(|| 0.2 * (rng.uniform() - 0.5));
        }
        refiner
    }

    /// Tiles join without seams: a view of several tiles equals one convolution of the view.
    #[test]
    fn tiles_leave_no_seams() {
        nets::deterministic();
        let architecture = RefinerArchitecture { channels: 6, blocks: 2, guidance: None };
        let refiner = random_refiner(architecture);
        for (width, height) in [(131, 257), (128, 128), (3, 1), (260, 5)] {
            let view = image(width, height);
            let window = Window {
                x: 0,
                y: 0,
                size: (width.next_multiple_of(FOLD), height.next_multiple_of(FOLD)),
            };
            let around = window.grown(refiner.architecture.receptive_radius());
            let mut input = Vec::new();
            around.fold(|x, y| input.extend_from_slice(around.pixel(&view, x, y)));
            let mut pass = Pass::default();
            let output = pass.forward(&refiner.layers(), around.folds(), &input);
            let mut residual = Vec::new();
            output.copy_samples(OUTPUTS * FOLD * FOLD, &mut residual);
            let refined = refiner.refine(&view).unwrap();
            window.unfold(&residual, OUTPUTS, |x, y, residual| {
                if x < width && y < height {
                    for c in 0..OUTPUTS {
                        let expected =
                            (view.data[(y * width + x) * INPUTS + c] + residual[c]).clamp(0.0, 1.0);
                        let tiled = refined.data[(y * width + x) * OUTPUTS + c];
                        assert!(
                            (expected - tiled).abs() < 1e-5,
                            "{width}×{height} at {x}, {y}: {tiled}, expected {expected}"
                        );
                    }
                }
            });
        }
    }

    /// Returns the residual of a window of 8×8 pixels.
    fn window_residual(refiner: &Refiner, view: &Image) -> Vec<f32> {
        let window = Window { x: 4, y: 4, size: (8, 8) };
        let layers = refiner.layers();
        let (architecture, mut pass) = (refiner.architecture, Pass::default());
        predict_residual(architecture, &layers, &mut pass, view, window, &Orientation::ALL[..1])
    }

    /// Training on few images pushes features below 0 everywhere. The residual must still depend
    /// on the input, or gradients would vanish for good.
    #[test]
    fn residuals_depend_on_the_input_if_features_are_negative() {
        nets::deterministic();
        let mut refiner =
            random_refiner(RefinerArchitecture { channels: 6, blocks: 1, guidance: None });
        refiner.parameters[1] = vec![-10.0; 6];
        let (dark, view) = (Image::new(16, 16, INPUTS, vec![0.0; 16 * 16 * INPUTS]), image(16, 16));
        let difference = window_residual(&refiner, &dark)
            .iter()
            .zip(window_residual(&refiner, &view))
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(difference > 0.01, "{difference}");
    }

    /// A tile without opacity in its surroundings stays unchanged; one opaque pixel changes it.
    #[test]
    fn transparent_tiles_are_unchanged() {
        let refiner =
            random_refiner(RefinerArchitecture { channels: 6, blocks: 1, guidance: None });
        let mut view = image(2 * TILE_SIDE, 8);
        for pixel in view.data.chunks_exact_mut(INPUTS) {
            pixel[3] = 0.0;
        }
        let changed_tiles = |view: &Image| {
            let refined = refiner.refine(view).unwrap();
            [0, 1].map(|tile| {
                (0..TILE_SIDE).any(|x| {
                    let pixel = tile * TILE_SIDE + x;
                    view.data[pixel * INPUTS..][..OUTPUTS]
                        != refined.data[pixel * OUTPUTS..][..OUTPUTS]
                })
            })
        };
        assert_eq!(changed_tiles(&view), [false, false]);
        view.data[(2 * TILE_SIDE - 1) * INPUTS + 3] = 0.1;
        assert_eq!(changed_tiles(&view), [false, true]);
        view.data[(TILE_SIDE + 7) * INPUTS + 3] = 0.1;
        assert_eq!(changed_tiles(&view), [true, true]);
    }

    fn mirrored(view: &Image) -> Image {
        let data = view
            .data
            .chunks_exact(view.width * view.channels)
            .flat_map(|row| row.chunks_exact(view.channels).rev().flatten().copied());
        Image::new(view.width, view.height, view.channels, data.collect())
    }

    /// Returns the largest difference between mirroring after and before refinement.
    fn mirroring_error(refiner: &Refiner, view: &Image, orientations: u32) -> f32 {
        let mirrored_after = mirrored(&refiner.refine_weighted(view, 1.0, orientations).unwrap());
        let mirrored_before = refiner.refine_weighted(&mirrored(view), 1.0, orientations).unwrap();
        mirrored_after
            .data
            .iter()
            .zip(&mirrored_before.data)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max)
    }

    /// With all eight orientations, refining a mirrored view equals mirroring the refined view.
    #[test]
    fn all_orientations_together_prefer_no_direction() {
        nets::deterministic();
        let refiner =
            random_refiner(RefinerArchitecture { channels: 6, blocks: 1, guidance: None });
        let view = image(150, 10);
        assert!(
            mirroring_error(&refiner, &view, 8) < 1e-5,
            "{}",
            mirroring_error(&refiner, &view, 8)
        );
        assert!(
            mirroring_error(&refiner, &view, 1) > 0.01,
            "{}",
            mirroring_error(&refiner, &view, 1)
        );
    }

    #[test]
    fn written_weights_are_read_and_other_networks_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(WEIGHTS_FILE);
        let architecture =
            RefinerArchitecture { channels: 6, blocks: 1, guidance: Some(WarpOptions::default()) };
        let refiner = random_refiner(architecture);
        refiner.write(&path).unwrap();
        let read = Refiner::read(&path, architecture).unwrap();
        assert_eq!(refiner.parameters, read.parameters);
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
                Refiner::read(&path, other)
                    .unwrap_err()
                    .to_string()
                    .contains("unsupported network")
            );
        }
        assert_eq!(
            read.refine(&image(8, 8)).unwrap_err().to_string(),
            format!("expected a view of {REFERENCE_INPUTS} channels, found 4")
        );
        let bytes = std::fs::read(&path).unwrap();
        for end in [0, 7, 100, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..end]).unwrap();
            assert!(Refiner::read(&path, architecture).is_err());
        }
    }
}
