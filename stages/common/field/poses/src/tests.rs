use pixels::Image;
use radiance::{Pixel, RenderError};
use scene::{Distortion, Intrinsics};

use super::*;

/// A ball before a wall, both painted.
struct BallAndWall;

impl BallAndWall {
    fn hit(origin: DVec3, direction: DVec3) -> f64 {
        let (half, c) = (origin.dot(direction), origin.length_squared() - 1.0);
        let root = half * half - c;
        if root > 0.0 { -half - root.sqrt() } else { (-2.0 - origin.z) / direction.z }
    }

    fn paint(at: DVec3) -> [f32; 3] {
        [0, 1, 2].map(|c| {
            let (f, c) = (2.0 + f64::from(c), f64::from(c));
            (0.5 + 0.2 * (f * at.x + c).sin() + 0.2 * (f * at.y - 0.5 * c + 1.3 * at.z).cos())
                as f32
        })
    }
}

fn seen_along(ray: &Ray) -> Pixel {
    let (origin, direction) = (DVec3::from(ray.origin), DVec3::from(ray.direction).normalize());
    let distance = BallAndWall::hit(origin, direction);
    let colour = BallAndWall::paint(origin + distance * direction);
    let depth = distance as f32;
    Pixel { colour, premultiplied: colour, opacity: 1.0, depth, median_depth: depth }
}

impl RayField for BallAndWall {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        Ok(rays.iter().map(seen_along).collect())
    }
}

fn camera(i: usize) -> Camera {
    let angle = 0.5 * i as f64;
    let rotation = DQuat::from_euler(
        glam::EulerRot::YXZ,
        0.12 * angle.sin(),
        0.1 * angle.cos(),
        0.05 * i as f64,
    );
    let distortion = Distortion::brown([-0.1, 0.03, 0.0], [0.002, -0.004]);
    let bare = Camera {
        name: format!("r_{i}"),
        intrinsics: Intrinsics {
            width: 64,
            height: 48,
            fx: 70.0,
            fy: 72.0,
            cx: 31.0,
            cy: 25.0,
            distortion,
        },
        camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.]],
    };
    with_pose(&bare, rotation, DVec3::new(0.5 * angle.sin(), 0.4 * angle.cos(), 4.0))
}

fn photograph(camera: &Camera) -> Image {
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    // A pixel is the mean of what it covers.
    let rays: Vec<Ray> = (0..9 * width * height)
        .map(|i| {
            let (pixel, sub) = (i / 9, i % 9);
            let at = |whole: usize, part: usize| whole as f64 + (part as f64 + 0.5) / 3.0;
            let ray = camera.ray(at(pixel % width, sub % 3), at(pixel / width, sub / 3));
            Ray::new(&ray, [1.0; 3])
        })
        .collect();
    let subs = BallAndWall.render(&rays).unwrap();
    let mean = |of: &[Pixel]| [0, 1, 2].map(|c| of.iter().map(|p| p.colour[c]).sum::<f32>() / 9.0);
    Image::new(width, height, 3, subs.chunks_exact(9).flat_map(mean).collect())
}

fn distance_at(a: &Camera, b: &Camera, (x, y): (f64, f64)) -> f64 {
    let ray = a.ray(x, y);
    let (u, v, _) = b.project(ray.at(BallAndWall::hit(ray.origin, ray.direction))).unwrap();
    (u - x).hypot(v - y)
}

/// Mean distance in pixels at which two cameras see the same places.
fn pixels_apart(a: &Camera, b: &Camera) -> f64 {
    let places: Vec<(f64, f64)> = (0..6)
        .flat_map(|x| (0..5).map(move |y| (4.0 + 11.0 * f64::from(x), 4.0 + 10.0 * f64::from(y))))
        .collect();
    places.iter().map(|&place| distance_at(a, b, place)).sum::<f64>() / places.len() as f64
}

fn motion(turn: [f64; 3], shift: [f64; 3]) -> Motion {
    Motion { rotation: turn.into(), translation: shift.into() }
}

#[test]
fn image_motion_is_that_of_a_moved_camera() {
    assert_image_motion(&camera(3));
    let mut wide = camera(3);
    let lens = Distortion::fisheye([-0.02, 0.006, -0.003, 0.0005]);
    wide.intrinsics.distortion = Distortion { tangential: [0.002, -0.004], ..lens };
    (wide.intrinsics.fx, wide.intrinsics.fy) = (30.0, 31.0);
    assert_image_motion(&wide);
}

#[track_caller]
fn assert_image_motion(camera: &Camera) {
    let (at, unit) = ([50.0, 7.0], 3.7);
    let ray = camera.ray(at[0], at[1]);
    let distance = 3.0;
    let depth = distance * camera.depth_per_distance(&ray);
    let predicted = image_motion(camera, at, depth, unit);
    let step = 1e-6;
    for i in 0..6 {
        let one = |k: usize, size: f64| [0, 1, 2].map(|j| if j + k == i { size } else { 0.0 });
        let moved = motion(one(0, step), one(3, unit * step)).applied_to(camera);
        let (u, v, _) = moved.project(ray.at(distance)).unwrap();
        for (predicted, seen) in
            [(predicted[0][i / 3][i % 3], u - at[0]), (predicted[1][i / 3][i % 3], v - at[1])]
        {
            assert!(
                (predicted - seen / step).abs() < 1e-3 * predicted.abs().max(1.0),
                "{i}: {predicted} {}",
                seen / step
            );
        }
    }
}

/// Cameras a few pixels off return to within a tenth of a pixel, coarse to fine, with a known
/// exposure, too. Silhouettes limit the accuracy: one ray there isn't the pixel's mean.
#[test]
fn moved_cameras_come_back() {
    for (i, (turn, shift)) in [
        ([0.02, -0.03, 0.01], [0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.12, -0.08, 0.1]),
        ([-0.02, 0.01, 0.04], [-0.1, 0.1, -0.15]),
        ([0.01, 0.02, -0.03], [0.15, 0.05, 0.1]),
    ]
    .into_iter()
    .enumerate()
    {
        let truth = camera(i);
        let exposure = if i == 3 { [0.8, 1.0, 1.25] } else { [1.0; 3] };
        let mut taken = photograph(&truth);
        taken.data.chunks_exact_mut(3).for_each(|p| (0..3).for_each(|c| p[c] /= exposure[c]));
        // What isn't known says nothing: a person in the corner.
        (0..20 * 64)
            .filter(|i| i % 64 < 15)
            .for_each(|i| taken.data[3 * i..3 * i + 3].fill(f32::NAN));
        let pyramid = Pyramid::new(&taken, 5);
        // Half the size; a quarter would be too small.
        assert_eq!(pyramid.smaller_levels(), 1);
        let mut found = motion(turn, shift).applied_to(&truth);
        let was = pixels_apart(&truth, &found);
        assert!(was > 1.5, "{i}: {was} pixels");
        for level in (0..2).rev() {
            let refined = refine(
                &BallAndWall,
                &found,
                &pyramid,
                level,
                &Options { max_renders: 6, exposure, ..Options::default() },
            )
            .unwrap();
            assert!(refined.after <= refined.before);
            found = refined.camera;
        }
        found.check().unwrap();
        let is = pixels_apart(&truth, &found);
        assert!(is < 0.15, "{i}: {was} pixels before, {is} after");
    }
}

/// Scene of [`BallAndWall`] at another position, in another unit.
struct Elsewhere {
    shift: DVec3,
    scale: f64,
}

impl Elsewhere {
    fn camera(&self, camera: &Camera) -> Camera {
        with_pose(camera, rotation(camera), self.scale * camera.centre() + self.shift)
    }
}

impl RayField for Elsewhere {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        let origin = |ray: &Ray| ((DVec3::from(ray.origin) - self.shift) / self.scale).to_array();
        let here: Vec<Ray> = rays.iter().map(|ray| Ray { origin: origin(ray), ..*ray }).collect();
        let mut seen = BallAndWall.render(&here)?;
        for pixel in &mut seen {
            pixel.depth *= self.scale as f32;
            pixel.median_depth *= self.scale as f32;
        }
        Ok(seen)
    }
}

/// Cameras of a georeferenced scene, and of one in another unit, are found as those at the origin.
#[test]
fn cameras_come_back_wherever_the_scene_lies() {
    let truth = camera(1);
    let pyramid = Pyramid::new(&photograph(&truth), 2);
    let off = motion([0.01, -0.02, 0.01], [0.1, -0.05, 0.1]).applied_to(&truth);
    let found_by = |field: &dyn RayField, camera: &Camera| {
        let mut found = camera.clone();
        for level in (0..2).rev() {
            let refined = refine(field, &found, &pyramid, level, &Options::default()).unwrap();
            found = refined.camera;
        }
        found
    };
    let here = found_by(&BallAndWall, &off);
    assert!(pixels_apart(&truth, &here) < 0.15);
    let utm = DVec3::new(500_000.0, 4_649_776.0, 120.0);
    for (shift, scale) in [(utm, 1.0), (utm, 0.025), (DVec3::ZERO, 1e-5), (DVec3::ZERO, 1e5)] {
        let scene = Elsewhere { shift, scale };
        let there = found_by(&scene, &scene.camera(&off));
        let back = Elsewhere { shift: -shift / scale, scale: 1.0 / scale }.camera(&there);
        assert!(pixels_apart(&back, &here) < 1e-3, "{shift} {scale}");
    }
}

/// Grey walls, masked pixels, a transparent field and numbers that aren't finite move no camera.
#[test]
fn uninformative_images_move_no_camera() {
    struct Everywhere(Pixel);
    impl RayField for Everywhere {
        fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
            Ok(vec![self.0; rays.len()])
        }
    }
    let camera = camera(1);
    let whole = photograph(&camera);
    let grey = Image { data: vec![0.5; whole.data.len()], ..whole.clone() };
    let unknown = Image { data: vec![f32::NAN; whole.data.len()], ..whole.clone() };
    let one_row = Image::new(64, 1, 3, vec![0.3; 192]);
    let nothing = Pixel { median_depth: f32::INFINITY, ..Pixel::default() };
    let wrong =
        Pixel { colour: [f32::NAN; 3], opacity: 1.0, median_depth: 3.0, ..Pixel::default() };
    for image in [&grey, &unknown, &one_row, &whole] {
        let pyramid = Pyramid::new(image, 2);
        for field in [&Everywhere(nothing) as &dyn RayField, &Everywhere(wrong)] {
            assert_eq!(
                refine(field, &camera, &pyramid, 1, &Options::default()).unwrap().camera,
                camera
            );
        }
        if !std::ptr::eq(image, &raw const whole) {
            assert_eq!(
                refine(&BallAndWall, &camera, &pyramid, 7, &Options::default()).unwrap().camera,
                camera
            );
        }
    }
}

#[test]
fn motions_are_told() {
    let camera = camera(2);
    let moved = motion([0.0, 0.01, 0.0], [0.3, 0.0, -0.4]).applied_to(&camera);
    let step = |to, depth| CameraMotion { from: &camera, to, depth };
    let told = MeanMotion::of_cameras([step(&moved, Some(4.0)), step(&camera, None)].into_iter());
    assert!((told.angle - 0.005).abs() < 1e-6 && (told.distance - 0.25).abs() < 1e-9, "{told:?}");
    // Half of a focal length of 70 pixels times 0.5 / 4.
    assert!((told.pixels - 4.375).abs() < 1e-9, "{told:?}");
    assert_eq!(
        told.to_string(),
        "turned by 0.286° and moved by 0.2500 (4.4 pixels of the photographs) on average"
    );
    for (angle, pixels, exceeds) in [(0.9f64, 2.9, false), (1.1, 0.0, true), (0.0, 3.1, true)] {
        assert_eq!(
            MeanMotion { angle: angle.to_radians(), pixels, distance: 0.0 }.exceeds_usual_error(),
            exceeds,
            "{angle}° {pixels}"
        );
    }
    assert_eq!(MeanMotion::of_cameras(std::iter::empty()).distance, 0.0);
}

fn between(list: &[Camera]) -> (DQuat, DVec3) {
    let (a, b) = (rotation(&list[2]), rotation(&list[5]));
    (a.inverse() * b, (a.inverse() * (list[5].centre() - list[2].centre())).normalize())
}

#[test]
fn common_motion_is_taken_back() {
    let were: Vec<Camera> = (0..7).map(camera).collect();
    let (turn, shift) =
        (DQuat::from_scaled_axis(DVec3::new(0.1, -0.05, 0.07)), DVec3::new(0.3, -0.2, 0.1));
    let mut cameras: Vec<Camera> = were
        .iter()
        .map(|c| with_pose(c, turn * rotation(c), 1.1 * (turn * c.centre()) + shift))
        .collect();
    remove_common_motion(&mut cameras, &were);
    for (camera, was) in cameras.iter().zip(&were) {
        assert!(pixels_apart(camera, was) < 1e-9, "{}", pixels_apart(camera, was));
    }
    // What cameras do beside that stays, relative to each other.
    let mut cameras = were.clone();
    cameras[2] = motion([0.02, 0.0, 0.01], [0.1, 0.0, 0.0]).applied_to(&cameras[2]);
    let expected = between(&cameras);
    remove_common_motion(&mut cameras, &were);
    let found = between(&cameras);
    assert!(expected.0.angle_between(found.0) < 1e-7 && (expected.1 - found.1).length() < 1e-9);
}

fn judged(
    photographs: &[Image],
    cameras: &[Camera],
    exposure: &dyn Fn(usize) -> [f32; 3],
) -> Option<f64> {
    let posed = cameras.iter().zip(photographs).enumerate();
    let posed: Vec<PosedPhotograph> = posed
        .map(|(i, (camera, image))| PosedPhotograph { camera, image, exposure: exposure(i) })
        .collect();
    photometric_error(&BallAndWall, &posed, 1.0).unwrap()
}

/// With the true surfaces the photometric error is small for the true cameras and large for moved
/// ones; known exposures make no difference.
#[test]
fn photometric_error_is_least_from_where_photographs_were_taken() {
    let cameras: Vec<Camera> = (0..6).map(camera).collect();
    let mut photographs: Vec<Image> = cameras.iter().map(photograph).collect();
    photographs[2].data.iter_mut().for_each(|v| *v *= 0.5);
    photographs[3].data[..64 * 3].fill(f32::NAN);
    let exposure = |i: usize| if i == 2 { [2.0; 3] } else { [1.0; 3] };
    let right = judged(&photographs, &cameras, &exposure).unwrap();
    assert!(right < 3e-4, "{right}");
    let off: Vec<Camera> = (0..6)
        .map(|i| {
            motion([0.01 * (i as f64).sin(), 0.01 * (i as f64).cos(), 0.0], [0.0; 3])
                .applied_to(&cameras[i])
        })
        .collect();
    let wrong = judged(&photographs, &off, &exposure).unwrap();
    assert!(wrong > 5.0 * right, "{wrong} {right}");
    assert!(judged(&photographs, &cameras, &|_| [1.0; 3]).unwrap() > 5.0 * right);
    // One alone has none to be compared with.
    assert_eq!(judged(&photographs, &cameras[..1], &exposure), None);
}
