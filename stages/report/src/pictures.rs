use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::Context as _;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use pixels::{Filter, Rgba8, encode_png, read_png, resize_pillow};
use rayon::prelude::*;
use serde::Serialize;
use stage::Context;

use crate::layers::{Group, Layer, ONLY_RENDER};

/// A picture of the page, as the page's script reads it.
#[derive(Clone, Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Picture {
    /// Index of the view in the page.
    pub(crate) view: usize,
    /// Index of the layer.
    pub(crate) layer: usize,
    /// Width of the original in pixels.
    pub(crate) width: usize,
    /// Height of the original in pixels.
    pub(crate) height: usize,
    /// Width of the copy in pixels.
    pub(crate) shown_width: usize,
    /// Path of the original, relative to the page.
    pub(crate) original: String,
    /// Data URI of the copy in the page.
    pub(crate) uri: String,
}

/// Request for the picture of a view in a layer.
pub(crate) struct Request<'a> {
    /// Index of the view in the page.
    pub(crate) view: usize,
    /// Name of the view.
    pub(crate) name: &'a str,
    /// Index of the layer.
    pub(crate) layer: usize,
    /// Range of depths that the colour scale covers.
    pub(crate) depths: (f32, f32),
}

/// A written original.
struct Original {
    /// Picture without copy.
    picture: Picture,
    group: Group,
    path: PathBuf,
    bytes: usize,
}

/// Compression of a picture's copy.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Quality {
    /// Copy of the original.
    Lossless,
    /// JPEG of at most `side` pixels in width and height.
    Jpeg { side: usize, quality: u8 },
}

/// Maximum number of bytes of a page's pictures for which copies are lossless: such a page opens
/// immediately (docs/design/041).
const LOSSLESS_BYTES: usize = 6_000_000;
/// Maximum width and height in pixels of LR photographs that are always lossless, because readers
/// compare their single pixels; chosen by hand.
const LOSSLESS_SIDE: usize = 128;

/// Qualities from the best to one that fits into the page of any run (docs/design/041).
const QUALITIES: [Quality; 11] = [
    Quality::Lossless,
    Quality::Jpeg { side: 800, quality: 90 },
    Quality::Jpeg { side: 800, quality: 82 },
    Quality::Jpeg { side: 640, quality: 82 },
    Quality::Jpeg { side: 640, quality: 72 },
    Quality::Jpeg { side: 512, quality: 72 },
    Quality::Jpeg { side: 400, quality: 70 },
    Quality::Jpeg { side: 320, quality: 66 },
    Quality::Jpeg { side: 240, quality: 64 },
    Quality::Jpeg { side: 160, quality: 60 },
    Quality::Jpeg { side: 96, quality: 55 },
];

/// Number of pictures from which the size of all copies is predicted (docs/design/041).
const SAMPLE_COUNT: usize = 16;

/// Writes originals to `views/` and returns copies of at most `budget` bytes in total. If no
/// quality fits, the copies have the lowest one.
pub(crate) fn write_pictures(
    context: &Context,
    layers: &[Layer<'_>],
    requests: &[Request<'_>],
    budget: usize,
) -> anyhow::Result<Vec<Picture>> {
    let files = file_names(layers, requests);
    let progress = context.progress("pictures", 2 * requests.len() as u64);
    let originals = requests
        .par_iter()
        .zip(files)
        .map(|(request, file)| {
            context.check_interrupt()?;
            let original = write_original(context, layers, request, file)?;
            progress.add(1);
            anyhow::Ok(original)
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let originals: Vec<Original> = originals.into_iter().flatten().collect();
    let mut quality = predict_quality(&originals, budget)?;
    loop {
        let pictures = originals
            .par_iter()
            .map(|original| {
                context.check_interrupt()?;
                progress.add(1);
                copy(original, QUALITIES[quality])
            })
            .collect::<anyhow::Result<Vec<Picture>>>()?;
        let bytes: usize = pictures.iter().map(|picture| picture.uri.len()).sum();
        if bytes <= budget || quality + 1 == QUALITIES.len() {
            return Ok(pictures);
        }
        quality += 1;
    }
}

fn write_original(
    context: &Context,
    layers: &[Layer<'_>],
    request: &Request<'_>,
    file: String,
) -> anyhow::Result<Option<Original>> {
    let layer = &layers[request.layer];
    let Some(image) = layer.picture(request.name, request.depths)? else { return Ok(None) };
    let path = context.output_path(&file)?;
    let bytes = encode_png(&image);
    std::fs::write(&path, &bytes).with_context(|| path.display().to_string())?;
    let picture = Picture {
        view: request.view,
        layer: request.layer,
        width: image.width,
        height: image.height,
        shown_width: image.width,
        original: file,
        uri: String::new(),
    };
    Ok(Some(Original { picture, group: layer.group.clone(), path, bytes: bytes.len() }))
}

/// Predicts from a sample of the pictures the index of the best quality that fits into the budget.
fn predict_quality(originals: &[Original], budget: usize) -> anyhow::Result<usize> {
    // Lengths in Base64.
    let all: usize = originals.iter().map(|original| original.bytes.div_ceil(3) * 4).sum();
    if all <= budget.min(LOSSLESS_BYTES) {
        return Ok(0);
    }
    let step = originals.len().div_ceil(SAMPLE_COUNT).max(1);
    let sample: Vec<&Original> = originals.iter().step_by(step).collect();
    for quality in 1..QUALITIES.len() {
        let copies: Vec<Picture> = sample
            .par_iter()
            .map(|original| copy(original, QUALITIES[quality]))
            .collect::<anyhow::Result<_>>()?;
        let bytes: usize = copies.iter().map(|picture| picture.uri.len()).sum();
        if bytes * originals.len() <= budget * sample.len() {
            return Ok(quality);
        }
    }
    Ok(QUALITIES.len() - 1)
}

/// Makes the copy of an original.
fn copy(original: &Original, quality: Quality) -> anyhow::Result<Picture> {
    let mut picture = original.picture.clone();
    let is_small = picture.width.max(picture.height) <= LOSSLESS_SIDE;
    let quality = match &original.group {
        Group::LowResolution if is_small => Quality::Lossless,
        _ => quality,
    };
    let (kind, bytes) = match quality {
        Quality::Lossless => ("png", std::fs::read(&original.path)?),
        Quality::Jpeg { side, quality } => {
            let small = shrunk(&read_png(&original.path)?, side);
            picture.shown_width = small.width;
            ("jpeg", encode_jpeg(&small, quality, &original.group)?)
        }
    };
    picture.uri = format!("data:image/{kind};base64,{}", STANDARD.encode(bytes));
    Ok(picture)
}

/// Shrinks an image to at most `side` pixels in width and height.
fn shrunk(image: &Rgba8, side: usize) -> Rgba8 {
    let longest = image.width.max(image.height);
    if longest <= side {
        return image.clone();
    }
    let [width, height] =
        [image.width, image.height].map(|size| (size * side).div_ceil(longest).max(1));
    resize_pillow(image, width, height, Filter::Bicubic)
}

fn encode_jpeg(image: &Rgba8, quality: u8, group: &Group) -> anyhow::Result<Vec<u8>> {
    let rgb: Vec<u8> =
        image.data.as_chunks::<4>().0.iter().flat_map(|p| [p[0], p[1], p[2]]).collect();
    // A pixel of an LR photograph covers several pixels of the screen.
    let (quality, sampling) = match group {
        Group::LowResolution => ((quality + 6).min(95), SamplingFactor::R_4_4_4),
        _ => (quality, SamplingFactor::R_4_2_0),
    };
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, quality);
    encoder.set_sampling_factor(sampling);
    encoder.set_progressive(true);
    encoder.set_optimized_huffman_tables(true);
    let width = u16::try_from(image.width).context("copy wider than 65,535 pixels")?;
    let height = u16::try_from(image.height).context("copy higher than 65,535 pixels")?;
    encoder.encode(&rgb, width, height, ColorType::Rgb)?;
    Ok(bytes)
}

/// Returns unique paths of the originals: one folder per view, with only the characters that
/// [`plain`] keeps.
fn file_names(layers: &[Layer<'_>], requests: &[Request<'_>]) -> Vec<String> {
    let mut taken = BTreeSet::new();
    let mut names = Vec::with_capacity(requests.len());
    for request in requests {
        let stem = stem(&layers[request.layer], request.name);
        let mut name = format!("{stem}.png");
        let mut number = 2;
        while !taken.insert(name.clone()) {
            name = format!("{stem}-{number}.png");
            number += 1;
        }
        names.push(name);
    }
    names
}

/// Returns the path of a view's original without extension, which needn't be unique.
fn stem(layer: &Layer<'_>, view: &str) -> String {
    let is_unlabelled = match layer.group {
        Group::Render => layer.label == ONLY_RENDER,
        _ => layer.rows.is_empty(),
    };
    let suffix = if is_unlabelled {
        String::new()
    } else {
        format!("-{}", plain(&layer.label.to_lowercase()))
    };
    format!("views/{}/{}{suffix}", plain(view), plain(layer.group.file_name()))
}

/// Replaces all characters except ASCII letters, digits, `-`, `_` and `.`, and keeps at most 60.
fn plain(text: &str) -> String {
    let text: String = text
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' })
        .take(60)
        .collect();
    let text = text.trim_matches(['-', '.']);
    if text.is_empty() { "view".to_owned() } else { text.to_owned() }
}
