use pixels::{Filter, Image, Resampling};
use radiance::Ray;
use scene::{Camera, CameraRay};

/// Photograph at several sizes.
#[derive(Clone, Debug)]
pub struct Pyramid {
    pub(crate) levels: Vec<PyramidLevel>,
}

#[derive(Clone, Debug)]
pub(crate) struct PyramidLevel {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) pixels: Vec<InformativePixel>,
}

/// Pixel with an image gradient, which constrains the camera's pose.
#[derive(Clone, Copy, Debug)]
pub(crate) struct InformativePixel {
    pub(crate) x: usize,
    pub(crate) y: usize,
    pub(crate) colour: [f32; 3],
    /// Change of each channel per pixel to the right, and per pixel down.
    pub(crate) gradient: [[f32; 2]; 3],
}

impl InformativePixel {
    /// Returns the position of the pixel's centre in the image.
    pub(crate) fn centre(&self) -> [f64; 2] {
        [self.x as f64 + 0.5, self.y as f64 + 0.5]
    }
}

/// Minimum width and height of a smaller level, in pixels. With 13 pixels, a field after few rays
/// turned cameras by several degrees (docs/design/025).
const MIN_LEVEL_SIDE: usize = 16;
/// Maximum number of pixels rendered per level, spread evenly over the informative ones; chosen by
/// hand.
const MAX_LEVEL_PIXELS: usize = 4096;
/// Minimum gradient of an informative pixel in some channel, per pixel; chosen by hand.
const MIN_GRADIENT: f32 = 3.0 / 255.0;

impl Pyramid {
    /// Creates the pyramid of an RGB image over its background, NaN in pixels that don't count. The
    /// image is followed by at most `smaller` levels, each half as wide as the one before.
    ///
    /// # Panics
    /// If the image doesn't have three channels.
    pub fn new(photograph: &Image, smaller: u32) -> Self {
        assert_eq!(photograph.channels, 3, "number of channels of a photograph");
        let size = (photograph.width, photograph.height);
        let mut levels = Vec::new();
        for level in 0..=smaller {
            let [width, height] = [size.0, size.1].map(|n| n.div_ceil(1 << level));
            if level > 0 && width.min(height) < MIN_LEVEL_SIDE {
                break;
            }
            let shrink = Resampling::new(Filter::Box, size, (width, height));
            levels.push(PyramidLevel::new(&shrink.apply(photograph)));
        }
        Self { levels }
    }

    /// True if the image itself has a pixel that constrains a pose.
    pub fn is_informative(&self) -> bool {
        self.levels.first().is_some_and(|level| !level.pixels.is_empty())
    }

    /// Returns the number of levels smaller than the image itself.
    pub fn smaller_levels(&self) -> u32 {
        self.levels.len() as u32 - 1
    }
}

impl PyramidLevel {
    pub(crate) fn new(image: &Image) -> Self {
        let (width, height) = (image.width, image.height);
        let mut pixels = Vec::new();
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                pixels.extend(informative_pixel(image, x, y));
            }
        }
        let stride = pixels.len().div_ceil(MAX_LEVEL_PIXELS).max(1);
        Self { width, height, pixels: pixels.into_iter().step_by(stride).collect() }
    }
}

/// Returns the rays through the centres of a camera's pixels, without and with a grey background.
pub(crate) fn pixel_rays(
    camera: &Camera,
    pixels: &[InformativePixel],
    background: f32,
) -> (Vec<CameraRay>, Vec<Ray>) {
    let rays = pixels.iter().map(|pixel| {
        let [x, y] = pixel.centre();
        let ray = camera.ray(x, y);
        (ray, Ray::new(&ray, [background; 3]))
    });
    rays.unzip()
}

/// Returns a pixel that is not on the border if its neighbourhood is known and has a gradient.
fn informative_pixel(image: &Image, x: usize, y: usize) -> Option<InformativePixel> {
    let [centre, left, right, up, down] = [(x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)]
        .map(|(x, y)| [0, 1, 2].map(|c| image.data[(y * image.width + x) * 3 + c]));
    let gradient = [0, 1, 2].map(|c| [0.5 * (right[c] - left[c]), 0.5 * (down[c] - up[c])]);
    let numbers = gradient.as_flattened();
    let is_known = numbers.iter().chain(&centre).all(|v| v.is_finite());
    (is_known && numbers.iter().any(|g| g.abs() > MIN_GRADIENT)).then_some(InformativePixel {
        x,
        y,
        colour: centre,
        gradient,
    })
}
