use scene::Distortion;

use super::*;
use crate::frame::Frame;
use crate::photograph::tests::write_png;

const CAMERAS: &str = "# Camera list\n1 SIMPLE_RADIAL 80 60 70 40 30 -0.1\n2 OPENCV 80 60 70 \
    71 41 29 0.1 0.01 0.001 -0.002\n";
const IMAGES: &str = "# Image list\n7 1 0 0 0 0 0 3 1 b 1.png\n10 10 5 20 20 6 30 30 -1\n3 0 \
    0 0 2 1 2 3 2 a.png\n\n";
const POINTS: &str = "5 0 0 1 255 0 0 0.1 7 0\n6 0 0 2 255 0 0 0.1 7 1\n";

/// Returns the content of `CAMERAS`, `IMAGES` and `POINTS` as binary files.
fn binary_model() -> [Vec<u8>; 3] {
    let mut cameras = 2u64.to_le_bytes().to_vec();
    for (id, model, parameters) in [
        (1u32, 2u32, &[70., 40., 30., -0.1][..]),
        (2, 4, &[70., 71., 41., 29., 0.1, 0.01, 0.001, -0.002]),
    ] {
        cameras.extend([id.to_le_bytes(), model.to_le_bytes()].concat());
        cameras.extend([80u64.to_le_bytes(), 60u64.to_le_bytes()].concat());
        cameras.extend(parameters.iter().flat_map(|p: &f64| p.to_le_bytes()));
    }
    let mut images = 2u64.to_le_bytes().to_vec();
    for (id, pose, camera, name, points) in [
        (7u32, [1., 0., 0., 0., 0., 0., 3.0f64], 1u32, "b 1.png", &[5u64, 6, u64::MAX][..]),
        (3, [0., 0., 0., 2., 1., 2., 3.], 2, "a.png", &[]),
    ] {
        images.extend(id.to_le_bytes());
        images.extend(pose.iter().flat_map(|p| p.to_le_bytes()));
        images.extend(camera.to_le_bytes());
        images.extend(name.as_bytes());
        images.push(0);
        images.extend((points.len() as u64).to_le_bytes());
        for (i, point) in points.iter().enumerate() {
            images.extend([10.0 * (i + 1) as f64; 2].iter().flat_map(|p| p.to_le_bytes()));
            images.extend(point.to_le_bytes());
        }
    }
    let mut points = 2u64.to_le_bytes().to_vec();
    for (id, z) in [(5u64, 1.0f64), (6, 2.0)] {
        points.extend(id.to_le_bytes());
        points.extend([0.0, 0.0, z].iter().flat_map(|p| p.to_le_bytes()));
        points.extend([255, 0, 0]);
        points.extend(0.1f64.to_le_bytes());
        points.extend(1u64.to_le_bytes());
        points.extend([7u32.to_le_bytes(), 0u32.to_le_bytes()].concat());
    }
    [cameras, images, points]
}

/// Creates a data set of two images and a model of the given files.
fn folder(model: &str, files: &[(&str, &[u8])]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    add_model(&dir, model, files);
    std::fs::create_dir(dir.path().join("images")).unwrap();
    for name in ["a.png", "b 1.png"] {
        write_png(&dir.path().join("images").join(name), 40, 30);
    }
    dir
}

fn add_model(dir: &tempfile::TempDir, model: &str, files: &[(&str, &[u8])]) {
    let sparse = dir.path().join(model);
    std::fs::create_dir_all(&sparse).unwrap();
    files.iter().for_each(|(name, bytes)| std::fs::write(sparse.join(name), bytes).unwrap());
}

fn text_files<'a>(
    cameras: &'a str,
    images: &'a str,
    points: &'a str,
) -> [(&'static str, &'a [u8]); 3] {
    [
        ("cameras.txt", cameras.as_bytes()),
        ("images.txt", images.as_bytes()),
        ("points3D.txt", points.as_bytes()),
    ]
}

fn frames_without_folders(set: &Dataset) -> Vec<Frame> {
    set.frames
        .iter()
        .map(|f| Frame { image: f.image.file_name().unwrap().into(), ..f.clone() })
        .collect()
}

#[test]
fn binary_and_text_models_are_equal() {
    let [cameras, images, points] = binary_model();
    let binary = folder(
        "sparse/0",
        &[("cameras.bin", &cameras), ("images.bin", &images), ("points3D.bin", &points)],
    );
    let text = folder("sparse/0", &text_files(CAMERAS, IMAGES, POINTS));
    let [from_binary, from_text] = [&binary, &text].map(|dir| Dataset::read(dir.path()).unwrap());
    assert_eq!(from_binary.notes, from_text.notes);
    assert!(
        from_binary.notes.contains(&"2 photographs have lens distortion".to_owned()),
        "{:?}",
        from_binary.notes
    );
    assert_eq!(frames_without_folders(&from_binary), frames_without_folders(&from_text));
    let [a, b] = &from_binary.frames[..] else { panic!("two frames") };
    assert_eq!((a.name.as_str(), b.name.as_str()), ("a", "b 1"));
    // The files have half the model's image size. Image 7's camera looks along +z, so that
    // (0, 0, 1) has depth 1 + 3; image 3's camera is rotated by 180° about z.
    assert_eq!(
        b.lens_intrinsics,
        Intrinsics {
            width: 40,
            height: 30,
            fx: 35.0,
            fy: 35.0,
            cx: 20.0,
            cy: 15.0,
            distortion: Distortion::brown([-0.1, 0.0, 0.0], [0.0; 2])
        }
    );
    assert_eq!(b.depth_range, Some([4.0, 5.0]));
    assert_eq!(b.camera_to_world, [[1., 0., 0., 0.], [0., -1., 0., 0.], [0., 0., -1., -3.]]);
    assert_eq!(a.lens_intrinsics.distortion, Distortion::brown([0.1, 0.01, 0.0], [0.001, -0.002]));
    assert_eq!(a.depth_range, None);
    assert!(
        (a.camera_to_world[0][3] - 1.0).abs() < 1e-12
            && (a.camera_to_world[2][3] + 3.0).abs() < 1e-12
    );
}

fn read_frames(dir: &Path) -> Vec<(String, Intrinsics, scene::Pose, Option<[f64; 2]>)> {
    let frames = Dataset::read(dir).unwrap().frames;
    frames
        .into_iter()
        .map(|f| (f.name, f.lens_intrinsics, f.camera_to_world, f.depth_range))
        .collect()
}

/// Editors on Windows write a byte order mark and CRLF line ends.
#[test]
fn text_may_have_a_byte_order_mark_and_crlf() {
    let changed =
        [CAMERAS, IMAGES, POINTS].map(|text| format!("\u{feff}{}", text.replace('\n', "\r\n")));
    let (unix, windows) = (
        folder("sparse/0", &text_files(CAMERAS, IMAGES, POINTS)),
        folder("sparse/0", &text_files(&changed[0], &changed[1], &changed[2])),
    );
    assert_eq!(read_frames(unix.path()), read_frames(windows.path()));
    let latin = folder(
        "sparse/0",
        &[("cameras.txt", CAMERAS.as_bytes()), ("images.txt", b"1 1 0 0 0 0 0 3 1 \xe4.png\n\n")],
    );
    let message = Dataset::read(latin.path()).unwrap_err().to_string();
    assert!(message.contains(r"images.txt: line 1: \xe4.png is not UTF-8"), "{message}");
}

/// Points that are too far or not finite don't affect depths; a note counts them.
#[test]
fn outlying_points_are_left_out() {
    let plain = folder("sparse/0", &text_files(CAMERAS, IMAGES, POINTS));
    for position in ["0 0 1e300", "0 0 1e6", "-1e6 0 1e6", "0 0 inf", "nan 0 1"] {
        let points = format!("{POINTS}8 {position} 255 0 0 0.1 7 0\n");
        let images = IMAGES.replace("30 30 -1", "30 30 8");
        let outlying = folder("sparse/0", &text_files(CAMERAS, &images, &points));
        assert_eq!(read_frames(outlying.path()), read_frames(plain.path()), "{position}");
        let notes = Dataset::read(outlying.path()).unwrap().notes;
        assert!(notes[1].starts_with("1 of 3 points removed: too far"), "{notes:?}");
    }
    let notes = Dataset::read(plain.path()).unwrap().notes;
    assert!(!notes.iter().any(|note| note.contains("removed")), "{notes:?}");
}

/// Dangling links are errors, even where a file is optional.
#[test]
fn dangling_links_are_named() {
    let files = text_files(CAMERAS, IMAGES, POINTS);
    for link in ["sparse", "images", "sparse/0/images.bin", "sparse/0/points3D.txt", "images/a.png"]
    {
        let dir = folder("sparse/0", &files);
        let path = dir.path().join(link);
        if path.is_dir() {
            std::fs::remove_dir_all(&path).unwrap();
        } else if path.is_file() {
            std::fs::remove_file(&path).unwrap();
        }
        std::os::unix::fs::symlink("gone", &path).unwrap();
        let message = Dataset::read(dir.path()).unwrap_err().to_string();
        let expected =
            format!("{} is a symbolic link to gone, which does not exist", path.display());
        assert!(message.contains(&expected), "{message}");
    }
}

#[test]
fn the_largest_model_is_read_and_reported() {
    let small = "1 1 0 0 0 0 0 3 1 a.png\n\n";
    let dir = folder("sparse/0", &text_files(CAMERAS, small, ""));
    add_model(&dir, "sparse/1", &text_files(CAMERAS, IMAGES, POINTS));
    let set = Dataset::read(dir.path()).unwrap();
    assert_eq!(set.frames.len(), 2);
    assert!(set.notes[0].contains("sparse/1"), "{:?}", set.notes);
    assert!(set.notes[1].contains("sparse/0 has 1, sparse/1 has 2"), "{:?}", set.notes);
}

fn read_texts(cameras: &str, images: &str) -> Result<Dataset, crate::DatasetError> {
    Dataset::read(folder("sparse/0", &text_files(cameras, images, POINTS)).path())
}

#[test]
fn mistakes_are_named() {
    for (from, to, expected) in [
        ("SIMPLE_RADIAL", "FOV", "line 2: FOV has 5 parameters"),
        (
            "SIMPLE_RADIAL 80 60 70 40 30 -0.1",
            "FOV 80 60 70 70 40 30 -0.1",
            "camera model FOV is not supported; undistort with colmap image_undistorter",
        ),
        ("SIMPLE_RADIAL", "ROUND", "camera model \"ROUND\" is unknown"),
        ("1 SIMPLE_RADIAL", "9 SIMPLE_RADIAL", "frame 1 (b 1.png): camera 1 not found"),
        ("80 60 70 40", "0 60 70 40", "image size 0×60 is invalid"),
        ("80 60 70 40", "80 80 70 40", "aspect ratios must match"),
        ("70 40 30 -0.1", "nan 40 30 -0.1", "fx is NaN"),
        ("30 -0.1", "30 inf", "lens distortion (k1 inf)"),
        ("70 40 30", "70 x 30", "line 2: parameter: \"x\""),
    ] {
        let message = read_texts(&CAMERAS.replace(from, to), IMAGES).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
    for (from, to, expected) in [
        ("7 1 0 0 0", "7 0 0 0 0", "line 2: (0, 0, 0, 0) is not a rotation quaternion"),
        ("a.png", "../a.png", "not a path inside"),
        (" 1 b 1.png", "", "line 2: camera id is missing"),
        (" b 1.png", "", "line 2: an image's name is missing"),
    ] {
        let message = read_texts(CAMERAS, &IMAGES.replace(from, to)).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
    let gone = read_texts(CAMERAS, &IMAGES.replace("a.png", "gone.png")).unwrap();
    assert!(
        gone.frames.len() == 1 && gone.notes[1].contains("1 of 2 images have no image file"),
        "{:?}",
        gone.notes
    );
    let forged = read_texts(CAMERAS, &IMAGES.replace("a.png", "\u{1b}[31m.png")).unwrap();
    assert!(forged.notes[1].ends_with(r"(first: \u{1b}[31m.png)"), "{:?}", forged.notes);
    let none = read_texts(CAMERAS, &IMAGES.replace(".png", ".jpg")).unwrap_err().to_string();
    assert!(none.contains("2 images listed, none found in "), "{none}");
    assert!(
        read_texts(CAMERAS, "# nothing\n")
            .unwrap_err()
            .to_string()
            .contains("the model has no images")
    );
}

fn with_model_number(number: u8) -> [Vec<u8>; 3] {
    let mut files = binary_model();
    files[0][12] = number;
    files
}

#[test]
fn unknown_model_numbers_are_named() {
    for number in [11, 12, 13, 16, 17, 200] {
        let message = read_binaries(&with_model_number(number)).unwrap_err().to_string();
        let expected = format!(
            "camera 1 has unknown model {number} (from a newer COLMAP?); \
            undistort with colmap image_undistorter"
        );
        assert!(message.ends_with(&expected), "{message}");
    }
    // SIMPLE_RADIAL_FISHEYE has as many parameters as SIMPLE_RADIAL.
    let set = read_binaries(&with_model_number(8)).unwrap();
    assert_eq!(
        set.frames[1].lens_intrinsics.distortion,
        Distortion::fisheye([-0.1, 0.0, 0.0, 0.0])
    );
    assert!(
        set.notes.contains(&"1 photograph was taken with a fisheye lens".to_owned()),
        "{:?}",
        set.notes
    );
}

fn read_binaries(files: &[Vec<u8>; 3]) -> Result<Dataset, crate::DatasetError> {
    let named = [
        ("cameras.bin", &files[0][..]),
        ("images.bin", &files[1][..]),
        ("points3D.bin", &files[2][..]),
    ];
    Dataset::read(folder("sparse/0", &named).path())
}

#[test]
fn truncated_binaries_are_errors_and_corrupted_ones_never_panic() {
    let intact = binary_model();
    assert!(read_binaries(&intact).is_ok());
    for file in 0..3 {
        for end in 0..intact[file].len() {
            let mut cut = intact.clone();
            cut[file].truncate(end);
            assert!(read_binaries(&cut).is_err(), "{file} {end}");
        }
        for position in 0..intact[file].len() {
            let mut corrupted = intact.clone();
            corrupted[file][position] ^= 0xff;
            // Many corrupted files are valid models; none may cause a panic or a huge allocation.
            drop(read_binaries(&corrupted));
        }
        let mut longer = intact.clone();
        longer[file].push(0);
        assert!(
            read_binaries(&longer)
                .unwrap_err()
                .to_string()
                .contains("unexpected data after the last")
        );
    }
    let mut huge = intact.clone();
    huge[1][..8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert!(read_binaries(&huge).unwrap_err().to_string().contains("don't fit into the"));
}
