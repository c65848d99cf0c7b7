use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::{DepthMap, Exposure, ExrImage, Image, psnr_of, read_exr};
use scene::{Background, Camera, Photograph, SurfaceMap, View};

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
    /// Camera-space z-depth in scene units, one value per pixel; 0 for views without depth.
    pub depth: Vec<f32>,
    /// Opacity, one value per pixel.
    pub opacity: Vec<f32>,
}

impl Rendered {
    /// Converts a view's image, and composites the colours on the grey level `background`. Fails if
    /// the image's size isn't the camera's, or if colour, opacity or, with `needs_depth`, depth is
    /// missing.
    pub fn new(
        camera: Camera,
        image: &ExrImage,
        background: f32,
        needs_depth: bool,
    ) -> Result<Self, RefinementError> {
        let Some(premultiplied) = image.premultiplied() else {
            let reason = "channels R, G, B and A are expected";
            return Err(RefinementError::view(&camera.name, reason));
        };
        let depth = match image.channel("Z") {
            Some(depth) => depth.to_vec(),
            None if needs_depth => {
                let reason = "the view has no depth, channel Z; render it with render-depth";
                return Err(RefinementError::view(&camera.name, reason));
            }
            None => vec![0.0; image.width * image.height],
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
        let opacity = view.data.chunks_exact(INPUTS).map(|pixel| pixel[OUTPUTS]).collect();
        Ok(Self { opacity, depth, view, camera })
    }

    /// Reads a view's image from an input. Returns the rendered view ([`Rendered::new`]) and the
    /// image; `None` if the view has no image.
    ///
    /// # Errors
    /// [`Failure::BadInput`], with input and view, if the image can't be read or isn't that of a
    /// rendered view.
    pub fn read(
        input: &GivenInput,
        view: &View,
        background: f32,
        needs_depth: bool,
    ) -> Result<Option<(Self, ExrImage)>, Failure> {
        let Some(file) = &view.image else { return Ok(None) };
        let input_name = format!("input {}", input.name());
        let path = input.path(file);
        let image = read_exr(&path)
            .and_then(|image| image.with_finite(&["R", "G", "B", "A", "Z"], &path))
            .bad_input(format!("{input_name}: view {}", view.camera.name))?;
        let rendered = Self::new(view.camera.clone(), &image, background, needs_depth)
            .bad_input(input_name)?;
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

/// Minimum opacity of the pixels that are compared for exposure in front of a background, in view
/// and photograph: the colour of a pixel that shows the background isn't proportional to the
/// exposure. Chosen by hand.
const MIN_EXPOSURE_OPACITY: f32 = 0.98;

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
        check_size(&rendered, &photograph.image)?;
        let Photograph { image: mut truth, mask } = photograph;
        if let Some(mask) = mask {
            mask.fill(&mut truth, &rendered.view);
        }
        Ok(Self { rendered, truth })
    }

    /// Combines a rendered view with its premultiplied photograph, which is corrected to the
    /// exposure of the view: that of the field's training images. The view is composited on the
    /// background. Also returns the photograph's exposure; `None` if the photograph stays
    /// unchanged, because the difference is negligible or can't be estimated.
    pub fn with_equal_exposure(
        rendered: Rendered,
        mut photograph: Photograph,
        background: Background,
    ) -> Result<(Self, Option<Exposure>), RefinementError> {
        check_size(&rendered, &photograph.image)?;
        let exposure = exposure(&rendered.view, &photograph, background)
            .filter(|exposure| !exposure.is_negligible());
        if let Some(exposure) = &exposure {
            exposure.undo(&mut photograph.image);
        }
        let known = Self::new(rendered, photograph.over(background.grey_level()))?;
        Ok((known, exposure))
    }

    /// Returns the PSNR of an image of the view in dB.
    pub fn psnr(&self, image: &Image) -> f64 {
        let samples = image.data.iter().zip(&self.truth.data);
        let squares: f64 = samples.map(|(a, b)| f64::from(a - b).powi(2)).sum();
        psnr_of(squares / self.truth.data.len() as f64)
    }
}

/// Fails if a view and its photograph differ in size.
fn check_size(rendered: &Rendered, image: &Image) -> Result<(), RefinementError> {
    let view = &rendered.view;
    if (view.width, view.height) == (image.width, image.height) {
        return Ok(());
    }
    let reason = format!(
        "{}×{} pixels, but its image has {}×{}; render it for the image's camera",
        view.width, view.height, image.width, image.height
    );
    Err(RefinementError::view(&rendered.camera.name, reason))
}

/// Estimates the exposure of a premultiplied photograph relative to a view, composited on the
/// background, of the same size. Returns `None` if the images determine no exposure.
fn exposure(view: &Image, photograph: &Photograph, background: Background) -> Option<Exposure> {
    let mut image = photograph.clone().over(background.grey_level()).masked_image();
    if background != Background::Opaque {
        let [view_pixels, photograph_pixels] =
            [view, &photograph.image].map(|image| image.data.chunks_exact(INPUTS));
        let pixels = image.data.chunks_exact_mut(OUTPUTS);
        for ((pixel, view), photograph) in pixels.zip(view_pixels).zip(photograph_pixels) {
            if view[OUTPUTS].min(photograph[OUTPUTS]) < MIN_EXPOSURE_OPACITY {
                // The fit ignores pixels without a value.
                pixel.fill(f32::NAN);
            }
        }
    }
    Exposure::fit(view, &image, BLOCK_SIDE)
}

#[cfg(test)]
mod tests {
    use numerics::CounterRng;
    use scene::Intrinsics;

    use super::*;

    const WIDTH: usize = 96;
    const HEIGHT: usize = 64;

    /// Returns a pixel's colour in a pattern of coarse patches.
    fn patch_colour(i: usize) -> [f32; 3] {
        let patch = (i % WIDTH / 12 + i / WIDTH / 12 * 8) as u64;
        [0, 1, 2].map(|c| 0.2 + 0.5 * numerics::uniform(5, c, patch))
    }

    /// Creates a view of patches, composited on a grey background, and its photograph, which
    /// differs by fine detail and an exposure. `opacity` is a pixel's opacity in both.
    fn view(
        [gain, offset, detail]: [f32; 3],
        background: f32,
        opacity: impl Fn(usize) -> f32,
    ) -> (Rendered, Photograph) {
        let camera = Camera {
            name: "patches".into(),
            intrinsics: Intrinsics {
                width: WIDTH as u32,
                height: HEIGHT as u32,
                fx: 96.0,
                fy: 96.0,
                cx: 48.0,
                cy: 32.0,
                distortion: Default::default(),
            },
            camera_to_world: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0]],
        };
        let mut rng = CounterRng::new(1, 2, 3);
        let (mut view, mut photograph) = (Vec::new(), Vec::new());
        let opacity: Vec<f32> = (0..WIDTH * HEIGHT).map(opacity).collect();
        for (i, alpha) in opacity.iter().enumerate() {
            let colour = patch_colour(i);
            view.extend(colour.map(|v| alpha * v + (1.0 - alpha) * background));
            view.push(*alpha);
            photograph.extend(colour.map(|v| {
                alpha * (gain * (v + detail * (rng.uniform() - 0.5)) + offset).clamp(0.0, 1.0)
            }));
            photograph.push(*alpha);
        }
        let view = Image::new(WIDTH, HEIGHT, 4, view);
        let rendered = Rendered { camera, view, depth: vec![2.0; opacity.len()], opacity };
        (rendered, Image::new(WIDTH, HEIGHT, 4, photograph).into())
    }

    /// Returns the mean difference between the images of two photographs.
    fn mean_difference(a: &Image, b: &Image) -> f32 {
        let pairs = a.data.iter().zip(&b.data);
        pairs.map(|(a, b)| (a - b).abs()).sum::<f32>() / a.data.len() as f32
    }

    #[test]
    fn depth_is_required_only_if_needed() {
        let camera = view([1.0, 0.0, 0.0], 0.5, |_| 1.0).0.camera;
        let channels =
            ["A", "B", "G", "R"].map(|name| (name.to_owned(), vec![0.5; WIDTH * HEIGHT]));
        let image = ExrImage { width: WIDTH, height: HEIGHT, channels: channels.into() };
        let error = Rendered::new(camera.clone(), &image, 1.0, true).unwrap_err();
        assert!(error.to_string().contains("no depth"), "{error}");
        let rendered = Rendered::new(camera, &image, 1.0, false).unwrap();
        assert_eq!(
            (rendered.view.data[..4].to_vec(), rendered.opacity[0]),
            (vec![1.0, 1.0, 1.0, 0.5], 0.5)
        );
    }

    #[test]
    fn a_different_exposure_is_estimated_and_removed() {
        let corrected = |exposure: [f32; 3]| {
            let (rendered, photograph) = view(exposure, 0.5, |_| 1.0);
            KnownView::with_equal_exposure(rendered, photograph, Background::Opaque).unwrap()
        };
        // Differences that a field's errors explain aren't corrected.
        for negligible in [[1.0, 0.0, 0.2], [1.05, 0.0, 0.0], [0.95, 0.02, 0.0]] {
            let (known, exposure) = corrected(negligible);
            assert_eq!(exposure, None, "{negligible:?}");
            assert_eq!(known.truth, view(negligible, 0.5, |_| 1.0).1.over(0.5).image);
        }
        let expected = corrected([1.0, 0.0, 0.2]).0.truth;
        for (gain, offset) in [(0.6, 0.0), (0.8, 0.1), (1.2, -0.05)] {
            let (known, exposure) = corrected([gain, offset, 0.2]);
            let exposure = exposure.unwrap();
            assert!(exposure.gain.iter().all(|g| (g / gain - 1.0).abs() < 0.05), "{exposure:?}");
            let offsets = exposure.offset.map(|o| (o - offset).abs());
            assert!(offsets.iter().all(|o| *o < 0.02), "{exposure:?}");
            let difference = mean_difference(&known.truth, &expected);
            assert!(difference < 0.02, "{difference}");
        }
    }

    /// The exposure of an object doesn't depend on its edge, and its correction keeps the
    /// background.
    #[test]
    fn the_background_has_no_exposure() {
        for (background, edge_width) in [Background::White, Background::Black]
            .into_iter()
            .flat_map(|background| [0.0, 1.0, 2.0, 4.0].map(|width| (background, width)))
        {
            let disk = |i: usize| {
                let (x, y) = ((i % WIDTH) as f32 - 47.5, (i / WIDTH) as f32 - 31.5);
                let inside = 28.0 - x.hypot(y);
                (inside / f32::max(edge_width, 1e-3) + 0.5).clamp(0.0, 1.0)
            };
            let grey = background.grey_level();
            let corrected = |gain: f32| {
                let (rendered, photograph) = view([gain, 0.0, 0.0], grey, disk);
                KnownView::with_equal_exposure(rendered, photograph, background).unwrap()
            };
            let (known, exposure) = corrected(1.3);
            let gain = exposure.unwrap().gain;
            assert!(gain.iter().all(|g| (g - 1.3).abs() < 1e-3), "{edge_width}: {gain:?}");
            let (expected, unchanged) = corrected(1.0);
            assert_eq!(unchanged, None, "{edge_width}");
            let difference = mean_difference(&known.truth, &expected.truth);
            assert!(difference < 1e-3, "{edge_width}: {difference}");
        }
    }

    #[test]
    fn no_exposure_is_fitted_to_flat_or_inverted_images() {
        let (rendered, photograph) = view([1.0, 0.0, 0.0], 0.5, |_| 1.0);
        for change in [|_: f32| 1.0, |v: f32| 1.0 - v] {
            let mut changed = photograph.clone();
            for pixel in changed.image.data.chunks_exact_mut(4) {
                pixel[..3].iter_mut().for_each(|v| *v = change(*v));
            }
            assert_eq!(exposure(&rendered.view, &changed, Background::Opaque), None);
        }
    }
}
