//! Comparison with PyTorch: `scripts/goldens/torch_field.py` writes `tests/goldens/mlp.safetensors`
//! (`make goldens`).

use numerics::uniform;
use safetensors::SafeTensors;
use scene::Bounds;
use tch::{Device, Kind, Tensor};

use crate::architecture::MlpArchitecture;
use crate::mlp::{Batch, Mlp, SampleDraws};
use crate::mlp_trainer::{MlpTrainer, MlpTraining};
use crate::network::MlpNetwork;
use crate::network::encode;
use crate::sampling::{importance, midpoints, stratified};

const GOLDENS: &[u8] = include_bytes!("../tests/goldens/mlp.safetensors");

/// Returns the same numbers as the script's `draw`.
fn draw(purpose: u64, shape: &[i64]) -> Tensor {
    let values: Vec<f64> = (0..shape.iter().product::<i64>())
        .map(|i| f64::from(uniform(11, purpose, i as u64)))
        .collect();
    Tensor::from_slice(&values).reshape(shape)
}

fn golden(name: &str) -> Tensor {
    let file = SafeTensors::deserialize(GOLDENS).unwrap();
    let view = file.tensor(name).unwrap();
    let kind = if view.dtype() == safetensors::Dtype::F64 { Kind::Double } else { Kind::Float };
    let shape: Vec<i64> = view.shape().iter().map(|&d| d as i64).collect();
    Tensor::from_data_size(view.data(), &shape, kind)
}

#[track_caller]
fn assert_close(name: &str, ours: &Tensor, tolerance: f64) {
    let theirs = golden(name).to_kind(Kind::Double);
    let ours = ours.detach().to_kind(Kind::Double);
    assert_eq!(ours.size(), theirs.size(), "{name}");
    let error = f64::try_from((&ours - &theirs).norm() / theirs.norm()).unwrap();
    assert!(error <= tolerance, "{name}: relative error {error:e}");
}

/// Creates a network with the script's weights.
fn network(architecture: MlpArchitecture, purpose: u64, kind: Kind) -> MlpNetwork {
    let mut next = purpose;
    let read = MlpNetwork::read(architecture, |_, shape| {
        let values = draw(next, shape);
        next += 1;
        Ok(if shape.len() == 2 {
            (6.0 / shape[1] as f64).sqrt() * (2.0 * values - 1.0)
        } else {
            0.2 * values - 0.05
        })
    });
    read.unwrap().to(Device::Cpu, kind).unwrap()
}

#[test]
fn published_size_matches_pytorch_in_f32() {
    let draw_uniform = |purpose, half_width: f64| {
        (draw(purpose, &[8, 3]) * (2.0 * half_width) - half_width).to_kind(Kind::Float)
    };
    let (position, direction) = (draw_uniform(1, 2.0), draw_uniform(2, 1.0));
    let code = encode(&position, 10).unwrap();
    assert_close("encoding", &code, 1e-6);
    let network = network(MlpArchitecture::default(), 1000, Kind::Float);
    assert_eq!(network.parameters.iter().map(Tensor::numel).sum::<usize>(), 595_844);
    let (colour, density) = network.forward(&code, &encode(&direction, 4).unwrap()).unwrap();
    assert_close("full.colour", &colour, 1e-5);
    assert_close("full.density", &density, 1e-5);
}

/// Returns a small field, a batch of rays, and the draws of their samples.
fn small_case() -> (Mlp, Batch, SampleDraws) {
    let architecture = MlpArchitecture {
        position_frequencies: 4,
        direction_frequencies: 2,
        layers: 6,
        hidden_dim: 16,
        coarse_samples: 8,
        fine_samples: 8,
        scaled_positions: false,
    };
    let bounds = Bounds::cube(2.0, 2.0, 6.0);
    let [coarse, fine] = [2000, 3000].map(|purpose| network(architecture, purpose, Kind::Double));
    let field = Mlp { architecture, bounds, coarse, fine, device: Device::Cpu };
    let origin = 0.5 * draw(3, &[8, 3]) + Tensor::from_slice(&[0.0, 0.0, 4.0f64]);
    let direction = draw(4, &[8, 3]) - 0.5;
    let _ = direction.narrow(1, 2, 1).fill_(-1.0);
    let noise = Some([draw(9, &[8, 8]) - 0.5, draw(10, &[8, 16]) - 0.5]);
    let draws = SampleDraws { coarse: draw(7, &[8, 8]), fine: draw(8, &[8, 8]), noise };
    (field, Batch { origin, direction, background: draw(5, &[8, 3]), maps: None }, draws)
}

#[test]
fn sampling_and_compositing_match_pytorch_in_f64() {
    let (field, batch, draws) = small_case();
    let [near, far] = [2.0, 6.0].map(|x| Tensor::full([8, 1], x, (Kind::Double, Device::Cpu)));
    let t = stratified(&near, &far, 8, Some(&draws.coarse)).unwrap();
    assert_close("stratified", &t, 1e-12);
    let output = field.forward(&batch, Some(&draws)).unwrap();
    // The reference implementation multiplies by 1 - α + 1e-10; `composite` adds optical depths.
    assert_close("coarse.weights", &output.coarse.weights, 1e-8);
    let inner = output.coarse.weights.narrow(1, 1, 6);
    assert_close(
        "importance",
        &importance(&midpoints(&t).unwrap(), &inner, &draws.fine).unwrap(),
        1e-9,
    );
    let even = stratified(&near, &far, 8, None).unwrap();
    let quantiles =
        Tensor::linspace(0, 1, 8, (Kind::Double, Device::Cpu)).expand([8, 8], false).contiguous();
    assert_close(
        "importance.even",
        &importance(&midpoints(&even).unwrap(), &inner, &quantiles).unwrap(),
        1e-9,
    );
    assert_close("fine.weights", &output.fine.weights, 1e-8);
    assert_close("coarse.colour", &output.coarse.colour, 1e-8);
    assert_close("fine.colour", &output.fine.colour, 1e-8);
}

fn flat(tensors: &[Tensor]) -> Tensor {
    Tensor::cat(&tensors.iter().map(|t| t.reshape([-1])).collect::<Vec<_>>(), 0)
}

fn image_loss(colour: &Tensor, target: &Tensor) -> Tensor {
    let mean = colour.reshape([2, 4, 3]).mean_dim([1i64].as_slice(), false, Kind::Double);
    (mean - target).square().mean(Kind::Double)
}

/// Compares the loss, every parameter's gradient, and all parameters after three steps of Adam.
#[test]
fn gradients_and_three_steps_match_pytorch_in_f64() {
    let (field, batch, draws) = small_case();
    let options = MlpTraining {
        rays: 1,
        max_rays_per_step: 8,
        learning_rate: 5e-4,
        learning_rate_decay: 1.0,
        epochs: 20,
        density_noise_std: 0.0,
        seed: 0,
    };
    let mut trainer = MlpTrainer::new(field, options).unwrap();
    let target = draw(6, &[2, 3]);
    for step in 0..3 {
        let output = trainer.field().forward(&batch, Some(&draws)).unwrap();
        let loss =
            image_loss(&output.coarse.colour, &target) + image_loss(&output.fine.colour, &target);
        let parameters: Vec<Tensor> = trainer.field().parameters().collect();
        let gradients = Tensor::run_backward(&[&loss], &parameters, false, false);
        if step == 0 {
            assert_close("loss", &loss.reshape([1]), 1e-9);
            assert_close("gradient", &flat(&gradients), 1e-7);
        }
        trainer.apply_gradients(&gradients, 0.0).unwrap();
    }
    assert_close("parameters", &flat(&trainer.field().parameters().collect::<Vec<_>>()), 1e-9);
}
