use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::{DEGRADATION_FILE, Degradation, Filter, Image, Resampling};
use scene::{Camera, Photograph, Views};

use crate::view::Rendered;

/// LR photographs of the cameras that a field was trained on; refined views of these cameras are
/// made consistent with them.
pub struct LrObservations<'a> {
    input: &'a GivenInput,
    views: Views,
    filter: Filter,
}

/// Support of the kernel's pseudo-inverse on each side, in LR pixels; chosen by hand.
const INVERSE_RADIUS_LR_PIXELS: usize = 12;

impl<'a> LrObservations<'a> {
    /// Opens a scene's training views and reads the kernel that degraded them.
    pub fn read(input: &'a GivenInput) -> Result<Self, Failure> {
        let degradation: Degradation = input.read_json(DEGRADATION_FILE)?;
        Ok(Self { input, views: Views::read(input)?, filter: degradation.kernel.filter() })
    }

    /// Returns whether the camera of each view has a photograph.
    pub fn covers(&self, views: &Views) -> bool {
        views
            .views
            .iter()
            .all(|view| self.views.taken_by(&view.camera).is_some_and(|own| own.image.is_some()))
    }

    /// Reads the LR photograph of a camera, composited on the background. The photograph has the
    /// camera's name and pose, and at most its size; `None` if there is no such photograph.
    pub fn photograph(&self, camera: &Camera) -> Result<Option<Photograph>, Failure> {
        let Some(view) = self.views.taken_by(camera) else { return Ok(None) };
        let photograph =
            view.read_photograph(self.input).bad_input(format!("photograph {}", camera.name))?;
        let k = &camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        Ok(photograph
            .filter(|p| p.image.width <= width && p.image.height <= height)
            .map(|p| p.over(self.views.background.grey_level())))
    }

    /// Makes a rendered view consistent with its own LR photograph, if there is one.
    pub fn make_consistent(&self, rendered: Rendered) -> Result<Rendered, Failure> {
        let Some(photograph) = self.photograph(&rendered.camera)? else { return Ok(rendered) };
        let colours = self.project(&rendered.colours(), &photograph);
        Ok(rendered.with_colours(&colours))
    }

    /// Returns the image nearest to `refined` that the kernel K degrades to `photograph`: refined +
    /// K⁺(photograph - K·refined), clamped to [0, 1]. The residual is 0 where the photograph is
    /// clipped to black or white and K·refined lies beyond, and where the photograph is masked
    /// (design note 016).
    pub fn project(
        &self,
        refined: &Image,
        Photograph { image: photograph, mask }: &Photograph,
    ) -> Image {
        let kernel = Resampling::new(
            self.filter,
            (refined.width, refined.height),
            (photograph.width, photograph.height),
        );
        let mut residual = kernel.apply(refined);
        for (r, &y) in residual.data.iter_mut().zip(&photograph.data) {
            let is_clipped = (y >= 1.0 && *r > 1.0) || (y <= 0.0 && *r < 0.0);
            *r = if is_clipped { 0.0 } else { y - *r };
        }
        if let Some(mask) = mask {
            let zeros = Image { data: vec![0.0; residual.data.len()], ..residual.clone() };
            mask.fill(&mut residual, &zeros);
        }
        // K⁺ = s·Pᵀ along each axis, with P of `AxisTaps::inverse` and s HR pixels per LR pixel.
        // This is the product of both axes' s.
        let pixels_per_lr_pixel =
            (refined.width * refined.height) as f32 / (photograph.width * photograph.height) as f32;
        let mut projected = kernel.inverse(INVERSE_RADIUS_LR_PIXELS).adjoint(&residual);
        for (projected, refined) in projected.data.iter_mut().zip(&refined.data) {
            *projected = (pixels_per_lr_pixel * *projected + refined).clamp(0.0, 1.0);
        }
        projected
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns channel `c` of pixel `i` in a smooth HR image.
    fn sample(hr_width: usize, i: usize, c: usize) -> f32 {
        0.5 + 0.3
            * ((i % hr_width * (c + 3)) as f32 * 0.08).sin()
            * ((i / hr_width) as f32 * 0.21).cos()
    }

    fn rms_error(a: &Image, b: &Image) -> f64 {
        let squares = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b).powi(2));
        (squares.sum::<f64>() / a.data.len() as f64).sqrt()
    }

    #[test]
    fn consistent_views_stay_and_others_are_corrected() {
        for (filter, hr_width, lr_width) in
            [(Filter::Lanczos, 48, 24), (Filter::Box, 45, 30), (Filter::Bicubic, 48, 12)]
        {
            let hr_size = (hr_width, hr_width * 2 / 3);
            let lr_size = (lr_width, lr_width * 2 / 3);
            let data = (0..hr_size.0 * hr_size.1)
                .flat_map(|i| [0, 1, 2].map(|c| sample(hr_width, i, c)))
                .collect();
            let truth = Image::new(hr_size.0, hr_size.1, 3, data);
            let kernel = Resampling::new(filter, hr_size, lr_size);
            let lr = Photograph::from(kernel.apply(&truth));
            let views = Views::new(scene::Background::White, scene::Bounds::default(), Vec::new());
            let folder = tempfile::tempdir().unwrap();
            let input = GivenInput::open("photographs", folder.path()).unwrap();
            let observations = LrObservations { input: &input, views, filter };
            assert!(rms_error(&observations.project(&truth, &lr), &truth) < 1e-5, "{filter:?}");
            let low_contrast = Image {
                data: truth.data.iter().map(|v| 0.45 + 0.2 * (v - 0.5)).collect(),
                ..truth.clone()
            };
            let projected = observations.project(&low_contrast, &lr);
            let (after, before) = (
                rms_error(&kernel.apply(&projected), &lr.image),
                rms_error(&kernel.apply(&low_contrast), &lr.image),
            );
            assert!(after < 0.1 * before, "{filter:?}: error {before} before, {after} after");
            let (after, before) = (rms_error(&projected, &truth), rms_error(&low_contrast, &truth));
            assert!(after < 0.9 * before, "{filter:?}: error {before} before, {after} after");
            let empty_mask = pixels::Mask {
                width: lr_size.0,
                height: lr_size.1,
                counts: vec![false; lr_size.0 * lr_size.1],
            };
            let lr = Photograph { mask: Some(empty_mask), ..lr };
            assert!(
                rms_error(&observations.project(&low_contrast, &lr), &low_contrast) < 1e-7,
                "{filter:?}: masked pixels change nothing"
            );
        }
    }
}
