use std::cell::RefCell;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use pixels::{AxisTaps, Filter, Image, Resampling, to_u8};

use crate::packed::{Bytes, PackedPhotograph, PixelMemory};

/// The field's HR pixels of every training view as they were last rendered, in 8 bits, and the
/// operators that make LR pixels of them. Before a pixel is first rendered it is the enlarged LR
/// image's.
#[derive(Debug)]
pub(crate) struct HrCache {
    /// HR pixels rendered together for an LR pixel, along x and y; no more than the smallest view
    /// has.
    side: [usize; 2],
    views: Vec<CachedView>,
}

/// A pixel of an LR photograph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LrPixel {
    /// Which view's photograph.
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
    /// RGB, row by row.
    rendered: Bytes,
    kernel: Arc<KernelOperator>,
}

/// What made LR images of a size, and what its residuals ask of HR pixels.
#[derive(Debug)]
pub(crate) struct KernelOperator {
    operator: Resampling,
    /// Weights of the pseudo-inverse, transposed.
    inverse: Resampling,
}

impl KernelOperator {
    /// The filter that makes LR images of HR ones; sizes are (width, height).
    pub(crate) fn new(filter: Filter, hr: (usize, usize), lr: (usize, usize)) -> Self {
        let operator = Resampling::new(filter, hr, lr);
        let inverse = operator.inverse(HrCache::REACH);
        Self { operator, inverse }
    }
}

/// Buffers of a thread.
#[derive(Default)]
struct Rows {
    /// 8-bit levels of a row, as read from a file.
    read: Vec<u8>,
    /// Levels of a row in floats.
    levels: Vec<[f32; 3]>,
}

thread_local! {
    static ROWS: RefCell<Rows> = RefCell::default();
}

/// Where `side` HR pixels around an LR pixel's centre begin along an axis.
fn first(at: usize, side: usize, hr: usize, lr: usize) -> usize {
    let scale = hr as f64 / lr as f64;
    let start = (at as f64 + 0.5).mul_add(scale, -0.5 * side as f64).round().max(0.0) as usize;
    start.min(hr.saturating_sub(side))
}

/// LR pixels on each side of one whose residuals count.
const LR_PIXELS_NEAR: usize = 2 * HrCache::REACH + 1;

impl HrCache {
    /// How far, in LR pixels, the kernels reach to either side of a block.
    const REACH: usize = 3;

    pub(crate) fn new(side: [usize; 2]) -> Self {
        Self { side, views: Vec::new() }
    }

    /// Whether a filter's footprint is the block of an LR pixel alone: then residuals need no other
    /// HR pixels than the fresh ones, and are those of the mean.
    pub(crate) fn is_needed(filter: Filter, hr: (usize, usize), lr: (usize, usize)) -> bool {
        let is_whole = hr.0.is_multiple_of(lr.0) && hr.1.is_multiple_of(lr.1);
        !(filter == Filter::Box && is_whole)
    }

    /// Adds the next view: an RGB image at HR size to begin with, and what makes it an LR image.
    pub(crate) fn add(
        &mut self,
        image: &Image,
        kernel: Arc<KernelOperator>,
        memory: &mut PixelMemory,
    ) -> io::Result<()> {
        let rendered = memory.keep(image.data.iter().map(|&v| to_u8(v)).collect())?;
        self.views.push(CachedView { width: image.width, height: image.height, rendered, kernel });
        Ok(())
    }

    /// First column and row of the HR pixels rendered for an LR pixel: those around its centre.
    fn block(&self, pixel: LrPixel) -> [usize; 2] {
        let view = &self.views[pixel.view];
        [
            first(pixel.x, self.side[0], view.width, view.kernel.operator.x.outputs()),
            first(pixel.y, self.side[1], view.height, view.kernel.operator.y.outputs()),
        ]
    }

    /// Where that block begins and how large an HR pixel is, in LR pixels.
    pub(crate) fn block_in_pixels(&self, pixel: LrPixel) -> ([f64; 2], [f64; 2]) {
        let [i, j] = self.block(pixel);
        let view = &self.views[pixel.view];
        let apart = [
            view.kernel.operator.x.outputs() as f64 / view.width as f64,
            view.kernel.operator.y.outputs() as f64 / view.height as f64,
        ];
        ([i as f64 * apart[0], j as f64 * apart[1]], apart)
    }

    /// The kernel's residuals around an LR pixel, with its block as freshly rendered and all else
    /// as cached, and what they ask of the block: writes P·residual for each colour, where P =
    /// Kᵀ·(s²·K·Kᵀ)⁻¹ is the pseudo-inverse but for the factor s², and returns the residual of the
    /// pixel itself. `judge` gets a channel, a prediction and its target, and gives the residual.
    pub(crate) fn back_project(
        &self,
        pixel: LrPixel,
        colours: &[[f32; 3]],
        targets: &PackedPhotograph,
        judge: impl Fn(usize, f32, f32) -> f32,
        back_projected: &mut [[f32; 3]],
    ) -> [f32; 3] {
        let block = Block { at: self.block(pixel), columns: self.side[0], colours };
        let LrPixel { view, x, y } = pixel;
        let view = &self.views[view];
        let (operator, inverse) = (&view.kernel.operator, &view.kernel.inverse);
        let (xs, ys) = (near(x, operator.x.outputs()), near(y, operator.y.outputs()));
        let target_rows = ys.clone().map(|qy| {
            let start = qy * targets.width();
            start + xs.start..start + xs.end
        });
        target_rows.clone().for_each(|row| targets.touch(&row));
        // What the kernel makes of it, and then the residuals.
        let mut residuals = view.projected(&block, xs.clone(), ys.clone());
        for (pixels, row) in target_rows.zip(&mut residuals) {
            let mut target = [[0.0; 4]; LR_PIXELS_NEAR];
            targets.row(pixels, &mut target[..xs.len()]);
            for (residual, target) in row.iter_mut().zip(&target) {
                *residual = std::array::from_fn(|c| judge(c, residual[c], target[c]));
            }
        }
        let [left, top] = block.at;
        for (b, back_projected) in back_projected.chunks_exact_mut(block.columns).enumerate() {
            let mut narrow = [[0.0f32; 3]; LR_PIXELS_NEAR];
            for (qy, row) in ys.clone().zip(&residuals) {
                let w = inverse.y.weight(qy, top + b);
                narrow
                    .as_flattened_mut()
                    .iter_mut()
                    .zip(row.as_flattened())
                    .for_each(|(sum, r)| *sum += w * r);
            }
            for (a, projection) in back_projected.iter_mut().enumerate() {
                *projection = [0.0; 3];
                for (qx, column) in xs.clone().zip(&narrow) {
                    let w = inverse.x.weight(qx, left + a);
                    (0..3).for_each(|c| projection[c] += w * column[c]);
                }
            }
        }
        residuals[y - ys.start][x - xs.start]
    }

    /// Remembers the fresh sub-pixel rays of an LR pixel.
    pub(crate) fn remember(&mut self, pixel: LrPixel, colours: &[[f32; 3]]) {
        let [left, top] = self.block(pixel);
        let view = &mut self.views[pixel.view];
        for (row, colours) in (top..).zip(colours.chunks_exact(self.side[0])) {
            ROWS.with_borrow_mut(|rows| {
                rows.read.clear();
                rows.read.extend(colours.as_flattened().iter().map(|&v| to_u8(v)));
                view.rendered.write(3 * (row * view.width + left), &rows.read);
            });
        }
    }

    /// Gives the cached bytes of all views, one view after the other.
    pub(crate) fn write(&self, to: &mut impl io::Write) -> io::Result<()> {
        let mut buffer = Vec::new();
        self.views.iter().try_for_each(|view| {
            to.write_all(view.rendered.read(0..view.rendered.len(), &mut buffer))
        })
    }

    /// Bytes cached.
    pub(crate) fn len(&self) -> usize {
        self.views.iter().map(|view| view.rendered.len()).sum()
    }

    /// Restores what [`HrCache::write`] gave, [`HrCache::len`] bytes.
    pub(crate) fn restore(&mut self, from: &mut impl io::Read) -> io::Result<()> {
        for view in &mut self.views {
            let mut bytes = vec![0; view.rendered.len()];
            from.read_exact(&mut bytes)?;
            view.rendered.write(0, &bytes);
        }
        Ok(())
    }
}

/// HR pixels that were rendered just now.
struct Block<'a> {
    /// Its first column and row.
    at: [usize; 2],
    columns: usize,
    colours: &'a [[f32; 3]],
}

impl CachedView {
    /// What the kernel makes of it at some LR columns and rows, at most [`LR_PIXELS_NEAR`] of each,
    /// with a block as freshly rendered.
    fn projected(
        &self,
        block: &Block<'_>,
        xs: Range<usize>,
        ys: Range<usize>,
    ) -> [[[f32; 3]; LR_PIXELS_NEAR]; LR_PIXELS_NEAR] {
        let (across, down) = (&self.kernel.operator.x, &self.kernel.operator.y);
        let (columns, lines) = (footprint(across, xs.clone()), footprint(down, ys.clone()));
        let [left, top] = block.at;
        let mut projected = [[[0.0f32; 3]; LR_PIXELS_NEAR]; LR_PIXELS_NEAR];
        let bytes_of = |line: usize| {
            let start = line * self.width;
            3 * (start + columns.start)..3 * (start + columns.end)
        };
        lines.clone().for_each(|line| self.rendered.touch(&bytes_of(line)));
        ROWS.with_borrow_mut(|rows| {
            for line in lines {
                let read = self.rendered.read(bytes_of(line), &mut rows.read);
                rows.levels.clear();
                rows.levels.extend(
                    read.as_chunks::<3>().0.iter().map(|pixel| pixel.map(|v| f32::from(v) / 255.0)),
                );
                if let Some(fresh) = line
                    .checked_sub(top)
                    .and_then(|b| block.colours.chunks_exact(block.columns).nth(b))
                {
                    rows.levels[left - columns.start..][..fresh.len()].copy_from_slice(fresh);
                }
                let mut narrow = [[0.0f32; 3]; LR_PIXELS_NEAR];
                for (qx, sum) in xs.clone().zip(&mut narrow) {
                    let (first, weights) = across.run(qx);
                    for (level, w) in rows.levels[first - columns.start..].iter().zip(weights) {
                        (0..3).for_each(|c| sum[c] += w * level[c]);
                    }
                }
                for (qy, sums) in ys.clone().zip(&mut projected) {
                    let w = down.weight(qy, line);
                    sums.as_flattened_mut()
                        .iter_mut()
                        .zip(narrow.as_flattened())
                        .for_each(|(sum, v)| *sum += w * v);
                }
            }
        });
        projected
    }
}

/// Inputs from the first to the last that outputs are made from.
fn footprint(taps: &AxisTaps, outputs: Range<usize>) -> Range<usize> {
    let (first, _) = taps.run(outputs.start);
    let (last, weights) = taps.run(outputs.end - 1);
    first..last + weights.len()
}

/// LR pixels beside one whose residuals count, of so many.
fn near(at: usize, end: usize) -> Range<usize> {
    at.saturating_sub(HrCache::REACH)..(at + HrCache::REACH + 1).min(end)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(width: usize, height: usize) -> Image {
        // Whole 8-bit levels, away from black and white.
        let sample = |i: usize| (40 + (i * 7919 + i * i * 31) % 170) as f32 / 255.0;
        Image::new(width, height, 3, (0..width * height * 3).map(sample).collect())
    }

    fn cache(side: [usize; 2], image: &Image, kernel: Arc<KernelOperator>) -> HrCache {
        let mut cache = HrCache::new(side);
        cache.add(image, kernel, &mut PixelMemory::unlimited()).unwrap();
        cache
    }

    /// Where a filter's footprint is the pixel's own block, the residual asks of every HR pixel
    /// what the mean's does.
    #[test]
    fn a_whole_box_is_the_mean() {
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
        let own =
            cache.back_project(pixel, &colours, &targets, |_, p, t| p - t, &mut back_projected);
        for c in 0..3 {
            let mean = colours.iter().map(|colour| colour[c]).sum::<f32>() / 4.0;
            assert!((own[c] - (mean - targets.pixel(8)[c])).abs() < 1e-6);
            assert!(
                back_projected
                    .iter()
                    .all(|p| (p[c] - own[c] / 4.0).abs() < 0.02 * own[c].abs() + 1e-6),
                "{back_projected:?}"
            );
        }
    }

    /// Residuals and their back-projections are K·c - y and P·(K·c - y) of the whole images, at any
    /// scale, also where the block is news.
    #[test]
    fn back_projections_are_the_operators_own() {
        for (lr, hr) in [
            ((9, 8), (18, 16)),
            ((10, 6), (27, 15)),
            ((7, 7), (11, 10)),
            ((5, 4), (20, 16)),
            ((1, 1), (2, 2)),
        ] {
            let side =
                [hr.0 as f64 / lr.0 as f64, hr.1 as f64 / lr.1 as f64].map(|s| s.ceil() as usize);
            let kernel = Arc::new(KernelOperator::new(Filter::Lanczos, hr, lr));
            let KernelOperator { operator, inverse } = &*kernel;
            let image = pattern(hr.0, hr.1);
            let targets = pattern(lr.0, lr.1);
            let packed =
                PackedPhotograph::new(&targets.clone().into(), &mut PixelMemory::unlimited())
                    .unwrap();
            let cache = cache(side, &image, kernel.clone());
            for y in 0..lr.1 {
                for x in 0..lr.0 {
                    let pixel = LrPixel { view: 0, x, y };
                    let [i, j] = cache.block(pixel);
                    let mut hybrid = image.clone();
                    let fresh: Vec<[f32; 3]> = (0..side[0] * side[1])
                        .map(|k| [0.2 + 0.1 * k as f32 / side[0] as f32, 0.5, 0.7])
                        .collect();
                    let at = |k: usize| 3 * ((j + k / side[0]) * hr.0 + i + k % side[0]);
                    fresh
                        .iter()
                        .enumerate()
                        .for_each(|(k, f)| hybrid.data[at(k)..at(k) + 3].copy_from_slice(f));
                    let mut residual = operator.apply(&hybrid);
                    residual.data.iter_mut().zip(&targets.data).for_each(|(r, t)| *r -= t);
                    let expected = inverse.adjoint(&residual);
                    let mut back_projected = vec![[9.0; 3]; fresh.len()];
                    let own = cache.back_project(
                        pixel,
                        &fresh,
                        &packed,
                        |_, p, t| p - t,
                        &mut back_projected,
                    );
                    for c in 0..3 {
                        assert!(
                            (own[c] - residual.data[3 * (y * lr.0 + x) + c]).abs() < 1e-5,
                            "{lr:?} {hr:?} ({x}, {y})"
                        );
                        for (k, projection) in back_projected.iter().enumerate() {
                            assert!(
                                (projection[c] - expected.data[at(k) + c]).abs() < 1e-5,
                                "{lr:?} {hr:?} ({x}, {y}) {k}"
                            );
                        }
                    }
                }
            }
        }
    }

    fn written(cache: &HrCache) -> Vec<u8> {
        let mut bytes = Vec::new();
        cache.write(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn remembers_what_it_is_told() {
        let kernel = Arc::new(KernelOperator::new(Filter::Box, (8, 6), (4, 3)));
        let mut first = cache([2, 2], &pattern(8, 6), kernel.clone());
        first.remember(LrPixel { view: 0, x: 3, y: 1 }, &[[1.0, 0.0, 0.2]; 4]);
        let kept = written(&first);
        assert_eq!(first.len(), kept.len());
        assert_eq!(kept[3 * (2 * 8 + 6)..][..6], [255, 0, 51, 255, 0, 51]);
        let mut other = cache([2, 2], &pattern(8, 6), kernel);
        other.restore(&mut &kept[..]).unwrap();
        assert_eq!(written(&other), kept);
        assert!(other.restore(&mut &kept[1..]).is_err(), "a byte is missing");
    }

    /// Every HR pixel belongs to some block, so none is left unseen.
    #[test]
    fn blocks_cover_the_image() {
        for (lr, hr) in
            [(10, 15), (10, 27), (100, 270), (7, 21), (3, 4), (10, 11), (1, 1), (40, 41)]
        {
            let side = (hr as f64 / lr as f64).ceil() as usize;
            let kernel = Arc::new(KernelOperator::new(Filter::Lanczos, (hr, hr), (lr, lr)));
            let cache = cache([side, side], &pattern(hr, hr), kernel);
            let mut seen = vec![false; hr];
            let start = |x: usize| cache.block(LrPixel { view: 0, x, y: 0 })[0];
            (0..lr).for_each(|x| seen[start(x)..][..side].fill(true));
            assert!(seen.iter().all(|s| *s), "{lr} {hr}");
        }
    }
}
