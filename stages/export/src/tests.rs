//! Everything on a ball that is known exactly.

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

/// A ball around the origin: red on the side of +x, blue on the other.
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
    let under = RADIUS * RADIUS - (origin + along * direction).length_squared();
    if under < 0.0 {
        return Pixel { colour: ray.background, depth: 9.0, median_depth: 9.0, ..Pixel::default() };
    }
    let distance = along - under.sqrt();
    let is_red = origin.x + distance * direction.x > 0.0;
    let colour = if is_red { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] };
    let depth = distance as f32;
    Pixel { colour, premultiplied: colour, opacity: 1.0, depth, median_depth: depth }
}

const BOX: Bounds = Bounds::cube(1.0, 1.0, 9.0);

fn camera_around(i: u32, count: u32, lowest: f64) -> Camera {
    let share = (f64::from(i) + 0.5) / f64::from(count);
    let (height, angle) = (lowest + (0.98 - lowest) * share, 2.4 * f64::from(i));
    let level = (1.0 - height * height).sqrt();
    let back = DVec3::new(level * angle.cos(), level * angle.sin(), height);
    let right = DVec3::Z.cross(back).normalize();
    let up = back.cross(right);
    Camera {
        name: format!("v {i}"),
        intrinsics: Intrinsics::from_angle_x(96, 80, 0.6),
        camera_to_world: [0, 1, 2].map(|k| [right[k], up[k], back[k], 3.0 * back[k]]),
    }
}

/// Cameras around the origin at distance 3; `up` is the lowest height that they have.
fn around(count: u32, lowest: f64) -> Vec<Camera> {
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

/// Signed volume between a triangle and the origin.
fn tetrahedron(mesh: &Mesh, t: &[u32; 3]) -> f64 {
    let [a, b, c] = t.map(|v| mesh.positions[v as usize].as_dvec3());
    a.dot(b.cross(c)) / 6.0
}

/// The volume inside, above 0 where triangles are counter-clockwise seen from outside.
fn volume(mesh: &Mesh) -> f64 {
    mesh.triangles.iter().map(|t| tetrahedron(mesh, t)).sum()
}

const BALL_VOLUME: f64 = 4.0 / 3.0 * std::f64::consts::PI * RADIUS * RADIUS * RADIUS;

fn beyond_the_ball(lattice: &Lattice, i: usize) -> f32 {
    let [nx, ny, _] = lattice.counts;
    let place = [i % nx, i / nx % ny, i / (nx * ny)].map(|n| n as f64);
    (lattice.to_world(place).length() - RADIUS) as f32
}

#[test]
fn surface_nets_close_a_ball_in_a_box_and_in_a_frustum() {
    let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]];
    let (near, far) = (2.5, 9.0);
    let frustum = Frustum { camera_to_world: pose, min: [-0.4; 2], max: [0.4; 2], near, far };
    for space in [Space::Box, Space::Ndc(frustum)] {
        let lattice = Lattice::new(&Bounds { space, ..BOX }, 48);
        let values: Vec<f32> = (0..lattice.len()).map(|i| beyond_the_ball(&lattice, i)).collect();
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
fn places_of_a_lattice_come_back() {
    let pose = [[0.0, 0.0, 1.0, 0.5], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 4.0]];
    let (near, far) = (0.5, 90.0);
    let frustum = Frustum { camera_to_world: pose, min: [-0.9, -0.6], max: [0.8, 0.7], near, far };
    for space in [Space::Box, Space::Ndc(frustum), Space::Contraction] {
        let lattice = Lattice::new(&Bounds { space, ..BOX }, 20);
        let place = [3.0, 1.5, 2.25];
        let back = lattice.to_lattice(lattice.to_world(place));
        assert!((DVec3::from(back) - DVec3::from(place)).length() < 1e-9, "{space:?}: {back:?}");
    }
}

#[test]
fn fused_depth_is_the_ball() {
    let mesh = fused(&views(&around(24, -0.95)), 64);
    assert_eq!(mesh.boundary_edges().len(), 0);
    assert!((volume(&mesh) / BALL_VOLUME - 1.0).abs() < 0.02, "{}", volume(&mesh));
    let off = mesh.positions.iter().map(|p| (f64::from(p.length()) - RADIUS).abs());
    let mean = off.sum::<f64>() / mesh.positions.len() as f64;
    // Pixels are 0.015 wide there.
    assert!(mean < 6e-3, "{mean}");
}

/// Cameras above alone: there is no surface where none looks.
#[test]
fn the_unseen_side_stays_open() {
    let mesh = fused(&views(&around(24, 0.05)), 64);
    assert!(mesh.boundary_edges().len() > 50, "{}", mesh.boundary_edges().len());
    for p in &mesh.positions {
        assert!((f64::from(p.length()) - RADIUS).abs() < 0.08, "{p}");
    }
}

/// A camera at distance 3 sees the points whose direction has a cosine above RADIUS / 3 with its
/// own.
fn is_seen(cameras: &[Camera], p: &glam::Vec3) -> bool {
    let outwards = p.as_dvec3().normalize();
    cameras.iter().any(|c| outwards.dot(c.centre().normalize()) > RADIUS / 3.0)
}

/// Fused surfaces extend a little beyond what is seen. That part is dropped, with only a few rows
/// before it.
#[test]
fn what_no_view_shows_is_dropped() {
    let (cameras, lattice) = (around(24, 0.3), Lattice::new(&BOX, 64));
    let views = views(&cameras);
    let whole = fused(&views, 64);
    let mut mesh = whole.clone();
    fusion::remove_unseen(&views, &lattice, &mut mesh);
    mesh.remove_small_components();
    assert!(
        !whole.positions.iter().all(|p| is_seen(&cameras, p))
            && mesh.positions.iter().all(|p| is_seen(&cameras, p))
    );
    let share = mesh.triangles.len() as f64 / whole.triangles.len() as f64;
    assert!((0.7..1.0).contains(&share), "{share}");
}

#[test]
fn surfels_lie_on_the_ball_and_face_outwards() {
    let views = views(&around(24, -0.95));
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

fn made_with(threads: usize) -> (Mesh, Vec<Surfel>) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let views = views(&around(9, -0.5));
        (fused(&views, 40), surfel::merge(&views, &BOX, 5_000))
    })
}

#[test]
fn any_number_of_threads_gives_the_same() {
    assert!(made_with(1) == made_with(3));
}

#[test]
fn pieces_of_a_few_triangles_go() {
    let mut mesh = fused(&views(&around(24, -0.95)), 64);
    let whole = mesh.clone();
    let first = mesh.positions.len() as u32;
    mesh.positions.extend([glam::Vec3::X, glam::Vec3::Y, glam::Vec3::Z]);
    mesh.triangles.insert(0, [first, first + 1, first + 2]);
    mesh.remove_small_components();
    assert!(mesh.positions == whole.positions && mesh.triangles == whole.triangles);
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

/// Header and numbers of a PLY file.
fn split_ply(bytes: &[u8]) -> (String, Vec<u8>) {
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    (String::from_utf8(bytes[..at].to_vec()).unwrap(), bytes[at..].to_vec())
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
fn points_keep_away_from_silhouettes_where_there_are_others() {
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
    let of = |name: &str| numbers[names.iter().position(|n| *n == name).unwrap()];
    // 0.75 of an opaque surface's 0.6.
    assert!((1.0 / (1.0 + (-of("opacity")).exp()) - 0.45).abs() < 1e-6);
    let colour = |c: i32| 0.5 + 0.282_094_79 * of(&format!("f_dc_{c}"));
    assert!((colour(0) - 1.0).abs() < 1e-6 && (colour(2)).abs() < 1e-6);
    let turn = glam::DQuat::from_xyzw(of("rot_1"), of("rot_2"), of("rot_3"), of("rot_0"));
    assert!((turn * DVec3::Z).dot(DVec3::NEG_Y) > 1.0 - 1e-6);
    assert!(of("scale_0") == of("scale_1") && of("scale_2") < of("scale_0") - 1.0);
}

#[test]
fn glb_chunks_hold_what_the_json_says() {
    let mesh = fused(&views(&around(9, -0.5)), 24);
    let colours = vec![[1.0, 0.5, 0.0]; mesh.positions.len()];
    let mut bytes = Vec::new();
    glb::write(&mut bytes, &mesh, &colours, &Coordinates::default()).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let text = word(12);
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + text]).unwrap();
    assert_eq!(word(20 + text), bytes.len() - 28 - text);
    assert_eq!(json["buffers"][0]["byteLength"], glb::buffer_length(&mesh));
    let views = json["bufferViews"].as_array().unwrap();
    let end =
        views.iter().map(|v| v["byteOffset"].as_u64().unwrap() + v["byteLength"].as_u64().unwrap());
    assert_eq!(end.max().unwrap() as usize, glb::buffer_length(&mesh));
    // 50 % display-encoded are 21.4 % of the light.
    let first = 28 + text + views[2]["byteOffset"].as_u64().unwrap() as usize;
    assert!((f32::from_bits(word(first + 4) as u32) - 0.2140).abs() < 1e-3);
}

/// A ball far away from the origin, of another size.
struct MovedBall {
    at: DVec3,
    scale: f64,
}

impl RayField for MovedBall {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        let pixel = |ray: &Ray| {
            let origin = (DVec3::from(ray.origin) - self.at) / self.scale;
            let pixel = ball_pixel(&Ray { origin: origin.to_array(), ..*ray });
            let scaled = |depth: f32| depth * self.scale as f32;
            Pixel { depth: scaled(pixel.depth), median_depth: scaled(pixel.median_depth), ..pixel }
        };
        Ok(rays.iter().map(pixel).collect())
    }
}

/// Surfaces far from the origin, with tiny and huge units, are counted from an offset; with it they
/// lie where they do around the origin.
#[test]
fn surfaces_far_away_have_an_offset() {
    let here = surfel::merge(&views(&around(9, -0.5)), &BOX, 100_000);
    for scale in [1e-12f64, 1e-5, 1.0, 1e5, 1e12] {
        let at = scale.max(1.0) * DVec3::new(500_000.3, 4_649_776.0, 120.0);
        let bounds = Bounds {
            min: [-scale; 3],
            max: [scale; 3],
            near: scale,
            far: 9.0 * scale,
            space: Space::Box,
        };
        // A tiny scene so far away has no digits left.
        let at = if scale < 1e-6 { DVec3::ZERO } else { at };
        let field = MovedBall { at, scale };
        let coordinates = Coordinates::new(&bounds.moved(at));
        let offset = coordinates.offset;
        assert_eq!(coordinates.is_moved(), at != DVec3::ZERO);
        assert!((offset - at).length() < 8.0 * scale, "{offset}");
        let cameras = around(9, -0.5).into_iter().map(|camera| {
            let centre = camera.centre();
            camera.moved(at + scale * centre - centre)
        });
        let (background, silent) = (Background::White, Progress::silent());
        let views: Vec<SurfaceView> = cameras
            .map(|c| SurfaceView::render(&field, &c, background, offset, &silent).unwrap())
            .collect();
        let there = surfel::merge(&views, &bounds.moved(at - offset), 100_000);
        // Cells at which roundings differ apart.
        let share = there.len() as f64 / here.len() as f64;
        assert!((share - 1.0).abs() < 0.05, "{share} at {scale}");
        for surfel in &there {
            let position = (offset - at + surfel.position) / scale;
            assert!((position.length() - RADIUS).abs() < 4e-3, "{position} at {scale}");
            assert!(position.normalize().dot(surfel.normal) > 0.9, "{position} at {scale}");
        }
    }
}

#[test]
fn offsets_are_short_and_only_where_they_are_needed() {
    let boxed = |middle: [f64; 3], half: f64| {
        let bounds = Bounds { min: [-half; 3], max: [half; 3], ..BOX };
        Coordinates::new(&bounds.moved(middle.into())).offset.to_array()
    };
    assert_eq!(boxed([15.9, -3.0, 0.0], 1.0), [0.0; 3]);
    assert_eq!(boxed([16.3, -3.2, -0.1], 1.0), [16.0, -3.0, 0.0]);
    assert_eq!(boxed([499_999.97, 4_649_776.21, 120.4], 0.02), [499_999.97, 4_649_776.21, 120.4]);
    assert_eq!(boxed([1e9, 0.0, 0.0], 3e7), [1e9, 0.0, 0.0]);
    let file = Coordinates { offset: DVec3::X }.offset_file(false);
    assert_eq!(
        (file.offset, file.files),
        ([1.0, 0.0, 0.0], vec!["points.ply".into(), "splats.ply".into()])
    );
}

/// A folder with images of the cameras' size, where `transforms.json` and COLMAP look for them.
fn folder(cameras: &[Camera]) -> tempfile::TempDir {
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

fn assert_same(set: &Dataset, cameras: &[Camera]) {
    assert_eq!(set.frames.len(), cameras.len());
    for camera in cameras {
        let frame = set.frames.iter().find(|f| f.name == camera.name).unwrap();
        assert_eq!(frame.stored_intrinsics, camera.intrinsics);
        let off =
            |r: usize, c: usize| (frame.camera_to_world[r][c] - camera.camera_to_world[r][c]).abs();
        assert!((0..12).all(|i| off(i / 4, i % 4) < 1e-12), "{}", camera.name);
    }
}

#[test]
fn cameras_come_back_from_both_files() {
    let plain = around(7, -0.9);
    let mut mixed = plain.clone();
    let distortion = Distortion::brown([0.1, -0.01, 0.0], [0.001, 0.002]);
    mixed[2].intrinsics.distortion = distortion;
    let fisheye = Distortion::fisheye([-0.02, 0.006, -0.003, 0.0005]);
    mixed[6].intrinsics.distortion = fisheye;
    mixed[4].intrinsics.cx += 3.5;
    // As published poses are: rounded.
    mixed[5].camera_to_world = plain[5].camera_to_world.map(|row| row.map(|v| f64::from(v as f32)));
    for cameras in [plain, mixed] {
        assert!(comes_back_from_transforms(&cameras) && comes_back_from_colmap(&cameras));
    }
}

/// A format that can't hold a lens says so, and the other holds it.
#[test]
fn lenses_are_in_the_formats_that_have_them() {
    let with = |lens: Distortion| {
        let mut cameras = around(3, -0.9);
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
        let found = [comes_back_from_transforms(&cameras), comes_back_from_colmap(&cameras)];
        assert_eq!(found, formats, "{lens}");
    }
    let cameras = with(Distortion { radial: [0.0, 0.0, 0.0, 0.01], ..Distortion::default() });
    let words = crate::lens_notes(&cameras);
    assert!(words.len() == 1 && words[0].contains("fourth radial term"), "{words:?}");
}

/// False where the format says that it can't hold the cameras.
fn comes_back_from_transforms(cameras: &[Camera]) -> bool {
    if CameraFormat::Transforms.lens_problem(cameras).is_some() {
        return false;
    }
    let folder = folder(cameras);
    let text = cameras::transforms_json(cameras, Some("points.ply")).to_string();
    std::fs::write(folder.path().join("transforms.json"), text).unwrap();
    assert_same(&Dataset::read(folder.path()).unwrap(), cameras);
    true
}

/// False where the format says that it can't hold the cameras.
fn comes_back_from_colmap(cameras: &[Camera]) -> bool {
    if CameraFormat::Colmap.lens_problem(cameras).is_some() {
        return false;
    }
    let folder = folder(cameras);
    let sparse = folder.path().join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    for (name, text) in cameras::colmap_files(cameras, &[one_surfel()], DVec3::ZERO) {
        std::fs::write(sparse.join(name), text).unwrap();
    }
    let set = Dataset::read(folder.path()).unwrap();
    assert!(set.notes[0].starts_with("COLMAP"), "{:?}", set.notes);
    let rounded: Vec<Camera> = cameras.iter().map(orthonormal).collect();
    assert_same(&set, &rounded);
    true
}

/// A camera's nearest rotation that a quaternion can say: what COLMAP's files hold.
fn orthonormal(camera: &Camera) -> Camera {
    let turn = glam::DQuat::from_mat3(&camera.rotation()).normalize();
    let r = DMat3::from_quat(turn);
    let at = camera.centre();
    let camera_to_world = [0, 1, 2].map(|k| [r.x_axis[k], r.y_axis[k], r.z_axis[k], at[k]]);
    Camera { camera_to_world, ..camera.clone() }
}
