use std::collections::BTreeSet;

use crate::{KnownView, RefinementError, Rendered};
use pixels::Image;
use rayon::prelude::*;
use scene::SurfaceMap;
use tch::{TchError, no_grad};

use super::network::{PaperRefiner, patch_tensor};

/// Side of a patch in pixels, as published.
pub(crate) const PATCH_PIXELS: usize = 64;
/// Overlap of neighbouring patches in pixels: a quarter of a patch (design note 024).
const OVERLAP_PIXELS: usize = 16;
/// Number of probes along each side of a patch: pixels whose depth locates reference patches;
/// chosen by hand.
const PROBES_PER_SIDE: usize = 4;

/// Column and row of a patch's top left corner.
type Corner = (usize, usize);

impl PaperRefiner {
    /// Redraws a view in patches of 64×64 pixels, blended where they overlap. Each patch gets at
    /// most `max_patches` reference patches, at positions where the patch's pixels are visible
    /// in the references. A patch without reference patches is its own reference, as in the paper's
    /// code. Returns an image of three channels in 0..1.
    pub fn refine(
        &self,
        rendered: &Rendered,
        references: &[&KnownView],
        max_patches: usize,
    ) -> Result<Image, RefinementError> {
        let view = &rendered.view;
        check_size(&rendered.camera.name, "the rendered view", view)?;
        for known in references {
            check_size(&known.rendered.camera.name, "the reference", &known.truth)?;
        }
        // Tensors aren't `Sync`, so each task takes handles of its own.
        let tasks: Vec<(Corner, Self)> = patch_starts(view.height)
            .into_iter()
            .flat_map(|y| patch_starts(view.width).into_iter().map(move |x| (x, y)))
            .map(|corner| (corner, self.shallow_clone()))
            .collect();
        let patches = tasks
            .into_par_iter()
            .map(|(corner, network)| network.redraw(rendered, corner, references, max_patches))
            .collect::<Result<Vec<_>, _>>()?;
        Ok(blend(view.width, view.height, &patches))
    }

    /// Redraws a view's patch with at most `max_patches` reference patches, in -1..1.
    fn redraw(
        &self,
        rendered: &Rendered,
        corner: Corner,
        references: &[&KnownView],
        max_patches: usize,
    ) -> Result<(Corner, Vec<f32>), TchError> {
        let samples = patch(&rendered.view, corner);
        let mut reference_samples: Vec<Vec<f32>> =
            matching_patches(rendered, references, corner, max_patches)
                .into_iter()
                .map(|(r, corner)| patch(&references[r].truth, corner))
                .collect();
        if reference_samples.is_empty() {
            reference_samples.push(samples.clone());
        }
        let own = patch_tensor(&samples, 1, PATCH_PIXELS)?;
        let count = reference_samples.len();
        let matching = patch_tensor(&reference_samples.concat(), count, PATCH_PIXELS)?;
        let redrawn = no_grad(|| self.forward(&own, &matching, false))?;
        let redrawn = redrawn.f_permute([0, 2, 3, 1])?.f_contiguous()?.f_view([-1])?;
        Ok((corner, Vec::<f32>::try_from(&redrawn)?))
    }
}

/// Fails if an image of the view `name` is smaller than a patch; the message calls it `role`.
fn check_size(name: &str, role: &str, image: &Image) -> Result<(), RefinementError> {
    if image.width >= PATCH_PIXELS && image.height >= PATCH_PIXELS {
        return Ok(());
    }
    let reason = format!(
        "{role} has {}×{} pixels; the paper's network needs at least {PATCH_PIXELS}×{PATCH_PIXELS}",
        image.width, image.height
    );
    Err(RefinementError::view(name, reason))
}

/// Returns the starts of patches along an axis; the last patch ends at the border.
fn patch_starts(size: usize) -> Vec<usize> {
    let last = size - PATCH_PIXELS;
    let mut all: Vec<usize> = (0..last).step_by(PATCH_PIXELS - OVERLAP_PIXELS).collect();
    all.push(last);
    all
}

/// Returns a patch of an image, row by row, in -1..1.
pub(crate) fn patch(image: &Image, (x, y): Corner) -> Vec<f32> {
    let mut samples = Vec::with_capacity(PATCH_PIXELS * PATCH_PIXELS * 3);
    for row in y..y + PATCH_PIXELS {
        for column in x..x + PATCH_PIXELS {
            let start = (row * image.width + column) * image.channels;
            samples.extend(image.data[start..start + 3].iter().map(|v| 2.0 * v - 1.0));
        }
    }
    samples
}

/// Finds at most `max_patches` reference patches that display the surface in a view's patch, the
/// most visible first. Returns the index of the reference and the corner of each. Each probe that
/// is visible in a reference yields one candidate; duplicates are dropped.
fn matching_patches(
    rendered: &Rendered,
    references: &[&KnownView],
    (x, y): Corner,
    max_patches: usize,
) -> Vec<(usize, Corner)> {
    let surface = rendered.surface();
    let surfaces: Vec<SurfaceMap<'_>> = references.iter().map(|r| r.rendered.surface()).collect();
    let step = PATCH_PIXELS / PROBES_PER_SIDE;
    let mut candidates = Vec::new();
    for (dx, dy) in (0..PROBES_PER_SIDE)
        .flat_map(|j| (0..PROBES_PER_SIDE).map(move |i| (i * step + step / 2, j * step + step / 2)))
    {
        for (r, other) in surfaces.iter().enumerate() {
            let projection = surface.visible_projection(x + dx, y + dy, other);
            let Some(projection) = projection else { continue };
            let truth = &references[r].truth;
            let [column, row] = projection.position;
            let corner =
                (matching_start(column, dx, truth.width), matching_start(row, dy, truth.height));
            let visibility = projection.cosine.max(0.0) * projection.relative_resolution.min(1.0);
            candidates.push((visibility, r, corner));
        }
    }
    candidates.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let mut taken = BTreeSet::new();
    candidates
        .into_iter()
        .map(|(_, r, corner)| (r, corner))
        .filter(|patch| taken.insert(*patch))
        .take(max_patches)
        .collect()
}

/// Returns the start of a patch along an axis of a reference, so that the patch's pixel `offset` is
/// the one that contains `position`. The patch is clamped to the reference of `size` pixels.
fn matching_start(position: f32, offset: usize, size: usize) -> usize {
    (position.floor() as isize - offset as isize).clamp(0, (size - PATCH_PIXELS) as isize) as usize
}

/// Blends patches in -1..1 to an image in 0..1, weighted by distance from the patch's border.
fn blend(width: usize, height: usize, patches: &[(Corner, Vec<f32>)]) -> Image {
    let mut sum = vec![0.0f32; width * height * 3];
    let mut weights = vec![0.0f32; width * height];
    for ((x, y), samples) in patches {
        for (i, pixel) in samples.chunks_exact(3).enumerate() {
            let (column, row) = (i % PATCH_PIXELS, i / PATCH_PIXELS);
            let index = (y + row) * width + x + column;
            let weight = border_distance(column) * border_distance(row);
            for c in 0..3 {
                sum[index * 3 + c] += weight * (0.5 * pixel[c] + 0.5);
            }
            weights[index] += weight;
        }
    }
    for (i, value) in sum.iter_mut().enumerate() {
        *value = (*value / weights[i / 3]).clamp(0.0, 1.0);
    }
    Image::new(width, height, 3, sum)
}

/// Returns the distance in pixels of a patch's column or row from the border of the patch.
fn border_distance(i: usize) -> f32 {
    (i + 1).min(PATCH_PIXELS - i) as f32
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
    fn blended_unchanged_patches_equal_the_image() {
        for (width, height) in [(64, 64), (65, 200), (150, 112), (129, 300)] {
            let original = image(width, height, 3);
            let corners = patch_starts(height)
                .into_iter()
                .flat_map(|y| patch_starts(width).into_iter().map(move |x| (x, y)));
            let patches: Vec<_> =
                corners.map(|corner| (corner, patch(&original, corner))).collect();
            let blended = blend(width, height, &patches);
            let max_error = original
                .data
                .iter()
                .zip(&blended.data)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max);
            assert!(max_error < 1e-6, "{width}×{height}: {max_error}");
        }
    }

    #[test]
    fn patches_overlap_by_a_quarter() {
        assert_eq!(patch_starts(256), [0, 48, 96, 144, 192]);
        // The last patch ends at the border.
        assert_eq!(patch_starts(150), [0, 48, 86]);
    }

    /// Creates a view of a wall at distance 2 by a camera moved parallel to the wall by `pixels`.
    fn wall_view(pixels: f64) -> KnownView {
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

    /// In a moved reference, the matching patch is shifted by the camera's movement. A reference
    /// that doesn't observe the patch has no match.
    #[test]
    fn matching_patches_display_the_same_part_of_the_wall() {
        let (view, right, elsewhere) = (wall_view(0.0), wall_view(20.0), wall_view(400.0));
        assert_eq!(matching_patches(&view.rendered, &[&right], (48, 16), 8), [(0, (28, 16))]);
        assert_eq!(
            matching_patches(&view.rendered, &[&elsewhere, &right], (48, 16), 8),
            [(1, (28, 16))]
        );
        assert!(matching_patches(&view.rendered, &[&elsewhere], (48, 16), 8).is_empty());
        // At the border the patch is moved into the image.
        assert_eq!(matching_patches(&view.rendered, &[&right], (0, 0), 8), [(0, (0, 0))]);
    }

    #[test]
    fn views_keep_their_size_and_small_ones_are_refused() {
        nets::deterministic();
        let network = PaperRefiner::new(4, 1).unwrap();
        let (view, reference) = (wall_view(0.0), wall_view(20.0));
        for references in [vec![], vec![&reference]] {
            let refined = network.refine(&view.rendered, &references, 8).unwrap();
            assert_eq!((refined.width, refined.height, refined.channels), (160, 96, 3));
            assert!(refined.data.iter().all(|v| (0.0..=1.0).contains(v)));
        }
        // The view is checked first.
        let mut small = view.rendered.clone();
        small.view = image(63, 96, 4);
        let mut small_reference = wall_view(20.0);
        small_reference.truth = image(96, 60, 3);
        let needed = "the paper's network needs at least 64×64";
        assert_eq!(
            network.refine(&small, &[&small_reference], 8).unwrap_err().to_string(),
            format!("view 0: the rendered view has 63×96 pixels; {needed}")
        );
        assert_eq!(
            network.refine(&view.rendered, &[&small_reference], 8).unwrap_err().to_string(),
            format!("view 20: the reference has 96×60 pixels; {needed}")
        );
    }
}
