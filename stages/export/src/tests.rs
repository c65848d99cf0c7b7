//! Tests of all outputs on a ball, whose surface is known exactly.

use dataset::Dataset;
use glam::{DMat3, DVec3};
use radiance::{Pixel, Ray, RayField, RenderError};
use scene::{Background, Bounds, Camera, Distortion, Frustum, Intrinsics, Space};
use stage::Progress;

use crate::cameras::CameraFormat;
use crate::coordinates::Coordinates;
use crate::lattice::Lattice;
use crate::mesh::Mesh;
use crate::surface_view::SurfaceView;
use crate::surfel::Surfel;
use crate::{cameras, fusion, glb, ply, surface_nets, surfel};

/// Ball around the origin: red where x > 0, otherwise blue.
struct Ball;

const RADIUS: f64 = 0.7;

impl RayField for Ball {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        Ok(rays.iter().map(ball_pixel).collect())
    }
}

fn ball_pixel(ray: &Ray) -> Pixel {
    let [origin, direction] = [ray.origin, ray.direction].map(DVec3::from);
    let along = -origin.dot(direction);
    let discriminant = RADIUS * RADIUS - (origin + along * direction).length_squared();
    if discriminant < 0.0 {
        return Pixel { colour: ray.background, depth: 9.0, median_depth: 9.0, ..Pixel::default() };
    }
    let distance = along - discriminant.sqrt();
    let is_red = origin.x + distance * direction.x > 0.0;
    let colour = if is_red { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] };
    let depth = distance as f32;
    Pixel { colour, premultiplied: colour, opacity: 1.0, depth, median_depth: depth }
}

const BOX: Bounds = Bounds::cube(1.0, 1.0, 9.0);

fn camera_around(i: u32, count: u32, lowest: f64) -> Camera {
    let fraction = (f64::from(i) + 0.5) / f64::from(count);
    let (height, angle) = (lowest + (0.98 - lowest) * fraction, 2.4 * f64::from(i));
    let horizontal = (1.0 - height * height).sqrt();
    let back = DVec3::new(horizontal * angle.cos(), horizontal * angle.sin(), height);
    let right = DVec3::Z.cross(back).normalize();
    let up = back.cross(right);
    Camera {
        name: format!("v {i}"),
        intrinsics: Intrinsics::from_angle_x(96, 80, 0.6),
        camera_to_world: [0, 1, 2].map(|k| [right[k], up[k], back[k], 3.0 * back[k]]),
    }
}

/// Returns cameras around the origin at distance 3; `lowest` is the minimum z of their directions.
fn cameras_around(count: u32, lowest: f64) -> Vec<Camera> {
    (0..count).map(|i| camera_around(i, count, lowest)).collect()
}

fn views(cameras: &[Camera]) -> Vec<SurfaceView> {
    let (background, silent) = (Background::White, Progress::silent());
    let view =
        |c: &Camera| SurfaceView::render(&Ball, c, background, DVec3::ZERO, &silent).unwrap();
    cameras.iter().map(view).collect()
}

fn fused(views: &[SurfaceView], cells: u32) -> Mesh {
    let lattice = Lattice::new(&BOX, cells);
    let values = fusion::fuse(views, &lattice, &Progress::silent());
    let mut mesh = surface_nets::extract(&lattice, &values, &Progress::silent());
    mesh.remove_small_components();
    mesh.compute_normals();
    mesh
}

/// Returns the signed volume between a triangle and the origin.
fn tetrahedron_volume(mesh: &Mesh, t: &[u32; 3]) -> f64 {
    let [a, b, c] = t.map(|v| mesh.positions[v as usize].as_dvec3());
    a.dot(b.cross(c)) / 6.0
}

/// Returns the enclosed volume, positive if triangles are counter-clockwise seen from outside.
fn volume(mesh: &Mesh) -> f64 {
    mesh.triangles.iter().map(|t| tetrahedron_volume(mesh, t)).sum()
}

const BALL_VOLUME: f64 = 4.0 / 3.0 * std::f64::consts::PI * RADIUS * RADIUS * RADIUS;

fn ball_distance(lattice: &Lattice, i: usize) -> f32 {
    let [nx, ny, _] = lattice.counts;
    let point = [i % nx, i / nx % ny, i / (nx * ny)].map(|n| n as f64);
    (lattice.to_world(point).length() - RADIUS) as f32
}

#[test]
fn surface_nets_close_a_ball_in_a_box_and_in_a_frustum() {
    let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]];
    let (near, far) = (2.5, 9.0);
    let frustum = Frustum { camera_to_world: pose, min: [-0.4; 2], max: [0.4; 2], near, far };
    for space in [Space::Box, Space::Ndc(frustum)] {
        let lattice = Lattice::new(&Bounds { space, ..BOX }, 48);
        let values: Vec<f32> = (0..lattice.len()).map(|i| ball_distance(&lattice, i)).collect();
        let mut mesh = surface_nets::extract(&lattice, &values, &Progress::silent());
        mesh.compute_normals();
        assert_eq!(mesh.boundary_edges().len(), 0, "{space:?}");
        assert!((volume(&mesh) / BALL_VOLUME - 1.0).abs() < 0.02, "{space:?}: {}", volume(&mesh));
        for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
            assert!((f64::from(p.length()) - RADIUS).abs() < 4e-3, "{space:?}: {p}");
            assert!(p.normalize().dot(*n) > 0.9, "{space:?}: {p} {n}");
        }
    }
}

#[test]
fn lattice_points_round_trip() {
    let pose = [[0.0, 0.0, 1.0, 0.5], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 4.0]];
    let (near, far) = (0.5, 90.0);
    let frustum = Frustum { camera_to_world: pose, min: [-0.9, -0.6], max: [0.8, 0.7], near, far };
    for space in [Space::Box, Space::Ndc(frustum), Space::Contraction] {
        let lattice = Lattice::new(&Bounds { space, ..BOX }, 20);
        let point = [3.0, 1.5, 2.25];
        let back = lattice.to_lattice(lattice.to_world(point));
        assert!((DVec3::from(back) - DVec3::from(point)).length() < 1e-9, "{space:?}: {back:?}");
    }
}

#[test]
fn fused_depth_reproduces_the_ball() {
    let mesh = fused(&views(&cameras_around(24, -0.95)), 64);
    assert_eq!(mesh.boundary_edges().len(), 0);
    assert!((volume(&mesh) / BALL_VOLUME - 1.0).abs() < 0.02, "{}", volume(&mesh));
    let errors = mesh.positions.iter().map(|p| (f64::from(p.length()) - RADIUS).abs());
    let mean = errors.sum::<f64>() / mesh.positions.len() as f64;
    // Pixels are 0.015 wide at the ball.
    assert!(mean < 6e-3, "{mean}");
}

/// All cameras are above the ball: no surface is created below, where no camera looks.
#[test]
fn the_unseen_side_stays_open() {
    let mesh = fused(&views(&cameras_around(24, 0.05)), 64);
    assert!(mesh.boundary_edges().len() > 50, "{}", mesh.boundary_edges().len());
    for p in &mesh.positions {
        assert!((f64::from(p.length()) - RADIUS).abs() < 0.08, "{p}");
    }
}

/// Returns whether a camera observes a point of the ball. At distance 3, the cosine between the
/// directions of such a point and the camera is above RADIUS / 3.
fn is_seen(cameras: &[Camera], p: &glam::Vec3) -> bool {
    let outwards = p.as_dvec3().normalize();
    cameras.iter().any(|c| outwards.dot(c.centre().normalize()) > RADIUS / 3.0)
}

/// Fused surfaces extend a little beyond the observed points. The unobserved part is removed, with
/// only a few rows of triangles before that part.
#[test]
fn unobserved_surface_is_removed() {
    let (cameras, lattice) = (cameras_around(24, 0.3), Lattice::new(&BOX, 64));
    let views = views(&cameras);
    let original = fused(&views, 64);
    let mut mesh = original.clone();
    fusion::remove_unseen(&views, &lattice, &mut mesh);
    mesh.remove_small_components();
    assert!(
        !original.positions.iter().all(|p| is_seen(&cameras, p))
            && mesh.positions.iter().all(|p| is_seen(&cameras, p))
    );
    let ratio = mesh.triangles.len() as f64 / original.triangles.len() as f64;
    assert!((0.7..1.0).contains(&ratio), "{ratio}");
}

#[test]
fn surfels_lie_on_the_ball_and_face_outwards() {
    let views = views(&cameras_around(24, -0.95));
    let all = surfel::merge(&views, &BOX, 1_000_000);
    let few = surfel::merge(&views, &BOX, 2_000);
    assert!(all.len() > 10_000 && (1_500..=2_000).contains(&few.len()), "{}", few.len());
    for surfel in all.iter().chain(&few) {
        let Surfel { position, normal, colour, opacity, spacing, .. } = *surfel;
        assert!((position.length() - RADIUS).abs() < 0.02, "{position}");
        assert!(normal.dot(position.normalize()) > 0.9 && opacity == 1.0 && spacing > 0.0);
        if position.x.abs() > 0.1 {
            assert_eq!(colour, if position.x > 0.0 { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] });
        }
    }
}

fn mesh_and_surfels(threads: usize) -> (Mesh, Vec<Surfel>) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let views = views(&cameras_around(9, -0.5));
        (fused(&views, 40), surfel::merge(&views, &BOX, 5_000))
    })
}

#[test]
fn any_number_of_threads_gives_equal_results() {
    assert!(mesh_and_surfels(1) == mesh_and_surfels(3));
}

#[test]
fn components_of_a_few_triangles_are_removed() {
    let mut mesh = fused(&views(&cameras_around(24, -0.95)), 64);
    let original = mesh.clone();
    let first = mesh.positions.len() as u32;
    mesh.positions.extend([glam::Vec3::X, glam::Vec3::Y, glam::Vec3::Z]);
    mesh.triangles.insert(0, [first, first + 1, first + 2]);
    mesh.remove_small_components();
    assert!(mesh.positions == original.positions && mesh.triangles == original.triangles);
}

fn one_surfel() -> Surfel {
    Surfel {
        position: DVec3::new(1.0, 2.0, 3.0),
        normal: DVec3::new(0.0, -1.0, 0.0),
        margin: 4,
        colour: [1.0, 0.5, 0.0],
        opacity: 0.75,
        spacing: 0.1,
    }
}

/// Splits a PLY file into its header and its binary data.
fn split_ply(bytes: &[u8]) -> (String, Vec<u8>) {
    let last_line = b"end_header\n";
    let length =
        bytes.windows(last_line.len()).position(|w| w == last_line).unwrap() + last_line.len();
    (String::from_utf8(bytes[..length].to_vec()).unwrap(), bytes[length..].to_vec())
}

#[test]
fn points_have_normals_and_colours() {
    let mut bytes = Vec::new();
    ply::write_points(&mut bytes, &[one_surfel()], &Coordinates::default()).unwrap();
    let (header, data) = split_ply(&bytes);
    assert!(header.contains("\nelement vertex 1\nproperty float x\n"), "{header}");
    assert!(
        header.ends_with(
            "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
        )
    );
    let floats: Vec<u8> =
        [1.0f32, 2.0, 3.0, 0.0, -1.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    assert_eq!(data, [&floats[..], &[255, 128, 0]].concat());
}

#[test]
fn points_at_silhouettes_are_left_out_if_others_exist() {
    let with = |margin| Surfel { margin, ..one_surfel() };
    let all = [with(1), with(2), with(3), with(4)];
    assert_eq!(ply::select_points(&all), all[2..]);
    assert_eq!(ply::select_points(&all[..2]), all[..2]);
}

#[test]
fn splats_are_discs_across_their_normal() {
    let mut bytes = Vec::new();
    ply::write_splats(&mut bytes, &[one_surfel()], &Coordinates::default()).unwrap();
    let (header, data) = split_ply(&bytes);
    let names: Vec<&str> =
        header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let numbers: Vec<f64> =
        data.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect();
    assert_eq!(names.len(), numbers.len());
    let get = |name: &str| numbers[names.iter().position(|n| *n == name).unwrap()];
    // 0.75 times 0.6, the opacity of a splat on an opaque surface.
    assert!((1.0 / (1.0 + (-get("opacity")).exp()) - 0.45).abs() < 1e-6);
    let colour = |c: i32| 0.5 + 0.282_094_79 * get(&format!("f_dc_{c}"));
    assert!((colour(0) - 1.0).abs() < 1e-6 && (colour(2)).abs() < 1e-6);
    let rotation = glam::DQuat::from_xyzw(get("rot_1"), get("rot_2"), get("rot_3"), get("rot_0"));
    assert!((rotation * DVec3::Z).dot(DVec3::NEG_Y) > 1.0 - 1e-6);
    assert!(get("scale_0") == get("scale_1") && get("scale_2") < get("scale_0") - 1.0);
}

#[test]
fn glb_chunks_match_the_json() {
    let mesh = fused(&views(&cameras_around(9, -0.5)), 24);
    let colours = vec![[1.0, 0.5, 0.0]; mesh.positions.len()];
    let mut bytes = Vec::new();
    glb::write(&mut bytes, &mesh, &colours, &Coordinates::default()).unwrap();
    let u32_at =
        |offset: usize| u32::from_le_bytes(bytes[offset..offset + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], u32_at(4), u32_at(8)), (&b"glTF"[..], 2, bytes.len()));
    let json_length = u32_at(12);
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + json_length]).unwrap();
    assert_eq!(u32_at(20 + json_length), bytes.len() - 28 - json_length);
    assert_eq!(json["buffers"][0]["byteLength"], glb::buffer_length(&mesh));
    let views = json["bufferViews"].as_array().unwrap();
    let ends =
        views.iter().map(|v| v["byteOffset"].as_u64().unwrap() + v["byteLength"].as_u64().unwrap());
    assert_eq!(ends.max().unwrap() as usize, glb::buffer_length(&mesh));
    // Display-encoded 0.5 is 0.214 in linear light.
    let first = 28 + json_length + views[2]["byteOffset"].as_u64().unwrap() as usize;
    assert!((f32::from_bits(u32_at(first + 4) as u32) - 0.2140).abs() < 1e-3);
}

/// Ball at another position, of another size.
struct MovedBall {
    centre: DVec3,
    scale: f64,
}

impl RayField for MovedBall {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        let pixel = |ray: &Ray| {
            let origin = (DVec3::from(ray.origin) - self.centre) / self.scale;
            let pixel = ball_pixel(&Ray { origin: origin.to_array(), ..*ray });
            let scaled = |depth: f32| depth * self.scale as f32;
            Pixel { depth: scaled(pixel.depth), median_depth: scaled(pixel.median_depth), ..pixel }
        };
        Ok(rays.iter().map(pixel).collect())
    }
}

/// Positions of surfaces far from the origin, in tiny and huge units, are relative to an offset.
/// Moved back and scaled, these surfaces are the same as around the origin.
#[test]
fn surfaces_far_away_have_an_offset() {
    let expected = surfel::merge(&views(&cameras_around(9, -0.5)), &BOX, 100_000);
    for scale in [1e-12f64, 1e-5, 1.0, 1e5, 1e12] {
        let centre = scale.max(1.0) * DVec3::new(500_000.3, 4_649_776.0, 120.0);
        let bounds = Bounds {
            min: [-scale; 3],
            max: [scale; 3],
            near: scale,
            far: 9.0 * scale,
            space: Space::Box,
        };
        // So far away, the rounding of f64 exceeds the size of a tiny scene.
        let centre = if scale < 1e-6 { DVec3::ZERO } else { centre };
        let field = MovedBall { centre, scale };
        let coordinates = Coordinates::new(&bounds.moved(centre));
        let offset = coordinates.offset;
        assert_eq!(coordinates.is_moved(), centre != DVec3::ZERO);
        assert!((offset - centre).length() < 8.0 * scale, "{offset}");
        let cameras = cameras_around(9, -0.5).into_iter().map(|camera| {
            let position = camera.centre();
            camera.moved(centre + scale * position - position)
        });
        let (background, silent) = (Background::White, Progress::silent());
        let views: Vec<SurfaceView> = cameras
            .map(|c| SurfaceView::render(&field, &c, background, offset, &silent).unwrap())
            .collect();
        let found = surfel::merge(&views, &bounds.moved(centre - offset), 100_000);
        // Rounding moves some surfels to other cells.
        let ratio = found.len() as f64 / expected.len() as f64;
        assert!((ratio - 1.0).abs() < 0.05, "{ratio} at {scale}");
        for surfel in &found {
            let position = (offset - centre + surfel.position) / scale;
            assert!((position.length() - RADIUS).abs() < 4e-3, "{position} at {scale}");
            assert!(position.normalize().dot(surfel.normal) > 0.9, "{position} at {scale}");
        }
    }
}

#[test]
fn offsets_are_short_and_zero_near_the_origin() {
    let offset = |middle: [f64; 3], half: f64| {
        let bounds = Bounds { min: [-half; 3], max: [half; 3], ..BOX };
        Coordinates::new(&bounds.moved(middle.into())).offset.to_array()
    };
    assert_eq!(offset([15.9, -3.0, 0.0], 1.0), [0.0; 3]);
    assert_eq!(offset([16.3, -3.2, -0.1], 1.0), [16.0, -3.0, 0.0]);
    assert_eq!(offset([499_999.97, 4_649_776.21, 120.4], 0.02), [499_999.97, 4_649_776.21, 120.4]);
    assert_eq!(offset([1e9, 0.0, 0.0], 3e7), [1e9, 0.0, 0.0]);
    let file = Coordinates { offset: DVec3::X }.offset_file(false);
    assert_eq!(
        (file.offset, file.files),
        ([1.0, 0.0, 0.0], vec!["points.ply".into(), "splats.ply".into()])
    );
}

/// Creates a folder with images of the cameras' sizes, where `transforms.json` and COLMAP expect
/// images.
fn image_folder(cameras: &[Camera]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    for camera in cameras {
        let k = camera.intrinsics;
        let (width, height) = (k.width as usize, k.height as usize);
        let image = pixels::Rgba8::new(width, height, vec![255; width * height * 4]);
        let file = folder.path().join(format!("images/{}.png", camera.name));
        pixels::write_png(&file, &image).unwrap();
    }
    folder
}

fn assert_equal_cameras(set: &Dataset, cameras: &[Camera]) {
    assert_eq!(set.frames.len(), cameras.len());
    for camera in cameras {
        let frame = set.frames.iter().find(|f| f.name == camera.name).unwrap();
        assert_eq!(frame.lens_intrinsics, camera.intrinsics);
        let error =
            |r: usize, c: usize| (frame.camera_to_world[r][c] - camera.camera_to_world[r][c]).abs();
        assert!((0..12).all(|i| error(i / 4, i % 4) < 1e-12), "{}", camera.name);
    }
}

#[test]
fn cameras_round_trip_through_both_formats() {
    let plain = cameras_around(7, -0.9);
    let mut mixed = plain.clone();
    let distortion = Distortion::brown([0.1, -0.01, 0.0], [0.001, 0.002]);
    mixed[2].intrinsics.distortion = distortion;
    let fisheye = Distortion::fisheye([-0.02, 0.006, -0.003, 0.0005]);
    mixed[6].intrinsics.distortion = fisheye;
    mixed[4].intrinsics.cx += 3.5;
    // Rounded, like published poses.
    mixed[5].camera_to_world = plain[5].camera_to_world.map(|row| row.map(|v| f64::from(v as f32)));
    for cameras in [plain, mixed] {
        assert!(transforms_preserve(&cameras) && colmap_preserves(&cameras));
    }
}

/// A format that can't represent a lens reports this; the other format represents the lens.
#[test]
fn formats_refuse_lenses_that_they_cannot_represent() {
    let with = |lens: Distortion| {
        let mut cameras = cameras_around(3, -0.9);
        cameras[1].intrinsics.distortion = lens;
        cameras
    };
    let brown = Distortion::brown([0.1, -0.01, 0.02], [0.001, 0.002]);
    let tangential = Distortion { tangential: [0.001, 0.002], ..Distortion::fisheye([0.01; 4]) };
    for (lens, formats) in [
        (brown, [true, true]),
        (Distortion { radial: [0.1, -0.01, 0.02, 0.003], ..brown }, [true, false]),
        (Distortion { denominator: [0.1, -0.01, 0.02], ..brown }, [false, true]),
        (Distortion::fisheye([0.0; 4]), [true, true]),
        (tangential, [true, true]),
    ] {
        let cameras = with(lens);
        let found = [transforms_preserve(&cameras), colmap_preserves(&cameras)];
        assert_eq!(found, formats, "{lens}");
    }
    let cameras = with(Distortion { radial: [0.0, 0.0, 0.0, 0.01], ..Distortion::default() });
    let notes = crate::lens_notes(&cameras);
    assert!(notes.len() == 1 && notes[0].contains("fourth radial term"), "{notes:?}");
}

/// Returns false if the format can't represent a lens, otherwise checks the cameras read back.
fn transforms_preserve(cameras: &[Camera]) -> bool {
    if CameraFormat::Transforms.lens_problem(cameras).is_some() {
        return false;
    }
    let folder = image_folder(cameras);
    let text = cameras::transforms_json(cameras, Some("points.ply")).to_string();
    std::fs::write(folder.path().join("transforms.json"), text).unwrap();
    assert_equal_cameras(&Dataset::read(folder.path()).unwrap(), cameras);
    true
}

/// Returns false if the format can't represent a lens, otherwise checks the cameras read back.
fn colmap_preserves(cameras: &[Camera]) -> bool {
    if CameraFormat::Colmap.lens_problem(cameras).is_some() {
        return false;
    }
    let folder = image_folder(cameras);
    let sparse = folder.path().join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    for (name, text) in cameras::colmap_files(cameras, &[one_surfel()], DVec3::ZERO) {
        std::fs::write(sparse.join(name), text).unwrap();
    }
    let set = Dataset::read(folder.path()).unwrap();
    assert!(set.notes[0].starts_with("COLMAP"), "{:?}", set.notes);
    let rounded: Vec<Camera> = cameras.iter().map(orthonormal).collect();
    assert_equal_cameras(&set, &rounded);
    true
}

/// Rounds a camera's rotation to that of a unit quaternion, which COLMAP's files contain.
fn orthonormal(camera: &Camera) -> Camera {
    let rotation = glam::DQuat::from_mat3(&camera.rotation()).normalize();
    let r = DMat3::from_quat(rotation);
    let centre = camera.centre();
    let camera_to_world = [0, 1, 2].map(|k| [r.x_axis[k], r.y_axis[k], r.z_axis[k], centre[k]]);
    Camera { camera_to_world, ..camera.clone() }
}
