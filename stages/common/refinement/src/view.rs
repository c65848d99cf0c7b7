use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::{DepthMap, Exposure, ExrImage, Image, read_exr};
use scene::{Camera, Photograph, Surface, View};

use crate::error::RefinementError;

/// A view as a field rendered it.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Where from; its intrinsics have the view's size.
    pub camera: Camera,
    /// Colour, on the background that is shown, and opacity.
    pub view: Image,
    /// Camera-space z-depth in scene units, a number a pixel.
    pub depth: Vec<f32>,
    /// Opacity, a number a pixel.
    pub opacity: Vec<f32>,
}

impl Rendered {
    /// From a view's file, over a grey level.
    pub fn new(camera: Camera, image: &ExrImage, background: f32) -> Result<Self, RefinementError> {
        let refuse =
            |reason: String| Err(RefinementError::View { name: camera.name.clone(), reason });
        let (Some(premultiplied), Some(map)) = (image.premultiplied(), DepthMap::of(image)) else {
            return refuse("channels R, G, B, A and Z are expected".to_owned());
        };
        let k = &camera.intrinsics;
        if (image.width, image.height) != (k.width as usize, k.height as usize) {
            let (width, height) = (image.width, image.height);
            return refuse(format!(
                "{width}×{height} pixels where its camera has {}×{}",
                k.width, k.height
            ));
        }
        let over = premultiplied.over(background);
        let pixels = over
            .data
            .chunks_exact(3)
            .zip(premultiplied.data.chunks_exact(4))
            .flat_map(|(c, p)| [c[0], c[1], c[2], p[3]]);
        let view = Image::new(image.width, image.height, 4, pixels.collect());
        Ok(Self { opacity: map.opacity.to_vec(), depth: map.depth.to_vec(), view, camera })
    }

    /// A view of an input over a grey level, and its file's channels. None where it has no image.
    ///
    /// # Errors
    /// [`Failure::BadInput`], with input and view, where its image can't be read or isn't a
    /// rendered view's.
    pub fn read(
        input: &GivenInput,
        view: &View,
        background: f32,
    ) -> Result<Option<(Self, ExrImage)>, Failure> {
        let Some(file) = &view.image else { return Ok(None) };
        let place = format!("input {}", input.name());
        let path = input.path(file);
        let image = read_exr(&path)
            .and_then(|image| image.with_finite(&["R", "G", "B", "A", "Z"], &path))
            .bad_input(format!("{place}: view {}", view.camera.name))?;
        let rendered = Self::new(view.camera.clone(), &image, background).bad_input(place)?;
        Ok(Some((rendered, image)))
    }

    /// Its colours alone.
    pub fn colours(&self) -> Image {
        let colours = self.view.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]);
        Image::new(self.view.width, self.view.height, 3, colours.collect())
    }

    /// The same view with other colours.
    ///
    /// # Panics
    /// Where they aren't of its size.
    #[must_use]
    pub fn with_colours(mut self, colours: &Image) -> Self {
        assert_eq!(
            (colours.width, colours.height),
            (self.view.width, self.view.height),
            "colours of its size"
        );
        for (pixel, colour) in self.view.data.chunks_exact_mut(4).zip(colours.data.chunks_exact(3))
        {
            pixel[..3].copy_from_slice(colour);
        }
        self
    }

    /// Where the field sees surfaces.
    pub fn surface(&self) -> Surface<'_> {
        let map = DepthMap { depth: &self.depth, opacity: &self.opacity };
        Surface { camera: &self.camera, map }
    }
}

/// A rendered view whose true image is known: an example to learn from, or a reference for other
/// views.
#[derive(Clone, Debug)]
pub struct KnownView {
    /// As rendered.
    pub rendered: Rendered,
    /// Colour, on the background that is shown; of the view's size. What is rendered, where nothing
    /// is known.
    pub truth: Image,
}

impl KnownView {
    /// A rendered view with its photograph, over the same background. Where that doesn't count it
    /// is taken for what is rendered, and so says nothing.
    pub fn new(rendered: Rendered, photograph: Photograph) -> Result<Self, RefinementError> {
        let (view, name, Photograph { image: mut truth, mask }) =
            (&rendered.view, &rendered.camera.name, photograph);
        if (view.width, view.height) != (truth.width, truth.height) {
            let reason = format!(
                "{}×{} pixels where its image has {}×{}; render it for the image's camera",
                view.width, view.height, truth.width, truth.height
            );
            return Err(RefinementError::View { name: name.clone(), reason });
        }
        mask.iter().for_each(|mask| mask.fill(&mut truth, view));
        Ok(Self { rendered, truth })
    }
}

/// Pixels along the sides of blocks whose means are compared: in those, what a field lacks in
/// detail evens out.
const BLOCK_SIDE: usize = 8;

impl KnownView {
    /// The exposure of the true image against the rendered view, which has the exposure of the
    /// images that the field learnt from. None where too little says what it is.
    pub fn exposure(&self) -> Option<Exposure> {
        Exposure::between(&self.rendered.view, &self.truth, BLOCK_SIDE)
    }

    /// The same view with a true image as the rendered one's exposure would have made it.
    #[must_use]
    pub fn without(mut self, exposure: &Exposure) -> Self {
        exposure.take_back(&mut self.truth);
        self
    }
}

#[cfg(test)]
mod tests {
    use counter_rng::CounterRng;
    use scene::Intrinsics;

    use super::*;

    /// A view of coarse patches, and an image that differs from it by fine detail and an exposure.
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
            let colour = [0, 1, 2].map(|c| 0.2 + 0.5 * counter_rng::uniform(5, c, patch));
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
    fn another_exposure_is_found_and_taken_away() {
        assert!(view(1.0, 0.0).exposure().unwrap().is_none());
        for (gain, offset) in [(0.6, 0.0), (0.8, 0.1), (1.2, -0.05)] {
            let dark = view(gain, offset);
            let exposure = dark.exposure().unwrap();
            assert!(
                !exposure.is_none() && exposure.gain.iter().all(|g| (g / gain - 1.0).abs() < 0.05),
                "{exposure:?}"
            );
            let offsets = exposure.offset.map(|o| (o - offset).abs());
            assert!(offsets.iter().all(|o| *o < 0.02), "{exposure:?}");
            let (same, again) = (view(1.0, 0.0), dark.without(&exposure));
            let pairs = || same.truth.data.iter().zip(&again.truth.data);
            let mean = pairs().map(|(a, b)| (a - b).abs()).sum::<f32>() / pairs().count() as f32;
            assert!(mean < 0.02, "{mean}");
        }
    }

    #[test]
    fn what_is_no_exposure_is_none() {
        let mut flat = view(1.0, 0.0);
        flat.truth.data.fill(1.0);
        assert_eq!(flat.exposure(), None);
        let mut negative = view(1.0, 0.0);
        negative.truth.data.iter_mut().for_each(|v| *v = 1.0 - *v);
        assert_eq!(negative.exposure(), None);
    }
}
