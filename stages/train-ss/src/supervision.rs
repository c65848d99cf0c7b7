use std::io;

use counter_rng::CounterRng;
use poses::MeanMotion;
use radiance::{Ray, RayField};
use scene::{Background, Camera, CameraRays};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::hr_cache::{HrCache, LrPixel};
use crate::learnt::Learnt;
use crate::moving_cameras::MovingCameras;
use crate::packed::{PackedPhotograph, PixelMemory};
use crate::pixel_sampler::PixelSampler;
use crate::reference_blocks::block_start;
use crate::residual::{Target, is_clipped};
use crate::sub_pixel_rays::SubPixelRays;

/// How rays are compared with the LR pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Supervision {
    /// Their mean is compared, whatever made the LR images (the paper's eq. 4).
    Average,
    /// Rays render HR pixels, and the known degradation kernel makes an LR pixel of them.
    Kernel,
}

/// Supersampling: a training pixel is drawn at random, those with detail more often, and sub-pixel
/// rays are cast through it.
///
/// `average` compares their mean with the LR pixel (mean squared error over the three channels).
/// `kernel` minimises the squared distance |K⁺·(K·c - y)|² of the HR pixels c from the nearest ones
/// that K makes the LR image y of: those of the drawn LR pixel are rendered, those around it cached
/// ([`HrCache`]), so that the whole footprint costs no more rays than the average. Each sub-pixel
/// ray gets its own share of K⁺·(K·c - y). (|K·c - y|² itself, whose gradient Kᵀ weakens fine
/// detail once more, learns slower.) Where K is the mean of whole pixels, both are alike, and
/// nothing is cached.
///
/// Of an HR reference a block of pixels is drawn at a time, one for each sub-pixel ray to meet, and
/// altogether four times as many blocks as an LR image has pixels.
pub struct Supersampling {
    /// LR photographs, then references.
    pub(crate) views: Vec<TrainingView>,
    pub(crate) sampler: PixelSampler,
    pub(crate) background: Background,
    pub(crate) sub_pixel_rays: SubPixelRays,
    pub(crate) supervision: Supervision,
    pub(crate) seed: u64,
    /// What it has come to know in the training.
    pub(crate) learnt: Learnt,
    pub(crate) memory: PixelMemory,
}

/// What a bundle is drawn from and compared with.
pub(crate) struct TrainingView {
    /// What bundles are drawn from, a pixel each: of a reference, means over blocks of its pixels.
    pub(crate) image: PackedPhotograph,
    /// A reference's own pixels; an LR photograph has none.
    pub(crate) hr: Option<PackedPhotograph>,
    pub(crate) rays: CameraRays,
}

/// How colours of a bundle's rays are compared with what was photographed.
enum Comparison<'a> {
    /// The kernel makes LR pixels of them and of the cached HR pixels around.
    Kernel(&'a HrCache),
    /// Each ray meets a pixel of the reference and is compared with it.
    Reference(&'a PackedPhotograph),
    /// Rays are fewer than the pixels of the reference's block: means are compared.
    ReferenceMean(&'a PackedPhotograph),
    /// The rays' mean is compared with the LR pixel.
    Mean,
}

/// Purpose of a draw.
const BACKGROUND: u64 = 101;

impl Supersampling {
    /// Sub-pixel rays of an LR pixel along x and y, once all are cast.
    pub fn full_side(&self) -> [usize; 2] {
        self.sub_pixel_rays.full
    }

    /// How many views are LR photographs.
    fn lr_views(&self) -> usize {
        self.views.iter().filter(|view| view.hr.is_none()).count()
    }

    /// How a view's bundles are compared by now.
    fn comparison(&self, view: usize) -> Comparison<'_> {
        let are_all_cast = self.sub_pixel_rays.are_all_cast();
        match (&self.views[view].hr, &self.learnt.cache) {
            (Some(hr), _) if are_all_cast => Comparison::Reference(hr),
            (Some(hr), _) => Comparison::ReferenceMean(hr),
            (None, Some(cache)) if are_all_cast => Comparison::Kernel(cache),
            (None, _) => Comparison::Mean,
        }
    }

    /// Column and row at which a block of a reference's pixels begins.
    fn reference_block(&self, hr: &PackedPhotograph, [x, y]: [usize; 2]) -> [usize; 2] {
        let [columns, rows] = self.sub_pixel_rays.full;
        [block_start(x, columns, hr.width()), block_start(y, rows, hr.height())]
    }

    /// Restores what [`Learnt::write`] wrote.
    pub(crate) fn restore(&mut self, from: &mut impl io::Read) -> io::Result<()> {
        self.learnt.restore(from)?;
        self.place_views();
        Ok(())
    }

    /// What went wrong with pixels that are kept in a file, if anything did.
    pub(crate) fn fault(&self) -> Option<&io::Error> {
        self.memory.fault()
    }

    /// Moves cameras, where that was asked for and it is time for it, to where the field's
    /// renderings meet their photographs best. `field` is only made when it is.
    pub(crate) fn refine_poses<'a>(
        &mut self,
        done: f64,
        field: impl FnOnce() -> anyhow::Result<Box<dyn RayField + 'a>>,
    ) -> anyhow::Result<()> {
        let Learnt { moving, exposures, .. } = &mut self.learnt;
        let Some(moving) = moving.as_mut().filter(|moving| moving.are_due(done)) else {
            return Ok(());
        };
        let exposures = exposures.as_ref();
        let exposure = |view: usize| exposures.map_or([1.0; 3], |e| e.of(view).map(f32::recip));
        moving
            .step(&*field()?, done, self.background.shown(), exposure)
            .map_err(fields::rendering_failure)?;
        self.place_views();
        Ok(())
    }

    /// Has rays cast from where cameras have moved to.
    fn place_views(&mut self) {
        let cameras = self.learnt.moving.iter().flat_map(MovingCameras::cameras);
        self.views.iter_mut().zip(cameras).for_each(|(view, camera)| view.rays = camera.rays());
    }

    /// How far cameras of photographs have gone, where that was asked for. `field` is only made
    /// then.
    pub(crate) fn moved<'a>(
        &self,
        field: impl FnOnce() -> anyhow::Result<Box<dyn RayField + 'a>>,
    ) -> anyhow::Result<Option<MeanMotion>> {
        let Some(moving) = &self.learnt.moving else { return Ok(None) };
        let moved = moving
            .moved(&*field()?, self.lr_views(), self.background.shown())
            .map_err(fields::rendering_failure)?;
        Ok(Some(moved))
    }

    /// Where the photographs were taken from, where that was asked for.
    pub fn refined_cameras(&self) -> &[Camera] {
        self.learnt.moving.as_ref().map_or(&[], |moving| &moving.cameras()[..self.lr_views()])
    }

    /// What each photograph is so many times as bright as, red, green and blue, where that was
    /// asked for.
    pub fn exposures(&self) -> &[[f32; 3]] {
        let exposures = self.learnt.exposures.as_ref();
        exposures.map_or(&[], |exposures| &exposures.factors()[..self.lr_views()])
    }

    /// The view and pixel that a bundle trains on.
    fn pixel(&self, bundle: u64) -> (usize, usize) {
        self.sampler.draw(bundle, |view, pixel| self.views[view].image.counts(pixel))
    }

    /// What lies behind a bundle's rays: with an open background, or none, another colour each
    /// time, so that opacity is learnt.
    fn behind(&self, bundle: u64) -> [f32; 3] {
        if matches!(self.background, Background::Alpha | Background::Opaque) {
            let mut rng = CounterRng::new(self.seed, BACKGROUND, bundle);
            [0, 1, 2].map(|_| rng.uniform())
        } else {
            [self.background.shown(); 3]
        }
    }
}

/// Mean of a channel.
fn mean(colours: &[[f32; 3]], c: usize) -> f32 {
    colours.iter().map(|colour| colour[c]).sum::<f32>() / colours.len() as f32
}

impl radiance::Supervisor for Supersampling {
    fn set_progress(&mut self, done: f64) {
        self.learnt.exposures.iter_mut().for_each(|exposures| exposures.settle(done));
        self.sub_pixel_rays.set_progress(done);
    }

    fn rays_per_bundle(&self) -> usize {
        self.sub_pixel_rays.count()
    }

    fn sample_rays(&self, bundle: u64, rays: &mut [Ray]) {
        let (index, pixel) = self.pixel(bundle);
        let view = &self.views[index];
        let background = self.behind(bundle);
        let (x, y) = (pixel % view.image.width(), pixel / view.image.width());
        let SubPixelRays { full, now, .. } = self.sub_pixel_rays;
        // Where the sub-pixel rays begin, and how far apart they are, in pixels of its camera.
        let (start, apart) = match self.comparison(index) {
            Comparison::Kernel(cache) => cache.block_in_pixels(LrPixel { view: index, x, y }),
            Comparison::Reference(hr) | Comparison::ReferenceMean(hr) => {
                let start = self.reference_block(hr, [x, y]).map(|s| s as f64);
                (start, [0, 1].map(|i| full[i] as f64 / now[i] as f64))
            }
            Comparison::Mean => ([x as f64, y as f64], now.map(|n| 1.0 / n as f64)),
        };
        for (k, ray) in rays.iter_mut().enumerate() {
            let (a, b) = (k % now[0], k / now[0]);
            let place =
                [start[0] + (a as f64 + 0.5) * apart[0], start[1] + (b as f64 + 0.5) * apart[1]];
            *ray = Ray::new(&view.rays.ray(place[0], place[1]), background);
        }
    }

    fn loss_and_gradient(
        &self,
        bundle: u64,
        colours: &[[f32; 3]],
        gradients: &mut [[f32; 3]],
    ) -> f64 {
        let (index, pixel) = self.pixel(bundle);
        let view = &self.views[index];
        let exposures = self.learnt.exposures.as_ref();
        let back = exposures.map_or([1.0; 3], |exposures| exposures.of(index).map(f32::recip));
        let target = Target {
            back,
            behind: self.behind(bundle),
            weight: self.sampler.weight(bundle, (index, pixel)),
            is_clipped: self.supervision == Supervision::Kernel && view.hr.is_none(),
        };
        let (x, y) = (pixel % view.image.width(), pixel / view.image.width());
        match self.comparison(index) {
            Comparison::Kernel(cache) => {
                let judge =
                    |c: usize, prediction, sample| target.unclipped_residual(c, prediction, sample);
                let pixel = LrPixel { view: index, x, y };
                let own = cache.back_project(pixel, colours, &view.image, judge, gradients);
                target.of_back_projected(own, gradients)
            }
            Comparison::Reference(hr) => {
                let columns = self.sub_pixel_rays.full[0];
                let [left, top] = self.reference_block(hr, [x, y]);
                let samples = (0..colours.len())
                    .map(|k| hr.pixel((top + k / columns) * hr.width() + left + k % columns));
                target.of_each(colours, samples, gradients)
            }
            Comparison::ReferenceMean(_) | Comparison::Mean => {
                target.of_mean(colours, view.image.pixel(pixel), gradients)
            }
        }
    }

    fn remember(&mut self, bundle: u64, colours: &[[f32; 3]]) {
        let Learnt { cache, exposures, .. } = &self.learnt;
        if cache.is_none() && exposures.is_none() {
            return;
        }
        let (index, pixel) = self.pixel(bundle);
        let image = &self.views[index].image;
        if let Some(exposures) = &mut self.learnt.exposures {
            let sample = image.pixel(pixel);
            let photographed =
                [0, 1, 2].map(|c| if is_clipped(sample[c]) { f32::NAN } else { sample[c] });
            exposures.learn(index, photographed, [0, 1, 2].map(|c| mean(colours, c)));
        }
        let is_cached = matches!(self.comparison(index), Comparison::Kernel(_));
        if let Some(cache) = self.learnt.cache.as_mut().filter(|_| is_cached) {
            let (x, y) = (pixel % image.width(), pixel / image.width());
            cache.remember(LrPixel { view: index, x, y }, colours);
        }
    }
}

#[cfg(test)]
mod tests {
    use pixels::{Filter, Image, Resampling};
    use radiance::Supervisor as _;
    use scene::{Distortion, Intrinsics, Photograph};

    use super::*;
    use crate::assembly::REFERENCE_DRAWS;
    use crate::photographs::Photographs;
    use crate::pixel_sampler::Order;
    use crate::reference_blocks::block_means;
    use crate::supersampling_options::SupersamplingOptions;

    fn options(supervision: Supervision, scale: [f64; 2]) -> SupersamplingOptions {
        SupersamplingOptions {
            supervision,
            scale,
            filter: Filter::Lanczos,
            supersample_warmup: 0.0,
            order: Order::Random,
            precrop_bundles: 0,
            pixel_importance: 1.0,
            exposure: false,
            pose_refinement: false,
            seed: 9,
        }
    }

    fn hr_image(width: usize, height: usize) -> Image {
        let sample = |i: usize| (60 + (i * 37 + i / 7 * 11) % 130) as f32 / 255.0;
        Image::new(width, height, 3, (0..width * height * 3).map(sample).collect())
    }

    fn example(
        supervision: Supervision,
        scale: [f64; 2],
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
                &options(supervision, scale),
            ),
            camera,
        )
    }

    fn supersampling(
        photographs: Photographs,
        references: Option<Photographs>,
        options: &SupersamplingOptions,
    ) -> Supersampling {
        // All but the first bytes go to a file.
        let memory = PixelMemory::new(100, std::env::temp_dir());
        let references = references.map(Photographs::over_background);
        Supersampling::new(photographs.over_background(), references, options, memory).unwrap()
    }

    /// The sub-pixel rays of a pixel are pixel rays of the finer image: no half-pixel shift, at any
    /// scale.
    #[test]
    fn sub_pixel_rays_are_the_finer_cameras_pixel_rays() {
        let cases = [
            (Supervision::Average, [3.0, 3.0]),
            (Supervision::Kernel, [3.0, 3.0]),
            (Supervision::Kernel, [2.8, 1.5]),
            (Supervision::Kernel, [1.2, 1.25]),
        ];
        for (kind, scale) in cases {
            let (supersampling, camera) = example(kind, scale, None);
            let size = [(5.0 * scale[0]).round(), (4.0 * scale[1]).round()];
            let hr = camera.resized(size[0] as u32, size[1] as u32);
            let mut rays = vec![Ray::default(); supersampling.rays_per_bundle()];
            let mut seen = vec![false; (size[0] * size[1]) as usize];
            for bundle in 0..200 {
                supersampling.sample_rays(bundle, &mut rays);
                for ray in &rays {
                    let pixel = (0..seen.len()).find(|i| {
                        let (x, y) = (
                            (i % size[0] as usize) as f64 + 0.5,
                            (i / size[0] as usize) as f64 + 0.5,
                        );
                        let expected = hr.ray(x, y).direction;
                        (0..3).all(|c| (ray.direction[c] - expected[c]).abs() < 1e-6)
                    });
                    seen[pixel.unwrap_or_else(|| {
                        panic!("{kind:?} {scale:?}: {ray:?} is no pixel's ray")
                    })] = true;
                }
            }
            assert!(seen.iter().all(|s| *s), "{kind:?} {scale:?}: every HR pixel is seen");
        }
    }

    fn backgrounds(background: Background) -> Vec<[f32; 3]> {
        let (mut supersampling, _) = example(Supervision::Kernel, [2.0, 2.0], None);
        supersampling.background = background;
        let mut rays = vec![Ray::default(); supersampling.rays_per_bundle()];
        let bundles = (0..40).map(|bundle| {
            supersampling.sample_rays(bundle, &mut rays);
            assert!(rays.iter().all(|r| r.background == rays[0].background));
            rays[0].background
        });
        bundles.collect()
    }

    /// Behind an opaque scene lies another colour in every bundle, and what is asked for is the
    /// same: a field that is opaque alone can give it.
    #[test]
    fn nothing_can_pretend_to_be_an_opaque_scenes_background() {
        assert!(backgrounds(Background::White).iter().all(|b| *b == [1.0; 3]));
        let colours = backgrounds(Background::Opaque);
        assert!((0..40).all(|i| (0..i).all(|j| colours[i] != colours[j])));
        assert!(
            colours.iter().flatten().any(|c| *c < 0.2)
                && colours.iter().flatten().any(|c| *c > 0.8)
        );
    }

    #[test]
    fn gradient_is_that_of_the_loss() {
        let (supersampling, _) = example(Supervision::Average, [2.0, 2.0], None);
        let colours: Vec<[f32; 3]> = (0..4).map(|k| [0.1 * k as f32, 0.5, 0.9]).collect();
        let mut gradients = vec![[0.0; 3]; 4];
        supersampling.loss_and_gradient(7, &colours, &mut gradients);
        for (k, c) in (0..4).flat_map(|k| (0..3).map(move |c| (k, c))) {
            let mut moved = colours.clone();
            let mut scrap = vec![[0.0; 3]; 4];
            moved[k][c] += 0.01;
            let up = supersampling.loss_and_gradient(7, &moved, &mut scrap);
            moved[k][c] -= 0.02;
            let numeric = (up - supersampling.loss_and_gradient(7, &moved, &mut scrap)) / 0.02;
            assert!((f64::from(gradients[k][c]) - numeric).abs() < 1e-5, "{k} {c}");
        }
    }

    /// The largest loss and the largest gradient, once the cache is full of the truth.
    fn worst(truth: &Image, lr: &Image, kind: Supervision) -> (f64, f32) {
        let (mut supersampling, _) = example(kind, [2.0, 2.0], Some(lr.clone()));
        let mut worst = (0.0f64, 0.0f32);
        for bundle in 0..800 {
            let pixel = supersampling.pixel(bundle).1;
            let (x, y) = (pixel % 5 * 2, pixel / 5 * 2);
            let colours: Vec<[f32; 3]> = (0..4)
                .map(|k| {
                    std::array::from_fn(|c| truth.data[3 * (x + k % 2 + (y + k / 2) * 10) + c])
                })
                .collect();
            let mut gradients = [[0.0; 3]; 4];
            let loss = supersampling.loss_and_gradient(bundle, &colours, &mut gradients);
            supersampling.remember(bundle, &colours);
            // Until then the cache isn't full of the truth.
            if bundle >= 400 {
                let gradient =
                    gradients.as_flattened().iter().fold(0.0f32, |most, g| most.max(g.abs()));
                worst = (worst.0.max(loss), worst.1.max(gradient));
            }
        }
        worst
    }

    /// Once the field renders the true HR image, the kernel is content: no loss and no gradient.
    /// The average isn't.
    #[test]
    fn only_the_kernel_is_content_with_the_truth() {
        let truth = hr_image(10, 8);
        let lr = Resampling::new(Filter::Lanczos, (10, 8), (5, 4)).apply(&truth);
        let (kernel, average) =
            (worst(&truth, &lr, Supervision::Kernel), worst(&truth, &lr, Supervision::Average));
        assert!(kernel.0 < 1e-9 && kernel.1 < 1e-5, "{kernel:?}");
        assert!(average.0 > 1e-4 && average.1 > 1e-3, "{average:?}");
    }

    /// What a kernel clipped at white asks no rendering to be white alone.
    #[test]
    fn clipped_white_asks_for_white_or_more() {
        let white = Image::new(5, 4, 3, vec![1.0; 60]);
        let (supersampling, _) = example(Supervision::Kernel, [2.0, 2.0], Some(white));
        let mut gradients = [[0.0; 3]; 4];
        assert!(
            supersampling.loss_and_gradient(3, &[[1.0; 3]; 4], &mut gradients) < 1e-10,
            "rounding alone"
        );
        assert!(
            supersampling.loss_and_gradient(3, &[[0.1; 3]; 4], &mut gradients) > 0.1,
            "what is too dark is still wrong"
        );
        assert!(gradients.as_flattened().iter().all(|g| *g < 0.0));
    }

    fn drawn(supersampling: &Supersampling, range: std::ops::Range<u64>) -> Vec<usize> {
        range.map(|g| supersampling.pixel(g).1).collect()
    }

    /// In epochs every pixel comes once before any comes again, each time in another order; the
    /// first come from the middle.
    #[test]
    fn epochs_draw_without_replacement() {
        let (mut supersampling, _) = example(Supervision::Average, [1.0, 1.0], None);
        (supersampling.sampler.order, supersampling.sampler.precrop_bundles) = (Order::Epochs, 50);
        // 5 × 4 pixels.
        assert!(
            drawn(&supersampling, 0..50)
                .iter()
                .all(|p| (1..3).contains(&(p % 5)) && (1..3).contains(&(p / 5)))
        );
        let (mut first, mut second) =
            (drawn(&supersampling, 50..70), drawn(&supersampling, 70..90));
        assert_ne!(first, second);
        for epoch in [&mut first, &mut second] {
            epoch.sort_unstable();
            assert_eq!(*epoch, (0..20).collect::<Vec<_>>());
        }
    }

    fn judged(of: &Supersampling, pixel: usize) -> (f64, [[f32; 3]; 4]) {
        let bundle = (0..).find(|&g| of.pixel(g).1 == pixel).unwrap();
        let mut gradients = [[0.0; 3]; 4];
        let loss = of.loss_and_gradient(bundle, &[[0.9, 0.1, 0.4]; 4], &mut gradients);
        (loss, gradients)
    }

    /// Pixels that don't count are neither drawn, nor pulled to what the photograph has there; what
    /// counts beside them is.
    #[test]
    fn masked_pixels_say_nothing() {
        for kind in [Supervision::Average, Supervision::Kernel] {
            let (plain, camera) = example(kind, [2.0, 2.0], None);
            let mask =
                pixels::Mask { width: 5, height: 4, counts: (0..20).map(|i| i % 5 < 3).collect() };
            let image = Image::new(5, 4, 3, (0..60).map(|i| (i + 1) as f32 / 62.0).collect());
            let photograph = Photograph { image: image.clone(), mask: Some(mask) };
            let mut masked = Photographs::taken_by(camera, image);
            masked.images =
                vec![PackedPhotograph::new(&photograph, &mut PixelMemory::unlimited()).unwrap()];
            let masked = supersampling(masked, None, &options(kind, [2.0, 2.0]));
            let mut drawn = [false; 20];
            (0..800).for_each(|g| drawn[masked.pixel(g).1] = true);
            assert!(drawn.iter().enumerate().all(|(i, d)| *d == (i % 5 < 3)), "{kind:?} {drawn:?}");
            // Far from the masked pixels all is as without them; beside them the kernel feels less.
            assert!(judged(&masked, 7).1.as_flattened().iter().all(|g| g.is_finite()));
            if kind == Supervision::Kernel {
                assert_ne!(judged(&masked, 7), judged(&plain, 7));
            } else {
                assert_eq!(judged(&masked, 7), judged(&plain, 7));
            }
        }
    }

    fn given(camera: &Camera, name: &str, width: usize, height: usize) -> Photographs {
        let camera = Camera { name: name.into(), ..camera.resized(width as u32, height as u32) };
        Photographs::taken_by(camera, hr_image(width, height))
    }

    fn direction_through(camera: &Camera, pixel: usize) -> glam::DVec3 {
        let width = camera.intrinsics.width as usize;
        camera.ray((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5).direction
    }

    /// References join LR images as they are: whatever made those, each sub-pixel ray is a
    /// reference's pixel, and all are met by some.
    #[test]
    fn references_are_compared_with_themselves() {
        let (_, camera) = example(Supervision::Kernel, [2.0, 2.0], None);
        // The last column of blocks overlaps the one before it.
        let (width, height) = (9, 8);
        let truth = hr_image(width, height);
        let large = camera.resized(9, 8);
        for kind in [Supervision::Average, Supervision::Kernel] {
            let mut joined = supersampling(
                given(&camera, "a", 5, 4),
                Some(given(&camera, "a", width, height)),
                &options(kind, [2.0, 2.0]),
            );
            assert_eq!(joined.sampler.numbers(), 20 + 20 * REFERENCE_DRAWS, "{kind:?}");
            let mut rays = [Ray { origin: [0.0; 3], direction: [0.0; 3], background: [0.0; 3] }; 4];
            let mut seen = [false; 72];
            for bundle in 0..800 {
                if joined.pixel(bundle).0 == 0 {
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
                pixels.iter().for_each(|&pixel| seen[pixel] = true);
                // A tenth too bright in the last sub-pixel ray's red, and right in all else.
                let mut colours = pixels.map(|pixel| [0, 1, 2].map(|c| truth.data[3 * pixel + c]));
                colours[3][0] += 0.1;
                let mut gradients = [[9.0; 3]; 4];
                let loss = joined.loss_and_gradient(bundle, &colours, &mut gradients);
                assert!((loss - 0.01 / 12.0).abs() < 1e-6, "{kind:?} {loss}");
                let pulled = gradients[3][0];
                assert!(
                    (pulled - 0.2 / 12.0).abs() < 1e-6
                        && gradients.as_flattened().iter().filter(|g| g.abs() > 1e-6).count() == 1
                );
                joined.remember(bundle, &colours);
            }
            assert!(seen.iter().all(|s| *s), "{kind:?}");
            // With fewer sub-pixel rays they meet the block's mean together.
            joined.sub_pixel_rays.warmup = 0.5;
            joined.set_progress(0.0);
            let bundle = (0..).find(|&bundle| joined.pixel(bundle) == (1, 4)).unwrap();
            joined.sample_rays(bundle, &mut rays[..1]);
            assert!(
                large.ray(8.0, 1.0).direction.distance(rays[0].direction.into()) < 1e-6,
                "{kind:?}"
            );
            let block = [7, 8, 16, 17].map(|pixel| [0, 1, 2].map(|c| truth.data[3 * pixel + c]));
            let mean = [0, 1, 2].map(|c| block.iter().map(|p| p[c]).sum::<f32>() / 4.0);
            assert!(joined.loss_and_gradient(bundle, &[mean], &mut [[0.0; 3]]) < 1e-10, "{kind:?}");
            joined.set_progress(1.0);
            // LR images have what they had.
            let plain = supersampling(given(&camera, "a", 5, 4), None, &options(kind, [2.0, 2.0]));
            let drawn = |of: &Supersampling| (0..).find(|&g| of.pixel(g) == (0, 7)).unwrap();
            let colours = [[0.9, 0.1, 0.4], [0.2, 0.3, 0.5], [0.6, 0.6, 0.1], [0.4, 0.8, 0.7]];
            let mut gradients = [[[0.0; 3]; 4]; 2];
            joined.loss_and_gradient(drawn(&joined), &colours, &mut gradients[0]);
            plain.loss_and_gradient(drawn(&plain), &colours, &mut gradients[1]);
            assert_eq!(gradients[0], gradients[1], "{kind:?}");
        }
        // Of a larger one no more is drawn.
        let larger = supersampling(
            given(&camera, "a", 5, 4),
            Some(given(&camera, "a", 20, 16)),
            &options(Supervision::Kernel, [2.0, 2.0]),
        );
        assert_eq!(larger.sampler.numbers(), 20 + 80);
        let mut masked = truth;
        masked.data[..3].fill(f32::NAN);
        let means = block_means(&masked, [2, 2]);
        assert!(means.data.iter().all(|v| v.is_finite()) && (means.width, means.height) == (5, 4));
        masked.data.fill(f32::NAN);
        assert!(block_means(&masked, [2, 2]).data.iter().all(|v| v.is_nan()));
    }

    /// At a broken scale a box may be whole for a photograph of one size and not for another's:
    /// then the pixels of both are cached, and each is compared with its own.
    #[test]
    fn sizes_share_a_cache() {
        let (_, camera) = example(Supervision::Kernel, [2.0, 2.0], None);
        let mut both = Photographs::taken_by(camera.resized(1, 1), hr_image(1, 1));
        let second = Photographs::taken_by(camera.resized(3, 2), hr_image(3, 2));
        both.views.views.extend(second.views.views);
        both.images.extend(second.images);
        let mut options = options(Supervision::Kernel, [1.5, 1.5]);
        options.filter = Filter::Box;
        let needs = |lr: (usize, usize)| options.needs_cache([lr].into_iter());
        assert!(!needs((1, 1)) && needs((3, 2)));
        let mut joined = supersampling(both, None, &options);
        let mut gradients = vec![[0.0; 3]; joined.rays_per_bundle()];
        for bundle in 0..50 {
            let colours = vec![[0.5, 0.4, 0.3]; joined.rays_per_bundle()];
            assert!(joined.loss_and_gradient(bundle, &colours, &mut gradients).is_finite());
            joined.remember(bundle, &colours);
        }
        assert_eq!(joined.learnt.written_len(), 3 * (2 * 2 + 5 * 3));
    }

    #[test]
    fn every_pixel_is_drawn() {
        let (supersampling, _) = example(Supervision::Average, [1.0, 1.0], None);
        let mut seen = [false; 20];
        (0..400).for_each(|g| seen[supersampling.pixel(g).1] = true);
        assert!(seen.iter().all(|s| *s));
    }
}
