use artifact::{FailureExt as _, GivenInput};
use pixels::{DEGRADATION_FILE, Degradation, Filter, Picture, Resampling};
use scene::{Camera, Photograph, Views};

use crate::Rendered;

/// LR photographs that some of the views' own cameras took: those that a field was trained on.
pub struct OwnPhotographs<'a> {
    input: &'a GivenInput,
    views: Views,
    filter: Filter,
}

/// LR pixels that the nearest picture looks at on each side.
const REACH: usize = 12;

impl<'a> OwnPhotographs<'a> {
    /// Those of a scene's training views, with the kernel that made them.
    pub fn read(input: &'a GivenInput) -> anyhow::Result<Self> {
        let degradation: Degradation = input.read_json(DEGRADATION_FILE)?;
        Ok(Self { input, views: Views::read(input)?, filter: degradation.kernel.filter() })
    }

    /// Whether each of some cameras took one.
    pub fn are_of_all(&self, cameras: &Views) -> bool {
        cameras.views.iter().all(|view| self.views.taken_by(&view.camera).is_some())
    }

    /// The LR photograph that was taken by a view's own camera, over the background, where there is one: of that name and pose, and smaller.
    pub fn of(&self, camera: &Camera) -> anyhow::Result<Option<Photograph>> {
        let Some(view) = self.views.taken_by(camera) else { return Ok(None) };
        let photograph = view.read_photograph(self.input).bad_input(format!("photograph {}", camera.name))?;
        let k = &camera.intrinsics;
        let is_smaller = |p: &Photograph| p.picture.width <= k.width as usize && p.picture.height <= k.height as usize;
        Ok(photograph.filter(is_smaller).map(|p| p.over(self.views.background.shown())))
    }

    /// A rendered view that agrees with its own photograph, where there is one.
    pub fn agreeing(&self, rendered: Rendered) -> anyhow::Result<Rendered> {
        let Some(photograph) = self.of(&rendered.camera)? else { return Ok(rendered) };
        let colours = self.agree(&rendered.colours(), &photograph);
        Ok(rendered.with_colours(&colours))
    }

    /// The picture nearest to `refined` that the kernel makes `photograph` of: refined + K⁺(photograph - K·refined), in [0, 1]. Where the
    /// photograph was clipped to black or white and the prediction lies beyond, it says nothing, nor where its mask leaves it out.
    pub fn agree(&self, refined: &Picture, Photograph { picture: photograph, mask }: &Photograph) -> Picture {
        let kernel = Resampling::new(self.filter, (refined.width, refined.height), (photograph.width, photograph.height));
        let mut residual = kernel.apply(refined);
        for (r, &y) in residual.data.iter_mut().zip(&photograph.data) {
            let clipped = (y >= 1.0 && *r > 1.0) || (y <= 0.0 && *r < 0.0);
            *r = if clipped { 0.0 } else { y - *r };
        }
        if let Some(mask) = mask {
            let none = Picture { data: vec![0.0; residual.data.len()], ..residual.clone() };
            mask.fill(&mut residual, &none);
        }
        let share = (refined.width * refined.height) as f32 / (photograph.width * photograph.height) as f32;
        let mut moved = kernel.inverse(REACH).adjoint(&residual);
        for (m, r) in moved.data.iter_mut().zip(&refined.data) {
            *m = (share * *m + r).clamp(0.0, 1.0);
        }
        moved
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_agrees_stays_and_what_does_not_is_moved_to_agree() {
        for (filter, wide, narrow) in [(Filter::Lanczos, 48, 24), (Filter::Box, 45, 30), (Filter::Bicubic, 48, 12)] {
            let size = (wide, wide * 2 / 3);
            let low_size = (narrow, narrow * 2 / 3);
            let level =
                |i: usize, c: usize| 0.5 + 0.3 * ((i % wide * (c + 3)) as f32 * 0.08).sin() * ((i / wide) as f32 * 0.21).cos();
            let data = (0..size.0 * size.1).flat_map(|i| [0, 1, 2].map(|c| level(i, c))).collect();
            let truth = Picture::new(size.0, size.1, 3, data);
            let kernel = Resampling::new(filter, size, low_size);
            let low = Photograph::from(kernel.apply(&truth));
            let views = Views::new(scene::Background::White, scene::Bounds::default(), Vec::new());
            let folder = tempfile::tempdir().unwrap();
            let input = GivenInput::open("photographs", folder.path()).unwrap();
            let photographs = OwnPhotographs { input: &input, views, filter };
            let error = |a: &Picture, b: &Picture| {
                let squares = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b).powi(2));
                (squares.sum::<f64>() / a.data.len() as f64).sqrt()
            };
            assert!(error(&photographs.agree(&truth, &low), &truth) < 1e-5, "{filter:?}");
            let softer = Picture { data: truth.data.iter().map(|v| 0.45 + 0.2 * (v - 0.5)).collect(), ..truth.clone() };
            let agreed = photographs.agree(&softer, &low);
            let (off, was) = (error(&kernel.apply(&agreed), &low.picture), error(&kernel.apply(&softer), &low.picture));
            assert!(off < 0.1 * was, "{filter:?}: {off} of {was} is left");
            let (off, was) = (error(&agreed, &truth), error(&softer, &truth));
            assert!(off < 0.9 * was, "{filter:?}: {off} of {was} is left");
            let none = pixels::Mask { width: low_size.0, height: low_size.1, counts: vec![false; low_size.0 * low_size.1] };
            let low = Photograph { mask: Some(none), ..low };
            assert!(error(&photographs.agree(&softer, &low), &softer) < 1e-7, "{filter:?}: what doesn't count moves nothing");
        }
    }
}
