use std::path::Path;

use tch::{Kind, TchError, Tensor, no_grad};

use crate::weights::{Weights, WeightsError, write};

/// Adam as PyTorch has it (Kingma and Ba 2015): β 0.9 and 0.999, ε 1e-8. Gradients are given, not
/// kept by the parameters, so that whoever makes them in parts can add them in an order of its own.
#[derive(Debug)]
pub struct Adam {
    first: Vec<Tensor>,
    second: Vec<Tensor>,
    updates: u64,
}

impl Adam {
    /// For parameters that haven't been trained.
    pub fn new(parameters: impl Iterator<Item = Tensor>) -> Result<Self, TchError> {
        let first = parameters
            .map(|p| p.f_zeros_like()?.f_detach())
            .collect::<Result<Vec<_>, TchError>>()?;
        let second = first.iter().map(Tensor::f_zeros_like).collect::<Result<_, _>>()?;
        Ok(Self { first, second, updates: 0 })
    }

    /// Steps taken.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// Takes a step.
    pub fn step(
        &mut self,
        parameters: impl Iterator<Item = Tensor>,
        gradients: &[Tensor],
        rate: f64,
    ) -> Result<(), TchError> {
        self.updates += 1;
        let t = i32::try_from(self.updates).unwrap_or(i32::MAX);
        let (one, two) = (1.0 - 0.9f64.powi(t), (1.0 - 0.999f64.powi(t)).sqrt());
        let moments = self.first.iter_mut().zip(&mut self.second);
        no_grad(|| {
            for ((mut parameter, g), (first, second)) in parameters.zip(gradients).zip(moments) {
                let _ = first.f_mul_scalar_(0.9)?.f_add_(&g.f_mul_scalar(0.1)?)?;
                let _ = second.f_mul_scalar_(0.999)?.f_addcmul_(g, &g.f_mul_scalar(0.001)?)?;
                let size = second.f_sqrt()?.f_div_scalar(two)?.f_add_scalar(1e-8)?;
                let _ = parameter.f_add_(&first.f_div(&size)?.f_mul_scalar(-rate / one)?)?;
            }
            Ok(())
        })
    }

    /// Writes all that a training needs to go on: a network's tensors by name, the moments of those
    /// that are learnt, and what the training itself counts. The caller makes it atomic.
    pub fn write_checkpoint(
        &self,
        path: &Path,
        network: Vec<(String, Tensor)>,
        counts: &[u64],
    ) -> Result<(), WeightsError> {
        let learnt = learnt(&network);
        let (first, second) =
            (moments(&learnt, "first", &self.first), moments(&learnt, "second", &self.second));
        let counts: Vec<i64> = counts.iter().chain([&self.updates]).map(|&c| c as i64).collect();
        let all: Vec<_> = network
            .into_iter()
            .chain(first)
            .chain(second)
            .chain([(COUNTS.to_owned(), Tensor::from_slice(&counts))])
            .collect();
        write(path, &all)
    }

    /// Goes on from such a checkpoint: the network's tensors get its values; returned are the
    /// optimiser and what was counted. Nothing changes where one of them can't be had.
    pub fn resume<const N: usize>(
        path: &Path,
        network: &[(String, Tensor)],
    ) -> Result<(Self, [u64; N]), WeightsError> {
        let weights = Weights::read(path)?;
        let (counts, updates) = counts(&weights)?;
        let learnt = learnt(network);
        let (first, second) =
            (read(&weights, "first", &learnt)?, read(&weights, "second", &learnt)?);
        let adam = Self { first, second, updates };
        let saved = network
            .iter()
            .map(|(name, tensor)| weights.tensor(name, &tensor.size()))
            .collect::<Result<Vec<_>, _>>()?;
        no_grad(|| {
            network.iter().zip(&saved).for_each(|((_, to), from)| to.shallow_clone().copy_(from));
        });
        Ok((adam, counts))
    }

    /// What a training had counted at a checkpoint.
    pub fn counts_of_checkpoint<const N: usize>(path: &Path) -> Result<[u64; N], WeightsError> {
        Ok(counts(&Weights::read(path)?)?.0)
    }
}

/// Name of what is counted, the optimiser's steps last.
const COUNTS: &str = "counts";

fn counts<const N: usize>(weights: &Weights) -> Result<([u64; N], u64), WeightsError> {
    let all = weights.integers(COUNTS, N + 1)?;
    Ok((std::array::from_fn(|i| all[i] as u64), all[N] as u64))
}

/// Moments of a kind by the names of what is learnt.
fn moments(learnt: &[(String, Tensor)], kind: &str, of: &[Tensor]) -> Vec<(String, Tensor)> {
    let moments = learnt.iter().zip(of);
    moments.map(|((name, _), t)| (format!("{kind}.{name}"), t.shallow_clone())).collect()
}

/// What [`moments`] named, on the devices of what is learnt.
fn read(
    weights: &Weights,
    kind: &str,
    learnt: &[(String, Tensor)],
) -> Result<Vec<Tensor>, WeightsError> {
    let mut moments = Vec::with_capacity(learnt.len());
    for (name, like) in learnt {
        let moment = weights.tensor(&format!("{kind}.{name}"), &like.size())?;
        moments.push(moment.to_device(like.device()));
    }
    Ok(moments)
}

/// The tensors that are learnt.
fn learnt(network: &[(String, Tensor)]) -> Vec<(String, Tensor)> {
    let learnt = network.iter().filter(|(_, tensor)| tensor.requires_grad());
    learnt.map(|(name, tensor)| (name.clone(), tensor.shallow_clone())).collect()
}

/// Whether all numbers of all tensors are finite.
pub fn all_finite(tensors: &[Tensor]) -> Result<bool, TchError> {
    for tensor in tensors {
        // The sum of finite numbers may overflow, but then they are no good either.
        if !tensor.f_sum(Kind::Double)?.f_double_value(&[])?.is_finite() {
            return Ok(false);
        }
    }
    Ok(true)
}
