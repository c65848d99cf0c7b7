use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use tch::{Device, Kind, TchError, Tensor};

use crate::adam::all_finite;

/// Error returned when weights can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file can't be opened or written.
    #[error("{path}: {source}")]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// The file isn't safetensors, or its tensors aren't those of the network.
    #[error("{path}: {reason}; check that the weights are those of this network")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Reason, as a sentence fragment.
        reason: String,
    },
    /// A tensor to be written isn't finite.
    #[error("{path}: tensor {name} is not finite; lower the learning rate")]
    NotFinite {
        /// Path of the file.
        path: PathBuf,
        /// Name of the tensor.
        name: String,
    },
    /// A libtorch operation failed.
    #[error("libtorch: {0}")]
    Torch(#[from] TchError),
}

/// Tensors of a safetensors file, in f32, i64 or u8 on the CPU.
#[derive(Debug)]
pub struct Weights {
    path: PathBuf,
    tensors: BTreeMap<String, Tensor>,
}

impl Weights {
    /// Reads a file of f32, f16, i64 or u8 tensors; f16 becomes f32.
    pub fn read(path: &Path) -> Result<Self, WeightsError> {
        let bytes = std::fs::read(path)
            .map_err(|source| WeightsError::Io { path: path.to_path_buf(), source })?;
        let file =
            SafeTensors::deserialize(&bytes).map_err(|e| format_error(path, e.to_string()))?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.tensors() {
            let shape: Vec<i64> = view.shape().iter().map(|&d| d as i64).collect();
            let kind = match view.dtype() {
                Dtype::F32 => Kind::Float,
                Dtype::F16 => Kind::Half,
                Dtype::I64 => Kind::Int64,
                Dtype::U8 => Kind::Uint8,
                other => {
                    let reason =
                        format!("tensor {name}: expected f32, f16, i64 or u8, found {other:?}");
                    return Err(format_error(path, reason));
                }
            };
            let kept_kind = if kind == Kind::Half { Kind::Float } else { kind };
            let tensor = Tensor::from_data_size(view.data(), &shape, kind).to_kind(kept_kind);
            tensors.insert(name, tensor);
        }
        Ok(Self { path: path.to_path_buf(), tensors })
    }

    /// Returns the i64 tensor of this name, which must have `count` elements.
    pub fn integers(&self, name: &str, count: usize) -> Result<Vec<i64>, WeightsError> {
        let tensor = self.tensors.get(name).filter(|t| t.kind() == Kind::Int64);
        let integers =
            tensor.and_then(|t| Vec::<i64>::try_from(t).ok().filter(|i| i.len() == count));
        integers.ok_or_else(|| self.error(format!("no tensor {name} of {count} i64 values")))
    }

    /// Returns the u8 tensor of this name, which must have `count` elements.
    pub fn bytes(&self, name: &str, count: i64) -> Result<Tensor, WeightsError> {
        let bytes = self.tensors.get(name).filter(|t| t.kind() == Kind::Uint8);
        let bytes = bytes.filter(|t| t.size() == [count]).map(Tensor::shallow_clone);
        bytes.ok_or_else(|| self.error(format!("no tensor {name} of {count} bytes")))
    }

    /// Returns whether the file has a tensor of this name.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// Returns the shape of a tensor, which must have `N` dimensions: for networks whose size is
    /// read from their file.
    pub fn shape<const N: usize>(&self, name: &str) -> Result<[i64; N], WeightsError> {
        let tensor = self.tensors.get(name);
        let size = tensor.ok_or_else(|| self.error(format!("no tensor {name}")))?.size();
        size.as_slice().try_into().map_err(|_| {
            self.error(format!("tensor {name}: expected {N} dimensions, found shape {size:?}"))
        })
    }

    /// Returns the f32 tensor of this name, which must have the given shape.
    pub fn tensor(&self, name: &str, shape: &[i64]) -> Result<Tensor, WeightsError> {
        let tensor = self.tensors.get(name).filter(|t| t.kind() == Kind::Float);
        let tensor = tensor.ok_or_else(|| self.error(format!("no f32 tensor {name}")))?;
        let found = tensor.size();
        if found != shape {
            return Err(
                self.error(format!("tensor {name}: expected shape {shape:?}, found {found:?}"))
            );
        }
        Ok(tensor.shallow_clone())
    }

    fn error(&self, reason: String) -> WeightsError {
        format_error(&self.path, reason)
    }
}

fn format_error(path: &Path, reason: String) -> WeightsError {
    WeightsError::Format { path: path.to_path_buf(), reason }
}

/// Writes named tensors of f32, i64 or u8 as safetensors without metadata, so that equal tensors
/// give equal bytes. Fails if a tensor isn't finite.
pub fn write(path: &Path, tensors: &[(String, Tensor)]) -> Result<(), WeightsError> {
    for (name, tensor) in tensors {
        if !all_finite(std::slice::from_ref(tensor))? {
            let (path, name) = (path.to_path_buf(), name.clone());
            return Err(WeightsError::NotFinite { path, name });
        }
    }
    let bytes = serialized(tensors)
        .map_err(std::io::Error::other)
        .and_then(|bytes| std::fs::write(path, bytes));
    bytes.map_err(|source| WeightsError::Io { path: path.to_path_buf(), source })
}

/// Serialises named tensors as safetensors.
fn serialized(
    tensors: &[(String, Tensor)],
) -> Result<Vec<u8>, Box<dyn std::error::Error + Send + Sync>> {
    let mut entries = Vec::with_capacity(tensors.len());
    for (name, tensor) in tensors {
        let dtype = match tensor.kind() {
            Kind::Int64 => Dtype::I64,
            Kind::Uint8 => Dtype::U8,
            Kind::Float => Dtype::F32,
            other => return Err(format!("tensor {name}: cannot write {other:?}").into()),
        };
        let flat = tensor.f_detach()?.f_to_device(Device::Cpu)?.f_contiguous()?;
        let mut data = vec![0u8; flat.numel() * flat.kind().elt_size_in_bytes()];
        flat.f_copy_data_u8(&mut data, flat.numel())?;
        let shape: Vec<usize> = tensor.size().iter().map(|&d| d as usize).collect();
        entries.push((name.as_str(), dtype, shape, data));
    }
    let mut views = Vec::with_capacity(entries.len());
    for (name, dtype, shape, data) in &entries {
        views.push((*name, TensorView::new(*dtype, shape.clone(), data)?));
    }
    Ok(safetensors::serialize(views, None)?)
}

/// A 2-D convolution with zero padding, with PyTorch's names and layout: `NAME.weight` (outputs ×
/// inputs × rows × columns) and `NAME.bias`.
#[derive(Debug)]
pub struct Conv {
    kernel: Tensor,
    bias: Tensor,
}

impl Conv {
    /// Reads the kernel, which must have the given shape, and the bias.
    pub fn read(weights: &Weights, name: &str, shape: [i64; 4]) -> Result<Self, WeightsError> {
        Ok(Self {
            kernel: weights.tensor(&format!("{name}.weight"), &shape)?,
            bias: weights.tensor(&format!("{name}.bias"), &shape[..1])?,
        })
    }

    /// Convolves images (count × inputs × rows × columns).
    pub fn forward(&self, x: &Tensor, stride: i64, padding: i64) -> Result<Tensor, TchError> {
        x.f_conv2d(&self.kernel, Some(&self.bias), [stride; 2], [padding; 2], [1, 1], 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_weights_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
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
    fn tensors_that_are_not_finite_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
        for value in [f32::NAN, f32::INFINITY] {
            let tensors = [("a".to_owned(), Tensor::from_slice(&[1.0, value]))];
            let message = write(&path, &tensors).unwrap_err().to_string();
            assert!(message.contains("tensor a is not finite") && !path.exists(), "{message}");
        }
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
