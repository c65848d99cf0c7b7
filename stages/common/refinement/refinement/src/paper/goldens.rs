//! Tests that the network and its loss agree with PyTorch's (`scripts/goldens/paper_refiner.py`).

use std::path::{Path, PathBuf};

use nets::Weights;
use tch::{Kind, Tensor};

use super::loss::PerceptualLoss;
use super::network::PaperRefiner;
use super::trainer::loss;

fn golden_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/golden.safetensors")
}

/// Returns the norm of the difference, relative to that of `b`.
fn relative_difference(a: &Tensor, b: &Tensor) -> f64 {
    let norm =
        |t: &Tensor| t.to_kind(Kind::Double).square().sum(Kind::Double).sqrt().double_value(&[]);
    norm(&(a - b)) / norm(b)
}

#[test]
fn network_and_loss_agree_with_pytorch() {
    nets::deterministic();
    let file = Weights::read(&golden_path()).unwrap();
    let tensor_4d = |name: &str| file.tensor(name, &file.shape::<4>(name).unwrap()).unwrap();
    let read_network = || PaperRefiner::read(&golden_path(), 4).unwrap();
    let (rendered, truth) = (tensor_4d("golden.rendered"), tensor_4d("golden.truth"));
    let references = tensor_4d("golden.references");

    let network = read_network();
    let features = tch::no_grad(|| network.encode(&rendered, false)).unwrap();
    for (i, found) in features.iter().enumerate() {
        let difference = relative_difference(found, &tensor_4d(&format!("golden.features.{i}")));
        assert!(difference < 1e-5, "features {i}: {difference:e}");
    }
    let drawn = tch::no_grad(|| network.forward(&rendered, &references, false)).unwrap();
    let difference = relative_difference(&drawn, &tensor_4d("golden.drawn"));
    assert!(difference < 1e-5, "forward: {difference:e}");

    // In training, the batch's mean and variance are used, and update the running ones.
    let found = network.forward(&rendered, &references, true).unwrap();
    let difference = relative_difference(&found, &tensor_4d("golden.training"));
    assert!(difference < 1e-5, "training: {difference:e}");
    let updated = tch::no_grad(|| network.forward(&rendered, &references, false)).unwrap();
    let difference = relative_difference(&updated, &tensor_4d("golden.moved"));
    assert!(difference < 1e-5, "running means: {difference:e}");

    for (kind, blocks) in [("l1", 0), ("caffe", 3), ("torchvision", 5)] {
        let prefix = format!("golden.{kind}.");
        let perceptual = (blocks > 0).then(|| {
            let path = Path::new(env!("CARGO_MANIFEST_DIR"))
                .join(format!("tests/goldens/vgg-{kind}.safetensors"));
            PerceptualLoss::from_weights(&Weights::read(&path).unwrap(), [4, 4, 6, 6, 6]).unwrap()
        });
        assert_eq!(perceptual.as_ref().map_or(0, PerceptualLoss::blocks), blocks);
        let network = read_network();
        let found = network.forward(&rendered, &references, true).unwrap();
        let (loss, _) = loss(&found, &truth, perceptual.as_ref()).unwrap();
        let expected = file.tensor(&format!("{prefix}loss"), &[1]).unwrap();
        let difference = relative_difference(&loss.reshape([1]), &expected);
        assert!(difference < 1e-5, "{kind}: loss {difference:e}");
        let parameters: Vec<Tensor> = network.parameters().collect();
        let gradients = Tensor::f_run_backward(&[&loss], &parameters, false, false).unwrap();
        let largest = gradients.iter().map(|g| g.abs().max().double_value(&[])).fold(0.0, f64::max);
        let trainable =
            network.named_tensors().into_iter().filter(|(_, tensor)| tensor.requires_grad());
        for ((name, _), gradient) in trainable.zip(&gradients) {
            let expected = file.tensor(&format!("{prefix}{name}"), &gradient.size()).unwrap();
            // If normalisation cancels a bias, the bias's gradient is only rounding.
            let scale = expected.abs().max().double_value(&[]).max(1e-3 * largest);
            let difference = (gradient - &expected).abs().max().double_value(&[]) / scale;
            assert!(difference < 1e-3, "{kind}: gradient of {name}: {difference:e}");
        }
    }
}
