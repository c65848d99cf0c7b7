use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

use counter_rng::CounterRng;
use pixels::{Filter, Image, Resampling};
use poses::Moved;
use radiance::{Ray, RayField};
use scene::{Background, Camera, Intrinsics, Photograph};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::Photographs;
use crate::exposure::Exposures;
use crate::hr_cache::{HrCache, KernelOperator};
use crate::moving_cameras::MovingCameras;
use crate::order::{Focus, detailed, shuffled};

/// How rays are compared with the LR pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Supervision {
    /// Their mean is compared, whatever made the LR images (the paper's eq. 4).
    Average,
    /// As `average`, on LR images that were filtered once so that the mean is the right model.
    Refiltered,
    /// Rays render HR pixels, and the known degradation kernel makes an LR pixel of them.
    Kernel,
}

/// Orders in which pixels are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Order {
    /// Each time any pixel, independently.
    Random,
    /// Each pixel once in random order, then again in another order.
    Epochs,
}

/// Supersampling: a training pixel is drawn at random, those with detail more often, and sub-pixel rays are cast through it.
///
/// `average` compares their mean with the LR pixel (mean squared error over the three channels); `refiltered` does so with y +
/// (A - K)·Uy, where A averages, K is the operator that made the LR images y, and U enlarges. `kernel` minimises the squared
/// distance |K⁺·(K·c - y)|² of the HR pixels c from the nearest ones that K makes y of: those of the drawn LR pixel are
/// rendered, those around it cached ([`HrCache`]), so that the whole footprint costs no more rays than the average. Each
/// sub-pixel ray gets its own share of K⁺·(K·c - y). (|K·c - y|² itself, whose gradient Kᵀ weakens fine detail once more,
/// learns slower.)
///
/// Of an HR reference a block of pixels is drawn at a time, one for each sub-pixel ray to meet, and altogether four times as
/// many blocks as an LR image has pixels.
pub struct Supersampling {
    /// LR photographs, then references.
    views: Vec<TrainingView>,
    /// How many of them are LR photographs.
    lr_views: usize,
    pixels: u64,
    background: Background,
    /// Sub-pixel rays along x and y, when all are cast and now.
    full: [usize; 2],
    side: [usize; 2],
    supersample_warmup: f64,
    order: Order,
    precrop_bundles: u64,
    focus: Focus,
    seed: u64,
    cache: Option<HrCache>,
    exposures: Option<Exposures>,
    moving: Option<MovingCameras>,
}

struct TrainingView {
    /// What bundles are drawn from, a pixel each: of a reference, means over blocks of its pixels. NaN where nothing is known: pixels that don't count.
    image: Image,
    /// A reference's own pixels.
    hr: Option<Image>,
    /// How many numbers the pixels of the views before this one have.
    before: u64,
    intrinsics: Intrinsics,
    origin: [f32; 3],
    /// Of a pinhole: direction of image position (0, 0), and what one pixel to the right or down adds; not of unit length.
    corner: [f64; 3],
    right: [f64; 3],
    down: [f64; 3],
}

impl TrainingView {
    fn new(image: Image, hr: Option<Image>, before: u64, camera: &Camera) -> Self {
        let (intrinsics, none) = (camera.intrinsics, [0.0; 3]);
        let mut view = Self { image, hr, before, intrinsics, origin: [0.0; 3], corner: none, right: none, down: none };
        view.place(camera);
        view
    }

    /// The photograph at its own size.
    fn photograph(&self) -> &Image {
        self.hr.as_ref().unwrap_or(&self.image)
    }

    /// Has its rays cast from where a camera is.
    fn place(&mut self, camera: &Camera) {
        let (k, r) = (camera.intrinsics, camera.rotation());
        self.origin = camera.centre().as_vec3().to_array();
        self.corner = (r * glam::DVec3::new(-k.cx / k.fx, k.cy / k.fy, -1.0)).to_array();
        self.right = (r.x_axis / k.fx).to_array();
        self.down = (-r.y_axis / k.fy).to_array();
    }
}

/// How to supersample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SupersamplingOptions {
    /// What is compared.
    pub supervision: Supervision,
    /// Size of the HR images that the field is to render, over that of the LR ones, per axis.
    pub scale: [f64; 2],
    /// The filter that made the LR images.
    pub filter: Filter,
    /// Share of the training during which fewer sub-pixel rays are cast.
    pub supersample_warmup: f64,
    /// In which order pixels are drawn.
    pub order: Order,
    /// Pixels at the start that come from the middle half of each image's width and height alone.
    pub precrop_bundles: u64,
    /// How many times as often a pixel with detail is drawn as a flat one, in random order.
    pub pixel_importance: f64,
    /// Whether to find each photograph's exposure.
    pub exposure: bool,
    /// Whether to move cameras to where photographs are met best.
    pub pose_refinement: bool,
    /// Seed of what is drawn.
    pub seed: u64,
}

/// Purposes of draws.
const PIXEL: u64 = 100;
const BACKGROUND: u64 = 101;

/// How many times as often something of a reference is drawn as of an LR image. On a small demo scene, six of twelve views at
/// HR, there are 21.66 dB without them, 21.63 and 22.12 with 1 and 4.
const REFERENCE_DRAWS: u64 = 4;

/// Draws until one is of a pixel that counts; after so many the last is taken, and has no residual.
const REDRAWS: usize = 64;

/// Above this (254.5 in 8 bits) an LR sample may have been clipped, and below its counterpart.
const SATURATED: f32 = 254.5 / 255.0;

impl Supersampling {
    /// Supervision by LR photographs, and by HR ones that join them. Pixels that don't count are neither drawn nor compared with.
    pub fn new(photographs: Photographs, references: Option<Photographs>, options: &SupersamplingOptions) -> Self {
        let (background, lr_views) = (photographs.views.background, photographs.images.len());
        let lr_pixels: u64 = photographs.images.iter().map(|p| (p.image.width * p.image.height) as u64).sum();
        let hr_length = |length: usize, i: usize| ((length as f64 * options.scale[i]).round() as usize).max(1);
        let operator = |image: &Image| {
            let (lr, hr) = ((image.width, image.height), (hr_length(image.width, 0), hr_length(image.height, 1)));
            (Resampling::new(Filter::Lanczos, lr, hr), Resampling::new(options.filter, hr, lr))
        };
        let smallest = |i: usize, length: fn(&Image) -> usize| {
            let lr = photographs.images.iter().map(|p| hr_length(length(&p.image), i));
            lr.chain(references.iter().flat_map(|r| &r.images).map(|p| length(&p.image))).min().unwrap_or(1)
        };
        let smallest = [smallest(0, |p| p.width), smallest(1, |p| p.height)];
        let full = [0, 1].map(|i| ((options.scale[i] - 1e-6).ceil() as usize).clamp(1, smallest[i]));
        let mut cache = None;
        let mut kernels: BTreeMap<(usize, usize), (Resampling, Arc<KernelOperator>)> = BTreeMap::new();
        let mut pixels = 0;
        let mut with_detail = Vec::new();
        let mut ready = Vec::new();
        let mut cameras = Vec::new();
        let all = [Some(photographs), references].into_iter().flatten();
        for (view, Photograph { mut image, mask }) in all.flat_map(|p| p.views.views.into_iter().zip(p.images)) {
            match options.supervision {
                // References are what they are: nothing has shrunk them.
                _ if ready.len() >= lr_views => {}
                Supervision::Average => {}
                Supervision::Refiltered => {
                    let (enlarge, shrink) = operator(&image);
                    image = refiltered(&image, &enlarge, &shrink);
                }
                Supervision::Kernel => {
                    let (enlarge, kernel) = kernels.entry((image.width, image.height)).or_insert_with(|| {
                        let (enlarge, shrink) = operator(&image);
                        (enlarge, Arc::new(KernelOperator::new(shrink)))
                    });
                    cache.get_or_insert_with(|| HrCache::new(full)).add(&enlarge.apply(&image), kernel.clone());
                }
            }
            let before = pixels;
            let (whole, known) = (image.clone(), Photograph { image, mask }.known());
            // What the kernel needs to know of pixels around those that don't count stays: what was photographed, since it blurred into its neighbours.
            let (whole, image, hr) = if ready.len() < lr_views {
                (whole, known, None)
            } else {
                (block_means(&whole, full), block_means(&known, full), Some(known))
            };
            let count = (image.width * image.height) as u64;
            // Each block of a reference has so many numbers.
            let draws = if hr.is_none() { 1 } else { (REFERENCE_DRAWS * lr_pixels / (lr_views as u64 * count)).max(1) };
            if options.pixel_importance > 1.0 {
                let counts = |pixel: &usize| !image.data[pixel * image.channels].is_nan();
                let detailed: Vec<usize> = detailed(&whole).filter(counts).collect();
                with_detail.extend((0..draws).flat_map(|k| detailed.iter().map(move |&pixel| before + k * count + pixel as u64)));
            }
            pixels += draws * count;
            ready.push(TrainingView::new(image, hr, before, &view.camera));
            cameras.push(view.camera);
        }
        let SupersamplingOptions { supersample_warmup, order, precrop_bundles, pixel_importance, exposure, seed, .. } = *options;
        let focus = Focus::new(pixel_importance, pixels, with_detail);
        let exposures = exposure.then(|| Exposures::new(ready.len()));
        let moving = options.pose_refinement.then(|| MovingCameras::new(cameras, ready.iter().map(TrainingView::photograph)));
        let side = full;
        Self {
            views: ready,
            lr_views,
            pixels,
            background,
            full,
            side,
            supersample_warmup,
            order,
            precrop_bundles,
            focus,
            seed,
            cache,
            exposures,
            moving,
        }
    }

    /// Sub-pixel rays of an LR pixel along x and y, once all are cast.
    pub fn full_side(&self) -> [usize; 2] {
        self.full
    }

    /// The cache, where the kernel is what counts for a view by now.
    fn kernel(&self, view: usize) -> Option<&HrCache> {
        self.cache.as_ref().filter(|_| self.side == self.full && view < self.lr_views)
    }

    /// What it has come to know in the training, for a checkpoint: HR pixels as last rendered, what exposures follow from, and poses.
    pub(crate) fn kept(&self) -> impl Iterator<Item = Cow<'_, [u8]>> {
        let renders = self.cache.iter().flat_map(HrCache::parts).map(Cow::Borrowed);
        let exposures = self.exposures.iter().map(|e| Cow::Owned(e.bytes()));
        renders.chain(exposures).chain(self.moving.iter().map(|m| Cow::Owned(m.bytes())))
    }

    /// Bytes of each of the three.
    fn kept_lengths(&self) -> [usize; 3] {
        [
            self.cache.as_ref().map_or(0, HrCache::len),
            self.exposures.as_ref().map_or(0, Exposures::len),
            self.moving.as_ref().map_or(0, MovingCameras::len),
        ]
    }

    /// Bytes of all that.
    pub(crate) fn kept_len(&self) -> usize {
        self.kept_lengths().iter().sum()
    }

    /// Restores what was kept, [`Supersampling::kept_len`] bytes.
    pub(crate) fn restore(&mut self, kept: &[u8]) {
        let [renders, sums, _] = self.kept_lengths();
        let (renders, rest) = kept.split_at(renders);
        let (sums, poses) = rest.split_at(sums);
        self.cache.iter_mut().for_each(|cache| cache.restore(renders));
        self.exposures.iter_mut().for_each(|exposures| exposures.restore(sums));
        self.moving.iter_mut().for_each(|moving| moving.restore(poses));
        self.place_views();
    }

    /// Moves cameras, where that was asked for and it is time for it, to where the field's renderings meet their photographs best. `field` is
    /// only made when it is.
    pub(crate) fn refine_poses<'a>(
        &mut self,
        done: f64,
        field: impl FnOnce() -> anyhow::Result<Box<dyn RayField + 'a>>,
    ) -> anyhow::Result<()> {
        let Some(moving) = self.moving.as_mut().filter(|moving| moving.are_due(done)) else { return Ok(()) };
        let exposure = |view: usize| self.exposures.as_ref().map_or([1.0; 3], |exposures| exposures.of(view).map(f32::recip));
        moving.step(&*field()?, done, self.background.shown(), exposure).map_err(|e| anyhow::anyhow!(e))?;
        self.place_views();
        Ok(())
    }

    /// Has rays cast from where cameras have moved to.
    fn place_views(&mut self) {
        let cameras = self.moving.iter().flat_map(MovingCameras::cameras);
        self.views.iter_mut().zip(cameras).for_each(|(view, camera)| view.place(camera));
    }

    /// How far cameras of photographs have gone, where that was asked for. `field` is only made then.
    pub(crate) fn moved<'a>(
        &self,
        field: impl FnOnce() -> anyhow::Result<Box<dyn RayField + 'a>>,
    ) -> anyhow::Result<Option<Moved>> {
        let Some(moving) = &self.moving else { return Ok(None) };
        let moved = moving.moved(&*field()?, self.lr_views, self.background.shown()).map_err(|e| anyhow::anyhow!(e))?;
        Ok(Some(moved))
    }

    /// Where the photographs were taken from, where that was asked for.
    pub fn refined_cameras(&self) -> &[Camera] {
        self.moving.as_ref().map_or(&[], |moving| &moving.cameras()[..self.lr_views])
    }

    /// What each photograph is so many times as bright as, red, green and blue, where that was asked for.
    pub fn exposures(&self) -> &[[f32; 3]] {
        self.exposures.as_ref().map_or(&[], |exposures| &exposures.factors()[..self.lr_views])
    }

    /// The view and pixel that a bundle trains on.
    fn pixel(&self, bundle: u64) -> (usize, usize) {
        let mut rng = CounterRng::new(self.seed, PIXEL, bundle);
        let (view, pixel) = match self.order {
            Order::Epochs if bundle >= self.precrop_bundles => {
                let bundle = bundle - self.precrop_bundles;
                self.place(shuffled(self.seed, bundle / self.pixels, bundle % self.pixels, self.pixels))
            }
            _ => {
                let mut draw = || self.place(self.focus.draw(self.pixels, &mut rng));
                let mut place = draw();
                for _ in 1..REDRAWS {
                    if self.counts(place) {
                        break;
                    }
                    place = draw();
                }
                place
            }
        };
        let (width, height) = (self.views[view].image.width as u64, self.views[view].image.height as u64);
        if bundle < self.precrop_bundles {
            let mut middle = |length: u64| length / 4 + rng.below((length / 2).max(1));
            let (x, y) = (middle(width), middle(height));
            return (view, (y * width + x) as usize);
        }
        (view, pixel)
    }

    /// The view and its pixel that have a number among those of all views.
    fn place(&self, pixel: u64) -> (usize, usize) {
        let view = self.views.partition_point(|v| v.before <= pixel) - 1;
        let TrainingView { image, before, .. } = &self.views[view];
        (view, (pixel - before) as usize % (image.width * image.height))
    }

    /// Whether anything is known of a pixel.
    fn counts(&self, (view, pixel): (usize, usize)) -> bool {
        let image = &self.views[view].image;
        !image.data[pixel * image.channels].is_nan()
    }

    /// What lies behind a bundle's rays: with an open background, or none, another colour each time, so that opacity is learnt.
    fn behind(&self, bundle: u64) -> [f32; 3] {
        if matches!(self.background, Background::Alpha | Background::Opaque) {
            let mut rng = CounterRng::new(self.seed, BACKGROUND, bundle);
            [0, 1, 2].map(|_| rng.uniform())
        } else {
            [self.background.shown(); 3]
        }
    }
}

/// Prediction less target; nothing where the target isn't known.
fn residual(prediction: f32, target: f32) -> f32 {
    if target.is_nan() { 0.0 } else { prediction - target }
}

/// The same, with the target's exposure taken back by a factor, and nothing where it was clipped and the prediction lies beyond it.
fn unclipped_residual(prediction: f32, target: f32, back: f32) -> f32 {
    let residual = residual(prediction, back * target);
    if (target >= SATURATED && residual > 0.0) || (target <= 1.0 - SATURATED && residual < 0.0) { 0.0 } else { residual }
}

/// The image as averaging would have made it: y + (A - K)·Uy, with A the average over LR pixels.
fn refiltered(image: &Image, enlarge: &Resampling, shrink: &Resampling) -> Image {
    let hr = enlarge.apply(image);
    let average = Resampling::new(Filter::Box, (hr.width, hr.height), (image.width, image.height));
    let mut out = average.apply(&hr);
    for ((value, &y), ky) in out.data.iter_mut().zip(&image.data).zip(shrink.apply(&hr).data) {
        *value += y - ky;
    }
    out
}

/// Where a block of a reference's pixels begins: the last of a row or column ends with the image.
fn block_start(block: usize, block_length: usize, length: usize) -> usize {
    (block * block_length).min(length.saturating_sub(block_length))
}

/// Means over blocks of an image's pixels, of those that are known.
fn block_means(image: &Image, block: [usize; 2]) -> Image {
    let (width, height) = (image.width.div_ceil(block[0]), image.height.div_ceil(block[1]));
    let mut data = Vec::with_capacity(width * height * image.channels);
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
        let (left, top) = (block_start(x, block[0], image.width), block_start(y, block[1], image.height));
        let rows = top..(top + block[1]).min(image.height);
        let pixels = rows.flat_map(|j| (left..(left + block[0]).min(image.width)).map(move |i| j * image.width + i));
        data.extend((0..image.channels).map(|c| {
            let known = pixels.clone().map(|pixel| image.data[pixel * image.channels + c]).filter(|v| !v.is_nan());
            let (sum, count) = known.fold((0.0, 0.0), |(sum, count), v| (sum + v, count + 1.0f32));
            sum / count
        }));
    }
    Image::new(width, height, image.channels, data)
}

/// How often the sub-pixel rays along a side double before all are cast: as many stages has the warm-up.
pub(crate) fn warmup_stages(side: u64) -> u32 {
    side.next_power_of_two().trailing_zeros()
}

impl radiance::Supervisor for Supersampling {
    fn set_progress(&mut self, done: f64) {
        self.exposures.iter_mut().for_each(|exposures| exposures.settle(done));
        self.side = self.full;
        if done < self.supersample_warmup {
            let stages = warmup_stages(self.full[0].max(self.full[1]) as u64);
            let now = 1 << (done / self.supersample_warmup * f64::from(stages)) as u32;
            self.side = self.full.map(|n| n.min(now));
        }
    }

    fn rays_per_bundle(&self) -> usize {
        self.side[0] * self.side[1]
    }

    fn sample_rays(&self, bundle: u64, rays: &mut [Ray]) {
        let (index, pixel) = self.pixel(bundle);
        let view = &self.views[index];
        let background = self.behind(bundle);
        let (x, y) = (pixel % view.image.width, pixel / view.image.width);
        // Where the sub-pixel rays begin, and how far apart they are, in pixels of its camera.
        let (start, apart) = match (self.kernel(index), &view.hr) {
            (Some(cache), _) => cache.block_in_pixels(index, x, y),
            (None, Some(hr)) => {
                let start = [block_start(x, self.full[0], hr.width), block_start(y, self.full[1], hr.height)];
                (start.map(|s| s as f64), [0, 1].map(|i| self.full[i] as f64 / self.side[i] as f64))
            }
            (None, None) => ([x as f64, y as f64], self.side.map(|n| 1.0 / n as f64)),
        };
        for (k, ray) in rays.iter_mut().enumerate() {
            let (a, b) = (k % self.side[0], k / self.side[0]);
            let u = start[0] + (a as f64 + 0.5) * apart[0];
            let v = start[1] + (b as f64 + 0.5) * apart[1];
            let [u, v] = view.intrinsics.undistort([u, v]);
            let d: [f64; 3] = std::array::from_fn(|i| view.corner[i] + u * view.right[i] + v * view.down[i]);
            let length = d.iter().map(|x| x * x).sum::<f64>().sqrt();
            *ray = Ray { origin: view.origin, direction: d.map(|x| (x / length) as f32), background };
        }
    }

    fn loss_and_gradient(&self, bundle: u64, colours: &[[f32; 3]], gradients: &mut [[f32; 3]]) -> f64 {
        let (index, pixel) = self.pixel(bundle);
        let image = &self.views[index].image;
        let sample = &image.data[pixel * image.channels..][..image.channels];
        let share = 1.0 / colours.len() as f32;
        let back = self.exposures.as_ref().map_or([1.0; 3], |exposures| exposures.of(index).map(f32::recip));
        let behind = if image.channels == 4 { self.behind(bundle) } else { [0.0; 3] };
        let is_cropped = bundle < self.precrop_bundles;
        let weight = if is_cropped { 1.0 } else { self.focus.weight(self.views[index].before + pixel as u64) };
        if let Some(cache) = self.kernel(index) {
            let at = [pixel % image.width, pixel / image.width];
            let residual = |c: usize, prediction, target| unclipped_residual(prediction, target, back[c]);
            let own = cache.back_project(index, at, colours, image, residual, gradients);
            gradients.as_flattened_mut().iter_mut().for_each(|g| *g *= weight * (2.0 / 3.0));
            return own.iter().map(|&r| f64::from(weight) * f64::from(r) * f64::from(r) / 3.0).sum();
        }
        let target = |sample: &[f32], c: usize| match sample {
            [.., alpha] if sample.len() == 4 => back[c] * (sample[c] + (1.0 - alpha) * behind[c]),
            _ => back[c] * sample[c],
        };
        let mut loss = 0.0;
        if let Some(hr) = self.views[index].hr.as_ref().filter(|_| self.side == self.full) {
            let left = block_start(pixel % image.width, self.full[0], hr.width);
            let top = block_start(pixel / image.width, self.full[1], hr.height);
            for (k, (colour, gradient)) in colours.iter().zip(gradients).enumerate() {
                let at = (top + k / self.full[0]) * hr.width + left + k % self.full[0];
                let sample = &hr.data[at * hr.channels..][..hr.channels];
                for c in 0..3 {
                    let residual = residual(colour[c], target(sample, c));
                    loss += f64::from(weight * share) * f64::from(residual) * f64::from(residual) / 3.0;
                    gradient[c] = weight * residual * share * (2.0 / 3.0);
                }
            }
            return loss;
        }
        for c in 0..3 {
            let mean = colours.iter().map(|colour| colour[c]).sum::<f32>() * share;
            let residual = residual(mean, target(sample, c));
            loss += f64::from(weight) * f64::from(residual) * f64::from(residual) / 3.0;
            for gradient in gradients.iter_mut() {
                gradient[c] = weight * residual * share * (2.0 / 3.0);
            }
        }
        loss
    }

    fn remember(&mut self, bundle: u64, colours: &[[f32; 3]]) {
        if self.cache.is_none() && self.exposures.is_none() {
            return;
        }
        let (index, pixel) = self.pixel(bundle);
        let image = &self.views[index].image;
        if let Some(exposures) = &mut self.exposures {
            let at = pixel * image.channels;
            let is_clipped = |y: f32| y >= SATURATED || y <= 1.0 - SATURATED;
            let photographed = [0, 1, 2].map(|c| image.data[at + c]).map(|y| if is_clipped(y) { f32::NAN } else { y });
            let mean = |c: usize| colours.iter().map(|colour| colour[c]).sum::<f32>() / colours.len() as f32;
            exposures.learn(index, photographed, [mean(0), mean(1), mean(2)]);
        }
        let is_cached = self.side == self.full && index < self.lr_views;
        if let Some(cache) = self.cache.as_mut().filter(|_| is_cached) {
            cache.remember(index, pixel % image.width, pixel / image.width, colours);
        }
    }
}

#[cfg(test)]
mod tests {
    use radiance::Supervisor as _;
    use scene::{Bounds, Camera, Distortion, View, Views};

    use super::*;

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

    fn example(supervision: Supervision, scale: [f64; 2], image: Option<Image>) -> (Supersampling, Camera) {
        let distortion = Distortion { radial: [0.1, -0.02, 0.01], tangential: [0.005, -0.003] };
        let camera = Camera {
            name: "a".into(),
            intrinsics: Intrinsics { width: 5, height: 4, fx: 6.0, fy: 7.0, cx: 2.4, cy: 2.1, distortion },
            camera_to_world: [[0., 0., 1., 3.], [1., 0., 0., 0.5], [0., 1., 0., 0.2]],
        };
        let bounds = Bounds { min: [-1.; 3], max: [1.; 3], near: 0.1, far: 9.0, ..Default::default() };
        let views = Views::new(Background::White, bounds, vec![View::camera_only(camera.clone())]);
        let image = image.unwrap_or_else(|| Image::new(5, 4, 3, (0..60).map(|i| (i + 1) as f32 / 62.0).collect()));
        let photographs = Photographs { views, images: vec![image.into()] };
        (Supersampling::new(photographs, None, &options(supervision, scale)), camera)
    }

    /// The sub-pixel rays of a pixel are pixel rays of the finer image: no half-pixel shift, at any scale.
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
                        let (x, y) = ((i % size[0] as usize) as f64 + 0.5, (i / size[0] as usize) as f64 + 0.5);
                        let expected = hr.ray(x, y).direction.as_vec3().to_array();
                        (0..3).all(|c| (ray.direction[c] - expected[c]).abs() < 1e-6)
                    });
                    seen[pixel.unwrap_or_else(|| panic!("{kind:?} {scale:?}: {ray:?} is no pixel's ray"))] = true;
                }
            }
            assert!(seen.iter().all(|s| *s), "{kind:?} {scale:?}: every HR pixel is seen");
        }
    }

    /// Behind an opaque scene lies another colour in every bundle, and what is asked for is the same: a field that is opaque alone
    /// can give it.
    #[test]
    fn nothing_can_pretend_to_be_an_opaque_scenes_background() {
        let behind = |background| -> Vec<[f32; 3]> {
            let (mut supersampling, _) = example(Supervision::Kernel, [2.0, 2.0], None);
            supersampling.background = background;
            let mut rays = vec![Ray::default(); supersampling.rays_per_bundle()];
            let bundles = (0..40).map(|bundle| {
                supersampling.sample_rays(bundle, &mut rays);
                assert!(rays.iter().all(|r| r.background == rays[0].background));
                rays[0].background
            });
            bundles.collect()
        };
        assert!(behind(Background::White).iter().all(|b| *b == [1.0; 3]));
        let colours = behind(Background::Opaque);
        assert!((0..40).all(|i| (0..i).all(|j| colours[i] != colours[j])));
        assert!(colours.iter().flatten().any(|c| *c < 0.2) && colours.iter().flatten().any(|c| *c > 0.8));
    }

    #[test]
    fn gradient_is_that_of_the_loss() {
        for kind in [Supervision::Average, Supervision::Refiltered] {
            let (supersampling, _) = example(kind, [2.0, 2.0], None);
            let colours: Vec<[f32; 3]> = (0..4).map(|k| [0.1 * k as f32, 0.5, 0.9]).collect();
            let mut gradients = vec![[0.0; 3]; 4];
            supersampling.loss_and_gradient(7, &colours, &mut gradients);
            for k in 0..4 {
                for c in 0..3 {
                    let mut moved = colours.clone();
                    let mut scrap = vec![[0.0; 3]; 4];
                    moved[k][c] += 0.01;
                    let up = supersampling.loss_and_gradient(7, &moved, &mut scrap);
                    moved[k][c] -= 0.02;
                    let numeric = (up - supersampling.loss_and_gradient(7, &moved, &mut scrap)) / 0.02;
                    assert!((f64::from(gradients[k][c]) - numeric).abs() < 1e-5, "{kind:?}");
                }
            }
        }
    }

    /// Once the field renders the true HR image, the kernel is content: no loss and no gradient. The average isn't.
    #[test]
    fn only_the_kernel_is_content_with_the_truth() {
        let truth = hr_image(10, 8);
        let lr = Resampling::new(Filter::Lanczos, (10, 8), (5, 4)).apply(&truth);
        let worst = |kind| {
            let (mut supersampling, _) = example(kind, [2.0, 2.0], Some(lr.clone()));
            let mut worst = (0.0f64, 0.0f32);
            for bundle in 0..800 {
                let pixel = supersampling.pixel(bundle).1;
                let (x, y) = (pixel % 5 * 2, pixel / 5 * 2);
                let colours: Vec<[f32; 3]> =
                    (0..4).map(|k| std::array::from_fn(|c| truth.data[3 * (x + k % 2 + (y + k / 2) * 10) + c])).collect();
                let mut gradients = [[0.0; 3]; 4];
                let loss = supersampling.loss_and_gradient(bundle, &colours, &mut gradients);
                supersampling.remember(bundle, &colours);
                // Until then the cache isn't full of the truth.
                if bundle >= 400 {
                    let gradient = gradients.as_flattened().iter().fold(0.0f32, |most, g| most.max(g.abs()));
                    worst = (worst.0.max(loss), worst.1.max(gradient));
                }
            }
            worst
        };
        let (kernel, average) = (worst(Supervision::Kernel), worst(Supervision::Average));
        assert!(kernel.0 < 1e-9 && kernel.1 < 1e-5, "{kernel:?}");
        assert!(average.0 > 1e-4 && average.1 > 1e-3, "{average:?}");
    }

    /// A clipped sample says no more than that the true value lies beyond.
    #[test]
    fn what_was_clipped_is_no_residual() {
        let cases =
            [(1.1, 1.0, 0.0), (0.9, 1.0, -0.1), (-0.1, 0.0, 0.0), (0.1, 0.0, 0.1), (1.1, 0.99, 0.11), (-0.1, 0.01, -0.11)];
        for (prediction, target, residual) in cases {
            assert!((unclipped_residual(prediction, target, 1.0) - residual).abs() < 1e-6, "{prediction} {target}");
        }
        let white = Image::new(5, 4, 3, vec![1.0; 60]);
        let (supersampling, _) = example(Supervision::Kernel, [2.0, 2.0], Some(white));
        let mut gradients = [[0.0; 3]; 4];
        assert!(supersampling.loss_and_gradient(3, &[[1.0; 3]; 4], &mut gradients) < 1e-10, "rounding alone");
        assert!(supersampling.loss_and_gradient(3, &[[0.1; 3]; 4], &mut gradients) > 0.1, "what is too dark is still wrong");
        assert!(gradients.as_flattened().iter().all(|g| *g < 0.0));
    }

    /// 1, 2, 4 … sub-pixel rays a side, each for an equal part of the warm-up, and then all.
    #[test]
    fn sub_pixel_rays_double_until_all_are_cast() {
        let rays_at = |scale: f64, done: f64| {
            let (mut supersampling, _) = example(Supervision::Kernel, [scale; 2], None);
            supersampling.supersample_warmup = 0.3;
            supersampling.set_progress(done);
            supersampling.rays_per_bundle()
        };
        for (scale, expected) in [(1.0, [1, 1, 1]), (2.0, [1, 1, 4]), (3.0, [1, 4, 9]), (4.0, [1, 4, 16])] {
            assert_eq!([0.0, 0.2, 0.3].map(|done| rays_at(scale, done)), expected, "{scale}");
        }
    }

    /// In epochs every pixel comes once before any comes again, each time in another order; the first come from the middle.
    #[test]
    fn epochs_draw_without_replacement() {
        let (mut supersampling, _) = example(Supervision::Average, [1.0, 1.0], None);
        (supersampling.order, supersampling.precrop_bundles) = (Order::Epochs, 50);
        let drawn = |range: std::ops::Range<u64>| range.map(|g| supersampling.pixel(g).1).collect::<Vec<_>>();
        // 5 × 4 pixels.
        assert!(drawn(0..50).iter().all(|p| (1..3).contains(&(p % 5)) && (1..3).contains(&(p / 5))));
        let (mut first, mut second) = (drawn(50..70), drawn(70..90));
        assert_ne!(first, second);
        for epoch in [&mut first, &mut second] {
            epoch.sort_unstable();
            assert_eq!(*epoch, (0..20).collect::<Vec<_>>());
        }
    }

    /// Pixels that don't count are neither drawn, nor pulled to what the photograph has there; what counts beside them is.
    #[test]
    fn masked_pixels_say_nothing() {
        for kind in [Supervision::Average, Supervision::Refiltered, Supervision::Kernel] {
            let (plain, camera) = example(kind, [2.0, 2.0], None);
            let mask = pixels::Mask { width: 5, height: 4, counts: (0..20).map(|i| i % 5 < 3).collect() };
            let image = Image::new(5, 4, 3, (0..60).map(|i| (i + 1) as f32 / 62.0).collect());
            let views = Views::new(Background::White, Bounds::default(), vec![View::camera_only(camera)]);
            let photograph = Photograph { image, mask: Some(mask) };
            let masked = Photographs { views, images: vec![photograph] };
            let masked = Supersampling::new(masked, None, &options(kind, [2.0, 2.0]));
            let mut drawn = [false; 20];
            (0..800).for_each(|g| drawn[masked.pixel(g).1] = true);
            assert!(drawn.iter().enumerate().all(|(i, d)| *d == (i % 5 < 3)), "{kind:?} {drawn:?}");
            // Far from the masked pixels all is as without them; beside them the kernel feels less.
            let judged = |of: &Supersampling, pixel: usize| {
                let bundle = (0..).find(|&g| of.pixel(g).1 == pixel).unwrap();
                let mut gradients = [[0.0; 3]; 4];
                let loss = of.loss_and_gradient(bundle, &[[0.9, 0.1, 0.4]; 4], &mut gradients);
                (loss, gradients)
            };
            assert!(judged(&masked, 7).1.as_flattened().iter().all(|g| g.is_finite()));
            if kind == Supervision::Kernel {
                assert_ne!(judged(&masked, 7), judged(&plain, 7));
            } else {
                assert_eq!(judged(&masked, 7), judged(&plain, 7));
            }
        }
        assert_eq!(residual(0.2, f32::NAN), 0.0);
        assert_eq!(unclipped_residual(0.2, f32::NAN, 1.0), 0.0);
    }

    /// References join LR images as they are: whatever made those, each sub-pixel ray is a reference's pixel, and all are met
    /// by some.
    #[test]
    fn references_are_compared_with_themselves() {
        let (_, camera) = example(Supervision::Kernel, [2.0, 2.0], None);
        let given = |name: &str, width: usize, height: usize| {
            let camera = Camera { name: name.into(), ..camera.resized(width as u32, height as u32) };
            let views = Views::new(Background::White, Bounds::default(), vec![View::camera_only(camera)]);
            Photographs { views, images: vec![hr_image(width, height).into()] }
        };
        // The last column of blocks overlaps the one before it.
        let (width, height) = (9, 8);
        let truth = hr_image(width, height);
        let camera = camera.resized(9, 8);
        for kind in [Supervision::Average, Supervision::Refiltered, Supervision::Kernel] {
            let mut joined = Supersampling::new(given("a", 5, 4), Some(given("a", width, height)), &options(kind, [2.0, 2.0]));
            assert_eq!(joined.pixels, 20 + 20 * REFERENCE_DRAWS, "{kind:?}");
            let mut rays = [Ray { origin: [0.0; 3], direction: [0.0; 3], background: [0.0; 3] }; 4];
            let mut seen = [false; 72];
            for bundle in 0..800 {
                if joined.pixel(bundle).0 == 0 {
                    continue;
                }
                joined.sample_rays(bundle, &mut rays);
                let pixels = rays.map(|ray| {
                    let of =
                        |pixel: usize| camera.ray((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5).direction.as_vec3();
                    (0..72).find(|&pixel| of(pixel).distance(ray.direction.into()) < 1e-6).expect("a pixel's ray")
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
                    (pulled - 0.2 / 12.0).abs() < 1e-6 && gradients.as_flattened().iter().filter(|g| g.abs() > 1e-6).count() == 1
                );
                joined.remember(bundle, &colours);
            }
            assert!(seen.iter().all(|s| *s), "{kind:?}");
            // With fewer sub-pixel rays they meet the block's mean together.
            joined.supersample_warmup = 0.5;
            joined.set_progress(0.0);
            let bundle = (0..).find(|&bundle| joined.pixel(bundle) == (1, 4)).unwrap();
            joined.sample_rays(bundle, &mut rays[..1]);
            assert!(camera.ray(8.0, 1.0).direction.as_vec3().distance(rays[0].direction.into()) < 1e-6, "{kind:?}");
            let block = [7, 8, 16, 17].map(|pixel| [0, 1, 2].map(|c| truth.data[3 * pixel + c]));
            let mean = [0, 1, 2].map(|c| block.iter().map(|p| p[c]).sum::<f32>() / 4.0);
            assert!(joined.loss_and_gradient(bundle, &[mean], &mut [[0.0; 3]]) < 1e-10, "{kind:?}");
            joined.set_progress(1.0);
            // LR images have what they had.
            let plain = Supersampling::new(given("a", 5, 4), None, &options(kind, [2.0, 2.0]));
            let drawn = |of: &Supersampling| (0..).find(|&g| of.pixel(g) == (0, 7)).unwrap();
            let colours = [[0.9, 0.1, 0.4], [0.2, 0.3, 0.5], [0.6, 0.6, 0.1], [0.4, 0.8, 0.7]];
            let mut gradients = [[[0.0; 3]; 4]; 2];
            joined.loss_and_gradient(drawn(&joined), &colours, &mut gradients[0]);
            plain.loss_and_gradient(drawn(&plain), &colours, &mut gradients[1]);
            assert_eq!(gradients[0], gradients[1], "{kind:?}");
        }
        // Of a larger one no more is drawn.
        let larger = Supersampling::new(given("a", 5, 4), Some(given("a", 20, 16)), &options(Supervision::Kernel, [2.0, 2.0]));
        assert_eq!(larger.pixels, 20 + 80);
        let mut masked = truth;
        masked.data[..3].fill(f32::NAN);
        let means = block_means(&masked, [2, 2]);
        assert!(means.data.iter().all(|v| v.is_finite()) && (means.width, means.height) == (5, 4));
        masked.data.fill(f32::NAN);
        assert!(block_means(&masked, [2, 2]).data.iter().all(|v| v.is_nan()));
    }

    #[test]
    fn every_pixel_is_drawn() {
        let (supersampling, _) = example(Supervision::Average, [1.0, 1.0], None);
        let mut seen = [false; 20];
        (0..400).for_each(|g| seen[supersampling.pixel(g).1] = true);
        assert!(seen.iter().all(|s| *s));
    }
}
