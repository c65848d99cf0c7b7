use std::path::Path;

use nets::Weights;
use tch::Tensor;

use crate::error::RefinementError;
use crate::refiner::Refiner;

/// Adam (Kingma and Ba 2015) with PyTorch's defaults: β 0.9 and 0.999, ε 1e-8. `nets::Adam` makes
/// about ten libtorch calls per parameter, which take a tenth of a step's time because the network
/// is small.
#[derive(Debug)]
pub(crate) struct Adam {
    /// First and second moments of each parameter.
    moments: Vec<[Vec<f32>; 2]>,
    updates: u64,
}

const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f32 = 1e-8;
/// Name of the number of updates in a checkpoint, as in those of `nets::Adam`.
const UPDATES: &str = "counts";
/// Prefixes of a parameter's moments in a checkpoint.
const MOMENTS: [&str; 2] = ["first", "second"];

impl Adam {
    /// Creates an optimiser with zero moments.
    pub(crate) fn new(refiner: &Refiner) -> Self {
        let zeros = |parameter: &Vec<f32>| [vec![0.0; parameter.len()], vec![0.0; parameter.len()]];
        Self { moments: refiner.parameters.iter().map(zeros).collect(), updates: 0 }
    }

    /// Returns the number of steps taken.
    pub(crate) fn steps_taken(&self) -> u64 {
        self.updates
    }

    /// Updates the parameters by one step.
    pub(crate) fn step(&mut self, refiner: &mut Refiner, gradients: &[Vec<f32>], rate: f64) {
        self.updates += 1;
        let t = i32::try_from(self.updates).unwrap_or(i32::MAX);
        let [beta1, beta2] = BETA.map(|beta| beta as f32);
        let [one_minus_beta1, one_minus_beta2] = BETA.map(|beta| (1.0 - beta) as f32);
        let corrections = BETA.map(|beta| 1.0 - beta.powi(t));
        let rate = (rate / corrections[0]) as f32;
        let sqrt_correction = corrections[1].sqrt() as f32;
        for (i, [first, second]) in self.moments.iter_mut().enumerate() {
            let parameter = refiner.parameters[i].iter_mut().zip(&gradients[i]);
            for ((p, g), (m, v)) in parameter.zip(first.iter_mut().zip(second)) {
                *m = beta1 * *m + one_minus_beta1 * g;
                *v = beta2 * *v + one_minus_beta2 * g * g;
                *p -= rate * *m / (v.sqrt() / sqrt_correction + EPSILON);
            }
        }
    }

    /// Writes a checkpoint of the refiner and of this optimiser.
    pub(crate) fn write_checkpoint(
        &self,
        refiner: &Refiner,
        path: &Path,
    ) -> Result<(), RefinementError> {
        let mut tensors = refiner.named_parameters()?;
        let names: Vec<String> = tensors.iter().map(|(name, _)| name.clone()).collect();
        for (kind, prefix) in MOMENTS.iter().enumerate() {
            for (name, moments) in names.iter().zip(&self.moments) {
                let moment = Tensor::f_from_slice(&moments[kind])?;
                tensors.push((format!("{prefix}.{name}"), moment));
            }
        }
        tensors.push((UPDATES.to_owned(), Tensor::f_from_slice(&[self.updates as i64])?));
        Ok(nets::write(path, &tensors)?)
    }

    /// Reads a refiner of this architecture and its optimiser from a checkpoint.
    pub(crate) fn resume(
        path: &Path,
        refiner: &Refiner,
    ) -> Result<(Refiner, Self), RefinementError> {
        let weights = Weights::read(path)?;
        let updates = weights.integers(UPDATES, 1)?[0] as u64;
        let mut moments = Vec::with_capacity(refiner.parameters.len());
        for ((name, _), parameter) in refiner.named_parameters()?.iter().zip(&refiner.parameters) {
            let read = |prefix: &str| -> Result<Vec<f32>, RefinementError> {
                let shape = [parameter.len() as i64];
                let moment = weights.tensor(&format!("{prefix}.{name}"), &shape)?;
                Ok(Vec::<f32>::try_from(moment)?)
            };
            moments.push([read(MOMENTS[0])?, read(MOMENTS[1])?]);
        }
        let refiner = Refiner::from_weights(&weights, refiner.architecture())?;
        Ok((refiner, Self { moments, updates }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::refiner::RefinerArchitecture;

    fn gradients(refiner: &Refiner, step: usize) -> Vec<Vec<f32>> {
        let gradient = |i: usize| ((i * (step + 3)) % 17) as f32 / 8.0 - 1.0;
        let parameters = refiner.parameters.iter();
        parameters.map(|parameter| (0..parameter.len()).map(gradient).collect()).collect()
    }

    /// Steps equal those of `nets::Adam`, which is tested against PyTorch.
    #[test]
    fn steps_are_those_of_libtorch() -> Result<(), RefinementError> {
        let architecture = RefinerArchitecture { channels: 6, blocks: 1, guidance: None };
        let mut refiner = Refiner::new(architecture, 5);
        let mut adam = Adam::new(&refiner);
        let tensors: Vec<Tensor> =
            refiner.named_parameters()?.into_iter().map(|(_, tensor)| tensor).collect();
        let parameters = || tensors.iter().map(Tensor::shallow_clone);
        let mut expected = nets::Adam::new(parameters())?;
        for step in 0..20 {
            let gradients = gradients(&refiner, step);
            adam.step(&mut refiner, &gradients, 1e-2);
            let shaped: Vec<Tensor> = gradients
                .iter()
                .zip(&tensors)
                .map(|(gradient, tensor)| Tensor::from_slice(gradient).reshape(tensor.size()))
                .collect();
            expected.step(parameters(), &shaped, 1e-2)?;
        }
        for ((name, found), expected) in refiner.named_parameters()?.iter().zip(&tensors) {
            let difference = (found - expected).abs().max().double_value(&[]);
            assert!(difference < 1e-6, "{name}: {difference}");
        }
        Ok(())
    }
}
