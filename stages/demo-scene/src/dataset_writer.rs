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
    /// Returns the path of a view's image in the data set.
    pub(crate) fn image_path(self, split: &str, number: usize) -> String {
        match self {
            Self::Blender => format!("{split}/r_{number}.png"),
            Self::Transforms => format!("images/{split}_{number}.jpg"),
        }
    }

    /// Writes a view's files.
    pub(crate) fn write_view(
        self,
        context: &Context,
        split: &str,
        number: usize,
        image: &RenderedImage,
    ) -> anyhow::Result<()> {
        let path = context.output_path(&self.image_path(split, number))?;
        if self == Self::Transforms {
            return write_jpeg(&path, &image.colour)
                .with_context(|| format!("cannot write {}", path.display()));
        }
        write_png(&path, &image.colour)?;
        if split == "test" {
            write_depth(&context.output_path(&depth_path(number))?, image)?;
        }
        Ok(())
    }
}

/// Returns the path of a test view's depth, for the data set's format `blender`.
fn depth_path(number: usize) -> String {
    format!("test/r_{number}_depth.exr")
}

/// Writer of a data set's camera files.
pub(crate) struct DatasetWriter {
    form: Form,
    /// True if training views have a camera of their own.
    has_training_camera: bool,
    /// Content of `transforms.json` without frames: the camera of the test views, and of all frames
    /// without a camera of their own; image names of each split.
    file: Value,
    /// Frames of `transforms.json`.
    frames: Vec<Value>,
}

impl DatasetWriter {
    /// Creates a writer without frames.
    pub(crate) fn new(params: &Params) -> Self {
        Self {
            form: params.form,
            has_training_camera: params.training_angle().is_some(),
            file: ViewCamera::of_test(params).transforms_entries(),
            frames: Vec::new(),
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
        let is_blender = self.form == Form::Blender;
        let has_own_camera = !is_blender && self.has_training_camera && split == "train";
        let own = if has_own_camera { camera.transforms_entries() } else { json!({}) };
        let paths: Vec<String> = (0..poses.len()).map(|i| self.form.image_path(split, i)).collect();
        let mut frames = Vec::with_capacity(poses.len());
        for (number, (pose, path)) in poses.iter().zip(&paths).enumerate() {
            let mut frame = own.clone();
            // Paths in Blender's format have no extension.
            frame["file_path"] = match path.strip_suffix(".png") {
                Some(stem) => json!(format!("./{stem}")),
                None => json!(path),
            };
            frame["transform_matrix"] = json!(pose);
            if is_blender && split == "test" {
                frame["depth_file_path"] = json!(format!("./{}", depth_path(number)));
            }
            frames.push(frame);
        }
        if is_blender {
            let mut file = camera.blender_entries();
            file["frames"] = json!(frames);
            return write_cameras(context, &format!("transforms_{split}.json"), &file);
        }
        self.frames.extend(frames);
        self.file[format!("{split}_filenames")] = json!(paths);
        Ok(())
    }

    /// Writes `transforms.json` unless the format is Blender's.
    pub(crate) fn finish(mut self, context: &Context) -> anyhow::Result<()> {
        if self.form == Form::Blender {
            return Ok(());
        }
        self.file["frames"] = json!(self.frames);
        write_cameras(context, "transforms.json", &self.file)
    }
}

fn write_cameras(context: &Context, name: &str, file: &Value) -> anyhow::Result<()> {
    context.write_json(name, file).context("cannot write the cameras")
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
