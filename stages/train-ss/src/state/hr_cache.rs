use std::cell::RefCell;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use pixels::{AxisTaps, Filter, Image, Resampling, to_u8};

use crate::photographs::{Bytes, PackedPhotograph, PixelMemory};

/// HR pixels of every training view as last rendered, in 8 bits, and the operators that shrink them
/// to LR. Pixels that haven't been rendered yet come from the enlarged LR image (design note 009).
#[derive(Debug)]
pub(crate) struct HrCache {
    /// HR pixels along x and y that are rendered for an LR pixel; at most the size of the smallest
    /// view.
    supersample: [usize; 2],
    views: Vec<CachedView>,
}

/// Pixel of an LR photograph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LrPixel {
    /// Index of the view.
    pub(crate) view: usize,
    /// Column.
    pub(crate) x: usize,
    /// Row.
    pub(crate) y: usize,
}

#[derive(Debug)]
struct CachedView {
    width: usize,
    height: usize,
    /// RGB levels, row by row.
    rendered: Bytes,
    kernel: Arc<KernelOperator>,
}

/// Degradation kernel K of one pair of image sizes, and its pseudo-inverse.
#[derive(Debug)]
pub(crate) struct KernelOperator {
    operator: Resampling,
    /// Weights P of [`Resampling::inverse`]: the pseudo-inverse, transposed and scaled.
    inverse: Resampling,
}

impl KernelOperator {
    /// Creates the operator from HR to LR; sizes are (width, height).
    pub(crate) fn new(filter: Filter, hr: (usize, usize), lr: (usize, usize)) -> Self {
        assert!(filter.support() <= HrCache::REACH as f64, "{filter:?} reaches too far");
        let operator = Resampling::new(filter, hr, lr);
        let inverse = operator.inverse(HrCache::REACH);
        Self { operator, inverse }
    }
}

/// Row buffers of a thread.
#[derive(Default)]
struct RowBuffers {
    /// 8-bit levels as read from the file.
    bytes: Vec<u8>,
    /// Levels in 0..1.
    levels: Vec<[f32; 3]>,
}

thread_local! {
    static ROW_BUFFERS: RefCell<RowBuffers> = RefCell::default();
}

/// Maximum number of LR pixels along an axis whose residuals are computed around an LR pixel.
const MAX_NEIGHBOURS: usize = 2 * HrCache::REACH + 1;

/// LR values of up to [`MAX_NEIGHBOURS`]² pixels.
type Neighbourhood = [[[f32; 3]; MAX_NEIGHBOURS]; MAX_NEIGHBOURS];

impl HrCache {
    /// Reach of the kernels to either side of a block, in LR pixels: Lanczos with three lobes.
    const REACH: usize = 3;

    pub(crate) fn new(supersample: [usize; 2]) -> Self {
        Self { supersample, views: Vec::new() }
    }

    /// Returns false if the filter's footprint is exactly the block of an LR pixel. Residuals then
    /// depend only on freshly rendered pixels, and equal the residuals of these pixels' mean.
    pub(crate) fn is_needed(filter: Filter, hr: (usize, usize), lr: (usize, usize)) -> bool {
        let is_whole = hr.0.is_multiple_of(lr.0) && hr.1.is_multiple_of(lr.1);
        !(filter == Filter::Box && is_whole)
    }

    /// Adds the next view, with its initial RGB image at HR size and its kernel.
    pub(crate) fn add(
        &mut self,
        image: &Image,
        kernel: Arc<KernelOperator>,
        memory: &mut PixelMemory,
    ) -> io::Result<()> {
        let rendered = memory.store(image.data.iter().map(|&v| to_u8(v)).collect())?;
        self.views.push(CachedView { width: image.width, height: image.height, rendered, kernel });
        Ok(())
    }

    /// Returns the first column and row of the HR pixels rendered for an LR pixel: those around its
    /// centre.
    fn block_start(&self, pixel: LrPixel) -> [usize; 2] {
        let view = &self.views[pixel.view];
        let Resampling { x, y, .. } = &view.kernel.operator;
        [
            centred_start(pixel.x, self.supersample[0], view.width, x.outputs()),
            centred_start(pixel.y, self.supersample[1], view.height, y.outputs()),
        ]
    }

    /// Returns the start of an LR pixel's block and the size of an HR pixel, both in LR pixels.
    pub(crate) fn block_in_lr_pixels(&self, pixel: LrPixel) -> ([f64; 2], [f64; 2]) {
        let [column, row] = self.block_start(pixel);
        let view = &self.views[pixel.view];
        let size = [
            view.kernel.operator.x.outputs() as f64 / view.width as f64,
            view.kernel.operator.y.outputs() as f64 / view.height as f64,
        ];
        ([column as f64 * size[0], row as f64 * size[1]], size)
    }

    /// Computes the kernel's residuals around an LR pixel, with freshly rendered `colours` in the
    /// pixel's block and cached ones elsewhere, and back-projects them to the block: writes
    /// Pᵀ·residual, with the P of [`Resampling::inverse`]. Apart from the ridge and the limited
    /// reach, Pᵀ is K⁺ / s², with the pseudo-inverse K⁺ = Kᵀ·(K·Kᵀ)⁻¹. Returns the residual of the
    /// pixel itself. `residual_of` returns the residual for a channel, a prediction and its target.
    pub(crate) fn back_project(
        &self,
        pixel: LrPixel,
        colours: &[[f32; 3]],
        targets: &PackedPhotograph,
        residual_of: impl Fn(usize, f32, f32) -> f32,
        back_projected: &mut [[f32; 3]],
    ) -> [f32; 3] {
        let [left, top] = self.block_start(pixel);
        let block = Block { left, top, columns: self.supersample[0], colours };
        let LrPixel { view, x, y } = pixel;
        let view = &self.views[view];
        let KernelOperator { operator, inverse } = &*view.kernel;
        let xs = neighbours(x, operator.x.outputs());
        let ys = neighbours(y, operator.y.outputs());
        let target_row = |qy: usize| {
            let start = qy * targets.width;
            start + xs.start..start + xs.end
        };
        for qy in ys.clone() {
            targets.prefetch(&target_row(qy));
        }
        // Predictions, which become residuals row by row.
        let mut residuals = view.project(&block, xs.clone(), ys.clone());
        for (j, row) in residuals.iter_mut().enumerate().take(ys.len()) {
            let mut target = [[0.0; 4]; MAX_NEIGHBOURS];
            targets.read_row(target_row(ys.start + j), &mut target[..xs.len()]);
            for (i, residual) in row.iter_mut().enumerate() {
                *residual = std::array::from_fn(|c| residual_of(c, residual[c], target[i][c]));
            }
        }
        for (b, back_projected) in back_projected.chunks_exact_mut(block.columns).enumerate() {
            let mut column_sums = [[0.0f32; 3]; MAX_NEIGHBOURS];
            for (j, row) in residuals.iter().enumerate().take(ys.len()) {
                let weight = inverse.y.weight(ys.start + j, top + b);
                add_scaled(column_sums.as_flattened_mut(), row.as_flattened(), weight);
            }
            for (a, back_projection) in back_projected.iter_mut().enumerate() {
                *back_projection = [0.0; 3];
                for (i, sum) in column_sums.iter().enumerate().take(xs.len()) {
                    add_scaled(back_projection, sum, inverse.x.weight(xs.start + i, left + a));
                }
            }
        }
        residuals[y - ys.start][x - xs.start]
    }

    /// Stores the levels of the freshly rendered colours of an LR pixel's block.
    pub(crate) fn store(&mut self, pixel: LrPixel, levels: &[[u8; 3]]) {
        let [left, top] = self.block_start(pixel);
        let view = &mut self.views[pixel.view];
        for (b, levels) in levels.chunks_exact(self.supersample[0]).enumerate() {
            view.rendered.write(3 * ((top + b) * view.width + left), levels.as_flattened());
        }
    }

    /// Writes the cached bytes of all views in order.
    pub(crate) fn write(&self, to: &mut impl io::Write) -> io::Result<()> {
        let mut buffer = Vec::new();
        for view in &self.views {
            to.write_all(view.rendered.read(0..view.rendered.len(), &mut buffer))?;
        }
        Ok(())
    }

    /// Returns the number of cached bytes.
    pub(crate) fn byte_length(&self) -> usize {
        self.views.iter().map(|view| view.rendered.len()).sum()
    }

    /// Restores the output of [`HrCache::write`].
    pub(crate) fn restore(&mut self, from: &mut impl io::Read) -> io::Result<()> {
        for view in &mut self.views {
            let mut bytes = vec![0; view.rendered.len()];
            from.read_exact(&mut bytes)?;
            view.rendered.write(0, &bytes);
        }
        Ok(())
    }
}

/// Freshly rendered HR pixels of an LR pixel.
struct Block<'a> {
    left: usize,
    top: usize,
    columns: usize,
    colours: &'a [[f32; 3]],
}

impl CachedView {
    /// Applies the kernel at some LR columns and rows, at most [`MAX_NEIGHBOURS`] of each, to the
    /// cached pixels with a freshly rendered block.
    fn project(&self, block: &Block<'_>, xs: Range<usize>, ys: Range<usize>) -> Neighbourhood {
        let (across, down) = (&self.kernel.operator.x, &self.kernel.operator.y);
        let (columns, lines) = (footprint(across, xs.clone()), footprint(down, ys.clone()));
        let mut projected = [[[0.0f32; 3]; MAX_NEIGHBOURS]; MAX_NEIGHBOURS];
        let line_bytes = |line: usize| {
            let start = line * self.width;
            3 * (start + columns.start)..3 * (start + columns.end)
        };
        for line in lines.clone() {
            self.rendered.prefetch(&line_bytes(line));
        }
        ROW_BUFFERS.with_borrow_mut(|buffers| {
            let RowBuffers { bytes, levels } = buffers;
            for line in lines {
                let cached = self.rendered.read(line_bytes(line), bytes).as_chunks::<3>().0;
                levels.clear();
                levels.extend(cached.iter().map(|pixel| pixel.map(|v| f32::from(v) / 255.0)));
                let mut fresh_rows = block.colours.chunks_exact(block.columns);
                if let Some(fresh) = line.checked_sub(block.top).and_then(|b| fresh_rows.nth(b)) {
                    levels[block.left - columns.start..][..fresh.len()].copy_from_slice(fresh);
                }
                let mut narrow = [[0.0f32; 3]; MAX_NEIGHBOURS];
                for (i, sum) in narrow.iter_mut().enumerate().take(xs.len()) {
                    let (first, weights) = across.run(xs.start + i);
                    for (level, weight) in levels[first - columns.start..].iter().zip(weights) {
                        add_scaled(sum, level, *weight);
                    }
                }
                for (j, sums) in projected.iter_mut().enumerate().take(ys.len()) {
                    let weight = down.weight(ys.start + j, line);
                    add_scaled(sums.as_flattened_mut(), narrow.as_flattened(), weight);
                }
            }
        });
        projected
    }
}

/// Adds `weight` times `values` to `sums`.
#[inline]
fn add_scaled(sums: &mut [f32], values: &[f32], weight: f32) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += weight * value;
    }
}

/// Returns the first of `count` HR pixels around the centre of an LR pixel along an axis.
fn centred_start(lr_pixel: usize, count: usize, hr: usize, lr: usize) -> usize {
    let scale = hr as f64 / lr as f64;
    let start =
        (lr_pixel as f64 + 0.5).mul_add(scale, -0.5 * count as f64).round().max(0.0) as usize;
    start.min(hr.saturating_sub(count))
}

/// Returns the range of inputs that contribute to a range of outputs.
fn footprint(taps: &AxisTaps, outputs: Range<usize>) -> Range<usize> {
    let (first, _) = taps.run(outputs.start);
    let (last, weights) = taps.run(outputs.end - 1);
    first..last + weights.len()
}

/// Returns the LR pixels along an axis whose residuals are computed around a pixel.
fn neighbours(pixel: usize, length: usize) -> Range<usize> {
    pixel.saturating_sub(HrCache::REACH)..(pixel + HrCache::REACH + 1).min(length)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(width: usize, height: usize) -> Image {
        // Exact 8-bit levels, away from black and white.
        let sample = |i: usize| (40 + (i * 7919 + i * i * 31) % 170) as f32 / 255.0;
        Image::new(width, height, 3, (0..width * height * 3).map(sample).collect())
    }

    fn cache(supersample: [usize; 2], image: &Image, kernel: Arc<KernelOperator>) -> HrCache {
        let mut cache = HrCache::new(supersample);
        cache.add(image, kernel, &mut PixelMemory::unlimited()).unwrap();
        cache
    }

    /// If a filter's footprint is the pixel's own block, every HR pixel gets an equal share of the
    /// mean's residual.
    #[test]
    fn a_box_of_one_block_is_the_mean() {
        let (hr, lr) = ((12, 8), (6, 4));
        assert!(
            !HrCache::is_needed(Filter::Box, hr, lr) && HrCache::is_needed(Filter::Lanczos, hr, lr)
        );
        assert!(HrCache::is_needed(Filter::Box, (11, 8), lr));
        let cache =
            cache([2, 2], &pattern(12, 8), Arc::new(KernelOperator::new(Filter::Box, hr, lr)));
        let targets =
            PackedPhotograph::new(&pattern(6, 4).into(), &mut PixelMemory::unlimited()).unwrap();
        let colours = [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9], [0.2, 0.1, 0.0]];
        let mut back_projected = [[9.0; 3]; 4];
        let pixel = LrPixel { view: 0, x: 2, y: 1 };
        let residual =
            cache.back_project(pixel, &colours, &targets, |_, p, t| p - t, &mut back_projected);
        for c in 0..3 {
            let mean = colours.iter().map(|colour| colour[c]).sum::<f32>() / 4.0;
            assert!((residual[c] - (mean - targets.pixel(8)[c])).abs() < 1e-6);
            assert!(
                back_projected
                    .iter()
                    .all(|p| (p[c] - residual[c] / 4.0).abs() < 0.02 * residual[c].abs() + 1e-6),
                "{back_projected:?}"
            );
        }
    }

    /// Residuals and their back-projections are K·c - y and Pᵀ·(K·c - y) of the whole images, at
    /// any scale, also where the block is freshly rendered.
    #[test]
    fn back_projections_equal_those_of_the_operators() {
        for (lr, hr) in [
            ((9, 8), (18, 16)),
            ((10, 6), (27, 15)),
            ((7, 7), (11, 10)),
            ((5, 4), (20, 16)),
            ((1, 1), (2, 2)),
        ] {
            let supersample =
                [hr.0 as f64 / lr.0 as f64, hr.1 as f64 / lr.1 as f64].map(|s| s.ceil() as usize);
            let kernel = Arc::new(KernelOperator::new(Filter::Lanczos, hr, lr));
            let KernelOperator { operator, inverse } = &*kernel;
            let image = pattern(hr.0, hr.1);
            let targets = pattern(lr.0, lr.1);
            let packed =
                PackedPhotograph::new(&targets.clone().into(), &mut PixelMemory::unlimited())
                    .unwrap();
            let cache = cache(supersample, &image, kernel.clone());
            for y in 0..lr.1 {
                for x in 0..lr.0 {
                    let pixel = LrPixel { view: 0, x, y };
                    let [i, j] = cache.block_start(pixel);
                    let mut hybrid = image.clone();
                    let fresh: Vec<[f32; 3]> = (0..supersample[0] * supersample[1])
                        .map(|k| [0.2 + 0.1 * k as f32 / supersample[0] as f32, 0.5, 0.7])
                        .collect();
                    let index =
                        |k: usize| 3 * ((j + k / supersample[0]) * hr.0 + i + k % supersample[0]);
                    fresh
                        .iter()
                        .enumerate()
                        .for_each(|(k, f)| hybrid.data[index(k)..index(k) + 3].copy_from_slice(f));
                    let mut residual = operator.apply(&hybrid);
                    residual.data.iter_mut().zip(&targets.data).for_each(|(r, t)| *r -= t);
                    let expected = inverse.adjoint(&residual);
                    let mut back_projected = vec![[9.0; 3]; fresh.len()];
                    let pixel_residual = cache.back_project(
                        pixel,
                        &fresh,
                        &packed,
                        |_, p, t| p - t,
                        &mut back_projected,
                    );
                    for c in 0..3 {
                        assert!(
                            (pixel_residual[c] - residual.data[3 * (y * lr.0 + x) + c]).abs()
                                < 1e-5,
                            "{lr:?} {hr:?} ({x}, {y})"
                        );
                        for (k, projection) in back_projected.iter().enumerate() {
                            assert!(
                                (projection[c] - expected.data[index(k) + c]).abs() < 1e-5,
                                "{lr:?} {hr:?} ({x}, {y}) {k}"
                            );
                        }
                    }
                }
            }
        }
    }

    fn bytes_of(cache: &HrCache) -> Vec<u8> {
        let mut bytes = Vec::new();
        cache.write(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn stored_pixels_are_restored() {
        let kernel = Arc::new(KernelOperator::new(Filter::Box, (8, 6), (4, 3)));
        let mut first = cache([2, 2], &pattern(8, 6), kernel.clone());
        first.store(LrPixel { view: 0, x: 3, y: 1 }, &[[255, 0, 51]; 4]);
        let stored = bytes_of(&first);
        assert_eq!(first.byte_length(), stored.len());
        assert_eq!(stored[3 * (2 * 8 + 6)..][..6], [255, 0, 51, 255, 0, 51]);
        let mut other = cache([2, 2], &pattern(8, 6), kernel);
        other.restore(&mut &stored[..]).unwrap();
        assert_eq!(bytes_of(&other), stored);
        assert!(other.restore(&mut &stored[1..]).is_err(), "a byte is missing");
    }

    /// Every HR pixel belongs to a block, so every HR pixel is rendered during training.
    #[test]
    fn blocks_cover_the_image() {
        for (lr, hr) in
            [(10, 15), (10, 27), (100, 270), (7, 21), (3, 4), (10, 11), (1, 1), (40, 41)]
        {
            let supersample = (hr as f64 / lr as f64).ceil() as usize;
            let kernel = Arc::new(KernelOperator::new(Filter::Lanczos, (hr, hr), (lr, lr)));
            let cache = cache([supersample; 2], &pattern(hr, hr), kernel);
            let mut is_covered = vec![false; hr];
            let start = |x: usize| cache.block_start(LrPixel { view: 0, x, y: 0 })[0];
            (0..lr).for_each(|x| is_covered[start(x)..][..supersample].fill(true));
            assert!(is_covered.iter().all(|covered| *covered), "{lr} {hr}");
        }
    }
}
