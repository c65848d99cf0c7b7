use std::path::Path;

use artifact::Failure;
use nets::WeightsError;
use refinement::{KnownView, RefinementError};

/// A trainer and the examples on which it trains its network.
pub(crate) struct ExampleTraining<'a, T> {
    pub(crate) trainer: T,
    pub(crate) examples: &'a [KnownView],
}

impl<T: refinement::Training> stage::Training for ExampleTraining<'_, T> {
    fn steps(&self) -> u64 {
        self.trainer.steps()
    }

    fn step(&mut self) -> anyhow::Result<Option<f64>> {
        self.trainer.step(self.examples).map_err(training_failure)
    }

    fn write_checkpoint(&self, path: &Path) -> anyhow::Result<()> {
        self.trainer.write_checkpoint(path).map_err(training_failure)
    }

    fn resume(&mut self, path: &Path) -> anyhow::Result<()> {
        Ok(self.trainer.resume(path)?)
    }
}

/// Converts the failure of a training: numbers that aren't finite are a numerical failure.
pub(crate) fn training_failure(error: RefinementError) -> anyhow::Error {
    match error {
        RefinementError::NotFinite { .. }
        | RefinementError::Weights(WeightsError::NotFinite { .. }) => {
            Failure::Numerical(error.to_string()).into()
        }
        error => error.into(),
    }
}

#[cfg(test)]
mod tests {
    use artifact::exit_code;

    use super::*;

    #[test]
    fn numbers_that_are_not_finite_are_a_numerical_failure() {
        let unusable = RefinementError::Unusable("view r_0: too small".to_owned());
        let weights = WeightsError::NotFinite { path: "w".into(), name: "a".to_owned() };
        for (error, code) in [
            (RefinementError::NotFinite { step: 7 }, 4),
            (RefinementError::Weights(weights), 4),
            (unusable, 1),
        ] {
            let message = error.to_string();
            let failure = training_failure(error);
            assert_eq!((failure.to_string(), exit_code(&failure)), (message, code));
        }
    }
}
