use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;

use pixels::{Filter, Image, Resampling};
use scene::{Camera, Space};

use super::options::SupersamplingOptions;
use super::pixel_sampler::{Importance, PixelSampler, ViewPixels, detailed_pixels};
use super::{Supersampling, TrainingView};
use crate::params::Exposure;
use crate::photographs::{PackedPhotograph, Photographs, PixelMemory, PixelSet};
use crate::state::{
    ExposureMeasurement, Exposures, HrCache, KernelOperator, MovingCameras, SupervisionState,
};
use crate::supersample::SupersampleSchedule;

/// Ratio of the number of draws of a reference's blocks to that of an LR image's pixels. On a small
/// demo scene with six of twelve views at HR, a ratio of 4 gives 22.12 dB, 1 gives 21.63 dB, and
/// training without references 21.66 dB (design note 019).
pub(crate) const REFERENCE_DRAWS: u64 = 4;

impl Supersampling {
    /// Creates a supervision by LR photographs and, optionally, HR references. Invalid pixels have
    /// no loss; sampling avoids them, except in epochs, which contain all pixels.
    pub(crate) fn new(
        photographs: Photographs,
        references: Option<Photographs>,
        options: &SupersamplingOptions,
        memory: PixelMemory,
    ) -> io::Result<Self> {
        let background = photographs.views.background;
        let is_contraction = photographs.views.bounds.space == Space::Contraction;
        let params = &options.params;
        let cameras = params
            .pose_refinement
            .then(|| MovingCameras::new(std::iter::once(&photographs).chain(references.as_ref())));
        let mut assembly = Assembly::new(&photographs, references.as_ref(), options, memory);
        for (view, photograph) in photographs.into_pairs() {
            assembly.add_photograph(&view.camera, photograph)?;
        }
        for (view, reference) in references.into_iter().flat_map(Photographs::into_pairs) {
            assembly.add_reference(&view.camera, reference)?;
        }
        let view_count = assembly.views.len();
        let counts = (assembly.index_count, assembly.valid_count);
        Ok(Self {
            sampler: PixelSampler {
                views: assembly.view_pixels,
                index_count: assembly.index_count,
                importance: Importance::new(params.pixel_importance, counts, assembly.detailed),
                in_epochs: params.in_epochs,
                precrop_bundles: params.precrop_bundles(),
                seed: params.seed,
            },
            state: SupervisionState {
                cache: assembly.cache,
                exposures: (params.exposure == Exposure::On).then(|| Exposures::new(view_count)),
                measurement: (params.exposure == Exposure::ByScene)
                    .then(|| ExposureMeasurement::new(view_count, is_contraction)),
                cameras,
            },
            views: assembly.views,
            background,
            schedule: SupersampleSchedule::new(assembly.supersample, params.supersample_warmup),
            supervision: params.supervision,
            seed: params.seed,
            memory: assembly.memory,
        })
    }
}

/// Builder of the training views: LR photographs first, then references.
struct Assembly<'a> {
    options: &'a SupersamplingOptions,
    /// Sub-pixel rays along x and y after the warm-up.
    supersample: [usize; 2],
    lr_views: usize,
    /// Number of pixels of all LR photographs.
    lr_pixels: u64,
    views: Vec<TrainingView>,
    /// Size and first pixel index of each view.
    view_pixels: Vec<ViewPixels>,
    /// Total number of pixel indices.
    index_count: u64,
    /// Number of indices of valid pixels, counted for importance sampling only.
    valid_count: u64,
    /// Indices of pixels with detail.
    detailed: PixelSet,
    cache: Option<HrCache>,
    /// Enlargement and kernel of each LR size.
    kernels: BTreeMap<(usize, usize), (Resampling, Arc<KernelOperator>)>,
    memory: PixelMemory,
}

impl<'a> Assembly<'a> {
    fn new(
        photographs: &Photographs,
        references: Option<&Photographs>,
        options: &'a SupersamplingOptions,
        memory: PixelMemory,
    ) -> Self {
        let supersample = options.supersample_within(photographs, references);
        let lr_sizes = photographs.images.iter().map(PackedPhotograph::size);
        Self {
            options,
            supersample,
            lr_views: photographs.images.len(),
            lr_pixels: photographs.images.iter().map(|image| image.pixels() as u64).sum(),
            views: Vec::new(),
            view_pixels: Vec::new(),
            index_count: 0,
            valid_count: 0,
            detailed: PixelSet::default(),
            cache: options.needs_cache(lr_sizes).then(|| HrCache::new(supersample)),
            kernels: BTreeMap::new(),
            memory,
        }
    }

    fn add_photograph(&mut self, camera: &Camera, photograph: PackedPhotograph) -> io::Result<()> {
        let image = photograph.unmasked();
        if let Some(cache) = &mut self.cache {
            let options = self.options;
            let lr = photograph.size();
            let hr = options.hr_size(lr);
            let (enlarge, kernel) = self.kernels.entry(lr).or_insert_with(|| {
                let enlarge = Resampling::new(Filter::Lanczos, lr, hr);
                (enlarge, Arc::new(KernelOperator::new(options.filter, hr, lr)))
            });
            cache.add(&enlarge.apply(&image), kernel.clone(), &mut self.memory)?;
        }
        self.index_pixels(&photograph, &image, 1);
        self.views.push(TrainingView { image: photograph, hr: None, rays: camera.rays() });
        Ok(())
    }

    /// Adds an HR reference, whose blocks of pixels are drawn as LR pixels are.
    fn add_reference(&mut self, camera: &Camera, reference: PackedPhotograph) -> io::Result<()> {
        let image = block_means(&reference.unmasked(), self.supersample);
        let masked = block_means(&reference.masked(), self.supersample);
        let blocks = PackedPhotograph::new(&masked.into(), &mut self.memory)?;
        let image_blocks = self.lr_views as u64 * blocks.pixels() as u64;
        let draws = (REFERENCE_DRAWS * self.lr_pixels / image_blocks).max(1);
        self.index_pixels(&blocks, &image, draws);
        self.views.push(TrainingView { image: blocks, hr: Some(reference), rays: camera.rays() });
        Ok(())
    }

    /// Gives each pixel of a view `draws` indices. `unmasked` also has the masked pixels' colours.
    fn index_pixels(&mut self, image: &PackedPhotograph, unmasked: &Image, draws: u64) {
        if self.options.params.pixel_importance > 1.0 {
            let mut detailed = detailed_pixels(unmasked);
            for (pixel, is_detailed) in detailed.iter_mut().enumerate() {
                let is_valid = image.is_valid(pixel);
                *is_detailed &= is_valid;
                self.valid_count += draws * u64::from(is_valid);
            }
            for _ in 0..draws {
                self.detailed.extend(detailed.iter().copied());
            }
        }
        let (width, height) = image.size();
        self.view_pixels.push(ViewPixels { width, height, start: self.index_count });
        self.index_count += draws * image.pixels() as u64;
    }
}

/// Returns the start of a block of a reference's pixels along an axis. The last block ends with the
/// image and may overlap the previous one.
pub(super) fn block_start(block: usize, block_length: usize, length: usize) -> usize {
    (block * block_length).min(length.saturating_sub(block_length))
}

/// Returns the means over blocks of an image's pixels, without NaN samples.
pub(super) fn block_means(image: &Image, block: [usize; 2]) -> Image {
    let (width, height) = (image.width.div_ceil(block[0]), image.height.div_ceil(block[1]));
    let mut data = Vec::with_capacity(width * height * image.channels);
    for y in 0..height {
        let top = block_start(y, block[1], image.height);
        for x in 0..width {
            let left = block_start(x, block[0], image.width);
            for c in 0..image.channels {
                let (mut sum, mut count) = (0.0, 0.0f32);
                for j in top..(top + block[1]).min(image.height) {
                    for i in left..(left + block[0]).min(image.width) {
                        let sample = image.data[(j * image.width + i) * image.channels + c];
                        if !sample.is_nan() {
                            sum += sample;
                            count += 1.0;
                        }
                    }
                }
                data.push(sum / count);
            }
        }
    }
    Image::new(width, height, image.channels, data)
}
