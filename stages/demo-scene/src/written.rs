//! Files of a data set, in both forms.

use std::fs::File;
use std::io::BufWriter;
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

/// JPEG's quality: that of a careful camera.
const QUALITY: u8 = 95;

impl Form {
    /// Where a split's images lie.
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
        frame: &RenderedImage,
    ) -> anyhow::Result<()> {
        if self == Self::Transforms {
            let path = context.output_path(&photograph(split, number))?;
            return write_jpeg(&path, &frame.colour)
                .with_context(|| format!("cannot write {}", path.display()));
        }
        write_png(&context.output_path(&format!("{split}/r_{number}.png"))?, &frame.colour)?;
        if split == "test" {
            write_depth(&context.output_path(&format!("test/r_{number}_depth.exr"))?, frame)?;
        }
        Ok(())
    }
}

/// Name of a photograph.
fn photograph(split: &str, number: u32) -> String {
    format!("images/{split}_{number}.jpg")
}

/// The files with cameras.
pub(crate) struct Written {
    form: Form,
    /// Camera of the frames that say nothing of theirs.
    shared: ViewCamera,
    /// Whether training frames have another.
    is_mixed: bool,
    /// Frames of `transforms.json`, and which of them are for what.
    frames: Vec<Value>,
    splits: Vec<(String, Vec<String>)>,
}

impl Written {
    pub(crate) fn new(params: &Params) -> Self {
        let (shared, is_mixed) = (ViewCamera::of_test(params), params.training_angle().is_some());
        Self { form: params.form, shared, is_mixed, frames: Vec::new(), splits: Vec::new() }
    }

    /// Takes in a split's cameras.
    pub(crate) fn add(
        &mut self,
        context: &Context,
        split: &str,
        camera: &ViewCamera,
        poses: &[[[f64; 4]; 4]],
    ) -> anyhow::Result<()> {
        if self.form == Form::Transforms {
            let names: Vec<String> =
                (0..poses.len() as u32).map(|number| photograph(split, number)).collect();
            let own =
                if self.is_mixed && split == "train" { camera.transforms() } else { json!({}) };
            for (name, pose) in names.iter().zip(poses) {
                let mut frame = own.clone();
                (frame["file_path"], frame["transform_matrix"]) = (json!(name), json!(pose));
                self.frames.push(frame);
            }
            self.splits.push((format!("{split}_filenames"), names));
            return Ok(());
        }
        let frames = poses.iter().enumerate().map(|(number, pose)| {
            let mut frame =
                json!({"file_path": format!("./{split}/r_{number}"), "transform_matrix": pose});
            if split == "test" {
                frame["depth_file_path"] = json!(format!("./test/r_{number}_depth.exr"));
            }
            frame
        });
        let frames: Vec<Value> = frames.collect();
        let mut file = camera.blender();
        file["frames"] = json!(frames);
        context
            .write_json(&format!("transforms_{split}.json"), &file)
            .context("cannot write the cameras")
    }

    /// Writes what is about all of them.
    pub(crate) fn end(self, context: &Context) -> anyhow::Result<()> {
        if self.form == Form::Blender {
            return Ok(());
        }
        let mut file = self.shared.transforms();
        file["frames"] = json!(self.frames);
        for (key, names) in self.splits {
            file[key] = json!(names);
        }
        context.write_json("transforms.json", &file).context("cannot write the cameras")
    }
}

/// Writes an image over white.
fn write_jpeg(path: &Path, image: &Rgba8) -> anyhow::Result<()> {
    let rgb: Vec<u8> = image.data.chunks_exact(4).flat_map(over_white).collect();
    let encoder = JpegEncoder::new_with_quality(BufWriter::new(File::create(path)?), QUALITY);
    Ok(encoder.write_image(
        &rgb,
        image.width as u32,
        image.height as u32,
        ExtendedColorType::Rgb8,
    )?)
}

fn over_white(p: &[u8]) -> [u8; 3] {
    let alpha = u32::from(p[3]);
    std::array::from_fn(|c| ((u32::from(p[c]) * alpha + 255 * (255 - alpha) + 127) / 255) as u8)
}

/// Depth of the first surface at each pixel's centre; where there is none, `Z` is 0 and `A` is 0.
fn write_depth(path: &Path, frame: &RenderedImage) -> Result<(), PixelError> {
    let channels = [
        Channel { name: "A", sample_type: SampleType::Half },
        Channel { name: "Z", sample_type: SampleType::Float },
    ];
    let (width, height) = (frame.colour.width, frame.colour.height);
    write_exr(
        path,
        (width, height),
        &channels,
        "Z: camera-space z-depth in scene units; A: 0 where nothing is seen",
        |first, rows, samples| {
            let band = &frame.depth[first * width..(first + rows) * width];
            for (sample, depth) in samples.chunks_exact_mut(2).zip(band) {
                sample
                    .copy_from_slice(&[f32::from(u8::from(depth.is_some())), depth.unwrap_or(0.0)]);
            }
            Ok(())
        },
    )
}
