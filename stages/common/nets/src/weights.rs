use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use tch::{Device, Kind, TchError, Tensor};

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

/// The tensors of a safetensors file, in f32, i64 or u8 on the CPU.
#[derive(Debug)]
pub struct Weights {
    path: PathBuf,
    tensors: BTreeMap<String, Tensor>,
}

impl Weights {
    /// Reads a file of f32, f16, i64 or u8 tensors.
    pub fn read(path: &Path) -> Result<Self, WeightsError> {
        let format = |reason: String| WeightsError::Format { path: path.to_path_buf(), reason };
        let bytes = std::fs::read(path)
            .map_err(|source| WeightsError::Io { path: path.to_path_buf(), source })?;
        let file = SafeTensors::deserialize(&bytes).map_err(|e| format(e.to_string()))?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.tensors() {
            let shape: Vec<i64> = view.shape().iter().map(|&d| d as i64).collect();
            let kind = match view.dtype() {
                Dtype::F32 => Kind::Float,
                Dtype::F16 => Kind::Half,
                Dtype::I64 => Kind::Int64,
                Dtype::U8 => Kind::Uint8,
                other => {
                    return Err(format(format!(
                        "tensor {name} is {other:?}; f32, f16, i64 or u8 is expected"
                    )));
                }
            };
            let tensor = Tensor::from_data_size(view.data(), &shape, kind);
            tensors.insert(
                name,
                if kind == Kind::Half { tensor.to_kind(Kind::Float) } else { tensor },
            );
        }
        Ok(Self { path: path.to_path_buf(), tensors })
    }

    /// Whole numbers, of which there must be so many.
    pub fn integers(&self, name: &str, count: usize) -> Result<Vec<i64>, WeightsError> {
        let integers = self
            .tensors
            .get(name)
            .filter(|t| t.kind() == Kind::Int64)
            .and_then(|t| Vec::<i64>::try_from(t).ok());
        integers.filter(|i| i.len() == count).ok_or_else(|| WeightsError::Format {
            path: self.path.clone(),
            reason: format!("no tensor {name} of {count} whole numbers"),
        })
    }

    /// Bytes, of which there must be so many.
    pub fn bytes(&self, name: &str, count: i64) -> Result<Tensor, WeightsError> {
        let bytes =
            self.tensors.get(name).filter(|t| t.kind() == Kind::Uint8 && t.size() == [count]);
        bytes.map(Tensor::shallow_clone).ok_or_else(|| WeightsError::Format {
            path: self.path.clone(),
            reason: format!("no tensor {name} of {count} bytes"),
        })
    }

    /// Whether there is a tensor of that name.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// The shape of a tensor that must have so many dimensions: for networks whose size is what
    /// their file says.
    pub fn shape<const N: usize>(&self, name: &str) -> Result<[i64; N], WeightsError> {
        let format = |reason: String| WeightsError::Format { path: self.path.clone(), reason };
        let size =
            self.tensors.get(name).ok_or_else(|| format(format!("no tensor {name}")))?.size();
        size.as_slice().try_into().map_err(|_| {
            format(format!("tensor {name} is {size:?} where {N} dimensions are expected"))
        })
    }

    /// A tensor of floats that must have a shape.
    pub fn tensor(&self, name: &str, shape: &[i64]) -> Result<Tensor, WeightsError> {
        let format = |reason: String| WeightsError::Format { path: self.path.clone(), reason };
        let tensor = self.tensors.get(name).filter(|t| t.kind() == Kind::Float);
        let tensor = tensor.ok_or_else(|| format(format!("no tensor {name}")))?;
        if tensor.size() != shape {
            return Err(format(format!(
                "tensor {name} is {:?} where {shape:?} is expected",
                tensor.size()
            )));
        }
        Ok(tensor.shallow_clone())
    }
}

/// Writes tensors of f32, i64 or u8, by name, as safetensors without metadata, so that bytes
/// repeat.
pub fn write(path: &Path, tensors: &[(String, Tensor)]) -> Result<(), WeightsError> {
    let io = |source| WeightsError::Io { path: path.to_path_buf(), source };
    let refused = |e: TchError| io(std::io::Error::other(e.to_string()));
    let mut bytes = Vec::with_capacity(tensors.len());
    for (name, tensor) in tensors {
        let dtype = match tensor.kind() {
            Kind::Int64 => Dtype::I64,
            Kind::Uint8 => Dtype::U8,
            _ => Dtype::F32,
        };
        let flat = tensor
            .f_detach()
            .and_then(|t| t.f_to_device(Device::Cpu)?.f_contiguous())
            .map_err(refused)?;
        let mut data = vec![0u8; flat.numel() * flat.kind().elt_size_in_bytes()];
        flat.f_copy_data_u8(&mut data, flat.numel()).map_err(refused)?;
        bytes.push((
            name.as_str(),
            dtype,
            tensor.size().iter().map(|&d| d as usize).collect::<Vec<_>>(),
            data,
        ));
    }
    let views = bytes.iter().map(|(name, dtype, shape, data)| {
        (
            *name,
            TensorView::new(*dtype, shape.clone(), data).expect("the data is that of the shape"),
        )
    });
    let whole = safetensors::serialize(views, None)
        .map_err(|e| io(std::io::Error::other(e.to_string())))?;
    std::fs::write(path, whole).map_err(io)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let path = tempfile::tempdir().unwrap().keep().join("w.safetensors");
        let (a, b) =
            (Tensor::from_slice(&[1.5f32, -2.0]).reshape([2, 1]), Tensor::from_slice(&[3i64, -1]));
        write(&path, &[("a".to_owned(), a.shallow_clone()), ("b".to_owned(), b)]).unwrap();
        let weights = Weights::read(&path).unwrap();
        assert_eq!(weights.tensor("a", &[2, 1]).unwrap(), a);
        assert_eq!(weights.integers("b", 2).unwrap(), [3, -1]);
        assert!(
            weights.tensor("b", &[2]).is_err()
                && weights.integers("a", 2).is_err()
                && weights.integers("b", 3).is_err()
        );
    }

    #[test]
    fn names_and_shapes_are_checked() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.safetensors");
        let data: Vec<u8> = (0..6).flat_map(|i| (i as f32).to_le_bytes()).collect();
        let view = safetensors::tensor::TensorView::new(Dtype::F32, vec![2, 3], &data).unwrap();
        std::fs::write(&path, safetensors::serialize([("a", view)], None).unwrap()).unwrap();
        let weights = Weights::read(&path).unwrap();
        assert_eq!(
            f64::try_from(weights.tensor("a", &[2, 3]).unwrap().sum(Kind::Double)).unwrap(),
            15.0
        );
        assert!(weights.tensor("a", &[3, 2]).unwrap_err().to_string().contains("[2, 3]"));
        assert!(weights.tensor("b", &[1]).is_err());
        assert_eq!(weights.shape::<2>("a").unwrap(), [2, 3]);
        assert!(
            weights.shape::<3>("a").is_err()
                && weights.shape::<1>("b").is_err()
                && weights.has("a")
                && !weights.has("b")
        );
        std::fs::write(&path, b"not safetensors").unwrap();
        assert!(Weights::read(&path).is_err());
    }
}
