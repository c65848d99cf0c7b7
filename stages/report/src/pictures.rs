use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::Context as _;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use pixels::{Filter, Rgba8, encode_png, read_png, resize_pillow};
use rayon::prelude::*;
use stage::Context;

use crate::layers::{Group, Layer, ONLY_RENDER};

/// A picture on the page.
pub(crate) struct Picture {
    /// The view's place among all views of the page.
    pub(crate) view: usize,
    /// The layer's place.
    pub(crate) layer: usize,
    /// Pixels of the original.
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Pixels across of the copy in the page.
    pub(crate) shown_width: usize,
    /// The original beside the page.
    pub(crate) original: String,
    /// The copy in the page.
    pub(crate) uri: String,
}

/// A picture that is wanted: view and layer by place, and the view's name.
pub(crate) struct Wanted<'a> {
    pub(crate) view: usize,
    pub(crate) name: &'a str,
    pub(crate) layer: usize,
    pub(crate) depths: (f32, f32),
}

/// An original that was written.
struct Original {
    view: usize,
    layer: usize,
    group: Group,
    width: usize,
    height: usize,
    file: String,
    path: PathBuf,
    bytes: usize,
}

/// A way to make pictures smaller.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Quality {
    /// The original.
    Lossless,
    /// JPEG of at most so many pixels across or down.
    Jpeg { side: usize, quality: u8 },
}

/// Bytes of pictures in a page up to which they are the originals: such a page opens at once.
const LOSSLESS_BYTES: usize = 6_000_000;
/// Pixels across and down up to which LR photographs are shown as they are: a reader looks at their
/// single pixels.
const LOSSLESS_SIDE: usize = 128;

/// From the best to what a page of any run has room for.
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

/// Pictures whose size tells that of all.
const SAMPLE_PICTURES: usize = 16;

/// Writes originals to `views/` and returns copies that have room in `budget` bytes of a page.
pub(crate) fn pictures(
    context: &Context,
    layers: &[Layer<'_>],
    wanted: &[Wanted<'_>],
    budget: usize,
) -> anyhow::Result<Vec<Picture>> {
    let files = file_names(layers, wanted);
    let progress = context.progress("pictures", 2 * wanted.len() as u64);
    let originals = wanted
        .par_iter()
        .zip(files)
        .map(|(wanted, file)| {
            context.check_interrupt()?;
            let original = write_original(context, layers, wanted, file)?;
            progress.add(1);
            anyhow::Ok(original)
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let originals: Vec<Original> = originals.into_iter().flatten().collect();
    let mut first = first_quality(&originals, budget)?;
    loop {
        let pictures = originals
            .par_iter()
            .map(|original| {
                context.check_interrupt()?;
                progress.add(1);
                copy(original, QUALITIES[first])
            })
            .collect::<anyhow::Result<Vec<Picture>>>()?;
        let bytes: usize = pictures.iter().map(|picture| picture.uri.len()).sum();
        if bytes <= budget || first + 1 == QUALITIES.len() {
            return Ok(pictures);
        }
        first += 1;
    }
}

fn write_original(
    context: &Context,
    layers: &[Layer<'_>],
    wanted: &Wanted<'_>,
    file: String,
) -> anyhow::Result<Option<Original>> {
    let layer = &layers[wanted.layer];
    let Some(image) = layer.picture(wanted.name, wanted.depths)? else { return Ok(None) };
    let path = context.output_path(&file)?;
    let bytes = encode_png(&image);
    std::fs::write(&path, &bytes).with_context(|| path.display().to_string())?;
    Ok(Some(Original {
        view: wanted.view,
        layer: wanted.layer,
        group: layer.group.clone(),
        width: image.width,
        height: image.height,
        file,
        path,
        bytes: bytes.len(),
    }))
}

/// The first quality that some of the pictures say has room.
fn first_quality(originals: &[Original], budget: usize) -> anyhow::Result<usize> {
    let all: usize = originals.iter().map(|original| base64_length(original.bytes)).sum();
    if all <= budget.min(LOSSLESS_BYTES) {
        return Ok(0);
    }
    let sample: Vec<&Original> =
        originals.iter().step_by(originals.len().div_ceil(SAMPLE_PICTURES).max(1)).collect();
    for place in 1..QUALITIES.len() {
        let copies: Vec<Picture> = sample
            .par_iter()
            .map(|original| copy(original, QUALITIES[place]))
            .collect::<anyhow::Result<_>>()?;
        let bytes: usize = copies.iter().map(|picture| picture.uri.len()).sum();
        if bytes * originals.len() <= budget * sample.len() {
            return Ok(place);
        }
    }
    Ok(QUALITIES.len() - 1)
}

fn base64_length(bytes: usize) -> usize {
    bytes.div_ceil(3) * 4
}

/// The copy of an original.
fn copy(original: &Original, quality: Quality) -> anyhow::Result<Picture> {
    let is_small = original.width.max(original.height) <= LOSSLESS_SIDE;
    let quality = match &original.group {
        Group::LowResolution if is_small => Quality::Lossless,
        _ => quality,
    };
    let (kind, bytes, shown_width) = match quality {
        Quality::Lossless => ("png", std::fs::read(&original.path)?, original.width),
        Quality::Jpeg { side, quality } => {
            let small = at_most(&read_png(&original.path)?, side);
            ("jpeg", encode_jpeg(&small, quality, &original.group)?, small.width)
        }
    };
    Ok(Picture {
        view: original.view,
        layer: original.layer,
        width: original.width,
        height: original.height,
        shown_width,
        original: original.file.clone(),
        uri: format!("data:image/{kind};base64,{}", STANDARD.encode(bytes)),
    })
}

/// An image with so many pixels across and down at most.
fn at_most(image: &Rgba8, side: usize) -> Rgba8 {
    let longest = image.width.max(image.height);
    if longest <= side {
        return image.clone();
    }
    let less = |size: usize| (size * side).div_ceil(longest).max(1);
    resize_pillow(image, less(image.width), less(image.height), Filter::Bicubic)
}

fn encode_jpeg(image: &Rgba8, quality: u8, group: &Group) -> anyhow::Result<Vec<u8>> {
    let rgb: Vec<u8> =
        image.data.as_chunks::<4>().0.iter().flat_map(|p| [p[0], p[1], p[2]]).collect();
    // A pixel of an LR photograph covers several of the screen's.
    let (quality, sampling) = match group {
        Group::LowResolution => ((quality + 6).min(95), SamplingFactor::R_4_4_4),
        _ => (quality, SamplingFactor::R_4_2_0),
    };
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, quality);
    encoder.set_sampling_factor(sampling);
    encoder.set_progressive(true);
    encoder.set_optimized_huffman_tables(true);
    let size = |pixels: usize| u16::try_from(pixels).context("a copy is smaller than 65,536");
    encoder.encode(&rgb, size(image.width)?, size(image.height)?, ColorType::Rgb)?;
    Ok(bytes)
}

/// Names of originals, each once: a folder a view, with plain letters alone.
fn file_names(layers: &[Layer<'_>], wanted: &[Wanted<'_>]) -> Vec<String> {
    let mut taken = BTreeSet::new();
    let mut names = Vec::with_capacity(wanted.len());
    for wanted in wanted {
        let stem = stem(&layers[wanted.layer], wanted.name);
        let numbered = (2usize..).map(|number| format!("{stem}-{number}.png"));
        let mut files = [format!("{stem}.png")].into_iter().chain(numbered);
        let free = files.find(|file| !taken.contains(file)).unwrap_or_default();
        taken.insert(free.clone());
        names.push(free);
    }
    names
}

/// Path of a view's original without its ending; other originals may have the same.
fn stem(layer: &Layer<'_>, view: &str) -> String {
    let whose = match (layer.row, &layer.group) {
        (None, _) => String::new(),
        (Some(_), Group::Render) if layer.label == ONLY_RENDER => String::new(),
        (Some(_), _) => format!("-{}", plain(&layer.label.to_lowercase())),
    };
    format!("views/{}/{}{whose}", plain(view), plain(layer.group.file_name()))
}

/// Letters that are plain in paths and addresses, 60 at most.
fn plain(text: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let text: String = text.chars().map(|c| if is_plain(c) { c } else { '-' }).take(60).collect();
    let text = text.trim_matches(['-', '.']);
    if text.is_empty() { "view".to_owned() } else { text.to_owned() }
}
