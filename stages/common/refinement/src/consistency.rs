use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::{DEGRADATION_FILE, Degradation, Filter, Image, Resampling};
use scene::{Camera, Photograph, Views};

use crate::view::Rendered;

/// LR observations by the views' own cameras, those that a field was trained on: refined views are
/// made consistent with them.
pub struct LrObservations<'a> {
    input: &'a GivenInput,
    views: Views,
    filter: Filter,
}

/// LR pixels that the nearest image looks at on each side.
const INVERSE_REACH: usize = 12;

impl<'a> LrObservations<'a> {
    /// Those of a scene's training views, with the kernel that made them.
    pub fn read(input: &'a GivenInput) -> Result<Self, Failure> {
        let degradation: Degradation = input.read_json(DEGRADATION_FILE)?;
        Ok(Self { input, views: Views::read(input)?, filter: degradation.kernel.filter() })
    }

    /// Whether there is one of each of some cameras.
    pub fn are_of_all(&self, cameras: &Views) -> bool {
        cameras.views.iter().all(|view| self.views.taken_by(&view.camera).is_some())
    }

    /// The LR photograph that was taken by a view's own camera, over the background, where there is
    /// one: of that name and pose, and smaller.
    pub fn of(&self, camera: &Camera) -> Result<Option<Photograph>, Failure> {
        let Some(view) = self.views.taken_by(camera) else { return Ok(None) };
        let photograph =
            view.read_photograph(self.input).bad_input(format!("photograph {}", camera.name))?;
        let k = &camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        let is_smaller = |p: &Photograph| p.image.width <= width && p.image.height <= height;
        Ok(photograph.filter(is_smaller).map(|p| p.over(self.views.background.shown())))
    }

    /// A rendered view that is consistent with its own LR observation, where there is one.
    pub fn make_consistent(&self, rendered: Rendered) -> Result<Rendered, Failure> {
        let Some(photograph) = self.of(&rendered.camera)? else { return Ok(rendered) };
        let colours = self.project(&rendered.colours(), &photograph);
        Ok(rendered.with_colours(&colours))
    }

    /// The image nearest to `refined` that the kernel makes `photograph` of: refined +
    /// K⁺(photograph - K·refined), in [0, 1]. Where the photograph was clipped to black or white
    /// and the prediction lies beyond, it says nothing, nor where its mask leaves it out.
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
            let clipped = (y >= 1.0 && *r > 1.0) || (y <= 0.0 && *r < 0.0);
            *r = if clipped { 0.0 } else { y - *r };
        }
        if let Some(mask) = mask {
            let none = Image { data: vec![0.0; residual.data.len()], ..residual.clone() };
            mask.fill(&mut residual, &none);
        }
        let share =
            (refined.width * refined.height) as f32 / (photograph.width * photograph.height) as f32;
        let mut moved = kernel.inverse(INVERSE_REACH).adjoint(&residual);
        for (m, r) in moved.data.iter_mut().zip(&refined.data) {
            *m = (share * *m + r).clamp(0.0, 1.0);
        }
        moved
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn level(hr_width: usize, i: usize, c: usize) -> f32 {
        0.5 + 0.3
            * ((i % hr_width * (c + 3)) as f32 * 0.08).sin()
            * ((i / hr_width) as f32 * 0.21).cos()
    }

    fn error(a: &Image, b: &Image) -> f64 {
        let squares = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b).powi(2));
        (squares.sum::<f64>() / a.data.len() as f64).sqrt()
    }

    #[test]
    fn what_is_consistent_stays_and_what_is_not_is_moved() {
        for (filter, hr_width, lr_width) in
            [(Filter::Lanczos, 48, 24), (Filter::Box, 45, 30), (Filter::Bicubic, 48, 12)]
        {
            let hr_size = (hr_width, hr_width * 2 / 3);
            let lr_size = (lr_width, lr_width * 2 / 3);
            let data = (0..hr_size.0 * hr_size.1)
                .flat_map(|i| [0, 1, 2].map(|c| level(hr_width, i, c)))
                .collect();
            let truth = Image::new(hr_size.0, hr_size.1, 3, data);
            let kernel = Resampling::new(filter, hr_size, lr_size);
            let lr = Photograph::from(kernel.apply(&truth));
            let views = Views::new(scene::Background::White, scene::Bounds::default(), Vec::new());
            let folder = tempfile::tempdir().unwrap();
            let input = GivenInput::open("photographs", folder.path()).unwrap();
            let observations = LrObservations { input: &input, views, filter };
            assert!(error(&observations.project(&truth, &lr), &truth) < 1e-5, "{filter:?}");
            let softer = Image {
                data: truth.data.iter().map(|v| 0.45 + 0.2 * (v - 0.5)).collect(),
                ..truth.clone()
            };
            let projected = observations.project(&softer, &lr);
            let (off, was) = (
                error(&kernel.apply(&projected), &lr.image),
                error(&kernel.apply(&softer), &lr.image),
            );
            assert!(off < 0.1 * was, "{filter:?}: {off} of {was} is left");
            let (off, was) = (error(&projected, &truth), error(&softer, &truth));
            assert!(off < 0.9 * was, "{filter:?}: {off} of {was} is left");
            let none = pixels::Mask {
                width: lr_size.0,
                height: lr_size.1,
                counts: vec![false; lr_size.0 * lr_size.1],
            };
            let lr = Photograph { mask: Some(none), ..lr };
            assert!(
                error(&observations.project(&softer, &lr), &softer) < 1e-7,
                "{filter:?}: what doesn't count moves nothing"
            );
        }
    }
}
