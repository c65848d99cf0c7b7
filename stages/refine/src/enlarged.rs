use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::Image;
use scene::{Camera, Photograph, Views};

/// Photographs enlarged by a method that looks at each alone.
pub(crate) struct Enlarged<'a> {
    input: &'a GivenInput,
    views: Views,
}

impl<'a> Enlarged<'a> {
    pub(crate) fn read(input: &'a GivenInput) -> anyhow::Result<Self> {
        Ok(Self { input, views: Views::read(input)? })
    }

    /// Whether there is one of a camera.
    pub(crate) fn has(&self, camera: &Camera) -> bool {
        self.views.taken_by(camera).is_some()
    }

    /// The mean of an image and what was made of the same camera's photograph, where its mask
    /// leaves it; the image where there is none.
    pub(crate) fn mean(&self, mut image: Image, camera: &Camera) -> anyhow::Result<Image> {
        let Some(view) = self.views.taken_by(camera) else { return Ok(image) };
        let place = || format!("input enlarged: view {}", camera.name);
        let Some(photograph) = view.read_photograph(self.input).bad_input(place())? else {
            return Ok(image);
        };
        let Photograph { image: mut other, mask } = photograph.over(self.views.background.shown());
        if (other.width, other.height) != (image.width, image.height) {
            let sizes = format!(
                "{}×{} pixels where the view to refine has {}×{}",
                other.width, other.height, image.width, image.height
            );
            return Err(Failure::BadInput(format!("{}: {sizes}", place())).into());
        }
        if let Some(mask) = mask {
            mask.fill(&mut other, &image);
        }
        image.data.iter_mut().zip(&other.data).for_each(|(v, other)| *v = 0.5 * (*v + other));
        Ok(image)
    }
}
