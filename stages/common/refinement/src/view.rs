use pixels::{ExrImage, Picture};
use scene::{Camera, Surface};

use crate::RefinementError;

/// A view as a field rendered it.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Where from; its intrinsics have the view's size.
    pub camera: Camera,
    /// Colour, on the background that is shown, and opacity.
    pub view: Picture,
    /// Camera-space z-depth in scene units, a number a pixel.
    pub depth: Vec<f32>,
    /// Opacity, a number a pixel.
    pub opacity: Vec<f32>,
}

impl Rendered {
    /// From a view's file, over a grey level.
    pub fn new(camera: Camera, image: &ExrImage, background: f32) -> Result<Self, RefinementError> {
        let refuse = |reason: String| Err(RefinementError::View { name: camera.name.clone(), reason });
        let (Some(picture), Some(depth)) = (image.premultiplied(), image.channel("Z")) else {
            return refuse("channels R, G, B, A and Z are expected".to_owned());
        };
        let k = &camera.intrinsics;
        if (image.width, image.height) != (k.width as usize, k.height as usize) {
            let (width, height) = (image.width, image.height);
            return refuse(format!("{width}×{height} pixels where its camera has {}×{}", k.width, k.height));
        }
        let over = picture.over(background);
        let pixels = over.data.chunks_exact(3).zip(picture.data.chunks_exact(4)).flat_map(|(c, p)| [c[0], c[1], c[2], p[3]]);
        let view = Picture::new(image.width, image.height, 4, pixels.collect());
        Ok(Self { opacity: picture.channel(3), depth: depth.to_vec(), view, camera })
    }

    /// Where the field sees surfaces.
    pub fn surface(&self) -> Surface<'_> {
        Surface { camera: &self.camera, depth: &self.depth, opacity: &self.opacity }
    }
}

/// A rendered view whose true picture is known: an example to learn from, or a reference for other views.
#[derive(Clone, Debug)]
pub struct KnownView {
    /// As rendered.
    pub rendered: Rendered,
    /// Colour, on the background that is shown; of the view's size.
    pub truth: Picture,
}

impl KnownView {
    /// A rendered view with its picture.
    pub fn new(rendered: Rendered, truth: Picture) -> Result<Self, RefinementError> {
        let (view, name) = (&rendered.view, &rendered.camera.name);
        if (view.width, view.height) != (truth.width, truth.height) {
            let reason = format!(
                "{}×{} pixels where its picture has {}×{}; render it for the picture's camera",
                view.width, view.height, truth.width, truth.height
            );
            return Err(RefinementError::View { name: name.clone(), reason });
        }
        Ok(Self { rendered, truth })
    }
}
