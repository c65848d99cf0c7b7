use artifact::{FailureExt as _, GivenInput};
use pixels::{DEPTH_CHANNELS, DepthMap, ExrImage, Image, Rgba8, psnr_of, read_exr, to_u8};
use scene::{Camera, Surface, View};

use crate::scored_view::{ScoredView, read_image};

/// A view's true image against its neighbour's, brought over by the rendered depths: depth is right
/// where colours agree.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WarpScore {
    /// Peak signal-to-noise ratio in dB over the pixels that the neighbour sees, too.
    pub psnr: f64,
    /// Their share.
    pub seen: f64,
}

/// The view whose centre is nearest to a view's, itself left out.
pub(crate) fn neighbour<'a>(of: &Camera, views: &'a [View]) -> Option<&'a View> {
    let away = |v: &&View| (v.camera.centre() - of.centre()).length_squared();
    views.iter().filter(|v| v.camera.name != of.name).min_by(|a, b| away(a).total_cmp(&away(b)))
}

/// A rendered view's depth and opacity.
pub(crate) fn read_surface(input: &GivenInput, view: &View) -> anyhow::Result<Option<ExrImage>> {
    let Some(depth) = &view.depth else { return Ok(None) };
    let path = input.path(depth);
    let image = read_exr(&path)
        .and_then(|image| image.with_finite(&DEPTH_CHANNELS, &path))
        .bad_input(format!("view {}", view.camera.name))?;
    let k = &view.camera.intrinsics;
    let whole = (image.width, image.height) == (k.width as usize, k.height as usize);
    Ok((whole && DepthMap::of(&image).is_some()).then_some(image))
}

/// Brings the neighbour's image over to a view and compares. The image shows what was brought over;
/// what the neighbour doesn't see is red. Images have the sizes of the views. `None` where it sees
/// nothing.
pub(crate) fn warp(
    view: (&Camera, &ExrImage, &Image),
    other: (&Camera, &ExrImage, &Image),
) -> Option<(WarpScore, Rgba8)> {
    const UNSEEN: [u8; 4] = [120, 20, 30, 255];
    let from = Surface { camera: view.0, map: DepthMap::of(view.1)? };
    let places = from.positions_in(&Surface { camera: other.0, map: DepthMap::of(other.1)? });
    let (mut sum, mut seen) = (0.0, 0usize);
    let mut data = Vec::with_capacity(4 * places.len());
    for (place, truth) in places.iter().zip(view.2.data.chunks_exact(3)) {
        let Some(place) = place else {
            data.extend(UNSEEN);
            continue;
        };
        let colour = other.2.colour_at(*place);
        sum += colour.iter().zip(truth).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
        seen += 1;
        data.extend(colour.map(to_u8).into_iter().chain([255]));
    }
    let share = seen as f64 / places.len().max(1) as f64;
    let psnr = psnr_of(sum / (3 * seen) as f64);
    (seen > 0)
        .then(|| (WarpScore { psnr, seen: share }, Rgba8::new(view.2.width, view.2.height, data)))
}

/// The true image of a view's nearest neighbour, seen from the view by the rendered depths.
pub(super) fn warped(view: &ScoredView<'_>) -> anyhow::Result<Option<(WarpScore, Rgba8)>> {
    let (scene, own_camera) = (view.scene, &view.view.camera);
    let Some(expected) = &view.expected else { return Ok(None) };
    let Some(other) = neighbour(own_camera, &scene.views.views) else { return Ok(None) };
    let other_truth = scene.truth.views.iter().find(|v| v.camera.name == other.camera.name);
    let Some((other_view, file)) = other_truth.and_then(|v| Some((v, v.image.as_ref()?))) else {
        return Ok(None);
    };
    let own = read_surface(scene.views_in, view.view)?;
    let (Some(own), Some(theirs)) = (own, read_surface(scene.views_in, other)?) else {
        return Ok(None);
    };
    let image = read_image(scene.truth_in, scene.truth, other_view, file)?;
    if (image.width, image.height) != (theirs.width, theirs.height) {
        return Ok(None);
    }
    Ok(warp((own_camera, &own, expected), (&other.camera, &theirs, &image)))
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

    fn image(depth: f32) -> ExrImage {
        let channels = vec![("A".into(), vec![1.0; 160]), ("Z".into(), vec![depth; 160])];
        ExrImage { width: 40, height: 4, channels }
    }

    fn wall(shift: usize) -> Image {
        let level = |i: usize| ((i % 40 + shift) as f32 * 0.7).sin() * 0.4 + 0.5;
        Image::new(40, 4, 3, (0..160).flat_map(|i| [level(i); 3]).collect())
    }

    fn walls_warped(depth: f32) -> (WarpScore, Rgba8) {
        let (a, b) = (camera("a", 0.0), camera("b", 0.1));
        warp((&a, &image(depth), &wall(0)), (&b, &image(depth), &wall(2))).unwrap()
    }

    /// A step of a tenth to the side before a wall at distance 2 moves its image by two pixels.
    #[test]
    fn right_depth_agrees_and_wrong_depth_does_not() {
        let (right, shown) = walls_warped(2.0);
        assert!(right.psnr > 60.0 && (right.seen - 0.95).abs() < 0.03, "{right:?}");
        // What lies left of the neighbour's shown isn't seen.
        assert_eq!(shown.data[..3], [120, 20, 30]);
        let (wrong, _) = walls_warped(3.0);
        assert!(wrong.psnr < 25.0, "{wrong:?}");
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
