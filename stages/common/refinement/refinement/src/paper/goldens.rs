//! The network and its loss against PyTorch's (`scripts/goldens/paper_refiner.py`).

use std::path::{Path, PathBuf};

use nets::Weights;
use tch::{Kind, Tensor};

use super::loss::PerceptualLoss;
use super::network::PaperRefiner;
use super::trainer::loss;

fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/golden.safetensors")
}

fn apart(a: &Tensor, b: &Tensor) -> f64 {
    let norm =
        |t: &Tensor| t.to_kind(Kind::Double).square().sum(Kind::Double).sqrt().double_value(&[]);
    norm(&(a - b)) / norm(b)
}

#[test]
fn network_and_loss_are_those_of_pytorch() {
    nets::deterministic();
    let file = Weights::read(&golden()).unwrap();
    let four = |name: &str| file.tensor(name, &file.shape::<4>(name).unwrap()).unwrap();
    let read = || PaperRefiner::read(&golden(), 4).unwrap();
    let (rendered, truth) = (four("golden.rendered"), four("golden.truth"));
    let references =
        file.tensor("golden.references", &file.shape::<4>("golden.references").unwrap()).unwrap();

    let network = read();
    let features = tch::no_grad(|| network.encode(&rendered, false)).unwrap();
    for (i, found) in features.iter().enumerate() {
        let off = apart(found, &four(&format!("golden.features.{i}")));
        assert!(off < 1e-5, "features {i}: {off:e}");
    }
    let drawn = tch::no_grad(|| network.forward(&rendered, &references, false)).unwrap();
    let off = apart(&drawn, &four("golden.drawn"));
    assert!(off < 1e-5, "forward: {off:e}");

    // In training, with the mean and variance of the batch, which also move the running ones.
    let found = network.forward(&rendered, &references, true).unwrap();
    let off = apart(&found, &four("golden.training"));
    assert!(off < 1e-5, "training: {off:e}");
    let moved = tch::no_grad(|| network.forward(&rendered, &references, false)).unwrap();
    let off = apart(&moved, &four("golden.moved"));
    assert!(off < 1e-5, "running means: {off:e}");

    for (kind, blocks) in [("l1", 0), ("caffe", 3), ("torchvision", 5)] {
        let prefix = format!("golden.{kind}.");
        let perceptual = (blocks > 0).then(|| {
            let path = Path::new(env!("CARGO_MANIFEST_DIR"))
                .join(format!("tests/goldens/vgg-{kind}.safetensors"));
            PerceptualLoss::from_weights(&Weights::read(&path).unwrap(), [4, 4, 6, 6, 6]).unwrap()
        });
        assert_eq!(perceptual.as_ref().map_or(0, PerceptualLoss::blocks), blocks);
        let network = read();
        let found = network.forward(&rendered, &references, true).unwrap();
        let (loss, _) = loss(&found, &truth, perceptual.as_ref()).unwrap();
        let expected = file.tensor(&format!("{prefix}loss"), &[1]).unwrap();
        let off = apart(&loss.reshape([1]), &expected);
        assert!(off < 1e-5, "{kind}: loss {off:e}");
        let parameters: Vec<Tensor> = network.parameters().collect();
        let gradients = Tensor::f_run_backward(&[&loss], &parameters, false, false).unwrap();
        let largest = gradients.iter().map(|g| g.abs().max().double_value(&[])).fold(0.0, f64::max);
        let trainable =
            network.named_tensors().into_iter().filter(|(_, tensor)| tensor.requires_grad());
        for ((name, _), gradient) in trainable.zip(&gradients) {
            let expected = file.tensor(&format!("{prefix}{name}"), &gradient.size()).unwrap();
            // Where normalisation takes a bias away again, its gradient is nothing but rounding.
            let scale = expected.abs().max().double_value(&[]).max(1e-3 * largest);
            let off = (gradient - &expected).abs().max().double_value(&[]) / scale;
            assert!(off < 1e-3, "{kind}: gradient of {name}: {off:e}");
        }
    }
}
