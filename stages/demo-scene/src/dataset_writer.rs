//! Files of a data set in Blender's format, or with one `transforms.json`.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use anyhow::Context as _;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder as _};
use pixels::{Channel, PixelError, Rgba8, SampleType, write_exr, write_png};
use serde_json::{Value, json};
use stage::Context;

use crate::camera::ViewCamera;
use crate::params::{Form, Params};
use crate::render::RenderedImage;

/// Quality of JPEG files, like that of a good camera; chosen by hand.
const JPEG_QUALITY: u8 = 95;

impl Form {
    /// Returns the folder of a split's images.
    pub(crate) fn folder(self, split: &str) -> &str {
        match self {
            Self::Blender => split,
            Self::Transforms => "images",
        }
    }

    /// Writes a view's files.
    pub(crate) fn write_view(
        self,
        context: &Context,
        split: &str,
        number: u32,
        image: &RenderedImage,
    ) -> anyhow::Result<()> {
        if self == Self::Transforms {
            let path = context.output_path(&photograph_name(split, number))?;
            return write_jpeg(&path, &image.colour)
                .with_context(|| format!("cannot write {}", path.display()));
        }
        write_png(&context.output_path(&format!("{split}/r_{number}.png"))?, &image.colour)?;
        if split == "test" {
            write_depth(&context.output_path(&format!("test/r_{number}_depth.exr"))?, image)?;
        }
        Ok(())
    }
}

/// Returns the path of a photograph in the data set.
fn photograph_name(split: &str, number: u32) -> String {
    format!("images/{split}_{number}.jpg")
}

/// Writer of a data set's camera files.
pub(crate) struct DatasetWriter {
    form: Form,
    /// Camera of the test views, and of all frames without a camera of their own.
    shared: ViewCamera,
    /// True if training views have a camera of their own.
    has_training_camera: bool,
    /// Frames of `transforms.json`.
    frames: Vec<Value>,
    /// Key and image names of each split in `transforms.json`.
    splits: Vec<(String, Vec<String>)>,
}

impl DatasetWriter {
    /// Creates a writer without frames.
    pub(crate) fn new(params: &Params) -> Self {
        Self {
            form: params.form,
            shared: ViewCamera::of_test(params),
            has_training_camera: params.training_angle().is_some(),
            frames: Vec::new(),
            splits: Vec::new(),
        }
    }

    /// Adds a split's cameras; in Blender's format, writes their file.
    pub(crate) fn add_split(
        &mut self,
        context: &Context,
        split: &str,
        camera: &ViewCamera,
        poses: &[[[f64; 4]; 4]],
    ) -> anyhow::Result<()> {
        if self.form == Form::Transforms {
            let has_own_camera = self.has_training_camera && split == "train";
            let own = if has_own_camera { camera.transforms_entries() } else { json!({}) };
            let mut names = Vec::with_capacity(poses.len());
            for (number, pose) in poses.iter().enumerate() {
                let name = photograph_name(split, number as u32);
                let mut frame = own.clone();
                frame["file_path"] = json!(name);
                frame["transform_matrix"] = json!(pose);
                self.frames.push(frame);
                names.push(name);
            }
            self.splits.push((format!("{split}_filenames"), names));
            return Ok(());
        }
        let mut frames = Vec::with_capacity(poses.len());
        for (number, pose) in poses.iter().enumerate() {
            let mut frame =
                json!({"file_path": format!("./{split}/r_{number}"), "transform_matrix": pose});
            if split == "test" {
                frame["depth_file_path"] = json!(format!("./test/r_{number}_depth.exr"));
            }
            frames.push(frame);
        }
        let mut file = camera.blender_entries();
        file["frames"] = json!(frames);
        context
            .write_json(&format!("transforms_{split}.json"), &file)
            .context("cannot write the cameras")
    }

    /// Writes `transforms.json` unless the format is Blender's.
    pub(crate) fn finish(self, context: &Context) -> anyhow::Result<()> {
        if self.form == Form::Blender {
            return Ok(());
        }
        let mut file = self.shared.transforms_entries();
        file["frames"] = json!(self.frames);
        for (key, names) in self.splits {
            file[key] = json!(names);
        }
        context.write_json("transforms.json", &file).context("cannot write the cameras")
    }
}

/// Writes an image, composited on white, as JPEG.
fn write_jpeg(path: &Path, image: &Rgba8) -> anyhow::Result<()> {
    let rgb: Vec<u8> = image.data.chunks_exact(4).flat_map(over_white).collect();
    let (width, height) = (image.width as u32, image.height as u32);
    let mut file = BufWriter::new(File::create(path)?);
    let encoder = JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY);
    encoder.write_image(&rgb, width, height, ExtendedColorType::Rgb8)?;
    Ok(file.flush()?)
}

/// Composites an RGBA pixel on white.
fn over_white(p: &[u8]) -> [u8; 3] {
    let alpha = u32::from(p[3]);
    std::array::from_fn(|c| ((u32::from(p[c]) * alpha + 255 * (255 - alpha) + 127) / 255) as u8)
}

/// Writes the depth of the first surface at each pixel's centre; without a surface, `Z` and `A` are
/// 0.
fn write_depth(path: &Path, image: &RenderedImage) -> Result<(), PixelError> {
    let channels = [
        Channel { name: "A", sample_type: SampleType::Half },
        Channel { name: "Z", sample_type: SampleType::Float },
    ];
    let (width, height) = (image.colour.width, image.colour.height);
    write_exr(
        path,
        (width, height),
        &channels,
        "Z: camera-space z-depth in scene units; A: 0 where nothing is seen",
        |first, rows, samples| {
            let band = &image.depth[first * width..(first + rows) * width];
            for (i, depth) in band.iter().enumerate() {
                samples[2 * i] = if depth.is_some() { 1.0 } else { 0.0 };
                samples[2 * i + 1] = depth.unwrap_or(0.0);
            }
            Ok(())
        },
    )
}
