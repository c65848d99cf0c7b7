use super::*;
use crate::jpeg::tests::{hidden_jpeg, jpeg};
use jpeg_encoder::SamplingFactor;
use scene::Distortion;

/// Returns an image whose red encodes the column and whose green encodes the row.
fn ramp(width: usize, height: usize) -> Rgba8 {
    let pixel =
        |i: usize| [(i % width * 255 / width) as u8, (i / width * 255 / height) as u8, 90, 255];
    Rgba8::new(width, height, (0..width * height).flat_map(pixel).collect())
}

pub(crate) fn write_png(path: &Path, width: usize, height: usize) {
    pixels::write_png(path, &ramp(width, height)).unwrap();
}

#[test]
fn images_are_read_by_their_content() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let image = ramp(32, 16);
    let rgb: Vec<u8> = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95)
        .encode(&rgb, 32, 16, image::ExtendedColorType::Rgb8)
        .unwrap();
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(
        read_header(&path).unwrap(),
        ImageHeader { size: (32, 16), orientation: Orientation::NoTransforms }
    );
    let read = super::read_image(&path, false).unwrap().0;
    let max_difference =
        read.data.iter().zip(&image.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
    assert!(max_difference < 12, "{max_difference}");
    for end in 0..bytes.len() {
        std::fs::write(&path, &bytes[..end]).unwrap();
        drop(super::read_image(&path, false));
    }
    // The header is checked before anything is allocated, and the message names the limit.
    let mut huge = bytes.clone();
    let frame_header = huge.windows(2).position(|marker| marker == b"\xff\xc0").unwrap();
    huge[frame_header + 5..frame_header + 9]
        .copy_from_slice(&[20_000u16.to_be_bytes(), 20_000u16.to_be_bytes()].concat());
    std::fs::write(&path, &huge).unwrap();
    let message = read_header(&path).unwrap_err().to_string();
    assert!(
        message.ends_with(
            "20000×20000 pixels exceed the limit of 268435456 (such as 16384×16384); make the \
            image smaller"
        ),
        "{message}"
    );
    // An EXIF block (APP1) that requires a quarter turn: the image is turned only if the
    // camera has the turned shape.
    let mut turned = bytes[..2].to_vec();
    turned.extend(
        b"\xff\xe1\x00\x22Exif\0\0II\x2a\0\x08\0\0\0\
        \x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0",
    );
    turned.extend(&bytes[2..]);
    std::fs::write(&path, &turned).unwrap();
    let stored = read_header(&path).unwrap();
    assert!(stored.size == (32, 16) && stored.is_sideways());
    let intrinsics = |width, height| Intrinsics::from_angle_x(width, height, 0.5);
    assert_eq!(fit_camera(intrinsics(32, 16), stored).unwrap(), (intrinsics(32, 16), Turn::Stored));
    assert_eq!(
        fit_camera(intrinsics(64, 32), stored).unwrap(),
        (intrinsics(64, 32).resized(32, 16), Turn::Stored)
    );
    assert_eq!(
        fit_camera(intrinsics(16, 32), stored).unwrap(),
        (intrinsics(16, 32), Turn::Upright)
    );
    assert!(
        fit_camera(intrinsics(32, 32), stored)
            .unwrap_err()
            .to_string()
            .contains("aspect ratios must match")
    );
    let upright = super::read_image(&path, true).unwrap().0;
    assert_eq!((upright.width, upright.height), (16, 32));
    assert!(
        upright.data[0] < 20 && upright.data[1] > 200,
        "the bottom left corner becomes the top left one"
    );
    std::fs::write(&path, "no image").unwrap();
    assert!(read_header(&path).unwrap_err().to_string().contains("a.png"));
    let other = dir.path().join("a.dat");
    std::fs::write(&other, "no image").unwrap();
    assert!(read_header(&other).unwrap_err().to_string().contains("neither PNG, JPEG nor EXR"));
}

/// A NaN is neither black nor transparent, and an infinity isn't white.
#[test]
fn pixels_that_are_not_finite_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.exr");
    let read_with = |bad: [f32; 4]| {
        exr::prelude::write_rgba_file(&path, 4, 3, |x, y| {
            let [r, g, b, a] = if (x, y) == (1, 2) { bad } else { [0.25; 4] };
            (r, g, b, a)
        })
        .unwrap();
        super::read_image(&path, false)
    };
    assert!(read_with([1e9, -1.0, 0.0, 1.0]).is_ok());
    for (index, channel) in COLOUR_CHANNELS.into_iter().enumerate() {
        for (value, name) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf")] {
            let mut bad = [0.25; 4];
            bad[index] = value;
            let message = read_with(bad).unwrap_err().to_string();
            let expected = format!("a.exr: channel {channel} is {name} at column 1, row 2;");
            assert!(message.contains(&expected), "{message}");
        }
    }
}

#[test]
fn a_jpeg_that_is_cut_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    let read = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        super::read_image(&path, false).map_err(|error| error.to_string())
    };
    let bytes = jpeg((40, 64), Some(SamplingFactor::R_4_2_0), false, 3);
    let complete = read(&bytes).unwrap();
    assert_eq!(read(&bytes[..bytes.len() - 2]), Ok(complete.clone()), "only the end marker is cut");
    assert_eq!(read(&[&bytes, &b"more"[..]].concat()), Ok(complete));
    let progressive = jpeg((40, 64), Some(SamplingFactor::R_4_2_0), true, 0);
    let second_restart = bytes.windows(2).position(|w| w == [0xff, 0xd1]).unwrap();
    for (bytes, expected) in [
        (
            &bytes[..second_restart],
            "a.jpg: cut short or damaged: 32 of 64 rows are missing; export",
        ),
        (&bytes[..bytes.len() - 9], "a.jpg: cut short or damaged: 16 of 64 rows are missing;"),
        (&bytes[..100], "a.jpg: cut short or damaged: 64 of 64 rows are missing; export"),
        (&bytes[..20], "a.jpg: damaged JPEG: headers and image data don't match; export"),
        (&progressive[..progressive.len() - 1], "detail of all 64 rows is missing; export"),
        (&hidden_jpeg(), "a.jpg: damaged JPEG: headers and image data don't match; export"),
    ] {
        let message = read(bytes).unwrap_err();
        assert!(message.contains(expected), "{message}");
    }
}

/// Returns a colour that depends smoothly on the ray's direction, so that the image through
/// each lens is known exactly.
fn colour_towards([u, v]: [f64; 2]) -> [u8; 4] {
    [(128.0 + 90.0 * (6.0 * u).sin()) as u8, (128.0 + 90.0 * (5.0 * v).cos()) as u8, 60, 255]
}

/// Returns the ray through a distorted position, by fixed-point iteration.
fn ray_through(intrinsics: &Intrinsics, x: f64, y: f64) -> [f64; 2] {
    let distorted = [(x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy];
    let mut undistorted = distorted;
    for _ in 0..50 {
        let distorted_again = intrinsics.distortion.distort(undistorted);
        undistorted = [
            undistorted[0] + distorted[0] - distorted_again[0],
            undistorted[1] + distorted[1] - distorted_again[1],
        ];
    }
    undistorted
}

fn image_of(ray: &dyn Fn(f64, f64) -> [f64; 2]) -> Rgba8 {
    let pixel = |i: usize| colour_towards(ray((i % 120) as f64 + 0.5, (i / 120) as f64 + 0.5));
    Rgba8::new(120, 90, (0..120 * 90).flat_map(pixel).collect())
}

/// Removing the distortion of a distorted image returns the pinhole image.
#[test]
fn distortion_is_removed() {
    let distortion = Distortion::brown([-0.12, 0.02, 0.0], [0.002, -0.001]);
    let intrinsics =
        Intrinsics { width: 120, height: 90, fx: 110.0, fy: 108.0, cx: 61.0, cy: 44.0, distortion };
    let pinhole = intrinsics.pinhole().unwrap();
    assert!(pinhole.fx != intrinsics.fx);
    let expected = image_of(&|x, y| [(x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy]);
    let found =
        undistort_image(&image_of(&|x, y| ray_through(&intrinsics, x, y)), &intrinsics, &pinhole);
    let max_difference =
        found.data.iter().zip(&expected.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
    assert!(max_difference <= 3, "{max_difference}");
}
