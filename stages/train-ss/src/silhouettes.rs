//! Visual hull from photographs with alpha: the cells that no photograph shows to be empty.

use artifact::GivenInput;
use glam::DVec3;
use pixels::Mask;
use radiance::spec::OCCUPANCY_CELLS;
use rayon::prelude::*;
use scene::{Background, Bounds, Camera, Photograph, Space, Views};

use crate::photographs::read_photograph;

/// Distance in pixels from a transparent region within which cells are kept: kernels with negative
/// lobes may cancel the alpha of thin parts at an object's border (design note 049).
const MARGIN_PIXELS: f64 = 1.5;
/// Highest alpha of a transparent pixel: half a step of 8 bits.
const MAX_TRANSPARENT_ALPHA: f32 = 0.5 / 255.0;

/// Returns a mask of the occupancy cells: false for each cell that lies entirely behind transparent
/// pixels in at least one view. Returns `None` if the space isn't a box, or if no photograph has
/// both transparent and opaque pixels.
pub(crate) fn cells_in_visual_hull(
    input: &GivenInput,
    views: &Views,
) -> anyhow::Result<Option<Vec<bool>>> {
    // Opaque photographs have no alpha, and reading them takes time.
    if views.bounds.space != Space::Box || views.background == Background::Opaque {
        return Ok(None);
    }
    let mut cells = vec![true; OCCUPANCY_CELLS.pow(3)];
    let mut has_silhouette = false;
    for view in &views.views {
        if let Some(silhouette) = Silhouette::new(&read_photograph(input, view)?) {
            has_silhouette = true;
            silhouette.carve(&view.camera, &views.bounds, &mut cells);
        }
    }
    Ok(has_silhouette.then_some(cells))
}

/// Number of opaque pixels above and to the left of each pixel corner of a photograph. A pixel of
/// unknown alpha counts as opaque.
struct Silhouette {
    width: usize,
    height: usize,
    sums: Vec<u32>,
}

impl Silhouette {
    /// Returns the silhouette of a photograph; `None` if the photograph has no transparent pixel,
    /// or no opaque one: from far away, an object may be smaller than a pixel.
    fn new(photograph: &Photograph) -> Option<Self> {
        let Photograph { image, mask } = photograph;
        if image.channels < 4 {
            return None;
        }
        let (width, height) = (image.width, image.height);
        let counts = mask.as_ref().map(|mask: &Mask| &mask.counts);
        let mut sums = vec![0; (width + 1) * (height + 1)];
        for row in 0..height {
            let mut in_row = 0;
            for column in 0..width {
                let pixel = row * width + column;
                let is_known = counts.is_none_or(|counts| counts[pixel]);
                let alpha = image.data[pixel * image.channels + 3];
                in_row += u32::from(!is_known || alpha > MAX_TRANSPARENT_ALPHA);
                let above = sums[row * (width + 1) + column + 1];
                sums[(row + 1) * (width + 1) + column + 1] = above + in_row;
            }
        }
        let opaque = *sums.last()? as usize;
        (1..width * height).contains(&opaque).then_some(Self { width, height, sums })
    }

    /// Excludes the cells that lie behind transparent pixels alone.
    fn carve(&self, camera: &Camera, bounds: &Bounds, cells: &mut [bool]) {
        let side = bounds.longest_side() / OCCUPANCY_CELLS as f64;
        let layer = OCCUPANCY_CELLS * OCCUPANCY_CELLS;
        cells.par_chunks_mut(layer).enumerate().for_each(|(z, cells)| {
            for (i, cell) in cells.iter_mut().enumerate().filter(|(_, cell)| **cell) {
                let corner = [i % OCCUPANCY_CELLS, i / OCCUPANCY_CELLS, z].map(|c| c as f64);
                let low = DVec3::from(bounds.min) + side * DVec3::from(corner);
                *cell = !self.is_transparent_around(camera, low, side);
            }
        });
    }

    /// Returns whether all pixels in front of a cube, and those around them, are in the image and
    /// transparent.
    fn is_transparent_around(&self, camera: &Camera, low: DVec3, side: f64) -> bool {
        // One projection decides for most cells of an object.
        let Some((x, y, _)) = camera.project(low + 0.5 * side) else { return false };
        if !self.is_transparent([x, y], [x, y]) {
            return false;
        }
        let (mut first, mut last) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for corner in 0..8 {
            let offset = [0, 1, 2].map(|axis| f64::from(corner >> axis & 1));
            let Some((x, y, _)) = camera.project(low + side * DVec3::from(offset)) else {
                return false;
            };
            (first, last) = ([first[0].min(x), first[1].min(y)], [last[0].max(x), last[1].max(y)]);
        }
        self.is_transparent(first.map(|p| p - MARGIN_PIXELS), last.map(|p| p + MARGIN_PIXELS))
    }

    /// Returns whether all pixels that a rectangle touches are in the image and transparent.
    fn is_transparent(&self, first: [f64; 2], last: [f64; 2]) -> bool {
        let size = [self.width, self.height].map(|size| size as f64);
        if (0..2).any(|axis| !(first[axis] >= 0.0 && last[axis] < size[axis])) {
            return false;
        }
        let [left, top] = first.map(|p| p as usize);
        let [right, bottom] = last.map(|p| p as usize + 1);
        let sum = |x, y| self.sums[y * (self.width + 1) + x];
        sum(right, bottom) + sum(left, top) == sum(left, bottom) + sum(right, top)
    }
}

#[cfg(test)]
mod tests {
    use pixels::Image;
    use scene::{Intrinsics, looking_at};

    use super::*;

    const SIZE: u32 = 48;

    fn camera(position: DVec3) -> Camera {
        Camera {
            name: "orbit".to_owned(),
            intrinsics: Intrinsics::from_angle_x(SIZE, SIZE, 0.8),
            camera_to_world: looking_at(position, DVec3::ZERO, DVec3::Y),
        }
    }

    /// Returns the photograph of a sphere of radius 0.3 around the origin.
    fn photograph_of_sphere(camera: &Camera) -> Photograph {
        let size = SIZE as usize;
        let pixels = (0..size * size).flat_map(|i| {
            let ray = camera.ray((i % size) as f64 + 0.5, (i / size) as f64 + 0.5);
            let nearest = ray.origin - ray.direction * ray.origin.dot(ray.direction);
            [if nearest.length() < 0.3 { 1.0 } else { 0.0 }; 4]
        });
        Image::new(size, size, 4, pixels.collect()).into()
    }

    /// Returns the cells that remain after carving by photographs, each edited first.
    fn carved(cameras: &[Camera], mut edit: impl FnMut(&mut Photograph)) -> Vec<bool> {
        let bounds = Bounds::cube(1.0, 1.0, 5.0);
        let mut cells = vec![true; OCCUPANCY_CELLS.pow(3)];
        for camera in cameras {
            let mut photograph = photograph_of_sphere(camera);
            edit(&mut photograph);
            if let Some(silhouette) = Silhouette::new(&photograph) {
                silhouette.carve(camera, &bounds, &mut cells);
            }
        }
        cells
    }

    fn distance_to_origin(cell: usize) -> f64 {
        let n = OCCUPANCY_CELLS;
        let p = [cell % n, cell / n % n, cell / (n * n)];
        DVec3::from(p.map(|c| (c as f64 + 0.5) / (n as f64 / 2.0) - 1.0)).length()
    }

    #[test]
    fn carving_retains_the_object_and_few_other_cells() {
        let cameras = [3.0 * DVec3::X, 3.0 * DVec3::Z, DVec3::new(2.0, 2.0, 1.0)].map(camera);
        let cells = carved(&cameras, |_| ());
        let near = (0..cells.len()).filter(|&cell| distance_to_origin(cell) < 0.32);
        assert!(near.into_iter().all(|cell| cells[cell]));
        let kept = cells.iter().filter(|kept| **kept).count();
        assert!(kept < cells.len() / 4, "{kept} of {} cells", cells.len());
    }

    /// Neither masked pixels nor the region outside the image are known to be empty.
    #[test]
    fn unknown_regions_are_retained() {
        let facing = camera(3.0 * DVec3::X);
        let masked = |photograph: &mut Photograph| {
            let size = SIZE as usize;
            let mask = Mask { width: size, height: size, counts: vec![false; size * size] };
            photograph.mask = Some(mask);
        };
        assert!(carved(std::slice::from_ref(&facing), masked).into_iter().all(|kept| kept));
        let averted = Camera {
            camera_to_world: looking_at(3.0 * DVec3::X, 9.0 * DVec3::Z, DVec3::Y),
            ..facing
        };
        assert!(carved(&[averted], |_| ()).into_iter().all(|kept| kept));
    }

    #[test]
    fn opaque_photographs_carve_nothing() {
        let white = Image::new(4, 4, 4, vec![1.0; 64]);
        assert!(Silhouette::new(&white.into()).is_none());
        let without_alpha = Image::new(4, 4, 3, vec![0.0; 48]);
        assert!(Silhouette::new(&without_alpha.into()).is_none());
    }

    /// From far away the sphere is smaller than a pixel, and the photograph displays none of it.
    #[test]
    fn empty_photographs_carve_nothing() {
        let cells = carved(&[camera(2000.0 * DVec3::new(0.6, 0.0, 0.8))], |photograph| {
            photograph.image.data.fill(0.0);
        });
        assert!(cells.into_iter().all(|kept| kept));
    }

    /// Every rectangle of whole pixels is compared with a test of its pixels one by one.
    #[test]
    fn rectangles_are_transparent_if_all_their_pixels_are() {
        let (width, height) = (7, 5);
        let is_opaque = |x: usize, y: usize| (x * 5 + y * 3).is_multiple_of(11);
        let pixels = (0..width * height).flat_map(|i| {
            let alpha = if is_opaque(i % width, i / width) { 1.0 } else { 0.0 };
            [0.0, 0.0, 0.0, alpha]
        });
        let image = Image::new(width, height, 4, pixels.collect());
        let silhouette = Silhouette::new(&image.into()).unwrap();
        for (left, top, right, bottom) in (0..width * height * width * height).map(|i| {
            let (first, last) = (i % (width * height), i / (width * height));
            (first % width, first / width, last % width, last / width)
        }) {
            if left <= right && top <= bottom {
                let is_empty = (top..=bottom).all(|y| (left..=right).all(|x| !is_opaque(x, y)));
                let first = [left as f64 + 0.1, top as f64 + 0.9];
                let last = [right as f64 + 0.2, bottom as f64 + 0.95];
                assert_eq!(silhouette.is_transparent(first, last), is_empty);
            }
        }
        assert!(!silhouette.is_transparent([-0.1, 1.0], [0.5, 1.0]));
        assert!(!silhouette.is_transparent([f64::NAN, 1.0], [0.5, 1.0]));
    }
}
