use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::{DepthMap, Exposure, ExrImage, Image, read_exr};
use scene::{Camera, Photograph, SurfaceMap, View};

use crate::error::RefinementError;

/// Number of channels of a rendered view: colour and opacity.
pub(crate) const INPUTS: usize = 4;
/// Number of channels of a view with reference features: difference, confidence and detail.
pub(crate) const REFERENCE_INPUTS: usize = 11;
/// Number of channels of an image.
pub(crate) const OUTPUTS: usize = 3;

/// View rendered from a field.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Camera; its intrinsics have the view's size.
    pub camera: Camera,
    /// Colour, composited on the background, and opacity.
    pub view: Image,
    /// Camera-space z-depth in scene units, one value per pixel.
    pub depth: Vec<f32>,
    /// Opacity, one value per pixel.
    pub opacity: Vec<f32>,
}

impl Rendered {
    /// Converts a view's image, composited on a grey background.
    pub fn new(camera: Camera, image: &ExrImage, background: f32) -> Result<Self, RefinementError> {
        let (Some(premultiplied), Some(map)) = (image.premultiplied(), DepthMap::of(image)) else {
            let reason = "channels R, G, B, A and Z are expected";
            return Err(RefinementError::view(&camera.name, reason));
        };
        let k = &camera.intrinsics;
        if (image.width, image.height) != (k.width as usize, k.height as usize) {
            let reason = format!(
                "{}×{} pixels, but its camera has {}×{}",
                image.width, image.height, k.width, k.height
            );
            return Err(RefinementError::view(&camera.name, reason));
        }
        let mut view = premultiplied.clone();
        let composited = premultiplied.over(background);
        for (i, pixel) in view.data.chunks_exact_mut(INPUTS).enumerate() {
            pixel[..OUTPUTS].copy_from_slice(&composited.data[i * OUTPUTS..][..OUTPUTS]);
        }
        Ok(Self { opacity: map.opacity.to_vec(), depth: map.depth.to_vec(), view, camera })
    }

    /// Reads a view of an input, composited on a grey background, together with its file's
    /// channels. Returns `None` if the view has no image.
    ///
    /// # Errors
    /// [`Failure::BadInput`], with input and view, if the image can't be read or isn't that of a
    /// rendered view.
    pub fn read(
        input: &GivenInput,
        view: &View,
        background: f32,
    ) -> Result<Option<(Self, ExrImage)>, Failure> {
        let Some(file) = &view.image else { return Ok(None) };
        let input_name = format!("input {}", input.name());
        let path = input.path(file);
        let image = read_exr(&path)
            .and_then(|image| image.with_finite(&["R", "G", "B", "A", "Z"], &path))
            .bad_input(format!("{input_name}: view {}", view.camera.name))?;
        let rendered = Self::new(view.camera.clone(), &image, background).bad_input(input_name)?;
        Ok(Some((rendered, image)))
    }

    /// Returns the colours, without opacity.
    pub fn colours(&self) -> Image {
        let colours = self.view.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]);
        Image::new(self.view.width, self.view.height, 3, colours.collect())
    }

    /// Replaces the colours.
    ///
    /// # Panics
    /// If `colours` has another size than the view.
    #[must_use]
    pub fn with_colours(mut self, colours: &Image) -> Self {
        assert_eq!(
            (colours.width, colours.height),
            (self.view.width, self.view.height),
            "colours have the view's size"
        );
        for (i, pixel) in self.view.data.chunks_exact_mut(INPUTS).enumerate() {
            pixel[..OUTPUTS].copy_from_slice(&colours.data[i * OUTPUTS..][..OUTPUTS]);
        }
        self
    }

    /// Returns the surfaces that the view's depth describes.
    pub fn surface(&self) -> SurfaceMap<'_> {
        let map = DepthMap { depth: &self.depth, opacity: &self.opacity };
        SurfaceMap { camera: &self.camera, map }
    }
}

/// Side in pixels of the blocks whose means are compared for exposure. In block means, missing
/// detail averages out (design note 018).
const BLOCK_SIDE: usize = 8;

/// Rendered view with its ground truth: a training example, or a reference for other views.
#[derive(Clone, Debug)]
pub struct KnownView {
    /// The view as rendered.
    pub rendered: Rendered,
    /// Ground truth of the view's size, composited on the background. Masked pixels have the
    /// rendered colour.
    pub truth: Image,
}

impl KnownView {
    /// Combines a rendered view with its photograph, composited on the same background. Masked
    /// pixels of the photograph get the rendered colour, so that view and photograph are equal
    /// there.
    pub fn new(rendered: Rendered, photograph: Photograph) -> Result<Self, RefinementError> {
        let view = &rendered.view;
        let Photograph { image: mut truth, mask } = photograph;
        if (view.width, view.height) != (truth.width, truth.height) {
            let reason = format!(
                "{}×{} pixels, but its image has {}×{}; render it for the image's camera",
                view.width, view.height, truth.width, truth.height
            );
            return Err(RefinementError::view(&rendered.camera.name, reason));
        }
        if let Some(mask) = mask {
            mask.fill(&mut truth, view);
        }
        Ok(Self { rendered, truth })
    }

    /// Estimates the exposure of the ground truth relative to the rendered view, which has the
    /// exposure of the field's training images. Returns `None` if the images determine no exposure.
    pub fn exposure(&self) -> Option<Exposure> {
        Exposure::fit(&self.rendered.view, &self.truth, BLOCK_SIDE)
    }

    /// Corrects the ground truth to the exposure of the rendered view.
    #[must_use]
    pub fn with_corrected_exposure(mut self, exposure: &Exposure) -> Self {
        exposure.undo(&mut self.truth);
        self
    }
}

#[cfg(test)]
mod tests {
    use numerics::CounterRng;
    use scene::Intrinsics;

    use super::*;

    /// Creates a view of coarse patches, and a ground truth that differs from the view by fine
    /// detail and an exposure.
    fn view(gain: f32, offset: f32) -> KnownView {
        let (width, height) = (96, 64);
        let camera = Camera {
            name: "patches".into(),
            intrinsics: Intrinsics {
                width: 96,
                height: 64,
                fx: 96.0,
                fy: 96.0,
                cx: 48.0,
                cy: 32.0,
                distortion: Default::default(),
            },
            camera_to_world: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]],
        };
        let mut rng = CounterRng::new(1, 2, 3);
        let (mut view, mut truth) = (Vec::new(), Vec::new());
        for i in 0..width * height {
            let patch = (i % width / 12 + i / width / 12 * 8) as u64;
            let colour = [0, 1, 2].map(|c| 0.2 + 0.5 * numerics::uniform(5, c, patch));
            view.extend(colour);
            view.push(1.0);
            truth.extend(
                colour.map(|v| (gain * (v + 0.2 * (rng.uniform() - 0.5)) + offset).clamp(0.0, 1.0)),
            );
        }
        let count = width * height;
        let view = Image::new(width, height, 4, view);
        let rendered =
            Rendered { camera, view, depth: vec![2.0; count], opacity: vec![1.0; count] };
        KnownView { rendered, truth: Image::new(width, height, 3, truth) }
    }

    #[test]
    fn a_different_exposure_is_estimated_and_removed() {
        assert!(view(1.0, 0.0).exposure().unwrap().is_negligible());
        for (gain, offset) in [(0.6, 0.0), (0.8, 0.1), (1.2, -0.05)] {
            let exposed = view(gain, offset);
            let exposure = exposed.exposure().unwrap();
            assert!(
                !exposure.is_negligible()
                    && exposure.gain.iter().all(|g| (g / gain - 1.0).abs() < 0.05),
                "{exposure:?}"
            );
            let offsets = exposure.offset.map(|o| (o - offset).abs());
            assert!(offsets.iter().all(|o| *o < 0.02), "{exposure:?}");
            let (reference, corrected) =
                (view(1.0, 0.0), exposed.with_corrected_exposure(&exposure));
            let pairs = || reference.truth.data.iter().zip(&corrected.truth.data);
            let mean = pairs().map(|(a, b)| (a - b).abs()).sum::<f32>() / pairs().count() as f32;
            assert!(mean < 0.02, "{mean}");
        }
    }

    #[test]
    fn no_exposure_is_fitted_to_flat_or_inverted_images() {
        let mut flat = view(1.0, 0.0);
        flat.truth.data.fill(1.0);
        assert_eq!(flat.exposure(), None);
        let mut negative = view(1.0, 0.0);
        negative.truth.data.iter_mut().for_each(|v| *v = 1.0 - *v);
        assert_eq!(negative.exposure(), None);
    }
}
