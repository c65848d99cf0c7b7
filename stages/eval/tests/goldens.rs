//! SSIM against scikit-image and PyTorch, LPIPS against its published example.

#![allow(missing_docs, reason = "a test")]
#[path = "../../common/imaging/pixels/tests/pattern.rs"]
#[allow(unreachable_pub, reason = "shared with pixels' tests")]
mod pattern;

use eval::ssim;
use pixels::Image;

fn levels(width: usize, height: usize, seed: u32) -> Vec<f64> {
    pattern::pattern(width, height, 3, seed).iter().map(|&v| f64::from(v) / 255.0).collect()
}

/// Returns an image and a blend with another image. The goldens are in f64; rounding the blend to
/// f32 costs about 1e-8.
fn images(width: usize, height: usize, seed: u32) -> (Image, Image) {
    let (a, other) = (levels(width, height, seed), levels(width, height, seed + 100));
    let b = a.iter().zip(&other).map(|(a, o)| (0.7 * a + 0.3 * o) as f32).collect();
    (
        Image::new(width, height, 3, a.iter().map(|&v| v as f32).collect()),
        Image::new(width, height, 3, b),
    )
}

#[test]
fn ssim_equals_scikit_image_and_pytorch() {
    let list: serde_json::Value = serde_json::from_str(include_str!("goldens/ssim.json")).unwrap();
    for case in list["cases"].as_array().unwrap() {
        let number = |key: &str| case[key].as_u64().unwrap() as usize;
        let (a, b) = images(number("width"), number("height"), number("seed") as u32);
        let scores = ssim(&a, &b);
        for (ours, key) in [(scores.valid, "valid"), (scores.reflected, "reflect")] {
            let theirs = case[key].as_f64().unwrap();
            assert!((ours - theirs).abs() < 1e-6, "{key}: {ours} {theirs} {case}");
        }
        assert!((ssim(&a, &a).reflected - 1.0).abs() < 1e-12);
    }
}

#[test]
fn one_pixel_and_narrow_images_have_an_ssim() {
    for (width, height) in [(1, 1), (2, 7), (4, 30)] {
        let (a, b) = images(width, height, 5);
        let scores = ssim(&a, &b);
        assert!(scores.valid.is_finite() && scores.reflected.is_finite());
    }
}

#[cfg(feature = "torch")]
#[test]
fn lpips_gives_the_published_distances() {
    let data = std::env::var("NERF_SR_DATA").map_or_else(
        |_| concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data").into(),
        std::path::PathBuf::from,
    );
    let weights = data.join("weights");
    if !weights.is_dir() {
        eprintln!("skipped: no data ({} is not there; set NERF_SR_DATA)", weights.display());
        return;
    }
    let lpips = eval::Lpips::read(&weights, eval::LpipsNetwork::Squeeze).unwrap();
    let read = |name: &str| pixels::read_premultiplied(&weights.join(name)).unwrap().over(1.0);
    let reference = read("ex_ref.png");
    for (name, expected) in [("ex_p0.png", 0.7112), ("ex_p1.png", 0.1479)] {
        let distance = lpips.distance(&reference, &read(name)).unwrap();
        assert!((distance - expected).abs() < 0.002, "{name}: {distance}");
    }
    assert!(lpips.distance(&reference, &reference).unwrap().abs() < 1e-6);
}

/// Distances of every network with fixed random weights equal those of PyTorch's layers
/// (`scripts/goldens/images.py`).
#[cfg(feature = "torch")]
#[test]
fn lpips_equals_pytorch_with_every_network() {
    use eval::LpipsNetwork::{Alex, Squeeze, Vgg};
    let list: serde_json::Value = serde_json::from_str(include_str!("goldens/lpips.json")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (name, network) in [("squeeze", Squeeze), ("alex", Alex), ("vgg", Vgg)] {
        let case = &list[name];
        let mut purpose = case["purpose"].as_u64().unwrap();
        for (part, file) in ["weights", "heads"].iter().zip(network.files()) {
            let tensors = case[part].as_array().unwrap().iter().map(|entry| {
                let shape: Vec<i64> = serde_json::from_value(entry["shape"].clone()).unwrap();
                let (scale, shift) = (
                    entry["scale"].as_f64().unwrap() as f32,
                    entry["shift"].as_f64().unwrap() as f32,
                );
                let count = shape.iter().product::<i64>() as u64;
                let values: Vec<f32> =
                    (0..count).map(|i| scale * numerics::uniform(7, purpose, i) + shift).collect();
                purpose += 1;
                (
                    entry["name"].as_str().unwrap().to_owned(),
                    tch::Tensor::from_slice(&values).reshape(&shape),
                )
            });
            nets::write(&folder.path().join(file), &tensors.collect::<Vec<_>>()).unwrap();
        }
        let lpips = eval::Lpips::read(folder.path(), network).unwrap();
        let (a, b) = images(45, 37, 9);
        let (found, expected) =
            (lpips.distance(&a, &b).unwrap(), case["distance"].as_f64().unwrap());
        assert!(
            (found / expected - 1.0).abs() < 1e-4,
            "{name}: {found} where PyTorch has {expected}"
        );
        let (a, b) = images(15, 15, 9);
        assert!(lpips.distance(&a, &b).unwrap_err().to_string().contains("at least"));
    }
}
