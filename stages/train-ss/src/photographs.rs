use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput};
use scene::{Background, View, Views};

use crate::packed::{PackedPhotograph, PixelMemory};

/// Photographs to train on, each with its view.
#[derive(Debug)]
pub(crate) struct Photographs {
    /// Where they were taken from.
    pub(crate) views: Views,
    /// One for each view, of its camera's size.
    pub(crate) images: Vec<PackedPhotograph>,
}

impl Photographs {
    /// Reads the first photographs of an input, at most so many, and packs each at once.
    pub(crate) fn read(
        input: &GivenInput,
        most: usize,
        memory: &mut PixelMemory,
    ) -> anyhow::Result<Self> {
        let mut views = Views::read(input)?;
        views.views.truncate(most);
        let images = views
            .views
            .iter()
            .map(|view| read(input, view, memory))
            .collect::<anyhow::Result<_>>()?;
        Ok(Self { views, images })
    }

    /// Over the background, but where that is open.
    pub(crate) fn over_background(self) -> Self {
        let background = self.views.background;
        if background == Background::Alpha {
            return self;
        }
        let images =
            self.images.into_iter().map(|photograph| photograph.over(background.shown())).collect();
        Self { images, ..self }
    }
}

#[cfg(test)]
impl Photographs {
    /// An image that a camera took, RGB or premultiplied RGBA.
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

fn read(
    input: &GivenInput,
    view: &View,
    memory: &mut PixelMemory,
) -> anyhow::Result<PackedPhotograph> {
    let (name, k) = (&view.camera.name, view.camera.intrinsics);
    let place = input.folder().display();
    let photograph = view.read_photograph(input).bad_input(&place)?;
    let photograph =
        photograph.with_context(|| format!("view {name}: it has no image")).bad_input(&place)?;
    let (width, height) = (photograph.image.width, photograph.image.height);
    if (width, height) != (k.width as usize, k.height as usize) {
        let message = format!(
            "{place}: view {name}: {width}×{height} pixels where its camera has {}×{}",
            k.width, k.height
        );
        return Err(Failure::BadInput(message).into());
    }
    PackedPhotograph::new(&photograph, memory).context(NO_PLACE)
}

/// What to say where pixels can't be written to their file.
pub(crate) const NO_PLACE: &str =
    "cannot keep pixels in a file beside the output; make place on that disk";
