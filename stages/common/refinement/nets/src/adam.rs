use std::path::Path;

use tch::{Kind, TchError, Tensor, no_grad};

use crate::weights::{Weights, WeightsError, write};

/// Adam with PyTorch's defaults (Kingma and Ba 2015): β 0.9 and 0.999, ε 1e-8. The caller passes
/// the gradients, so that it can sum shards in a fixed order.
#[derive(Debug)]
pub struct Adam {
    first: Vec<Tensor>,
    second: Vec<Tensor>,
    updates: u64,
}

impl Adam {
    /// Creates an optimiser with zero moments for untrained parameters.
    pub fn new(parameters: impl Iterator<Item = Tensor>) -> Result<Self, TchError> {
        let first = parameters
            .map(|p| p.f_zeros_like()?.f_detach())
            .collect::<Result<Vec<_>, TchError>>()?;
        let second = first.iter().map(Tensor::f_zeros_like).collect::<Result<_, _>>()?;
        Ok(Self { first, second, updates: 0 })
    }

    /// Returns the number of steps taken.
    pub fn steps_taken(&self) -> u64 {
        self.updates
    }

    /// Updates the parameters by one step.
    pub fn step(
        &mut self,
        parameters: impl Iterator<Item = Tensor>,
        gradients: &[Tensor],
        learning_rate: f64,
    ) -> Result<(), TchError> {
        self.updates += 1;
        let t = i32::try_from(self.updates).unwrap_or(i32::MAX);
        let bias_correction1 = 1.0 - 0.9f64.powi(t);
        let sqrt_correction2 = (1.0 - 0.999f64.powi(t)).sqrt();
        no_grad(|| {
            for (i, (mut parameter, g)) in parameters.zip(gradients).enumerate() {
                let (first, second) = (&mut self.first[i], &mut self.second[i]);
                let _ = first.f_mul_scalar_(0.9)?.f_add_(&g.f_mul_scalar(0.1)?)?;
                let _ = second.f_mul_scalar_(0.999)?.f_addcmul_(g, &g.f_mul_scalar(0.001)?)?;
                let size = second.f_sqrt()?.f_div_scalar(sqrt_correction2)?.f_add_scalar(1e-8)?;
                let scale = -learning_rate / bias_correction1;
                let _ = parameter.f_add_(&first.f_div(&size)?.f_mul_scalar(scale)?)?;
            }
            Ok(())
        })
    }

    /// Writes a checkpoint: a network's tensors by name, the moments of its trainable tensors, and
    /// the training's own counters. The caller makes the write atomic.
    pub fn write_checkpoint(
        &self,
        path: &Path,
        network: Vec<(String, Tensor)>,
        counts: &[u64],
    ) -> Result<(), WeightsError> {
        let trainable = trainable(&network);
        let counts: Vec<i64> = counts.iter().chain([&self.updates]).map(|&c| c as i64).collect();
        let mut tensors = network;
        for (kind, moments) in [("first", &self.first), ("second", &self.second)] {
            for (i, (name, _)) in trainable.iter().enumerate() {
                tensors.push((format!("{kind}.{name}"), moments[i].shallow_clone()));
            }
        }
        tensors.push((COUNTS.to_owned(), Tensor::from_slice(&counts)));
        write(path, &tensors)
    }

    /// Resumes from a checkpoint: copies its values into the network's tensors, and returns the
    /// optimiser and the training's counters. If any tensor is missing, nothing changes.
    pub fn resume<const N: usize>(
        path: &Path,
        network: &[(String, Tensor)],
    ) -> Result<(Self, [u64; N]), WeightsError> {
        let weights = Weights::read(path)?;
        let (counts, updates) = read_counts(&weights)?;
        let trainable = trainable(network);
        let adam = Self {
            first: read_moments(&weights, "first", &trainable)?,
            second: read_moments(&weights, "second", &trainable)?,
            updates,
        };
        let saved = network
            .iter()
            .map(|(name, tensor)| weights.tensor(name, &tensor.size()))
            .collect::<Result<Vec<_>, _>>()?;
        no_grad(|| {
            for ((_, tensor), saved) in network.iter().zip(&saved) {
                tensor.shallow_clone().copy_(saved);
            }
        });
        Ok((adam, counts))
    }
}

/// Name of the tensor of counters; the optimiser's steps are last.
const COUNTS: &str = "counts";

/// Reads the training's counters and the optimiser's number of steps.
fn read_counts<const N: usize>(weights: &Weights) -> Result<([u64; N], u64), WeightsError> {
    let all = weights.integers(COUNTS, N + 1)?;
    Ok((std::array::from_fn(|i| all[i] as u64), all[N] as u64))
}

/// Reads the `first` or `second` moments of trainable tensors, each on its tensor's device.
fn read_moments(
    weights: &Weights,
    kind: &str,
    trainable: &[(String, Tensor)],
) -> Result<Vec<Tensor>, WeightsError> {
    let mut moments = Vec::with_capacity(trainable.len());
    for (name, tensor) in trainable {
        let moment = weights.tensor(&format!("{kind}.{name}"), &tensor.size())?;
        moments.push(moment.to_device(tensor.device()));
    }
    Ok(moments)
}

/// Returns the tensors that require gradients.
fn trainable(network: &[(String, Tensor)]) -> Vec<(String, Tensor)> {
    let trainable = network.iter().filter(|(_, tensor)| tensor.requires_grad());
    trainable.map(|(name, tensor)| (name.clone(), tensor.shallow_clone())).collect()
}

/// Returns the learning rate of step 0, 1, …: `highest` times a linear warm-up, times a cosine from
/// 1 to 0.
pub fn cosine_rate(highest: f64, step: u64, steps: u64, warm_up_steps: u64) -> f64 {
    let warm_up = ((step + 1) as f64 / warm_up_steps as f64).min(1.0);
    let cosine = 0.5 * (1.0 + libm::cos(std::f64::consts::PI * step as f64 / steps as f64));
    highest * warm_up * cosine
}

/// Adds a shard's gradients to their sum.
pub fn add_gradients(sum: &mut [Tensor], gradients: &[Tensor]) -> Result<(), TchError> {
    no_grad(|| {
        for (sum, gradient) in sum.iter_mut().zip(gradients) {
            let _ = sum.f_add_(gradient)?;
        }
        Ok(())
    })
}

/// Returns whether all elements of all tensors are finite.
pub fn all_finite(tensors: &[Tensor]) -> Result<bool, TchError> {
    for tensor in tensors {
        if !tensor.f_sum(Kind::Double)?.f_double_value(&[])?.is_finite() {
            return Ok(false);
        }
    }
    Ok(true)
}
