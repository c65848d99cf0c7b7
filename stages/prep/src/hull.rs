use glam::DVec3;
use rayon::prelude::*;
use scene::{Bounds, Camera};

/// Cells of the hull grid along each axis.
pub const GRID: usize = 128;

/// Alpha below this is taken for the rounding of an 8-bit zero.
const EMPTY_ALPHA: f32 = 1.5 / 255.0;

/// The visual hull of the masks on a grid over the bounds: 1 where every view that sees the cell has alpha near it.
///
/// Conservative: a mask is widened by the kernel's footprint (in LR pixels) and by the cell's own size, and a cell that a view
/// doesn't see counts as kept by it. x runs fastest.
pub fn carve(bounds: &Bounds, cameras: &[Camera], alphas: &[Vec<f32>], footprint: usize) -> Vec<u8> {
    let (min, max) = (DVec3::from(bounds.min), DVec3::from(bounds.max));
    let cell = (max - min) / GRID as f64;
    let radius = 0.5 * cell.length();
    let masks: Vec<NearAlpha> = alphas
        .par_iter()
        .zip(cameras)
        .map(|(alpha, camera)| {
            let nearest = (camera.centre() - camera.centre().clamp(min, max)).length().max(1e-3 * (max - min).length());
            let spread = (radius * camera.intrinsics.fx.max(camera.intrinsics.fy) / nearest).ceil() as usize;
            NearAlpha::new(alpha, camera, footprint + spread)
        })
        .collect();
    (0..GRID * GRID)
        .into_par_iter()
        .flat_map_iter(|zy| {
            let (y, z) = (zy % GRID, zy / GRID);
            let masks = &masks;
            (0..GRID).map(move |x| {
                let centre = min + cell * DVec3::new(x as f64 + 0.5, y as f64 + 0.5, z as f64 + 0.5);
                let kept = cameras.iter().zip(masks).all(|(camera, mask)| mask.may_hold(camera.project(centre)));
                u8::from(kept)
            })
        })
        .collect()
}

/// No cell was left.
#[derive(Debug, thiserror::Error)]
#[error("the masks leave nothing of the scene; do the images have alpha? choose hull: none")]
pub(crate) struct EmptyHull;

/// The box of the kept cells, one cell wider on each side.
pub(crate) fn tightened(bounds: &Bounds, cameras: &[Camera], alphas: &[Vec<f32>], footprint: usize) -> Result<Bounds, EmptyHull> {
    let grid = carve(bounds, cameras, alphas, footprint);
    let mut low = [GRID; 3];
    let mut high = [0usize; 3];
    for (i, _) in grid.iter().enumerate().filter(|(_, kept)| **kept == 1) {
        for (axis, at) in [i % GRID, i / GRID % GRID, i / (GRID * GRID)].into_iter().enumerate() {
            low[axis] = low[axis].min(at);
            high[axis] = high[axis].max(at + 1);
        }
    }
    if low[0] == GRID {
        return Err(EmptyHull);
    }
    let mut tight = *bounds;
    for axis in 0..3 {
        let cell = (bounds.max[axis] - bounds.min[axis]) / GRID as f64;
        tight.min[axis] = bounds.min[axis] + cell * low[axis].saturating_sub(1) as f64;
        tight.max[axis] = bounds.min[axis] + cell * (high[axis] + 1).min(GRID) as f64;
    }
    Ok(tight)
}

/// Which pixels have alpha within a distance.
struct NearAlpha {
    width: usize,
    height: usize,
    near_alpha: Vec<bool>,
}

impl NearAlpha {
    fn new(alpha: &[f32], camera: &Camera, distance: usize) -> Self {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        // A square dilation, one axis after the other.
        let mut near_alpha: Vec<bool> = alpha.iter().map(|&a| a > EMPTY_ALPHA).collect();
        for (stride, length) in [(1, width), (width, height)] {
            let source = near_alpha.clone();
            for (i, near) in near_alpha.iter_mut().enumerate() {
                let at = i / stride % length;
                let (from, to) = (at.saturating_sub(distance), (at + distance).min(length - 1));
                *near = (from..=to).any(|k| source[i - at * stride + k * stride]);
            }
        }
        Self { width, height, near_alpha }
    }

    fn may_hold(&self, seen: Option<(f64, f64, f64)>) -> bool {
        let Some((x, y, _)) = seen else { return true };
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f64 && y < self.height as f64;
        !inside || self.near_alpha[y as usize * self.width + x as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Intrinsics;

    /// Two cameras at right angles that see a centred square of half the image.
    #[test]
    fn two_masks_leave_their_common_column() {
        let camera = |m| Camera { name: "c".into(), intrinsics: Intrinsics::from_angle_x(32, 32, 0.5), camera_to_world: m };
        let front = camera([[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 10.]]);
        let side = camera([[0., 0., 1., 10.], [0., 1., 0., 0.], [-1., 0., 0., 0.]]);
        let mask: Vec<f32> =
            (0..32 * 32).map(|i| f32::from(u8::from((8..24).contains(&(i % 32)) && (8..24).contains(&(i / 32))))).collect();
        let bounds = Bounds { min: [-2.; 3], max: [2.; 3], near: 1., far: 20., ..Default::default() };
        let tight = tightened(&bounds, &[front, side], &[mask.clone(), mask.clone()], 1).unwrap();
        for axis in 0..3 {
            // The square spans ±1.27 at the centre; conservative means never less, and not everything.
            assert!((1.27..1.95).contains(&tight.max[axis]) && (-1.95..-1.27).contains(&tight.min[axis]), "{tight:?}");
        }
        let empty = vec![0.0; 32 * 32];
        let front = camera([[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 10.]]);
        assert!(tightened(&bounds, &[front], &[empty], 1).is_err());
    }
}
