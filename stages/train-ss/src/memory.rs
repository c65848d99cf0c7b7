use std::sync::Arc;

use pixels::{Picture, Resampling, to_u8};

/// The field's HR pixels of every training view as they were last rendered, in 8 bits, and the operators that make LR pixels
/// of them. Before a pixel is first rendered it is the enlarged LR picture's.
#[derive(Debug)]
pub(crate) struct Memory {
    /// HR pixels rendered together for an LR pixel, along x and y; no more than the smallest view has.
    side: [usize; 2],
    views: Vec<Remembered>,
}

#[derive(Debug)]
struct Remembered {
    width: usize,
    height: usize,
    /// RGB, row by row.
    rendered: Vec<u8>,
    kernel: Arc<Kernel>,
}

/// What made LR pictures of a size, and what its residuals ask of HR pixels.
#[derive(Debug)]
pub(crate) struct Kernel {
    operator: Resampling,
    /// Weights of the pseudo-inverse, transposed.
    inverse: Resampling,
}

impl Kernel {
    pub(crate) fn new(operator: Resampling) -> Self {
        let inverse = operator.inverse(Memory::REACH);
        Self { operator, inverse }
    }
}

impl Memory {
    pub(crate) fn new(side: [usize; 2]) -> Self {
        Self { side, views: Vec::new() }
    }

    /// Adds the next view: an RGB picture at HR size to begin with, and what makes it an LR picture.
    pub(crate) fn add(&mut self, picture: &Picture, kernel: Arc<Kernel>) {
        let rendered = picture.data.iter().map(|&v| to_u8(v)).collect();
        self.views.push(Remembered { width: picture.width, height: picture.height, rendered, kernel });
    }

    /// First column and row of the HR pixels rendered for an LR pixel: those around its centre.
    fn block(&self, view: usize, x: usize, y: usize) -> [usize; 2] {
        let view = &self.views[view];
        let first = |i: usize, at: usize, fine: usize, coarse: usize| {
            let scale = fine as f64 / coarse as f64;
            let start = (at as f64 + 0.5).mul_add(scale, -0.5 * self.side[i] as f64).round().max(0.0) as usize;
            start.min(fine.saturating_sub(self.side[i]))
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

    /// The kernel's residuals around an LR pixel, with its block as freshly rendered and all else as remembered, and what they
    /// ask of the block: writes P·residual for each colour, where P = Kᵀ·(s²·K·Kᵀ)⁻¹ is the pseudo-inverse but for the factor s², and
    /// returns the residual of the pixel itself. `judge` gets a prediction and its target, for each channel, and gives the
    /// residual.
    pub(crate) fn pull(
        &self,
        view: usize,
        [x, y]: [usize; 2],
        colours: &[[f32; 3]],
        targets: &Picture,
        judge: impl Fn(f32, f32) -> f32,
        pulls: &mut [[f32; 3]],
    ) -> [f32; 3] {
        let [left, top] = self.block(view, x, y);
        let [columns, rows] = self.side;
        let view = &self.views[view];
        let (across, down, inverse) = (&view.kernel.operator.x, &view.kernel.operator.y, &view.kernel.inverse);
        let near = |at: usize, end: usize| at.saturating_sub(Self::REACH)..(at + Self::REACH + 1).min(end);
        let (xs, ys) = (near(x, across.outputs()), near(y, down.outputs()));
        // Remembered rows, filtered along x for the columns of the neighbourhood: each row serves all of its LR rows.
        const MOST: usize = 2 * Memory::REACH + 1;
        let mut sums = [[[0.0f32; 3]; MOST]; MOST];
        let first_row = down.run(ys.start).0;
        let last_row = down.run(ys.end - 1).0 + down.run(ys.end - 1).1.len();
        for (j, row) in (first_row..last_row).zip(view.rendered[3 * view.width * first_row..].chunks_exact(3 * view.width)) {
            let mut filtered = [[0.0f32; 3]; MOST];
            for (qx, sum) in xs.clone().zip(&mut filtered) {
                let (first, weights) = across.run(qx);
                for (pixel, w) in row[3 * first..].as_chunks::<3>().0.iter().zip(weights) {
                    (0..3).for_each(|c| sum[c] += w * f32::from(pixel[c]));
                }
            }
            // What is fresh replaces what was remembered.
            if let Some(b) = j.checked_sub(top).filter(|b| *b < rows) {
                for (a, fresh) in colours[b * columns..(b + 1) * columns].iter().enumerate() {
                    let old = &row[3 * (left + a)..];
                    for (qx, sum) in xs.clone().zip(&mut filtered) {
                        let w = across.weight(qx, left + a);
                        (0..3).for_each(|c| sum[c] += w * (255.0 * fresh[c] - f32::from(old[c])));
                    }
                }
            }
            for (qy, sums) in ys.clone().zip(&mut sums) {
                let w = down.weight(qy, j);
                if w != 0.0 {
                    sums.iter_mut().flatten().zip(filtered.as_flattened()).for_each(|(sum, v)| *sum += w * v);
                }
            }
        }
        pulls.fill([0.0; 3]);
        let mut own = [0.0; 3];
        for (qy, sums) in ys.zip(&sums) {
            for (qx, sum) in xs.clone().zip(sums) {
                let target = &targets.data[3 * (qy * targets.width + qx)..];
                let residual: [f32; 3] = std::array::from_fn(|c| judge(sum[c] / 255.0, target[c]));
                if [qx, qy] == [x, y] {
                    own = residual;
                }
                for (k, pull) in pulls.iter_mut().enumerate() {
                    let w = inverse.x.weight(qx, left + k % columns) * inverse.y.weight(qy, top + k / columns);
                    (0..3).for_each(|c| pull[c] += w * residual[c]);
                }
            }
        }
        own
    }

    /// Remembers the fresh sub-rays of an LR pixel.
    pub(crate) fn remember(&mut self, view: usize, x: usize, y: usize, colours: &[[f32; 3]]) {
        let [i, j] = self.block(view, x, y);
        let columns = self.side[0];
        let view = &mut self.views[view];
        for (row, colours) in view.rendered.chunks_exact_mut(3 * view.width).skip(j).zip(colours.chunks_exact(columns)) {
            for (pixel, colour) in row[3 * i..].as_chunks_mut::<3>().0.iter_mut().zip(colours) {
                *pixel = colour.map(to_u8);
            }
        }
    }

    /// The remembered bytes of all views, one after the other.
    pub(crate) fn parts(&self) -> impl Iterator<Item = &[u8]> {
        self.views.iter().map(|v| &v.rendered[..])
    }

    /// Bytes remembered.
    pub(crate) fn len(&self) -> usize {
        self.parts().map(<[u8]>::len).sum()
    }

    /// Restores what [`Memory::parts`] gave, [`Memory::len`] bytes.
    pub(crate) fn restore(&mut self, bytes: &[u8]) {
        let mut rest = bytes;
        for view in &mut self.views {
            let (own, after) = rest.split_at(view.rendered.len());
            view.rendered.copy_from_slice(own);
            rest = after;
        }
    }
}

#[cfg(test)]
mod tests {
    use pixels::{Filter, Resampling};

    use super::*;

    fn picture(width: usize, height: usize) -> Picture {
        // Whole 8-bit levels, away from black and white.
        let sample = |i: usize| (40 + (i * 7919 + i * i * 31) % 170) as f32 / 255.0;
        Picture::new(width, height, 3, (0..width * height * 3).map(sample).collect())
    }

    /// Residuals and pulls are K·c - y and P·(K·c - y) of the whole pictures, at any scale, also where the block is news.
    #[test]
    fn pulls_are_the_operators_own() {
        for (low, high) in [((9, 8), (18, 16)), ((10, 6), (27, 15)), ((7, 7), (11, 10)), ((5, 4), (20, 16)), ((1, 1), (2, 2))] {
            let side = [high.0 as f64 / low.0 as f64, high.1 as f64 / low.1 as f64].map(|s| s.ceil() as usize);
            let operator = Resampling::new(Filter::Lanczos, high, low);
            let inverse = operator.inverse(Memory::REACH);
            let fine = picture(high.0, high.1);
            let targets = picture(low.0, low.1);
            let mut memory = Memory::new(side);
            memory.add(&fine, Arc::new(Kernel::new(operator.clone())));
            for y in 0..low.1 {
                for x in 0..low.0 {
                    let [i, j] = memory.block(0, x, y);
                    let mut hybrid = fine.clone();
                    let fresh: Vec<[f32; 3]> =
                        (0..side[0] * side[1]).map(|k| [0.2 + 0.1 * k as f32 / side[0] as f32, 0.5, 0.7]).collect();
                    let at = |k: usize| 3 * ((j + k / side[0]) * high.0 + i + k % side[0]);
                    fresh.iter().enumerate().for_each(|(k, f)| hybrid.data[at(k)..at(k) + 3].copy_from_slice(f));
                    let mut residual = operator.apply(&hybrid);
                    residual.data.iter_mut().zip(&targets.data).for_each(|(r, t)| *r -= t);
                    let expected = inverse.adjoint(&residual);
                    let mut pulls = vec![[9.0; 3]; fresh.len()];
                    let own = memory.pull(0, [x, y], &fresh, &targets, |p, t| p - t, &mut pulls);
                    for c in 0..3 {
                        assert!((own[c] - residual.data[3 * (y * low.0 + x) + c]).abs() < 1e-5, "{low:?} {high:?} ({x}, {y})");
                        for (k, pull) in pulls.iter().enumerate() {
                            assert!((pull[c] - expected.data[at(k) + c]).abs() < 1e-5, "{low:?} {high:?} ({x}, {y}) {k}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn remembers_what_it_is_told() {
        let mut memory = Memory::new([2, 2]);
        memory.add(&picture(8, 6), Arc::new(Kernel::new(Resampling::new(Filter::Box, (8, 6), (4, 3)))));
        memory.remember(0, 3, 1, &[[1.0, 0.0, 0.2]; 4]);
        let bytes: Vec<u8> = memory.parts().flatten().copied().collect();
        assert_eq!(memory.len(), bytes.len());
        assert_eq!(bytes[3 * (2 * 8 + 6)..][..6], [255, 0, 51, 255, 0, 51]);
        let mut other = Memory::new([2, 2]);
        other.add(&picture(8, 6), Arc::new(Kernel::new(Resampling::new(Filter::Box, (8, 6), (4, 3)))));
        other.restore(&bytes);
        assert!(other.parts().eq(memory.parts()));
    }

    /// Every HR pixel belongs to some block, so none is left unseen.
    #[test]
    fn blocks_cover_the_picture() {
        for (low, high) in [(10, 15), (10, 27), (100, 270), (7, 21), (3, 4), (10, 11), (1, 1), (40, 41)] {
            let side = (high as f64 / low as f64).ceil() as usize;
            let mut memory = Memory::new([side, side]);
            let operator = Resampling::new(Filter::Lanczos, (high, high), (low, low));
            memory.add(&picture(high, high), Arc::new(Kernel::new(operator)));
            let mut seen = vec![false; high];
            (0..low).for_each(|x| seen[memory.block(0, x, 0)[0]..][..side].fill(true));
            assert!(seen.iter().all(|s| *s), "{low} {high}");
        }
    }
}
