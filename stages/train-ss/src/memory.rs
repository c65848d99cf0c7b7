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
    operator: Resampling,
}

impl Memory {
    pub(crate) fn new(side: [usize; 2]) -> Self {
        Self { side, views: Vec::new() }
    }

    /// Adds the next view: an RGB picture at HR size to begin with, and what makes it an LR picture.
    pub(crate) fn add(&mut self, picture: &Picture, operator: Resampling) {
        let rendered = picture.data.iter().map(|&v| to_u8(v)).collect();
        self.views.push(Remembered { width: picture.width, height: picture.height, rendered, operator });
    }

    /// First column and row of the HR pixels rendered for an LR pixel: those around its centre.
    fn block(&self, view: usize, x: usize, y: usize) -> [usize; 2] {
        let view = &self.views[view];
        let first = |i: usize, at: usize, fine: usize, coarse: usize| {
            let scale = fine as f64 / coarse as f64;
            let start = (at as f64 + 0.5).mul_add(scale, -0.5 * self.side[i] as f64).round().max(0.0) as usize;
            start.min(fine.saturating_sub(self.side[i]))
        };
        [first(0, x, view.width, view.operator.x.outputs()), first(1, y, view.height, view.operator.y.outputs())]
    }

    /// Where that block begins and how large an HR pixel is, in LR pixels.
    pub(crate) fn block_in_pixels(&self, view: usize, x: usize, y: usize) -> ([f64; 2], [f64; 2]) {
        let [i, j] = self.block(view, x, y);
        let view = &self.views[view];
        let apart = [view.operator.x.outputs() as f64 / view.width as f64, view.operator.y.outputs() as f64 / view.height as f64];
        ([i as f64 * apart[0], j as f64 * apart[1]], apart)
    }

    /// (K - A)·c' at an LR pixel: what to add to the mean of its fresh sub-rays to predict the LR pixel.
    pub(crate) fn correction(&self, view: usize, x: usize, y: usize) -> [f32; 3] {
        let [i, j] = self.block(view, x, y);
        let view = &self.views[view];
        let rows = view.rendered.chunks_exact(3 * view.width);
        let ((left, across), (top, down)) = (view.operator.x.run(x), view.operator.y.run(y));
        let mut sum = [0.0f32; 3];
        for (row, wy) in rows.clone().skip(top).zip(down) {
            let mut along = [0.0f32; 3];
            for (pixel, wx) in row[3 * left..].as_chunks::<3>().0.iter().zip(across) {
                (0..3).for_each(|c| along[c] += wx * f32::from(pixel[c]));
            }
            (0..3).for_each(|c| sum[c] += wy * along[c]);
        }
        let mut block = [0u32; 3];
        for row in rows.skip(j).take(self.side[1]) {
            for pixel in row[3 * i..].as_chunks::<3>().0.iter().take(self.side[0]) {
                (0..3).for_each(|c| block[c] += u32::from(pixel[c]));
            }
        }
        let count = (self.side[0] * self.side[1]) as f32;
        std::array::from_fn(|c| (sum[c] - block[c] as f32 / count) / 255.0)
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

    /// With the HR picture in it, the memory and fresh sub-rays that agree predict what the kernel makes of it; at any scale.
    #[test]
    fn predicts_what_the_kernel_makes() {
        for ((low, high), side) in
            [((9, 8), (18, 16)), ((10, 6), (27, 15)), ((7, 7), (11, 10)), ((5, 4), (20, 16)), ((1, 1), (2, 2))].map(
                |(low, high): ((usize, usize), (usize, usize))| ((low, high), [high.0.div_ceil(low.0), high.1.div_ceil(low.1)]),
            )
        {
            let fine = picture(high.0, high.1);
            let operator = Resampling::new(Filter::Lanczos, high, low);
            let expected = operator.apply(&fine);
            let mut memory = Memory::new(side);
            memory.add(&fine, operator);
            for y in 0..low.1 {
                for x in 0..low.0 {
                    let [i, j] = memory.block(0, x, y);
                    let fresh: Vec<[f32; 3]> = (0..side[0] * side[1])
                        .map(|k| (i + k % side[0]) + (j + k / side[0]) * high.0)
                        .map(|p| std::array::from_fn(|c| fine.data[3 * p + c]))
                        .collect();
                    let correction = memory.correction(0, x, y);
                    for c in 0..3 {
                        let mean = fresh.iter().map(|f| f[c]).sum::<f32>() / fresh.len() as f32;
                        let predicted = mean + correction[c];
                        assert!((predicted - expected.data[3 * (y * low.0 + x) + c]).abs() < 1e-5, "{low:?} {high:?} ({x}, {y})");
                    }
                    memory.remember(0, x, y, &fresh);
                }
            }
            // All that was remembered was there already.
            assert_eq!(
                memory.parts().next().unwrap(),
                Picture::to_rgba8(&fine).data.chunks(4).flat_map(|p| p[..3].to_vec()).collect::<Vec<_>>()
            );
        }
    }

    /// Every HR pixel belongs to some block, so none is left unseen.
    #[test]
    fn blocks_cover_the_picture() {
        for (low, high) in [(10, 15), (10, 27), (100, 270), (7, 21), (3, 4), (10, 11), (1, 1), (40, 41)] {
            let side = (high as f64 / low as f64).ceil() as usize;
            let mut memory = Memory::new([side, side]);
            memory.add(&picture(high, high), Resampling::new(Filter::Lanczos, (high, high), (low, low)));
            let mut seen = vec![false; high];
            (0..low).for_each(|x| seen[memory.block(0, x, 0)[0]..][..side].fill(true));
            assert!(seen.iter().all(|s| *s), "{low} {high}");
        }
    }
}
