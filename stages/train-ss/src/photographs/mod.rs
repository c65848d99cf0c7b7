//! Photographs to train on, packed into memory and, beyond a budget, a file.

mod packed;
mod pixel_memory;
mod pixel_set;
mod references;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput};
use scene::{Background, Photograph, View, Views};

pub(crate) use packed::PackedPhotograph;
pub(crate) use pixel_memory::{Bytes, PixelMemory};
pub(crate) use pixel_set::PixelSet;
pub(crate) use references::check_references;

/// Message for a pixel file that can't be written.
pub(crate) const NO_SPACE: &str =
    "cannot store pixels in a file next to the output; free space on that disk";

/// Photographs to train on, each with its view.
#[derive(Debug)]
pub(crate) struct Photographs {
    /// Views of the photographs.
    pub(crate) views: Views,
    /// One photograph per view, of its camera's size.
    pub(crate) images: Vec<PackedPhotograph>,
}

impl Photographs {
    /// Reads the first `max_count` photographs of an input and packs each before reading the next.
    pub(crate) fn read(
        input: &GivenInput,
        max_count: usize,
        memory: &mut PixelMemory,
    ) -> anyhow::Result<Self> {
        let mut views = Views::read(input)?;
        views.views.truncate(max_count);
        let images = views
            .views
            .iter()
            .map(|view| pack_photograph(input, view, memory))
            .collect::<anyhow::Result<_>>()?;
        Ok(Self { views, images })
    }

    /// Returns each view with its photograph.
    pub(crate) fn into_pairs(self) -> impl Iterator<Item = (View, PackedPhotograph)> {
        self.views.views.into_iter().zip(self.images)
    }

    /// Composites the photographs over the scene's background unless that is transparent.
    pub(crate) fn over_background(self) -> Self {
        let background = self.views.background;
        if background == Background::Alpha {
            return self;
        }
        let images = self
            .images
            .into_iter()
            .map(|photograph| photograph.over(background.grey_level()))
            .collect();
        Self { images, ..self }
    }
}

#[cfg(test)]
impl Photographs {
    /// Creates a set of one photograph and its camera; `image` is RGB or premultiplied RGBA.
    pub(crate) fn taken_by(camera: scene::Camera, image: pixels::Image) -> Self {
        let views = Views::new(
            Background::White,
            scene::Bounds::default(),
            vec![View::camera_only(camera)],
        );
        let packed = PackedPhotograph::new(&image.into(), &mut PixelMemory::unlimited()).unwrap();
        Self { views, images: vec![packed] }
    }
}

/// Reads the photograph of a view, which must have one.
pub(crate) fn read_photograph(input: &GivenInput, view: &View) -> Result<Photograph, Failure> {
    let folder = input.folder().display();
    let photograph = view.read_photograph(input).bad_input(&folder)?;
    photograph.with_context(|| format!("view {} has no image", view.camera.name)).bad_input(&folder)
}

/// Reads and packs the photograph of a view, which must have the camera's size.
fn pack_photograph(
    input: &GivenInput,
    view: &View,
    memory: &mut PixelMemory,
) -> anyhow::Result<PackedPhotograph> {
    let (name, k) = (&view.camera.name, view.camera.intrinsics);
    let photograph = read_photograph(input, view)?;
    let (width, height) = (photograph.image.width, photograph.image.height);
    if (width, height) != (k.width as usize, k.height as usize) {
        let message = format!(
            "{}: view {name}: the image has {width}×{height} pixels, its camera {}×{}",
            input.folder().display(),
            k.width,
            k.height
        );
        return Err(Failure::BadInput(message).into());
    }
    PackedPhotograph::new(&photograph, memory).context(NO_SPACE)
}
