//! Measures how far the spectrum of photographs reaches: enlarged, blurred or unfocused photographs
//! contain less detail than their pixels could (docs/design/035).

use artifact::WARNING;
use pixels::Rgba8;

use crate::image_plan::ImagePlan;

/// Side of a block whose spectrum is measured, in pixels.
const BLOCK_SIDE: usize = 32;
/// Maximum number of measured blocks of an image; chosen by hand.
const MAX_BLOCKS: usize = 256;
/// Divisor of the number of blocks: only the quarter of largest variance is considered, since
/// smooth areas have no detail. At most [`MAX_BLOCKS`] blocks of this quarter are measured, at even
/// steps in the order of variance.
const MEASURED_DIVISOR: usize = 4;
/// Frequencies that fix the expected spectrum.
const REFERENCE_FREQUENCIES: [usize; 2] = [2, 3];
/// Minimum flattened power (k² times the power at frequency k) of images with structure, in squared
/// levels: the mean at [`REFERENCE_FREQUENCIES`], summed over all measured blocks; chosen by hand.
const MIN_POWER: f64 = 1.0;
/// First frequency that is compared with the expected spectrum.
const FIRST_COMPARED: usize = 4;
/// Minimum ratio of power to expected power where there is detail: 6 dB less.
const MIN_POWER_RATIO: f64 = 0.25;
/// Fraction of the LR images' resolution below which detail is missing. Photographs at their
/// camera's full resolution reach 0.78.
const MIN_REACH: f64 = 0.7;

/// Power of image blocks by frequency, in both directions.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Spectrum {
    power: [f64; BLOCK_SIDE],
}

impl Spectrum {
    /// Measures an image over white. Images without a block have no power.
    pub(crate) fn of(image: &Rgba8) -> Self {
        let mut blocks: Vec<([usize; 2], f64)> = Vec::new();
        for y in (0..image.height.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
            for x in (0..image.width.saturating_sub(BLOCK_SIDE - 1)).step_by(BLOCK_SIDE) {
                blocks.push(([x, y], variance(&block(image, [x, y]))));
            }
        }
        // The sort is stable, so that equal blocks keep their order.
        blocks.sort_by(|a, b| b.1.total_cmp(&a.1));
        blocks.truncate(blocks.len().div_ceil(MEASURED_DIVISOR));
        let stride = blocks.len().div_ceil(MAX_BLOCKS).max(1);
        let waves = waves();
        let mut power = [0.0; BLOCK_SIDE];
        for (at, _) in blocks.iter().step_by(stride) {
            add_power(&mut power, &block(image, *at), &waves);
        }
        Self { power }
    }

    /// Adds the spectra of several images.
    pub(crate) fn sum(spectra: &[Self]) -> Self {
        let mut sum = Self::default();
        for spectrum in spectra {
            for (sum, power) in sum.power.iter_mut().zip(spectrum.power) {
                *sum += power;
            }
        }
        sum
    }

    /// Returns the fraction of the resolution that detail reaches, from 0 to 1. The power of sharp
    /// images falls with the square of the frequency (Field 1987, "Relations between the statistics
    /// of natural images and the response properties of cortical cells"). Noise counts as detail.
    /// Returns `None` for images without blocks or structure.
    pub(crate) fn reach(&self) -> Option<f64> {
        let flattened_power = |k: usize| self.power[k] * (k * k) as f64;
        let expected = REFERENCE_FREQUENCIES.map(flattened_power).iter().sum::<f64>()
            / REFERENCE_FREQUENCIES.len() as f64;
        if expected <= MIN_POWER {
            return None;
        }
        // Geometric mean over neighbouring frequencies.
        let power_ratio = |k: usize| {
            let near = (k - 1)..=(k + 1).min(BLOCK_SIDE - 1);
            let ratios = near.clone().map(|k| flattened_power(k) / expected);
            let logarithms = ratios.map(|ratio| ratio.max(f64::MIN_POSITIVE).ln());
            (logarithms.sum::<f64>() / near.count() as f64).exp()
        };
        let end = (FIRST_COMPARED..BLOCK_SIDE).find(|&k| power_ratio(k) < MIN_POWER_RATIO);
        Some(end.unwrap_or(BLOCK_SIDE) as f64 / BLOCK_SIDE as f64)
    }
}

/// Returns the fraction of the LR images' resolution that detail reaches. `reach` is the fraction
/// for photographs, which are `factor` times as wide.
pub(crate) fn lr_reach(reach: f64, factor: f64) -> f64 {
    (reach * factor).min(1.0)
}

/// Returns a warning of missing detail, with the remedy; `None` if nothing is missing. The remedy
/// has a smaller scale if HR images of the given `scale` would be larger than the photographs.
pub(crate) fn missing_detail_warning(
    lr_reach: f64,
    images: &ImagePlan,
    scale: f64,
) -> Option<String> {
    (lr_reach < MIN_REACH).then(|| {
        let width = (lr_reach * f64::from(images.sizes.lr.0)).ceil();
        let max_scale = f64::from(images.native.0) / width;
        let (and_scale, keep) = if scale > max_scale {
            (format!(" and scale {}", (100.0 * max_scale).floor() / 100.0), "keep")
        } else {
            (String::new(), "keeps")
        };
        format!(
            "{WARNING}detail reaches only {:.0} % of the LR images' resolution: the photographs \
            are enlarged, blurred or unfocused; lr_width {width}{and_scale} with lr_source \
            downscaled {keep} all detail, in less time",
            100.0 * lr_reach
        )
    })
}

/// Returns the luminance of a block over white, in levels.
fn block(image: &Rgba8, [x, y]: [usize; 2]) -> [[f64; BLOCK_SIDE]; BLOCK_SIDE] {
    std::array::from_fn(|row| {
        let start = 4 * ((y + row) * image.width + x);
        std::array::from_fn(|column| {
            let [r, g, b, a] =
                std::array::from_fn(|c| f64::from(image.data[start + 4 * column + c]));
            (0.299 * r + 0.587 * g + 0.114 * b) * a / 255.0 + 255.0 - a
        })
    })
}

fn variance(block: &[[f64; BLOCK_SIDE]; BLOCK_SIDE]) -> f64 {
    let count = (BLOCK_SIDE * BLOCK_SIDE) as f64;
    let mean = block.iter().flatten().sum::<f64>() / count;
    block.iter().flatten().map(|value| (value - mean).powi(2)).sum::<f64>() / count
}

/// Returns the cosines of a discrete cosine transform (DCT-II), by frequency.
fn waves() -> [[f64; BLOCK_SIDE]; BLOCK_SIDE] {
    std::array::from_fn(|k| {
        std::array::from_fn(|x| {
            let angle = std::f64::consts::PI * ((2 * x + 1) * k) as f64 / (2 * BLOCK_SIDE) as f64;
            angle.cos() * (2.0 / BLOCK_SIDE as f64).sqrt()
        })
    })
}

/// Adds a block's power along both axes, over all frequencies of the other axis.
fn add_power(
    power: &mut [f64; BLOCK_SIDE],
    block: &[[f64; BLOCK_SIDE]; BLOCK_SIDE],
    waves: &[[f64; BLOCK_SIDE]; BLOCK_SIDE],
) {
    // By Parseval's theorem, the sum over the other axis' frequencies is that over its pixels.
    for (k, wave) in waves.iter().enumerate().skip(1) {
        for line in 0..BLOCK_SIDE {
            let across: f64 = (0..BLOCK_SIDE).map(|i| wave[i] * block[line][i]).sum();
            let down: f64 = (0..BLOCK_SIDE).map(|i| wave[i] * block[i][line]).sum();
            power[k] += (across.powi(2) + down.powi(2)) / BLOCK_SIDE as f64;
        }
    }
}

#[cfg(test)]
mod tests {
    use pixels::{Filter, Kernel, resize_pillow};

    use super::*;
    use crate::sizes::{downscaled_sizes, enlarged_sizes};

    /// Returns an image of overlapping discs of all sizes: sharp edges everywhere.
    fn discs(side: usize) -> Rgba8 {
        let mut data = vec![255; 4 * side * side];
        let mut state = 1_u64;
        let mut draw = |bound: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 33) as usize % bound
        };
        for _ in 0..4 * side {
            let ([x, y], radius) = ([draw(side), draw(side)], 2 + draw(side) / (1 + draw(12)) / 4);
            let colour = [draw(256) as u8, draw(256) as u8, draw(256) as u8];
            for row in y.saturating_sub(radius)..(y + radius).min(side) {
                for column in x.saturating_sub(radius)..(x + radius).min(side) {
                    if (row.abs_diff(y)).pow(2) + (column.abs_diff(x)).pow(2) < radius * radius {
                        let start = 4 * (row * side + column);
                        data[start..start + 3].copy_from_slice(&colour);
                    }
                }
            }
        }
        Rgba8::new(side, side, data)
    }

    fn resized(image: &Rgba8, side: usize) -> Rgba8 {
        resize_pillow(image, side, side, Filter::Lanczos)
    }

    #[test]
    fn an_enlarged_image_reaches_part_of_its_resolution() {
        let sharp = resized(&discs(512), 256);
        assert_eq!(Spectrum::of(&sharp).reach(), Some(1.0));
        for (side, low, high) in [(512, 0.4, 0.55), (768, 0.25, 0.4)] {
            let reach = Spectrum::of(&resized(&sharp, side)).reach().unwrap();
            assert!((low..high).contains(&reach), "{side}: {reach}");
            // The enlarged image is sharp if downscaled again.
            assert_eq!(Spectrum::of(&resized(&resized(&sharp, side), 200)).reach(), Some(1.0));
        }
    }

    #[test]
    fn images_without_structure_have_no_reach() {
        for image in [
            Rgba8::new(64, 64, vec![200; 4 * 64 * 64]),
            Rgba8::new(20, 90, vec![7; 4 * 20 * 90]),
            Rgba8::new(0, 0, vec![]),
        ] {
            assert_eq!(Spectrum::of(&image).reach(), None);
        }
        assert_eq!(Spectrum::default().reach(), None);
    }

    /// Two equal images have twice the power of one, and the same reach.
    #[test]
    fn spectra_are_summed() {
        let sharp = resized(&discs(512), 256);
        let spectrum = Spectrum::of(&sharp);
        let twice = Spectrum::sum(&[spectrum.clone(), spectrum.clone()]);
        assert_eq!(twice.reach(), spectrum.reach());
        assert_eq!(twice.power[5], 2.0 * spectrum.power[5]);
    }

    #[test]
    fn missing_detail_is_reported_with_a_remedy() {
        assert_eq!(lr_reach(0.5, 1.0), 0.5);
        assert_eq!(lr_reach(0.5, 8.0), 1.0);
        let native = (800, 600);
        let sizes = enlarged_sizes(native, 2.0);
        let images = ImagePlan { has_truth: false, kernel: Kernel::Box, sizes, native };
        assert_eq!(missing_detail_warning(0.7, &images, 2.0), None);
        for (reach, remedy, width, scale) in [
            (0.47, "lr_width 376 with lr_source downscaled keeps all detail", 376, 2.0),
            (0.6, "lr_width 480 and scale 1.66 with lr_source downscaled keep all", 480, 1.66),
        ] {
            let note = missing_detail_warning(reach, &images, 2.0).unwrap();
            let percent = format!(" {:.0} % ", 100.0 * reach);
            assert!(note.contains(&percent) && note.contains(remedy), "{note}");
            assert!(downscaled_sizes(native, Some(width), scale).is_ok());
        }
    }
}
