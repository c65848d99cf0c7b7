//! Supervision of a training: the rays that are cast, and the loss between their colours and the
//! photographs.

mod assembly;
mod memory;
mod options;
mod pixel_sampler;
mod residual;
mod setup;

use std::io;

use numerics::CounterRng;
use pixels::to_u8;
use poses::MeanMotion;
use radiance::{PhaseClock, Ray, RayField, RenderedBundles};
use rayon::prelude::*;
use scene::{Background, Camera, CameraRays};

use crate::params::Supervision;
use crate::photographs::{PackedPhotograph, PixelMemory};
use crate::state::{
    ExposureDifference, ExposureMeasurement, Exposures, HrCache, LrPixel, MovingCameras,
    SupervisionState,
};
use crate::supersample::SupersampleSchedule;

use assembly::block_start;
use pixel_sampler::PixelSampler;
use residual::{LossContext, may_be_clipped};
pub(crate) use setup::alpha_background_error;
pub use setup::set_up_supervision;

/// Supersampling: draws a training pixel, more often where the image has detail, and casts
/// sub-pixel rays through it.
///
/// `average` compares the rays' mean with the LR pixel, by the mean squared error over the three
/// channels. `kernel` minimises |K⁺·(K·c - y)|², the squared distance between the rendered HR image
/// c and the nearest HR image whose degradation by K is the LR image y. The HR pixels of the drawn
/// LR pixel are rendered, and those around it are read from a cache ([`HrCache`]), so that the
/// kernel's whole footprint costs no more rays than the average. Each sub-pixel ray gets its own
/// component of K⁺·(K·c - y). The gradient of |K·c - y|² would have Kᵀ instead, which attenuates
/// fine detail once more (design note 009). If K is the mean of whole pixels, both supervisions are
/// equal and nothing is cached.
///
/// A draw from an HR reference is a block with one pixel for each sub-pixel ray (design note 019).
pub struct Supersampling {
    /// LR photographs, then references.
    pub(crate) views: Vec<TrainingView>,
    pub(crate) sampler: PixelSampler,
    pub(crate) background: Background,
    pub(crate) schedule: SupersampleSchedule,
    pub(crate) supervision: Supervision,
    pub(crate) seed: u64,
    pub(crate) state: SupervisionState,
    pub(crate) memory: PixelMemory,
}

/// View whose pixels are drawn and compared.
pub(crate) struct TrainingView {
    /// Pixels to sample: those of an LR photograph, or the means over blocks of a reference.
    pub(crate) image: PackedPhotograph,
    /// Pixels of a reference; `None` for an LR photograph.
    pub(crate) hr: Option<PackedPhotograph>,
    pub(crate) rays: CameraRays,
}

/// Comparison of a bundle's colours with a photograph.
enum Comparison<'a> {
    /// Compares the photograph with the LR pixels that the kernel computes from rays and cached HR
    /// pixels.
    Kernel(&'a HrCache),
    /// Compares each ray with a pixel of the reference.
    Reference(&'a PackedPhotograph),
    /// Compares the rays' mean with that of the reference's block, which has more pixels than rays.
    ReferenceMean(&'a PackedPhotograph),
    /// Compares the rays' mean with the LR pixel.
    Mean,
}

/// RNG stream of background colours.
const BACKGROUND_STREAM: u64 = 101;

impl Supersampling {
    /// Returns the number of sub-pixel rays along x and y after the warm-up.
    pub fn supersample(&self) -> [usize; 2] {
        self.schedule.supersample
    }

    /// Returns the number of LR photographs.
    fn lr_view_count(&self) -> usize {
        self.views.iter().filter(|view| view.hr.is_none()).count()
    }

    /// Returns the current comparison for a view's bundles.
    fn comparison(&self, view: usize) -> Comparison<'_> {
        let is_warmed_up = self.schedule.is_warmed_up();
        match (&self.views[view].hr, &self.state.cache) {
            (Some(hr), _) if is_warmed_up => Comparison::Reference(hr),
            (Some(hr), _) => Comparison::ReferenceMean(hr),
            (None, Some(cache)) if is_warmed_up => Comparison::Kernel(cache),
            (None, _) => Comparison::Mean,
        }
    }

    /// Returns the first column and row of a block of a reference's pixels.
    fn reference_block(&self, hr: &PackedPhotograph, pixel: LrPixel) -> [usize; 2] {
        let [columns, rows] = self.schedule.supersample;
        [block_start(pixel.x, columns, hr.width), block_start(pixel.y, rows, hr.height)]
    }

    /// Restores the state of a checkpoint, see [`SupervisionState::restore`].
    pub(crate) fn restore(
        &mut self,
        saved: SupervisionState,
        from: &mut impl io::Read,
    ) -> io::Result<()> {
        self.state.restore(saved, from)?;
        self.update_rays();
        Ok(())
    }

    /// Moves cameras towards the poses at which the field's renders fit the photographs, if pose
    /// refinement is enabled and its next round is due. `field` is only called then.
    pub(crate) fn refine_poses<'a>(
        &mut self,
        progress: f64,
        field: impl FnOnce() -> anyhow::Result<Box<dyn RayField + 'a>>,
    ) -> anyhow::Result<()> {
        let SupervisionState { cameras, exposures, .. } = &mut self.state;
        let Some(cameras) = cameras.as_mut().filter(|cameras| cameras.is_round_due(progress))
        else {
            return Ok(());
        };
        cameras
            .step(&*field()?, progress, self.background.grey_level(), |view| {
                exposure_correction(exposures.as_ref(), view)
            })
            .map_err(fields::rendering_failure)?;
        self.update_rays();
        Ok(())
    }

    /// Replaces each view's rays by those of its current camera.
    fn update_rays(&mut self) {
        let cameras = self.state.cameras.as_ref().map_or(&[][..], MovingCameras::cameras);
        for (i, camera) in cameras.iter().enumerate() {
            self.views[i].rays = camera.rays();
        }
    }

    /// Measures the motion of the photographs' cameras, if pose refinement is enabled. `field` is
    /// only called then.
    pub(crate) fn mean_motion<'a>(
        &self,
        field: impl FnOnce() -> anyhow::Result<Box<dyn RayField + 'a>>,
    ) -> anyhow::Result<Option<MeanMotion>> {
        let Some(cameras) = &self.state.cameras else { return Ok(None) };
        let motion = cameras
            .mean_motion(&*field()?, self.lr_view_count(), self.background.grey_level())
            .map_err(fields::rendering_failure)?;
        Ok(Some(motion))
    }

    /// Returns the refined cameras of the photographs; empty without pose refinement.
    pub fn refined_cameras(&self) -> &[Camera] {
        let cameras = self.state.cameras.as_ref();
        cameras.map_or(&[], |cameras| &cameras.cameras()[..self.lr_view_count()])
    }

    /// Returns the RGB gain of each photograph relative to the field; empty if exposures aren't
    /// estimated.
    pub fn exposures(&self) -> &[[f32; 3]] {
        let exposures = self.state.exposures.as_ref();
        exposures.map_or(&[], |exposures| &exposures.gains()[..self.lr_view_count()])
    }

    /// Returns how much the photographs' exposures differ, after the step that ends the
    /// measurement; `None` after any other step.
    pub(crate) fn exposure_difference(&self, progress: f64) -> Option<ExposureDifference> {
        self.state.measurement.as_ref()?.difference(progress, self.lr_view_count())
    }

    /// Returns the view and pixel that a bundle trains on.
    fn drawn_pixel(&self, bundle: u64) -> (usize, usize) {
        self.sampler.draw(bundle, |view, pixel| self.views[view].image.is_valid(pixel))
    }

    /// Returns the view, column and row of an LR pixel, or of a reference's block.
    fn position(&self, view: usize, pixel: usize) -> LrPixel {
        let width = self.views[view].image.width;
        LrPixel { view, x: pixel % width, y: pixel / width }
    }

    /// Returns the background colour of a bundle's rays: random with background `alpha` or
    /// `opaque`, so that opacity is trained.
    fn ray_background(&self, bundle: u64) -> [f32; 3] {
        if matches!(self.background, Background::Alpha | Background::Opaque) {
            let mut rng = CounterRng::new(self.seed, BACKGROUND_STREAM, bundle);
            [0, 1, 2].map(|_| rng.uniform())
        } else {
            [self.background.grey_level(); 3]
        }
    }
}

/// Pixels of consecutive bundles, and the 8-bit levels of their sub-pixel rays.
struct RenderedPixels {
    pixels: Vec<RenderedPixel>,
    levels: Vec<[u8; 3]>,
}

/// Pixel whose bundle was rendered.
struct RenderedPixel {
    position: LrPixel,
    /// Photographed colour; NaN in clipped channels.
    photographed: [f32; 3],
    /// Mean colour of the rays.
    rendered: [f32; 3],
    /// True if the levels belong in the cache.
    is_cached: bool,
}

impl Supersampling {
    /// Finds the pixels of rendered bundles, and converts the bundles' colours for storage.
    fn rendered_pixels(&self, bundles: &RenderedBundles<'_>, rays: usize) -> RenderedPixels {
        let pixels = bundles.bundles(rays).map(|(bundle, colours)| {
            let (view, pixel) = self.drawn_pixel(bundle);
            let sample = self.views[view].image.pixel(pixel);
            RenderedPixel {
                position: self.position(view, pixel),
                photographed: [0, 1, 2]
                    .map(|c| if may_be_clipped(sample[c]) { f32::NAN } else { sample[c] }),
                rendered: [0, 1, 2].map(|c| {
                    colours.iter().map(|colour| colour[c]).sum::<f32>() / colours.len() as f32
                }),
                is_cached: matches!(self.comparison(view), Comparison::Kernel(_)),
            }
        });
        let levels = bundles.colours.iter().map(|colour| colour.map(to_u8));
        RenderedPixels { pixels: pixels.collect(), levels: levels.collect() }
    }
}

/// Returns the factors per channel that convert a photograph's colours to the field's.
fn exposure_correction(exposures: Option<&Exposures>, view: usize) -> [f32; 3] {
    exposures.map_or([1.0; 3], |exposures| exposures.gains()[view].map(f32::recip))
}

impl radiance::Supervisor for Supersampling {
    fn set_progress(&mut self, progress: f64) {
        if let Some(exposures) = &mut self.state.exposures {
            exposures.update_gains(progress);
        }
        if let Some(measurement) = &mut self.state.measurement {
            measurement.start_step();
        }
        self.schedule.set_progress(progress);
    }

    fn rays_per_bundle(&self) -> usize {
        self.schedule.rays_per_pixel()
    }

    fn sample_rays(&self, bundle: u64, rays: &mut [Ray]) {
        let (view, pixel) = self.drawn_pixel(bundle);
        let position = self.position(view, pixel);
        let background = self.ray_background(bundle);
        let SupersampleSchedule { supersample, current_supersample, .. } = self.schedule;
        // Start of the sub-pixel rays and distance between them, in pixels of the view's camera.
        let (start, spacing) = match self.comparison(view) {
            Comparison::Kernel(cache) => cache.block_in_lr_pixels(position),
            Comparison::Reference(hr) | Comparison::ReferenceMean(hr) => (
                self.reference_block(hr, position).map(|start| start as f64),
                [0, 1].map(|i| supersample[i] as f64 / current_supersample[i] as f64),
            ),
            Comparison::Mean => {
                let start = [position.x as f64, position.y as f64];
                (start, current_supersample.map(|n| 1.0 / n as f64))
            }
        };
        for (k, ray) in rays.iter_mut().enumerate() {
            let x = start[0] + ((k % current_supersample[0]) as f64 + 0.5) * spacing[0];
            let y = start[1] + ((k / current_supersample[0]) as f64 + 0.5) * spacing[1];
            *ray = Ray::new(&self.views[view].rays.ray(x, y), background);
        }
    }

    fn loss_and_gradient(
        &self,
        bundle: u64,
        colours: &[[f32; 3]],
        gradients: &mut [[f32; 3]],
    ) -> f64 {
        let (index, pixel) = self.drawn_pixel(bundle);
        let view = &self.views[index];
        let context = LossContext {
            inverse_gains: exposure_correction(self.state.exposures.as_ref(), index),
            background: self.ray_background(bundle),
            weight: self.sampler.weight(bundle, (index, pixel)),
            allows_clipping: self.supervision == Supervision::Kernel && view.hr.is_none(),
        };
        let position = self.position(index, pixel);
        match self.comparison(index) {
            Comparison::Kernel(cache) => {
                let residual = cache.back_project(
                    position,
                    colours,
                    &view.image,
                    |c, prediction, sample| context.unclipped_residual(c, prediction, sample),
                    gradients,
                );
                context.back_projected_loss(residual, gradients)
            }
            Comparison::Reference(hr) => {
                let columns = self.schedule.supersample[0];
                let [left, top] = self.reference_block(hr, position);
                let sample_of =
                    |k: usize| hr.pixel((top + k / columns) * hr.width + left + k % columns);
                context.mean_of_losses(colours, sample_of, gradients)
            }
            Comparison::ReferenceMean(_) | Comparison::Mean => {
                context.loss_of_mean(colours, view.image.pixel(pixel), gradients)
            }
        }
    }

    fn record_colours(&mut self, rendered: &[RenderedBundles<'_>], clock: &PhaseClock) {
        let is_measuring =
            self.state.measurement.as_ref().is_some_and(ExposureMeasurement::is_measuring);
        if self.state.cache.is_none() && self.state.exposures.is_none() && !is_measuring {
            return;
        }
        let rays = self.rays_per_bundle();
        // Draws and conversions take almost all of the time, and only they run in parallel: sums
        // and overlapping blocks need the bundles' order.
        let drawn: Vec<RenderedPixels> = (rendered.par_iter())
            .map(|bundles| clock.task(|| self.rendered_pixels(bundles, rays)))
            .collect();
        for RenderedPixels { pixels, levels } in drawn {
            for (pixel, levels) in pixels.iter().zip(levels.chunks_exact(rays)) {
                let RenderedPixel { position, photographed, rendered, .. } = *pixel;
                if let Some(exposures) = &mut self.state.exposures {
                    exposures.add_pixel(position.view, photographed, rendered);
                }
                if let Some(measurement) = &mut self.state.measurement {
                    measurement.add_pixel(position.view, photographed, rendered);
                }
                if let Some(cache) = self.state.cache.as_mut().filter(|_| pixel.is_cached) {
                    cache.store(position, levels);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use pixels::{Filter, Image, Resampling};
    use radiance::Supervisor as _;
    use scene::{Distortion, Intrinsics, Photograph, Space};

    use super::assembly::{REFERENCE_DRAWS, block_means};
    use super::options::SupersamplingOptions;
    use super::*;
    use crate::params::{Params, Resolved, SceneFacts};
    use crate::photographs::Photographs;

    fn record_colours(supersampling: &mut Supersampling, first_bundle: u64, colours: &[[f32; 3]]) {
        let rendered = RenderedBundles { first_bundle, colours };
        supersampling.record_colours(&[rendered], &PhaseClock::start());
    }

    fn options(supervision: Supervision, supersample: f64) -> SupersamplingOptions {
        let scene = SceneFacts {
            space: Space::Box,
            background: Background::White,
            pixels_across: 5.0,
            lr_pixels: 20,
            has_kernel: true,
            is_fine_tuning: false,
        };
        let (supervision, exposure) = (Some(supervision), Some(false));
        let params = Params { supersample, supervision, exposure, seed: 9, ..Params::default() };
        let params = params.resolve(&scene);
        let params = Resolved { supersample_warmup: 0.0, pixel_importance: 1.0, ..params };
        SupersamplingOptions { params, filter: Filter::Lanczos }
    }

    fn hr_image(width: usize, height: usize) -> Image {
        let sample = |i: usize| (60 + (i * 37 + i / 7 * 11) % 130) as f32 / 255.0;
        Image::new(width, height, 3, (0..width * height * 3).map(sample).collect())
    }

    /// Returns the supersampling of a 5×4 photograph, and its camera.
    fn example(
        supervision: Supervision,
        supersample: f64,
        image: Option<Image>,
    ) -> (Supersampling, Camera) {
        let distortion = Distortion::brown([0.1, -0.02, 0.01], [0.005, -0.003]);
        let camera = Camera {
            name: "a".into(),
            intrinsics: Intrinsics {
                width: 5,
                height: 4,
                fx: 6.0,
                fy: 7.0,
                cx: 2.4,
                cy: 2.1,
                distortion,
            },
            camera_to_world: [[0., 0., 1., 3.], [1., 0., 0., 0.5], [0., 1., 0., 0.2]],
        };
        let image = image.unwrap_or_else(|| {
            Image::new(5, 4, 3, (0..60).map(|i| (i + 1) as f32 / 62.0).collect())
        });
        (
            supersampling(
                Photographs::taken_by(camera.clone(), image),
                None,
                &options(supervision, supersample),
            ),
            camera,
        )
    }

    fn supersampling(
        photographs: Photographs,
        references: Option<Photographs>,
        options: &SupersamplingOptions,
    ) -> Supersampling {
        // All but the first 100 bytes go to a file.
        let memory = PixelMemory::new(100, std::env::temp_dir());
        let references = references.map(Photographs::over_background);
        Supersampling::new(photographs.over_background(), references, options, memory).unwrap()
    }

    /// The sub-pixel rays of a pixel are pixel rays of the finer image: no half-pixel shift, at any
    /// scale.
    #[test]
    fn sub_pixel_rays_are_the_finer_cameras_pixel_rays() {
        let cases = [
            (Supervision::Average, 3.0),
            (Supervision::Kernel, 3.0),
            (Supervision::Kernel, 2.8),
            (Supervision::Kernel, 1.5),
            (Supervision::Kernel, 1.2),
        ];
        for (kind, supersample) in cases {
            let (supersampling, camera) = example(kind, supersample, None);
            let size = [(5.0 * supersample).round(), (4.0 * supersample).round()];
            let hr = camera.resized(size[0] as u32, size[1] as u32);
            let mut rays = vec![Ray::default(); supersampling.rays_per_bundle()];
            let mut has_ray = vec![false; (size[0] * size[1]) as usize];
            for bundle in 0..200 {
                supersampling.sample_rays(bundle, &mut rays);
                for ray in &rays {
                    let pixel = (0..has_ray.len()).find(|i| {
                        let (x, y) = (
                            (i % size[0] as usize) as f64 + 0.5,
                            (i / size[0] as usize) as f64 + 0.5,
                        );
                        let expected = hr.ray(x, y).direction;
                        (0..3).all(|c| (ray.direction[c] - expected[c]).abs() < 1e-6)
                    });
                    has_ray[pixel.unwrap_or_else(|| {
                        panic!("{kind:?} {supersample}: {ray:?} is no pixel's ray")
                    })] = true;
                }
            }
            assert!(
                has_ray.iter().all(|has| *has),
                "{kind:?} {supersample}: every HR pixel has a ray"
            );
        }
    }

    /// Returns the background colours of 40 bundles.
    fn backgrounds(background: Background) -> Vec<[f32; 3]> {
        let (mut supersampling, _) = example(Supervision::Kernel, 2.0, None);
        supersampling.background = background;
        let mut rays = vec![Ray::default(); supersampling.rays_per_bundle()];
        let bundles = (0..40).map(|bundle| {
            supersampling.sample_rays(bundle, &mut rays);
            assert!(rays.iter().all(|r| r.background == rays[0].background));
            rays[0].background
        });
        bundles.collect()
    }

    /// Each bundle of an opaque scene has its own background colour, but the photographs stay the
    /// same, so only an opaque field can match them.
    #[test]
    fn backgrounds_of_opaque_scenes_are_random() {
        assert!(backgrounds(Background::White).iter().all(|b| *b == [1.0; 3]));
        let colours = backgrounds(Background::Opaque);
        assert!((0..40).all(|i| (0..i).all(|j| colours[i] != colours[j])));
        assert!(
            colours.iter().flatten().any(|c| *c < 0.2)
                && colours.iter().flatten().any(|c| *c > 0.8)
        );
    }

    #[test]
    fn gradients_equal_numerical_derivatives_of_the_loss() {
        let (supersampling, _) = example(Supervision::Average, 2.0, None);
        let colours: Vec<[f32; 3]> = (0..4).map(|k| [0.1 * k as f32, 0.5, 0.9]).collect();
        let mut gradients = vec![[0.0; 3]; 4];
        supersampling.loss_and_gradient(7, &colours, &mut gradients);
        for (k, c) in (0..4).flat_map(|k| (0..3).map(move |c| (k, c))) {
            let mut perturbed = colours.clone();
            let mut unused = vec![[0.0; 3]; 4];
            perturbed[k][c] += 0.01;
            let higher = supersampling.loss_and_gradient(7, &perturbed, &mut unused);
            perturbed[k][c] -= 0.02;
            let numeric =
                (higher - supersampling.loss_and_gradient(7, &perturbed, &mut unused)) / 0.02;
            assert!((f64::from(gradients[k][c]) - numeric).abs() < 1e-5, "{k} {c}");
        }
    }

    /// Returns the largest loss and gradient after the cache has been filled with the ground truth.
    fn largest_loss_and_gradient(truth: &Image, lr: &Image, kind: Supervision) -> (f64, f32) {
        let (mut supersampling, _) = example(kind, 2.0, Some(lr.clone()));
        let mut largest = (0.0f64, 0.0f32);
        for bundle in 0..800 {
            let pixel = supersampling.drawn_pixel(bundle).1;
            let (x, y) = (pixel % 5 * 2, pixel / 5 * 2);
            let colours: Vec<[f32; 3]> = (0..4)
                .map(|k| {
                    std::array::from_fn(|c| truth.data[3 * (x + k % 2 + (y + k / 2) * 10) + c])
                })
                .collect();
            let mut gradients = [[0.0; 3]; 4];
            let loss = supersampling.loss_and_gradient(bundle, &colours, &mut gradients);
            record_colours(&mut supersampling, bundle, &colours);
            // The first 400 bundles fill the cache with the ground truth.
            if bundle >= 400 {
                let gradient =
                    gradients.as_flattened().iter().fold(0.0f32, |most, g| most.max(g.abs()));
                largest = (largest.0.max(loss), largest.1.max(gradient));
            }
        }
        largest
    }

    /// When the field renders the true HR image, supervision by the kernel has neither loss nor
    /// gradient. Supervision by the average has both.
    #[test]
    fn only_the_kernel_has_no_loss_at_the_truth() {
        let truth = hr_image(10, 8);
        let lr = Resampling::new(Filter::Lanczos, (10, 8), (5, 4)).apply(&truth);
        let [kernel, average] = [Supervision::Kernel, Supervision::Average]
            .map(|kind| largest_loss_and_gradient(&truth, &lr, kind));
        assert!(kernel.0 < 1e-9 && kernel.1 < 1e-5, "{kernel:?}");
        assert!(average.0 > 1e-4 && average.1 > 1e-3, "{average:?}");
    }

    /// A pixel that is clipped to white in a photograph may be rendered as white or brighter.
    #[test]
    fn clipped_white_accepts_white_or_more() {
        let white = Image::new(5, 4, 3, vec![1.0; 60]);
        let (supersampling, _) = example(Supervision::Kernel, 2.0, Some(white));
        let mut gradients = [[0.0; 3]; 4];
        for colour in [1.0, 1.2] {
            assert!(
                supersampling.loss_and_gradient(3, &[[colour; 3]; 4], &mut gradients) < 1e-10,
                "only rounding errors remain at {colour}"
            );
        }
        assert!(
            supersampling.loss_and_gradient(3, &[[0.1; 3]; 4], &mut gradients) > 0.1,
            "darker colours have a loss"
        );
        assert!(gradients.as_flattened().iter().all(|g| *g < 0.0));
    }

    fn drawn_pixels(supersampling: &Supersampling, range: std::ops::Range<u64>) -> Vec<usize> {
        range.map(|g| supersampling.drawn_pixel(g).1).collect()
    }

    /// In epochs every pixel is drawn once before any is drawn again, in a new order each time. The
    /// first bundles are drawn from the middle.
    #[test]
    fn epochs_draw_without_replacement() {
        let (mut supersampling, _) = example(Supervision::Average, 1.0, None);
        (supersampling.sampler.in_epochs, supersampling.sampler.precrop_bundles) = (true, 50);
        // 5 × 4 pixels.
        assert!(
            drawn_pixels(&supersampling, 0..50)
                .iter()
                .all(|p| (1..3).contains(&(p % 5)) && (1..3).contains(&(p / 5)))
        );
        let (mut first, mut second) =
            (drawn_pixels(&supersampling, 50..70), drawn_pixels(&supersampling, 70..90));
        assert_ne!(first, second);
        for epoch in [&mut first, &mut second] {
            epoch.sort_unstable();
            assert_eq!(*epoch, (0..20).collect::<Vec<_>>());
        }
    }

    fn loss_and_gradients_at(supersampling: &Supersampling, pixel: usize) -> (f64, [[f32; 3]; 4]) {
        let bundle = (0..).find(|&g| supersampling.drawn_pixel(g).1 == pixel).unwrap();
        let mut gradients = [[0.0; 3]; 4];
        let loss = supersampling.loss_and_gradient(bundle, &[[0.9, 0.1, 0.4]; 4], &mut gradients);
        (loss, gradients)
    }

    /// Masked pixels are neither drawn nor compared with the photograph. Unmasked pixels next to a
    /// mask are.
    #[test]
    fn masked_pixels_have_no_influence() {
        for kind in [Supervision::Average, Supervision::Kernel] {
            let (plain, camera) = example(kind, 2.0, None);
            let mask =
                pixels::Mask { width: 5, height: 4, counts: (0..20).map(|i| i % 5 < 3).collect() };
            let image = Image::new(5, 4, 3, (0..60).map(|i| (i + 1) as f32 / 62.0).collect());
            let photograph = Photograph { image: image.clone(), mask: Some(mask) };
            let mut masked = Photographs::taken_by(camera, image);
            masked.images =
                vec![PackedPhotograph::new(&photograph, &mut PixelMemory::unlimited()).unwrap()];
            let masked = supersampling(masked, None, &options(kind, 2.0));
            let mut drawn = [false; 20];
            (0..800).for_each(|g| drawn[masked.drawn_pixel(g).1] = true);
            assert!(drawn.iter().enumerate().all(|(i, d)| *d == (i % 5 < 3)), "{kind:?} {drawn:?}");
            // Pixel 7 is next to masked pixels, which only the kernel's footprint includes.
            assert!(
                loss_and_gradients_at(&masked, 7).1.as_flattened().iter().all(|g| g.is_finite())
            );
            if kind == Supervision::Kernel {
                assert_ne!(loss_and_gradients_at(&masked, 7), loss_and_gradients_at(&plain, 7));
            } else {
                assert_eq!(loss_and_gradients_at(&masked, 7), loss_and_gradients_at(&plain, 7));
            }
        }
    }

    fn photograph_of_size(camera: &Camera, name: &str, width: usize, height: usize) -> Photographs {
        let camera = Camera { name: name.into(), ..camera.resized(width as u32, height as u32) };
        Photographs::taken_by(camera, hr_image(width, height))
    }

    fn direction_through(camera: &Camera, pixel: usize) -> glam::DVec3 {
        let width = camera.intrinsics.width as usize;
        camera.ray((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5).direction
    }

    /// References are used at their full size, with either supervision: each sub-pixel ray goes
    /// through one pixel of the reference, and every pixel of the reference gets a ray.
    #[test]
    fn references_are_used_at_their_full_size() {
        let (_, camera) = example(Supervision::Kernel, 2.0, None);
        // The last column of blocks overlaps the one before it.
        let (width, height) = (9, 8);
        let truth = hr_image(width, height);
        let large = camera.resized(9, 8);
        for kind in [Supervision::Average, Supervision::Kernel] {
            let mut joined = supersampling(
                photograph_of_size(&camera, "a", 5, 4),
                Some(photograph_of_size(&camera, "a", width, height)),
                &options(kind, 2.0),
            );
            assert_eq!(joined.sampler.index_count, 20 + 20 * REFERENCE_DRAWS, "{kind:?}");
            let mut rays = [Ray { origin: [0.0; 3], direction: [0.0; 3], background: [0.0; 3] }; 4];
            let mut has_ray = [false; 72];
            for bundle in 0..800 {
                if joined.drawn_pixel(bundle).0 == 0 {
                    continue;
                }
                joined.sample_rays(bundle, &mut rays);
                let pixels = rays.map(|ray| {
                    (0..72)
                        .find(|&pixel| {
                            direction_through(&large, pixel).distance(ray.direction.into()) < 1e-6
                        })
                        .expect("a pixel's ray")
                });
                pixels.iter().for_each(|&pixel| has_ray[pixel] = true);
                // Only the red of the last sub-pixel ray is wrong: 0.1 too bright.
                let mut colours = pixels.map(|pixel| [0, 1, 2].map(|c| truth.data[3 * pixel + c]));
                colours[3][0] += 0.1;
                let mut gradients = [[9.0; 3]; 4];
                let loss = joined.loss_and_gradient(bundle, &colours, &mut gradients);
                assert!((loss - 0.01 / 12.0).abs() < 1e-6, "{kind:?} {loss}");
                let red_gradient = gradients[3][0];
                assert!(
                    (red_gradient - 0.2 / 12.0).abs() < 1e-6
                        && gradients.as_flattened().iter().filter(|g| g.abs() > 1e-6).count() == 1
                );
                record_colours(&mut joined, bundle, &colours);
            }
            assert!(has_ray.iter().all(|has| *has), "{kind:?}");
            // During the warm-up, fewer sub-pixel rays are compared with the block's mean.
            joined.schedule.warmup = 0.5;
            joined.set_progress(0.0);
            let bundle = (0..).find(|&bundle| joined.drawn_pixel(bundle) == (1, 4)).unwrap();
            joined.sample_rays(bundle, &mut rays[..1]);
            assert!(
                large.ray(8.0, 1.0).direction.distance(rays[0].direction.into()) < 1e-6,
                "{kind:?}"
            );
            let block = [7, 8, 16, 17].map(|pixel| [0, 1, 2].map(|c| truth.data[3 * pixel + c]));
            let mean = [0, 1, 2].map(|c| block.iter().map(|p| p[c]).sum::<f32>() / 4.0);
            assert!(joined.loss_and_gradient(bundle, &[mean], &mut [[0.0; 3]]) < 1e-10, "{kind:?}");
            joined.set_progress(1.0);
            // The gradients of LR images stay unchanged.
            let plain =
                supersampling(photograph_of_size(&camera, "a", 5, 4), None, &options(kind, 2.0));
            let first_draw = |supersampling: &Supersampling| {
                (0..).find(|&g| supersampling.drawn_pixel(g) == (0, 7)).unwrap()
            };
            let colours = [[0.9, 0.1, 0.4], [0.2, 0.3, 0.5], [0.6, 0.6, 0.1], [0.4, 0.8, 0.7]];
            let mut gradients = [[[0.0; 3]; 4]; 2];
            joined.loss_and_gradient(first_draw(&joined), &colours, &mut gradients[0]);
            plain.loss_and_gradient(first_draw(&plain), &colours, &mut gradients[1]);
            assert_eq!(gradients[0], gradients[1], "{kind:?}");
        }
        // A larger reference doesn't get more draws.
        let larger = supersampling(
            photograph_of_size(&camera, "a", 5, 4),
            Some(photograph_of_size(&camera, "a", 20, 16)),
            &options(Supervision::Kernel, 2.0),
        );
        assert_eq!(larger.sampler.index_count, 20 + 80);
        let mut masked = truth;
        masked.data[..3].fill(f32::NAN);
        let means = block_means(&masked, [2, 2]);
        assert!(means.data.iter().all(|v| v.is_finite()) && (means.width, means.height) == (5, 4));
        masked.data.fill(f32::NAN);
        assert!(block_means(&masked, [2, 2]).data.iter().all(|v| v.is_nan()));
    }

    /// With a fractional supersample, the ratio of HR to LR size may be an integer for one
    /// photograph and not for another. Then the pixels of both are cached, each compared with its
    /// own photograph.
    #[test]
    fn photographs_of_different_sizes_share_a_cache() {
        let (_, camera) = example(Supervision::Kernel, 2.0, None);
        let mut both = Photographs::taken_by(camera.resized(1, 1), hr_image(1, 1));
        let second = Photographs::taken_by(camera.resized(3, 2), hr_image(3, 2));
        both.views.views.extend(second.views.views);
        both.images.extend(second.images);
        let mut options = options(Supervision::Kernel, 1.5);
        options.filter = Filter::Box;
        let needs = |lr: (usize, usize)| options.needs_cache([lr].into_iter());
        assert!(!needs((1, 1)) && needs((3, 2)));
        let mut joined = supersampling(both, None, &options);
        let mut gradients = vec![[0.0; 3]; joined.rays_per_bundle()];
        for bundle in 0..50 {
            let colours = vec![[0.5, 0.4, 0.3]; joined.rays_per_bundle()];
            assert!(joined.loss_and_gradient(bundle, &colours, &mut gradients).is_finite());
            record_colours(&mut joined, bundle, &colours);
        }
        assert_eq!(joined.state.cache.unwrap().byte_length(), 3 * (2 * 2 + 5 * 3));
    }

    #[test]
    fn every_pixel_is_drawn() {
        let (supersampling, _) = example(Supervision::Average, 1.0, None);
        let mut is_drawn = [false; 20];
        (0..400).for_each(|g| is_drawn[supersampling.drawn_pixel(g).1] = true);
        assert!(is_drawn.iter().all(|drawn| *drawn));
    }
}
