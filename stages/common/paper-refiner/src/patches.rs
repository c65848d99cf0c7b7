use std::collections::BTreeSet;

use pixels::Image;
use rayon::prelude::*;
use refinement::{KnownView, RefinementError, Rendered};
use scene::Surface;
use tch::{TchError, Tensor, no_grad};

use crate::network::{COLOURS, PaperRefiner};

/// Pixels along a patch's side, as published.
pub(crate) const PATCH: usize = 64;
/// Pixels by which patches overlap unless told otherwise: a quarter.
pub const OVERLAP: usize = 16;
/// Pixels along each side of a patch that look for a reference patch.
const LOOKS_PER_SIDE: usize = 4;

/// A patch's top left corner.
type Corner = (usize, usize);

impl PaperRefiner {
    /// A view redrawn by patches of 64×64 that overlap by so many pixels, at most by half, and are
    /// blended. Each gets `count` patches of references that show the same: where its own pixels
    /// are seen there, by depth and with nothing before them. One that has fewer is given itself
    /// instead, as in the reference. An image of three channels in 0..1.
    pub fn refine(
        &self,
        rendered: &Rendered,
        references: &[&KnownView],
        count: usize,
        overlap: usize,
    ) -> Result<Image, RefinementError> {
        let view = &rendered.view;
        if view.width < PATCH || view.height < PATCH {
            let reason = format!(
                "{}×{} pixels; the paper's network needs {PATCH}×{PATCH}",
                view.width, view.height
            );
            return Err(RefinementError::View { name: rendered.camera.name.clone(), reason });
        }
        if let Some(small) =
            references.iter().find(|r| r.truth.width < PATCH || r.truth.height < PATCH)
        {
            let reason = format!("a reference of fewer than {PATCH}×{PATCH} pixels");
            return Err(RefinementError::View { name: small.rendered.camera.name.clone(), reason });
        }
        let corners: Vec<(Corner, Self)> = starts(view.height, overlap)
            .into_iter()
            .flat_map(|y| starts(view.width, overlap).into_iter().map(move |x| (x, y)))
            .map(|corner| (corner, self.share()))
            .collect();
        let drawn = corners
            .into_par_iter()
            .map(|(corner, network)| network.redraw(rendered, corner, references, count))
            .collect::<Result<Vec<_>, _>>()?;
        Ok(stitch(view.width, view.height, &drawn))
    }

    /// A view's patch, redrawn beside at most `count` patches of references, in -1..1.
    fn redraw(
        &self,
        rendered: &Rendered,
        corner: Corner,
        references: &[&KnownView],
        count: usize,
    ) -> Result<(Corner, Vec<f32>), TchError> {
        let own = patch(&rendered.view, corner);
        let mut others: Vec<Vec<f32>> = matches(rendered, references, corner, count)
            .into_iter()
            .map(|(r, at)| patch(&references[r].truth, at))
            .collect();
        if others.is_empty() {
            others.push(own.clone());
        }
        let drawn = no_grad(|| self.forward(&tensor(&[own])?, &tensor(&others)?, false))?;
        let drawn = drawn.f_permute([0, 2, 3, 1])?.f_contiguous()?.f_view([-1])?;
        Ok((corner, Vec::<f32>::try_from(&drawn)?))
    }
}

/// Patches as a network takes them: count × 3 × rows × columns.
fn tensor(patches: &[Vec<f32>]) -> Result<Tensor, TchError> {
    let side = PATCH as i64;
    Tensor::f_from_slice(&patches.concat())?
        .f_reshape([patches.len() as i64, side, side, COLOURS])?
        .f_permute([0, 3, 1, 2])
}

/// Where patches begin along an axis: the last one ends at the border.
fn starts(size: usize, overlap: usize) -> Vec<usize> {
    let last = size - PATCH;
    let mut all: Vec<usize> = (0..last).step_by(PATCH - overlap.min(PATCH / 2)).collect();
    all.push(last);
    all
}

/// A patch of an image, row by row, in -1..1.
pub(crate) fn patch(image: &Image, (x, y): Corner) -> Vec<f32> {
    let mut samples = Vec::with_capacity(PATCH * PATCH * 3);
    for row in y..y + PATCH {
        for column in x..x + PATCH {
            let at = (row * image.width + column) * image.channels;
            samples.extend(image.data[at..at + 3].iter().map(|v| 2.0 * v - 1.0));
        }
    }
    samples
}

/// Reference patches that show what a patch does, best first: which reference, and its corner.
/// Pixels spread over the patch each say where the patch lies in a reference that sees them; the
/// same corner counts once.
fn matches(
    rendered: &Rendered,
    references: &[&KnownView],
    (x, y): Corner,
    count: usize,
) -> Vec<(usize, Corner)> {
    let surface = rendered.surface();
    let surfaces: Vec<Surface<'_>> = references.iter().map(|r| r.rendered.surface()).collect();
    let step = PATCH / LOOKS_PER_SIDE;
    let mut found = Vec::new();
    for (dx, dy) in (0..LOOKS_PER_SIDE)
        .flat_map(|j| (0..LOOKS_PER_SIDE).map(move |i| (i * step + step / 2, j * step + step / 2)))
    {
        for (r, other) in surfaces.iter().enumerate() {
            let Some(visibility) = surface.visibility(x + dx, y + dy, other) else { continue };
            let truth = &references[r].truth;
            let at = (
                start(visibility.place[0], dx, truth.width),
                start(visibility.place[1], dy, truth.height),
            );
            found.push((visibility.cosine.max(0.0) * visibility.detail.min(1.0), r, at));
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let mut taken = BTreeSet::new();
    found
        .into_iter()
        .map(|(_, r, at)| (r, at))
        .filter(|patch| taken.insert(*patch))
        .take(count)
        .collect()
}

/// Where a patch begins along an axis of a reference in which a pixel's centre is seen at `place`:
/// as far before the pixel as here.
fn start(place: f32, before: usize, size: usize) -> usize {
    ((place - 0.5).round() as isize - before as isize).clamp(0, (size - PATCH) as isize) as usize
}

/// Patches in -1..1 as an image in 0..1: where they overlap, each weighs by how far it is from its
/// own border.
fn stitch(width: usize, height: usize, patches: &[(Corner, Vec<f32>)]) -> Image {
    let (mut sum, mut weights) = (vec![0.0f32; width * height * 3], vec![0.0f32; width * height]);
    let inward = |i: usize| (i + 1).min(PATCH - i) as f32;
    for ((x, y), samples) in patches {
        for (i, pixel) in samples.chunks_exact(3).enumerate() {
            let (column, row) = (i % PATCH, i / PATCH);
            let (at, weight) = ((y + row) * width + x + column, inward(column) * inward(row));
            (0..3).for_each(|c| sum[at * 3 + c] += weight * (0.5 * pixel[c] + 0.5));
            weights[at] += weight;
        }
    }
    sum.chunks_exact_mut(3)
        .zip(weights)
        .for_each(|(pixel, w)| pixel.iter_mut().for_each(|v| *v = (*v / w).clamp(0.0, 1.0)));
    Image::new(width, height, 3, sum)
}

#[cfg(test)]
mod tests {
    use scene::{Camera, Intrinsics};

    use super::*;

    fn image(width: usize, height: usize, channels: usize) -> Image {
        let data = (0..width * height * channels).map(|i| (i * 37 % 101) as f32 / 100.0).collect();
        Image::new(width, height, channels, data)
    }

    #[test]
    fn patches_that_do_nothing_are_stitched_to_the_image() {
        for (width, height, overlap) in
            [(64, 64, 16), (65, 200, 0), (150, 112, 16), (150, 112, 0), (129, 300, 100)]
        {
            let whole = image(width, height, 3);
            let corners = starts(height, overlap)
                .into_iter()
                .flat_map(|y| starts(width, overlap).into_iter().map(move |x| (x, y)));
            let patches: Vec<_> = corners.map(|corner| (corner, patch(&whole, corner))).collect();
            let again = stitch(width, height, &patches);
            let worst =
                whole.data.iter().zip(&again.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-6, "{width}×{height} by {overlap}: {worst}");
        }
    }

    #[test]
    fn patches_overlap_by_as_much_as_asked() {
        assert_eq!(starts(256, 0), [0, 64, 128, 192]);
        assert_eq!(starts(256, OVERLAP), [0, 48, 96, 144, 192]);
        assert_eq!(starts(150, 32), [0, 32, 64, 86]);
        // Never by more than half.
        assert_eq!(starts(150, 64), starts(150, 32));
    }

    /// A wall at distance 2, seen by cameras that move along it by so many pixels.
    fn known(pixels: f64) -> KnownView {
        let (width, height) = (160, 96);
        let camera = Camera {
            name: format!("{pixels}"),
            intrinsics: Intrinsics {
                width,
                height,
                fx: 100.0,
                fy: 100.0,
                cx: 80.0,
                cy: 48.0,
                distortion: Default::default(),
            },
            camera_to_world: [
                [1.0, 0.0, 0.0, pixels / 50.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 2.0],
            ],
        };
        let (view, count) = (image(width as usize, height as usize, 4), (width * height) as usize);
        let rendered =
            Rendered { camera, view, depth: vec![2.0; count], opacity: vec![1.0; count] };
        KnownView { rendered, truth: image(width as usize, height as usize, 3) }
    }

    /// Before a wall, a reference shows all pixels of a patch at one place; a reference that
    /// doesn't look there has none.
    #[test]
    fn reference_patches_show_the_same_place() {
        let (view, right, away) = (known(0.0), known(20.0), known(400.0));
        assert_eq!(matches(&view.rendered, &[&right], (48, 16), 8), [(0, (28, 16))]);
        assert_eq!(matches(&view.rendered, &[&away, &right], (48, 16), 8), [(1, (28, 16))]);
        assert!(matches(&view.rendered, &[&away], (48, 16), 8).is_empty());
        // At the border the patch is moved into the image.
        assert_eq!(matches(&view.rendered, &[&right], (0, 0), 8), [(0, (0, 0))]);
    }

    #[test]
    fn a_view_is_redrawn_at_its_size_or_refused() {
        nets::deterministic();
        let network = PaperRefiner::new(4, 1).unwrap();
        let (view, other) = (known(0.0), known(20.0));
        for references in [vec![], vec![&other]] {
            let drawn = network.refine(&view.rendered, &references, 8, OVERLAP).unwrap();
            assert_eq!((drawn.width, drawn.height, drawn.channels), (160, 96, 3));
            assert!(drawn.data.iter().all(|v| (0.0..=1.0).contains(v)));
        }
        let mut small = view.rendered.clone();
        small.view = image(63, 96, 4);
        assert!(network.refine(&small, &[], 8, OVERLAP).unwrap_err().to_string().contains("64×64"));
    }
}
