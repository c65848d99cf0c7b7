//! libtorch glue that stages with networks share: determinism and weights. The networks themselves live where they are used.
//!
//! * [`deterministic`]: one intra-op thread; stages work in parallel over images instead, so bytes don't depend on threads.
//! * [`Weights`]: tensors of a safetensors file, by name, each with the shape it must have.
//!
//! ```no_run,standalone_crate
//! nets::deterministic();
//! let weights = nets::Weights::read("squeezenet1_1.safetensors".as_ref())?;
//! let kernel = weights.tensor("features.0.weight", &[64, 3, 3, 3])?;
//! # Ok::<(), nets::WeightsError>(())
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};
use tch::{Kind, Tensor};

/// Makes libtorch repeat its bytes: sums are split by thread, so it gets one.
pub fn deterministic() {
    tch::set_num_threads(1);
}

/// Weights that can't be used.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file can't be opened.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file isn't safetensors, or its tensors aren't those of the network.
    #[error("{path}: {reason}; is it the right network's weights?")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

/// The tensors of a safetensors file, in f32 on the CPU.
#[derive(Debug)]
pub struct Weights {
    path: PathBuf,
    tensors: BTreeMap<String, Tensor>,
}

impl Weights {
    /// Reads a file of f32 or f16 tensors.
    pub fn read(path: &Path) -> Result<Self, WeightsError> {
        let format = |reason: String| WeightsError::Format { path: path.to_path_buf(), reason };
        let bytes = std::fs::read(path).map_err(|source| WeightsError::Io { path: path.to_path_buf(), source })?;
        let file = SafeTensors::deserialize(&bytes).map_err(|e| format(e.to_string()))?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.tensors() {
            let shape: Vec<i64> = view.shape().iter().map(|&d| d as i64).collect();
            let kind = match view.dtype() {
                Dtype::F32 => Kind::Float,
                Dtype::F16 => Kind::Half,
                other => return Err(format(format!("tensor {name} is {other:?}; f32 or f16 is expected"))),
            };
            tensors.insert(name, Tensor::from_data_size(view.data(), &shape, kind).to_kind(Kind::Float));
        }
        Ok(Self { path: path.to_path_buf(), tensors })
    }

    /// A tensor that must have a shape.
    pub fn tensor(&self, name: &str, shape: &[i64]) -> Result<Tensor, WeightsError> {
        let format = |reason: String| WeightsError::Format { path: self.path.clone(), reason };
        let tensor = self.tensors.get(name).ok_or_else(|| format(format!("no tensor {name}")))?;
        if tensor.size() != shape {
            return Err(format(format!("tensor {name} is {:?} where {shape:?} is expected", tensor.size())));
        }
        Ok(tensor.shallow_clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_shapes_are_checked() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.safetensors");
        let data: Vec<u8> = (0..6).flat_map(|i| (i as f32).to_le_bytes()).collect();
        let view = safetensors::tensor::TensorView::new(Dtype::F32, vec![2, 3], &data).unwrap();
        std::fs::write(&path, safetensors::serialize([("a", view)], None).unwrap()).unwrap();
        let weights = Weights::read(&path).unwrap();
        assert_eq!(f64::try_from(weights.tensor("a", &[2, 3]).unwrap().sum(Kind::Double)).unwrap(), 15.0);
        assert!(weights.tensor("a", &[3, 2]).unwrap_err().to_string().contains("[2, 3]"));
        assert!(weights.tensor("b", &[1]).is_err());
        std::fs::write(&path, b"not safetensors").unwrap();
        assert!(Weights::read(&path).is_err());
    }
}
