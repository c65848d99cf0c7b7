use artifact::{FailureExt as _, GivenInput};
use pixels::{DepthMap, ExrImage, Image, Mask, Rgba8, psnr_of, to_u8};
use scene::{Camera, SurfaceMap, View};

use super::read_depth;
use crate::scored_view::{ScoredView, read_image};

/// Agreement of a view's true image with its neighbour's, warped by the rendered depths: a measure
/// of the depths' accuracy.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WarpScore {
    /// Peak signal-to-noise ratio in dB over the pixels that are visible from the neighbour and
    /// that neither view's mask excludes.
    pub psnr: f64,
    /// Fraction of the view's pixels that are compared.
    pub seen: f64,
}

/// Maximum distance between two cameras divided by the median depth of a view: 20° of parallax,
/// 2·tan 10°, chosen by hand. Between cameras farther apart, reflections and occlusions cause
/// larger errors than wrong depths.
const MAX_DISTANCE_PER_DEPTH: f64 = 0.3527;

/// Returns the other view whose centre is nearest to a camera's.
fn neighbour<'a>(camera: &Camera, views: &'a [View]) -> Option<&'a View> {
    let distance = |view: &View| (view.camera.centre() - camera.centre()).length_squared();
    let others = views.iter().filter(|view| view.camera.name != camera.name);
    others.min_by(|a, b| distance(a).total_cmp(&distance(b)))
}

/// True if two cameras are near enough for a comparison of their views, by
/// [`MAX_DISTANCE_PER_DEPTH`]. `map` has the depths of the first camera.
fn are_near(camera: &Camera, other: &Camera, map: DepthMap<'_>) -> bool {
    let surfaces = (0..map.depth.len()).filter(|pixel| map.has_surface(*pixel));
    let mut depths: Vec<f32> = surfaces.map(|pixel| map.depth[pixel]).collect();
    depths.sort_by(f32::total_cmp);
    let Some(median) = depths.get(depths.len() / 2) else { return false };
    let distance = (other.centre() - camera.centre()).length();
    distance <= MAX_DISTANCE_PER_DEPTH * f64::from(*median)
}

/// Reads a rendered view's depth image; `None` if it is missing or has another size.
fn read_depth_image(input: &GivenInput, view: &View) -> anyhow::Result<Option<ExrImage>> {
    let Some(depth) = &view.depth else { return Ok(None) };
    let image = read_depth(&input.path(depth), &view.camera.name)?;
    let k = &view.camera.intrinsics;
    let has_size = (image.width, image.height) == (k.width as usize, k.height as usize);
    Ok(has_size.then_some(image))
}

/// View with its true image; images have the size of the camera's.
struct TrueView<'a> {
    camera: &'a Camera,
    /// Rendered depth and opacity.
    depth: &'a ExrImage,
    truth: &'a Image,
    mask: Option<Mask>,
}

/// Number of pixels that [`Image::colour_at`] reads on each side of the nearest one.
const CUBIC_MARGIN: usize = 2;

/// Warps the neighbour's image to a view by both depths, and scores the result. In the picture,
/// pixels that are masked or aren't visible from the neighbour are red. `None` if a depth image
/// lacks a channel, or no pixel remains.
fn warp(view: &TrueView<'_>, neighbour: &TrueView<'_>) -> Option<(WarpScore, Rgba8)> {
    const INVISIBLE_COLOUR: [u8; 4] = [120, 20, 30, 255];
    let (truth, other_truth) = (view.truth, neighbour.truth);
    let surface = SurfaceMap { camera: view.camera, map: DepthMap::of(view.depth)? };
    let other = SurfaceMap { camera: neighbour.camera, map: DepthMap::of(neighbour.depth)? };
    let mut positions = surface.positions_in(&other);
    if let Some(mask) = &view.mask {
        for (position, counts) in positions.iter_mut().zip(&mask.counts) {
            *position = position.filter(|_| *counts);
        }
    }
    let size = (other_truth.width, other_truth.height);
    // The mask has this size already; resizing only widens it by the margin.
    if let Some(mask) = neighbour.mask.as_ref().map(|mask| mask.resized(size, CUBIC_MARGIN)) {
        for position in &mut positions {
            *position = position.filter(|&[x, y]| {
                mask.counts.get(y as usize * mask.width + x as usize).is_some_and(|counts| *counts)
            });
        }
    }
    let (mut sum, mut visible) = (0.0, 0usize);
    let mut data = Vec::with_capacity(4 * positions.len());
    for (i, pixel) in truth.data.chunks_exact(3).enumerate() {
        let Some(position) = positions[i] else {
            data.extend(INVISIBLE_COLOUR);
            continue;
        };
        let colour = other_truth.colour_at(position);
        sum += (0..3).map(|c| f64::from(colour[c] - pixel[c]).powi(2)).sum::<f64>();
        visible += 1;
        data.extend(colour.map(to_u8));
        data.push(255);
    }
    if visible == 0 {
        return None;
    }
    let psnr = psnr_of(sum / (3 * visible) as f64);
    let seen = visible as f64 / positions.len() as f64;
    Some((WarpScore { psnr, seen }, Rgba8::new(truth.width, truth.height, data)))
}

/// Scores a view against its nearest neighbour's true image, warped by the rendered depths. `None`
/// if an image or depth is missing, the neighbour is too far away, or the neighbour shows no pixel
/// of the view.
pub(super) fn score_view(scored: &ScoredView<'_>) -> anyhow::Result<Option<(WarpScore, Rgba8)>> {
    let (scene, own_camera) = (scored.scene, &scored.view.camera);
    let Some(truth) = &scored.truth else { return Ok(None) };
    let Some(other) = neighbour(own_camera, &scene.views.views) else { return Ok(None) };
    let other_truth = scene.truth.views.iter().find(|v| v.camera.name == other.camera.name);
    let Some((other_view, file)) = other_truth.and_then(|v| Some((v, v.image.as_ref()?))) else {
        return Ok(None);
    };
    let Some(depth) = read_depth_image(scene.views_input, scored.view)? else { return Ok(None) };
    if DepthMap::of(&depth).is_none_or(|map| !are_near(own_camera, &other.camera, map)) {
        return Ok(None);
    }
    let Some(other_depth) = read_depth_image(scene.views_input, other)? else { return Ok(None) };
    let image = read_image(scene.truth_input, scene.truth, other_view, file)?;
    if (image.width, image.height) != (other_depth.width, other_depth.height) {
        return Ok(None);
    }
    let read_mask = |true_view: &View, image: &Image| {
        let mask = true_view.read_mask(scene.truth_input, (image.width, image.height));
        mask.bad_input(format!("view {}", true_view.camera.name))
    };
    let view = TrueView {
        camera: own_camera,
        depth: &depth,
        truth,
        mask: read_mask(scored.true_view, truth)?,
    };
    let neighbour = TrueView {
        camera: &other.camera,
        depth: &other_depth,
        truth: &image,
        mask: read_mask(other_view, &image)?,
    };
    Ok(warp(&view, &neighbour))
}

#[cfg(test)]
mod tests {
    use super::*;
    use scene::Intrinsics;

    fn camera(name: &str, x: f64) -> Camera {
        Camera {
            name: name.into(),
            intrinsics: Intrinsics {
                width: 40,
                height: 4,
                fx: 40.0,
                fy: 40.0,
                cx: 20.0,
                cy: 2.0,
                distortion: Default::default(),
            },
            camera_to_world: [[1., 0., 0., x], [0., 1., 0., 0.], [0., 0., 1., 0.]],
        }
    }

    fn depth_image(depth: f32) -> ExrImage {
        let channels = vec![("A".into(), vec![1.0; 160]), ("Z".into(), vec![depth; 160])];
        ExrImage { width: 40, height: 4, channels }
    }

    fn wall(shift: usize) -> Image {
        let level = |i: usize| ((i % 40 + shift) as f32 * 0.7).sin() * 0.4 + 0.5;
        Image::new(40, 4, 3, (0..160).flat_map(|i| [level(i); 3]).collect())
    }

    fn warp_walls(depth: f32) -> (WarpScore, Rgba8) {
        warp_masked_walls(depth, [None, None])
    }

    fn warp_masked_walls(depth: f32, [mask, other_mask]: [Option<Mask>; 2]) -> (WarpScore, Rgba8) {
        let (a, b, depth) = (camera("a", 0.0), camera("b", 0.1), depth_image(depth));
        let view = TrueView { camera: &a, depth: &depth, truth: &wall(0), mask };
        let neighbour = TrueView { camera: &b, depth: &depth, truth: &wall(2), mask: other_mask };
        warp(&view, &neighbour).unwrap()
    }

    /// The neighbour's camera is 0.1 to the right, so that a wall at distance 2 is shifted by two
    /// pixels.
    #[test]
    fn right_depth_agrees_and_wrong_depth_does_not() {
        let (correct, picture) = warp_walls(2.0);
        assert!(correct.psnr > 60.0 && (correct.seen - 0.95).abs() < 0.03, "{correct:?}");
        // The view's left border is outside the neighbour's image.
        assert_eq!(picture.data[..3], [120, 20, 30]);
        let (wrong, _) = warp_walls(3.0);
        assert!(wrong.psnr < 25.0, "{wrong:?}");
    }

    /// Masked pixels of either view aren't compared: here the right half of the view, or the left
    /// half of the neighbour.
    #[test]
    fn masked_pixels_are_not_compared() {
        let half = |is_left: bool| Mask {
            width: 40,
            height: 4,
            counts: (0..160).map(|i| (i % 40 < 20) == is_left).collect(),
        };
        let (own, picture) = warp_masked_walls(2.0, [Some(half(true)), None]);
        assert!((own.seen - 0.45).abs() < 0.03, "{own:?}");
        assert_eq!(picture.data[4 * 30..][..3], [120, 20, 30]);
        let (others, _) = warp_masked_walls(2.0, [None, Some(half(false))]);
        assert!((others.seen - 0.45).abs() < 0.06, "{others:?}");
    }

    /// Views 10° apart are compared, views 30° apart are not: their surfaces look different.
    #[test]
    fn far_apart_views_are_not_compared() {
        for (angle, is_compared) in [(10.0_f64, true), (30.0, false)] {
            let baseline = 2.0 * 2.0 * (angle / 2.0).to_radians().tan();
            let (a, b) = (camera("a", 0.0), camera("b", baseline));
            let image = depth_image(2.0);
            let map = DepthMap::of(&image).unwrap();
            assert_eq!(are_near(&a, &b, map), is_compared, "{angle}");
        }
    }

    #[test]
    fn the_neighbour_is_the_nearest_other_view() {
        let views: Vec<View> = [("a", 0.0), ("b", 1.0), ("c", 1.2)]
            .map(|(n, x)| View::camera_only(camera(n, x)))
            .into();
        assert_eq!(neighbour(&views[0].camera, &views).unwrap().camera.name, "b");
        assert_eq!(neighbour(&views[1].camera, &views).unwrap().camera.name, "c");
        assert!(neighbour(&views[0].camera, &views[..1]).is_none());
    }
}
