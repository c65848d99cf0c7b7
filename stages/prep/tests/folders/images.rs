//! Pixels: EXR, EXIF orientation, strips at the border, and formats that aren't read.

use std::path::Path;

use pixels::{Channel, PixelError, Rgba8, SampleType, write_exr};
use serde_json::json;

use super::kit::{
    CAMERA, Case, Expected, SIDE, Scene, case, held_out, jpeg, photograph, transforms, write,
    write_colmap, write_image, write_llff, write_mask, write_photographs, write_transforms,
};

/// Log line about the data set of most cases.
const TRANSFORMS: &str = "transforms.json (instant-ngp, nerfstudio): 3 photographs";
const COLMAP: &str = "COLMAP: 10 photographs from sparse/0";

/// Writes EXR photographs; 16 pixels of the second have the value 40.
fn write_exrs(folder: &Path) {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    for number in 0..3 {
        let channels = ["R", "G", "B"].map(|name| Channel { name, sample_type: SampleType::Half });
        let size = (SIDE as usize, SIDE as usize);
        let bright_samples = if number == 1 { 3 * SIDE as usize } else { 0 };
        let path = folder.join(format!("images/a{number}.exr"));
        write_exr(&path, size, &channels, "", |first, _, samples| {
            for (i, sample) in samples.iter_mut().enumerate() {
                let index = 3 * first * size.0 + i;
                *sample = if index < bright_samples { 40.0 } else { (index % 97) as f32 / 97.0 };
            }
            Ok::<(), PixelError>(())
        })
        .unwrap();
    }
    write_transforms(folder, &transforms("images/a#.exr", 3));
}

/// Writes photographs, and depth of half their height for the test view.
fn write_low_depth(folder: &Path) {
    write_photographs(folder, "images/a#.png", 3);
    let mut list = transforms("images/a#.png", 3);
    list["frames"][0]["depth_file_path"] = json!("a0.exr");
    write_transforms(folder, &list);
    let channels = ["A", "Z"].map(|name| Channel { name, sample_type: SampleType::Float });
    write_exr(&folder.join("a0.exr"), (16, 8), &channels, "", |_, _, samples| {
        samples.fill(1.0);
        Ok::<(), PixelError>(())
    })
    .unwrap();
}

/// Writes JPEGs with an EXIF orientation, and cameras of the given size.
fn write_oriented(folder: &Path, stored: (u32, u32), orientation: u8, camera: (u32, u32)) {
    for number in 0..3 {
        let image = jpeg(&photograph(stored.0, stored.1, number), Some(orientation));
        write(folder.join(format!("images/a{number}.jpg")), image);
    }
    let mut list = transforms("images/a#.jpg", 3);
    (list["w"], list["h"]) = (json!(camera.0), json!(camera.1));
    write_transforms(folder, &list);
}

/// Returns the expected scene with views of the given size.
fn of_size(mut scene: Scene, width: f64, height: f64) -> Expected {
    for view in scene.train.iter_mut().chain(&mut scene.test) {
        (view.inside[0], view.inside[1]) = (width, height);
    }
    Expected::Scene(scene)
}

/// Writes ten photographs with dark strips of the given widths: top, right, bottom, left.
fn write_strips(folder: &Path, [top, right, bottom, left]: [u32; 4]) {
    write_colmap(&folder.join("sparse/0"), CAMERA, "a#.png", 10);
    for number in 0..10 {
        let mut image = photograph(SIDE, SIDE, number);
        for pixel in 0..SIDE * SIDE {
            let (x, y) = (pixel % SIDE, pixel / SIDE);
            if x < left || x >= SIDE - right || y < top || y >= SIDE - bottom {
                image.data[4 * pixel as usize..][..3].fill(2);
            }
        }
        write_image(&folder.join(format!("images/a{number}.png")), &image);
    }
}

fn is_inside(x: u32, y: u32) -> bool {
    (3..SIDE - 3).contains(&x) && (3..SIDE - 3).contains(&y)
}

fn write_masked_strips(folder: &Path) {
    write_strips(folder, [3; 4]);
    for number in 0..10 {
        write_mask(&folder.join(format!("masks/a{number}.png")), (SIDE, SIDE), is_inside);
    }
}

fn with_lines(mut scene: Scene, lines: &[&'static str]) -> Scene {
    scene.further = lines.to_vec();
    scene
}

/// Writes views of an object on black: a disc of several sizes.
fn write_discs(folder: &Path) {
    write_colmap(&folder.join("sparse/0"), CAMERA, "a#.png", 10);
    for number in 0..10 {
        let radius_squared = 24 + 3 * number as i64;
        let mut image = photograph(SIDE, SIDE, number);
        for pixel in 0..(SIDE * SIDE) as usize {
            let (x, y) = (pixel as i64 % 16 - 8, pixel as i64 / 16 - 8);
            if x * x + y * y > radius_squared {
                image.data[4 * pixel..][..3].fill(0);
            }
        }
        write_image(&folder.join(format!("images/a{number}.png")), &image);
    }
}

/// Writes a data set whose second photograph has the given name and content.
fn write_format(folder: &Path, name: &str, content: &[u8]) {
    let mut list = transforms("images/a#.png", 3);
    list["frames"][1]["file_path"] = json!(name);
    write_photographs(folder, "images/a#.png", 3);
    write(folder.join(name), content);
    write_transforms(folder, &list);
}

fn exif_cases() -> Vec<Case> {
    const ASSUMED: &str = "3 photographs have an EXIF orientation that the camera's width and height neither confirm nor contradict; assuming that poses refer to the stored image";
    vec![
        case(
            "colmap#1456: a square, turned by 90°",
            |folder| write_oriented(folder, (SIDE, SIDE), 6, (SIDE, SIDE)),
            Expected::Scene(held_out("a#", 3, &[TRANSFORMS, ASSUMED])),
        ),
        case(
            "colmap#2104: turned by 180°",
            |folder| write_oriented(folder, (SIDE, 12), 3, (SIDE, 12)),
            of_size(held_out("a#", 3, &[TRANSFORMS, ASSUMED]), 16.0, 12.0),
        ),
        case(
            "the camera has the stored shape",
            |folder| write_oriented(folder, (SIDE, 12), 6, (SIDE, 12)),
            of_size(held_out("a#", 3, &[TRANSFORMS]), 16.0, 12.0),
        ),
        case(
            "the camera has the turned shape",
            |folder| write_oriented(folder, (SIDE, 12), 6, (12, SIDE)),
            of_size(
                held_out(
                    "a#",
                    3,
                    &[TRANSFORMS, "3 photographs are turned upright, as EXIF data require"],
                ),
                12.0,
                16.0,
            ),
        ),
    ]
}

fn border_cases() -> Vec<Case> {
    vec![
        case(
            "f2-nerf#33: strips around every photograph",
            |folder| write_strips(folder, [3; 4]),
            Expected::Scene(with_lines(
                held_out("a#", 10, &[COLMAP]),
                &[
                    "warning: uniform strips at the border (colour 2 2 2; top 3, right 3, bottom 3, left 3 pixels) in 8 of 8 sampled views seem to come from undistortion or letterboxing, not from a background: mask them out (masks/NAME.png, mask_path) or crop the photographs",
                ],
            )),
        ),
        case(
            "letterboxing",
            |folder| write_strips(folder, [2, 0, 3, 0]),
            Expected::Scene(with_lines(
                held_out("a#", 10, &[COLMAP]),
                &[
                    "warning: uniform strips at the border (colour 2 2 2; top 2, bottom 3 pixels) in 8 of 8 sampled views seem to come from undistortion or letterboxing, not from a background: mask them out (masks/NAME.png, mask_path) or crop the photographs",
                ],
            )),
        ),
        case("strips that are masked out", write_masked_strips, {
            let mut scene = held_out(
                "a#",
                10,
                &[
                    COLMAP,
                    "10 of 10 views have masks (10 by masks/NAME.png, where black is excluded)",
                ],
            );
            for view in scene.train.iter_mut().chain(&mut scene.test) {
                view.mask = Some(is_inside);
            }
            Expected::Scene(with_lines(
                scene,
                &[
                    "uniform strips at the border (colour 2 2 2; top 3, right 3, bottom 3, left 3 pixels) in 8 of 8 sampled views are masked out; they are not a background",
                ],
            ))
        }),
        case(
            "objects on black are on black",
            write_discs,
            Expected::Scene(with_lines(
                held_out("a#", 10, &[COLMAP]),
                &[
                    "images have no alpha; borders are one flat colour (0 0 0) in 8 of 8 sampled views",
                ],
            )),
        ),
    ]
}

fn format_cases() -> Vec<Case> {
    vec![
        case(
            "HEIC",
            |folder| write_format(folder, "images/b.HEIC", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 1 (images/b.HEIC): DIR/images/b.HEIC is a HEIC image, which is not supported; convert: magick mogrify -format jpg -quality 98 'DIR/images'/*.HEIC",
            ),
        ),
        case(
            "WebP that is named PNG",
            |folder| write_format(folder, "images/b.png", b"RIFF\x10\0\0\0WEBPVP8 \0\0\0\0"),
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 1 (images/b.png): DIR/images/b.png is a WebP image, which is not supported; convert: magick mogrify -format png 'DIR/images'/*.png",
            ),
        ),
        case(
            "TIFF",
            |folder| write_format(folder, "images/b.tif", b"II*\0\x08\0\0\0\0\0\0\0"),
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 1 (images/b.tif): DIR/images/b.tif is a TIFF image, which is not supported; convert: magick mogrify -format png 'DIR/images'/*.tif",
            ),
        ),
        case(
            "BMP",
            |folder| write_format(folder, "images/b.bmp", b"BM\x46\0\0\0\0\0\0\0\x36\0\0\0"),
            Expected::Refused(
                "dataset: DIR/transforms.json: frame 1 (images/b.bmp): DIR/images/b.bmp is a BMP image, which is not supported; convert: magick mogrify -format png 'DIR/images'/*.bmp",
            ),
        ),
        case(
            "HEIC that was converted",
            |folder| {
                write_format(folder, "images/b.HEIC", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic");
                write_image(&folder.join("images/b.jpg"), &photograph(SIDE, SIDE, 1));
            },
            {
                let mut scene = held_out(
                    "a#",
                    3,
                    &[
                        TRANSFORMS,
                        "1 file name found with a different extension (first: images/b.HEIC is images/b.jpg)",
                    ],
                );
                scene.train[0].name = "b".to_owned();
                Expected::Scene(scene)
            },
        ),
        case(
            "LLFF of WebP",
            |folder| {
                write_llff(folder, &[0, 1], [2.0, 6.0]);
                for name in ["images/a.webp", "images/b.webp"] {
                    write(folder.join(name), b"RIFF\x10\0\0\0WEBPVP8 \0\0\0\0");
                }
            },
            Expected::Refused(
                "dataset: DIR/poses_bounds.npy: 2 poses for 0 images in images/ (2 in WebP, which is not supported; convert: magick mogrify -format png 'DIR/images'/*.webp); counts must match, or view_imgs.txt must list the images that have poses",
            ),
        ),
    ]
}

pub(crate) fn cases() -> Vec<Case> {
    let mut cases = vec![
        case("ns#1097, LFS#1011: EXR above 1", write_exrs, {
            Expected::Scene(with_lines(
                held_out("a#", 3, &[TRANSFORMS]),
                &[
                    "warning: 16 of 768 pixels (2.08 %) are brighter than 1 and clipped to 1, in 1 of 3 EXR photographs (first: frame a1); to keep them, scale the files to at most 1",
                ],
            ))
        }),
        Case {
            name: "depth of another shape",
            make: write_low_depth,
            params: json!({"lr_source": "downscaled"}),
            expected: Expected::Refused(
                "frame a0: DIR/a0.exr: depth has 16×8 pixels, its photograph 16×16; aspect ratios must match",
            ),
        },
        case(
            "ns#1213, EasyVolcap#31: several sizes",
            |folder| {
                let mut list = transforms("images/a#.png", 3);
                let image = Rgba8 { ..photograph(12, SIDE, 1) };
                write_photographs(folder, "images/a#.png", 3);
                write_image(&folder.join("images/a1.png"), &image);
                (list["frames"][1]["w"], list["frames"][1]["cx"]) = (json!(12), json!(6));
                write_transforms(folder, &list);
            },
            {
                let mut scene = held_out(
                    "a#",
                    3,
                    &[TRANSFORMS, "photographs have 2 sizes, from 12×16 to 16×16"],
                );
                scene.train[0].inside = [12.0, 16.0, 20.0, 20.0, 6.0, 8.0];
                Expected::Scene(scene)
            },
        ),
    ];
    cases.extend(exif_cases());
    cases.extend(border_cases());
    cases.extend(format_cases());
    cases
}
