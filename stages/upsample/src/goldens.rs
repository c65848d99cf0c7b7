//! Tests that networks agree with PyTorch's (`scripts/goldens/upsample.py`), and that broken files
//! are refused.

use std::path::{Path, PathBuf};

use nets::Weights;
use pixels::{Filter, Image, psnr_of, read_png, resize_pillow};
use tch::{Kind, Tensor, no_grad};

use crate::check_scale;
use crate::imdn::Imdn;
use crate::liif::Liif;
use crate::network::Network;
use crate::swinir::SwinIr;

const FILES: [&str; 7] = [
    "imdn",
    "liif",
    "swinir_classical",
    "swinir_classical_x3",
    "swinir_light",
    "swinir_real",
    "swinir_real_x2",
];

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/goldens/{name}.safetensors"))
}

fn read(name: &str, weights: &Weights) -> Result<Box<dyn Network>, nets::WeightsError> {
    Ok(match name.split('_').next() {
        Some("imdn") => Box::new(Imdn::read(weights)?),
        Some("liif") => Box::new(Liif::read(weights)?),
        _ => Box::new(SwinIr::read(weights)?),
    })
}

fn case_tensor(weights: &Weights, number: usize, role: &str) -> Tensor {
    let name = format!("golden.{role}.{number}");
    weights.tensor(&name, &weights.shape::<4>(&name).unwrap()).unwrap()
}

#[test]
fn networks_agree_with_pytorch() {
    nets::deterministic();
    for name in FILES {
        let weights = Weights::read(&golden(name)).unwrap();
        let network = read(name, &weights).unwrap();
        let mut cases = 0;
        while weights.has(&format!("golden.input.{cases}")) {
            let (input, expected) =
                (case_tensor(&weights, cases, "input"), case_tensor(&weights, cases, "output"));
            let [.., rows, columns] = expected.size()[..] else { unreachable!() };
            let found = no_grad(|| network.enlarge(&input, [rows, columns])).unwrap();
            assert_eq!(found.size(), expected.size(), "{name}, case {cases}");
            let norm = |t: &Tensor| t.square().sum(Kind::Double).sqrt().double_value(&[]);
            let difference = norm(&(&found - &expected)) / norm(&expected);
            assert!(difference < 1e-5, "{name}, case {cases}: {difference:e}");
            cases += 1;
        }
        assert!(cases > 0, "{name} has no cases");
    }
}

/// A file with a missing or empty tensor is refused or describes another network. Reading never
/// panics.
#[test]
fn broken_weights_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("broken.safetensors");
    for name in FILES {
        let bytes = std::fs::read(golden(name)).unwrap();
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header: serde_json::Map<String, serde_json::Value> =
            serde_json::from_slice(&bytes[8..8 + length]).unwrap();
        let names: Vec<&String> =
            header.keys().filter(|n| !n.starts_with("golden") && !n.starts_with("__")).collect();
        let complete = Weights::read(&golden(name)).unwrap();
        let all: Vec<(String, Tensor)> = names
            .iter()
            .map(|n| {
                let shape: Vec<i64> = serde_json::from_value(header[*n]["shape"].clone()).unwrap();
                ((*n).clone(), complete.tensor(n, &shape).unwrap())
            })
            .collect();
        let mut refused = 0;
        for broken in 0..all.len() {
            for empty in [false, true] {
                let tensors: Vec<(String, Tensor)> = all
                    .iter()
                    .enumerate()
                    .filter(|(i, _)| *i != broken || empty)
                    .map(|(i, (n, t))| {
                        (
                            n.clone(),
                            if i == broken {
                                Tensor::zeros(vec![0; t.dim()], (Kind::Float, tch::Device::Cpu))
                            } else {
                                t.shallow_clone()
                            },
                        )
                    })
                    .collect();
                nets::write(&path, &tensors).unwrap();
                let network = Weights::read(&path).and_then(|weights| read(name, &weights));
                refused += usize::from(network.is_err());
            }
        }
        assert!(refused >= 2 * all.len() - 12, "{name}: {refused} of {} refused", 2 * all.len());
    }
}

#[test]
fn sizes_that_a_network_cannot_produce_are_refused() {
    assert!(
        check_scale(Some(4), [5, 7], [20, 28]).is_ok()
            && check_scale(None, [5, 7], [13, 20]).is_ok()
    );
    assert!(check_scale(Some(4), [5, 7], [20, 27]).unwrap_err().to_string().contains("4 times"));
}

/// IMDN with the released weights scores on ten real views as in PyTorch.
#[test]
fn released_imdn_scores_as_in_pytorch() {
    let data = std::env::var("NERF_SR_DATA").map_or_else(
        |_| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"),
        PathBuf::from,
    );
    if !data.join("weights/imdn_x2.safetensors").is_file() {
        eprintln!("skipped: no data ({} is not there; set NERF_SR_DATA)", data.display());
        return;
    }
    nets::deterministic();
    let scores = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/imdn-lego.json");
    let scores: serde_json::Value =
        serde_json::from_slice(&std::fs::read(scores).unwrap()).unwrap();
    for scale in [2usize, 4] {
        let weights =
            Weights::read(&data.join(format!("weights/imdn_x{scale}.safetensors"))).unwrap();
        let network = Imdn::read(&weights).unwrap();
        assert_eq!(network.scale(), Some(scale as i64));
        let rows = scores[format!("x{scale}")].as_array().unwrap();
        assert_eq!(rows.len(), 10);
        for row in rows {
            let view = row["view"].as_str().unwrap();
            let image = read_png(&data.join(format!("nerf_synthetic/lego/{view}.png"))).unwrap();
            let white = Image::premultiplied(&image).over(1.0).to_rgba8();
            let hr = resize_pillow(&white, 200, 200, Filter::Lanczos);
            let lr = resize_pillow(&hr, 200 / scale, 200 / scale, Filter::Bicubic);
            let input = nets::tensor_of(&Image::premultiplied(&lr).over(0.0)).unwrap();
            let enlarged = no_grad(|| network.enlarge(&input, [200, 200])).unwrap().clamp(0.0, 1.0);
            let (enlarged, truth) =
                (nets::image_of(&enlarged).unwrap(), Image::premultiplied(&hr).over(0.0));
            let error: f64 =
                enlarged.data.iter().zip(&truth.data).map(|(a, b)| f64::from(a - b).powi(2)).sum();
            let (found, expected) =
                (psnr_of(error / truth.data.len() as f64), row["psnr"].as_f64().unwrap());
            assert!(
                (found - expected).abs() < 0.02,
                "{view} ×{scale}: {found} dB, PyTorch {expected} dB"
            );
            assert!(
                expected > row["bicubic_psnr"].as_f64().unwrap() + 1.0,
                "{view} ×{scale}: no better than bicubic"
            );
        }
    }
}
