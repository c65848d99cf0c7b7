use std::path::Path;

use tch::{Device, Kind, TchError, Tensor, no_grad};

use crate::{Weights, WeightsError};

/// Adam as PyTorch has it (Kingma and Ba 2015): β 0.9 and 0.999, ε 1e-8. Gradients are given, not kept by the parameters, so that
/// whoever makes them in parts can add them in an order of its own.
#[derive(Debug)]
pub struct Adam {
    first: Vec<Tensor>,
    second: Vec<Tensor>,
    updates: u64,
}

impl Adam {
    /// For parameters that haven't been trained.
    pub fn new(parameters: impl Iterator<Item = Tensor>) -> Result<Self, TchError> {
        let first = parameters.map(|p| p.f_zeros_like()?.f_detach()).collect::<Result<Vec<_>, TchError>>()?;
        let second = first.iter().map(Tensor::f_zeros_like).collect::<Result<_, _>>()?;
        Ok(Self { first, second, updates: 0 })
    }

    /// Steps taken.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// Takes a step.
    pub fn step(&mut self, parameters: impl Iterator<Item = Tensor>, gradients: &[Tensor], rate: f64) -> Result<(), TchError> {
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

    /// The moments by the parameters' names, for a checkpoint.
    pub fn named<'a>(&'a self, names: &'a [String]) -> impl Iterator<Item = (String, Tensor)> + 'a {
        [("first", &self.first), ("second", &self.second)].into_iter().flat_map(move |(kind, moments)| {
            names.iter().zip(moments).map(move |(name, t)| (format!("{kind}.{name}"), t.shallow_clone()))
        })
    }

    /// Goes on from a checkpoint that [`Adam::named`] went into; `parameters` are names and shapes.
    pub fn read(
        weights: &Weights,
        parameters: &[(String, Vec<i64>)],
        updates: u64,
        device: Device,
    ) -> Result<Self, WeightsError> {
        let read = |kind: &str| -> Result<Vec<Tensor>, WeightsError> {
            let moment =
                |(name, shape): &(String, Vec<i64>)| Ok(weights.tensor(&format!("{kind}.{name}"), shape)?.to_device(device));
            parameters.iter().map(moment).collect()
        };
        Ok(Self { first: read("first")?, second: read("second")?, updates })
    }

    /// Writes a network's tensors by name and, of those that are learnt, the moments: all that a training needs to go on whose steps are the
    /// optimiser's. The caller makes it atomic.
    pub fn write_checkpoint(&self, path: &Path, network: Vec<(String, Tensor)>) -> Result<(), WeightsError> {
        let learnt: Vec<String> = learnt(&network).map(|(name, _)| name).collect();
        let updates = (UPDATES.to_owned(), Tensor::from_slice(&[self.updates as i64]));
        let all: Vec<_> = network.into_iter().chain(self.named(&learnt)).chain([updates]).collect();
        crate::write(path, &all)
    }

    /// Goes on from such a checkpoint: the network's tensors get its values. Nothing changes where one can't be had.
    pub fn resume(path: &Path, network: &[(String, Tensor)]) -> Result<Self, WeightsError> {
        let weights = Weights::read(path)?;
        let updates = weights.integers(UPDATES, 1)?[0] as u64;
        let adam = Self::read(&weights, &learnt(network).collect::<Vec<_>>(), updates, Device::Cpu)?;
        let saved = network.iter().map(|(name, tensor)| weights.tensor(name, &tensor.size())).collect::<Result<Vec<_>, _>>()?;
        no_grad(|| network.iter().zip(&saved).for_each(|((_, to), from)| to.shallow_clone().copy_(from)));
        Ok(adam)
    }
}

/// Name of the number of steps in a checkpoint.
const UPDATES: &str = "updates";

/// Names and shapes of the tensors that are learnt.
fn learnt(network: &[(String, Tensor)]) -> impl Iterator<Item = (String, Vec<i64>)> {
    network.iter().filter(|(_, tensor)| tensor.requires_grad()).map(|(name, tensor)| (name.clone(), tensor.size()))
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
