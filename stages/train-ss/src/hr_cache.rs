use std::sync::Arc;

use pixels::{Image, Resampling, to_u8};

/// The field's HR pixels of every training view as they were last rendered, in 8 bits, and the operators that make LR pixels
/// of them. Before a pixel is first rendered it is the enlarged LR image's.
#[derive(Debug)]
pub(crate) struct HrCache {
    /// HR pixels rendered together for an LR pixel, along x and y; no more than the smallest view has.
    side: [usize; 2],
    views: Vec<CachedView>,
}

#[derive(Debug)]
struct CachedView {
    width: usize,
    height: usize,
    /// RGB, row by row.
    rendered: Vec<u8>,
    /// RGB of the LR pixels that the kernel makes of those, in levels of 1/[`ONE`]². It follows every change: whole numbers add up to the
    /// same whatever the order, so it is what the kernel makes of them anew, to the last bit.
    projected: Vec<[i64; 3]>,
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
    pub(crate) fn new(operator: Resampling) -> Self {
        let inverse = operator.inverse(HrCache::REACH);
        Self { operator, inverse }
    }
}

impl HrCache {
    pub(crate) fn new(side: [usize; 2]) -> Self {
        Self { side, views: Vec::new() }
    }

    /// Adds the next view: an RGB image at HR size to begin with, and what makes it an LR image.
    pub(crate) fn add(&mut self, image: &Image, kernel: Arc<KernelOperator>) {
        let rendered = image.data.iter().map(|&v| to_u8(v)).collect();
        let mut view = CachedView { width: image.width, height: image.height, rendered, projected: Vec::new(), kernel };
        view.project();
        self.views.push(view);
    }

    /// First column and row of the HR pixels rendered for an LR pixel: those around its centre.
    fn block(&self, view: usize, x: usize, y: usize) -> [usize; 2] {
        let view = &self.views[view];
        let first = |i: usize, at: usize, hr: usize, lr: usize| {
            let scale = hr as f64 / lr as f64;
            let start = (at as f64 + 0.5).mul_add(scale, -0.5 * self.side[i] as f64).round().max(0.0) as usize;
            start.min(hr.saturating_sub(self.side[i]))
        };
        [first(0, x, view.width, view.kernel.operator.x.outputs()), first(1, y, view.height, view.kernel.operator.y.outputs())]
    }

    /// Where that block begins and how large an HR pixel is, in LR pixels.
    pub(crate) fn block_in_pixels(&self, view: usize, x: usize, y: usize) -> ([f64; 2], [f64; 2]) {
        let [i, j] = self.block(view, x, y);
        let view = &self.views[view];
        let apart = [
            view.kernel.operator.x.outputs() as f64 / view.width as f64,
            view.kernel.operator.y.outputs() as f64 / view.height as f64,
        ];
        ([i as f64 * apart[0], j as f64 * apart[1]], apart)
    }

    /// How far, in LR pixels, the kernels reach to either side of a block.
    const REACH: usize = 3;

    /// The kernel's residuals around an LR pixel, with its block as freshly rendered and all else as cached, and what they
    /// ask of the block: writes P·residual for each colour, where P = Kᵀ·(s²·K·Kᵀ)⁻¹ is the pseudo-inverse but for the factor s², and
    /// returns the residual of the pixel itself. `judge` gets a channel, a prediction and its target, and
    /// gives the residual.
    pub(crate) fn back_project(
        &self,
        view: usize,
        [x, y]: [usize; 2],
        colours: &[[f32; 3]],
        targets: &Image,
        judge: impl Fn(usize, f32, f32) -> f32,
        back_projected: &mut [[f32; 3]],
    ) -> [f32; 3] {
        const MOST: usize = 2 * HrCache::REACH + 1;
        let [left, top] = self.block(view, x, y);
        let [columns, rows] = self.side;
        let view = &self.views[view];
        let (operator, inverse) = (&view.kernel.operator, &view.kernel.inverse);
        let (xs, ys) = (near(x, Self::REACH, operator.x.outputs()), near(y, Self::REACH, operator.y.outputs()));
        // What the fresh block changes in what the kernel made, and then the residuals.
        let mut residuals = [[[0.0f32; 3]; MOST]; MOST];
        for b in 0..rows {
            let mut change = [[0.0f32; 3]; MOST];
            let cached = &view.rendered[3 * ((top + b) * view.width + left)..].as_chunks::<3>().0[..columns];
            for (a, (fresh, old)) in colours[b * columns..][..columns].iter().zip(cached).enumerate() {
                let news: [f32; 3] = std::array::from_fn(|c| 255.0 * fresh[c] - f32::from(old[c]));
                for (qx, sum) in xs.clone().zip(&mut change) {
                    let w = operator.x.weight(qx, left + a);
                    (0..3).for_each(|c| sum[c] += w * news[c]);
                }
            }
            for (qy, sums) in ys.clone().zip(&mut residuals) {
                let w = operator.y.weight(qy, top + b);
                sums.as_flattened_mut().iter_mut().zip(change.as_flattened()).for_each(|(sum, v)| *sum += w * v);
            }
        }
        let mut own = [0.0; 3];
        for (qy, row) in ys.clone().zip(&mut residuals) {
            for (qx, residual) in xs.clone().zip(row) {
                let at = qy * targets.width + qx;
                let (projected, target) = (&view.projected[at], &targets.data[3 * at..]);
                *residual = std::array::from_fn(|c| {
                    let prediction = (projected[c] as f32).mul_add(1.0 / (ONE * ONE), residual[c]);
                    judge(c, prediction / 255.0, target[c])
                });
                if [qx, qy] == [x, y] {
                    own = *residual;
                }
            }
        }
        for b in 0..rows {
            let mut projected_rows = [[0.0f32; 3]; MOST];
            for (qy, row) in ys.clone().zip(&residuals) {
                let w = inverse.y.weight(qy, top + b);
                projected_rows.as_flattened_mut().iter_mut().zip(row.as_flattened()).for_each(|(sum, r)| *sum += w * r);
            }
            for (a, projection) in back_projected[b * columns..][..columns].iter_mut().enumerate() {
                *projection = [0.0; 3];
                for (qx, column) in xs.clone().zip(&projected_rows) {
                    let w = inverse.x.weight(qx, left + a);
                    (0..3).for_each(|c| projection[c] += w * column[c]);
                }
            }
        }
        own
    }

    /// Remembers the fresh sub-pixel rays of an LR pixel.
    pub(crate) fn remember(&mut self, view: usize, x: usize, y: usize, colours: &[[f32; 3]]) {
        // A block at the edge may lie off its LR pixel's centre.
        const REACH: usize = HrCache::REACH + 1;
        let [left, top] = self.block(view, x, y);
        let columns = self.side[0];
        let view = &mut self.views[view];
        let operator = &view.kernel.operator;
        let (xs, ys) = (near(x, REACH, operator.x.outputs()), near(y, REACH, operator.y.outputs()));
        for (b, colours) in colours.chunks_exact(columns).enumerate() {
            let mut change = [[0i64; 3]; 2 * REACH + 1];
            let cached = view.rendered[3 * ((top + b) * view.width + left)..].as_chunks_mut::<3>().0;
            for (a, (pixel, fresh)) in cached.iter_mut().zip(colours).enumerate() {
                let old = std::mem::replace(pixel, fresh.map(to_u8));
                for (qx, sum) in xs.clone().zip(&mut change) {
                    let w = whole(operator.x.weight(qx, left + a));
                    (0..3).for_each(|c| sum[c] += w * (i64::from(pixel[c]) - i64::from(old[c])));
                }
            }
            if change.as_flattened().iter().all(|d| *d == 0) {
                continue;
            }
            for qy in ys.clone() {
                let w = whole(operator.y.weight(qy, top + b));
                for (projected, change) in view.projected[qy * operator.x.outputs()..][xs.clone()].iter_mut().zip(&change) {
                    (0..3).for_each(|c| projected[c] += w * change[c]);
                }
            }
        }
    }

    /// The cached bytes of all views, one after the other.
    pub(crate) fn parts(&self) -> impl Iterator<Item = &[u8]> {
        self.views.iter().map(|v| &v.rendered[..])
    }

    /// Bytes cached.
    pub(crate) fn len(&self) -> usize {
        self.parts().map(<[u8]>::len).sum()
    }

    /// Restores what [`HrCache::parts`] gave, [`HrCache::len`] bytes.
    pub(crate) fn restore(&mut self, bytes: &[u8]) {
        let mut rest = bytes;
        for view in &mut self.views {
            let (own, after) = rest.split_at(view.rendered.len());
            view.rendered.copy_from_slice(own);
            view.project();
            rest = after;
        }
    }
}

impl CachedView {
    /// Applies the kernel to all of it.
    fn project(&mut self) {
        let (across, down) = (&self.kernel.operator.x, &self.kernel.operator.y);
        let mut narrow = vec![[0i64; 3]; across.outputs() * self.height];
        for (row, sums) in self.rendered.chunks_exact(3 * self.width).zip(narrow.chunks_exact_mut(across.outputs())) {
            for (i, sum) in sums.iter_mut().enumerate() {
                let (first, weights) = across.run(i);
                for (pixel, &w) in row[3 * first..].as_chunks::<3>().0.iter().zip(weights) {
                    (0..3).for_each(|c| sum[c] += whole(w) * i64::from(pixel[c]));
                }
            }
        }
        self.projected.clear();
        self.projected.resize(across.outputs() * down.outputs(), [0; 3]);
        for (j, sums) in self.projected.chunks_exact_mut(across.outputs()).enumerate() {
            let (first, weights) = down.run(j);
            for (row, &w) in narrow[first * across.outputs()..].chunks_exact(across.outputs()).zip(weights) {
                sums.as_flattened_mut().iter_mut().zip(row.as_flattened()).for_each(|(sum, v)| *sum += whole(w) * v);
            }
        }
    }
}

/// Outputs up to `reach` beside one, of so many.
fn near(at: usize, reach: usize, end: usize) -> std::ops::Range<usize> {
    at.saturating_sub(reach)..(at + reach + 1).min(end)
}

/// What weights of 1 are in fixed point.
const ONE: f32 = (1 << 20) as f32;

/// A weight in fixed point.
fn whole(weight: f32) -> i64 {
    (weight * ONE + 0.5f32.copysign(weight)) as i64
}

#[cfg(test)]
mod tests {
    use pixels::{Filter, Resampling};

    use super::*;

    fn pattern(width: usize, height: usize) -> Image {
        // Whole 8-bit levels, away from black and white.
        let sample = |i: usize| (40 + (i * 7919 + i * i * 31) % 170) as f32 / 255.0;
        Image::new(width, height, 3, (0..width * height * 3).map(sample).collect())
    }

    /// Residuals and their back-projections are K·c - y and P·(K·c - y) of the whole images, at any scale, also where the block
    /// is news.
    #[test]
    fn back_projections_are_the_operators_own() {
        for (lr, hr) in [((9, 8), (18, 16)), ((10, 6), (27, 15)), ((7, 7), (11, 10)), ((5, 4), (20, 16)), ((1, 1), (2, 2))] {
            let side = [hr.0 as f64 / lr.0 as f64, hr.1 as f64 / lr.1 as f64].map(|s| s.ceil() as usize);
            let operator = Resampling::new(Filter::Lanczos, hr, lr);
            let inverse = operator.inverse(HrCache::REACH);
            let image = pattern(hr.0, hr.1);
            let targets = pattern(lr.0, lr.1);
            let mut cache = HrCache::new(side);
            cache.add(&image, Arc::new(KernelOperator::new(operator.clone())));
            for y in 0..lr.1 {
                for x in 0..lr.0 {
                    let [i, j] = cache.block(0, x, y);
                    let mut hybrid = image.clone();
                    let fresh: Vec<[f32; 3]> =
                        (0..side[0] * side[1]).map(|k| [0.2 + 0.1 * k as f32 / side[0] as f32, 0.5, 0.7]).collect();
                    let at = |k: usize| 3 * ((j + k / side[0]) * hr.0 + i + k % side[0]);
                    fresh.iter().enumerate().for_each(|(k, f)| hybrid.data[at(k)..at(k) + 3].copy_from_slice(f));
                    let mut residual = operator.apply(&hybrid);
                    residual.data.iter_mut().zip(&targets.data).for_each(|(r, t)| *r -= t);
                    let expected = inverse.adjoint(&residual);
                    let mut back_projected = vec![[9.0; 3]; fresh.len()];
                    let own = cache.back_project(0, [x, y], &fresh, &targets, |_, p, t| p - t, &mut back_projected);
                    for c in 0..3 {
                        assert!((own[c] - residual.data[3 * (y * lr.0 + x) + c]).abs() < 1e-5, "{lr:?} {hr:?} ({x}, {y})");
                        for (k, projection) in back_projected.iter().enumerate() {
                            assert!((projection[c] - expected.data[at(k) + c]).abs() < 1e-5, "{lr:?} {hr:?} ({x}, {y}) {k}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn remembers_what_it_is_told() {
        let mut cache = HrCache::new([2, 2]);
        cache.add(&pattern(8, 6), Arc::new(KernelOperator::new(Resampling::new(Filter::Box, (8, 6), (4, 3)))));
        cache.remember(0, 3, 1, &[[1.0, 0.0, 0.2]; 4]);
        let bytes: Vec<u8> = cache.parts().flatten().copied().collect();
        assert_eq!(cache.len(), bytes.len());
        assert_eq!(bytes[3 * (2 * 8 + 6)..][..6], [255, 0, 51, 255, 0, 51]);
        let mut other = HrCache::new([2, 2]);
        other.add(&pattern(8, 6), Arc::new(KernelOperator::new(Resampling::new(Filter::Box, (8, 6), (4, 3)))));
        other.restore(&bytes);
        assert!(other.parts().eq(cache.parts()));
    }

    /// What the kernel makes follows what is cached, at any scale and also at the edges.
    #[test]
    fn projected_pixels_follow() {
        for (lr, hr) in [((9, 8), (18, 16)), ((10, 6), (27, 15)), ((7, 7), (11, 10)), ((5, 4), (20, 16)), ((20, 13), (21, 14))] {
            for filter in [Filter::Box, Filter::Bicubic, Filter::Lanczos] {
                let side = [hr.0 as f64 / lr.0 as f64, hr.1 as f64 / lr.1 as f64].map(|s| s.ceil() as usize);
                let mut cache = HrCache::new(side);
                cache.add(&pattern(hr.0, hr.1), Arc::new(KernelOperator::new(Resampling::new(filter, hr, lr))));
                for k in 0..lr.0 * lr.1 {
                    let colours: Vec<[f32; 3]> = (0..side[0] * side[1]).map(|i| [(i * 7 + k) as f32 % 1.0, 0.3, 1.0]).collect();
                    cache.remember(0, k % lr.0, k / lr.0, &colours);
                }
                let followed = cache.views[0].projected.clone();
                cache.views[0].project();
                assert_eq!(cache.views[0].projected, followed, "{filter:?} {lr:?} {hr:?}");
            }
        }
    }

    /// Every HR pixel belongs to some block, so none is left unseen.
    #[test]
    fn blocks_cover_the_image() {
        for (lr, hr) in [(10, 15), (10, 27), (100, 270), (7, 21), (3, 4), (10, 11), (1, 1), (40, 41)] {
            let side = (hr as f64 / lr as f64).ceil() as usize;
            let mut cache = HrCache::new([side, side]);
            let operator = Resampling::new(Filter::Lanczos, (hr, hr), (lr, lr));
            cache.add(&pattern(hr, hr), Arc::new(KernelOperator::new(operator)));
            let mut seen = vec![false; hr];
            (0..lr).for_each(|x| seen[cache.block(0, x, 0)[0]..][..side].fill(true));
            assert!(seen.iter().all(|s| *s), "{lr} {hr}");
        }
    }
}
