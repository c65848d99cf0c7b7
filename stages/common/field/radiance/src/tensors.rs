use std::path::{Path, PathBuf};

use bytemuck::Pod;
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};

/// Error returned when a field or checkpoint can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FieldError {
    /// The file can't be read or written.
    #[error("{path}: {source}")]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file's content is neither a field nor a checkpoint.
    #[error("{path}: {reason}")]
    Format {
        /// Path of the file.
        path: PathBuf,
        /// Reason, as a sentence fragment.
        reason: String,
    },
}

// Files are little-endian, and so are numbers in memory.
const _: () = assert!(cfg!(target_endian = "little"));

/// Vector to write: name, element type and bytes.
pub(crate) type Tensor<'a> = (&'a str, Dtype, &'a [u8]);

/// Creates a tensor of floats.
pub(crate) fn floats<'a>(name: &'a str, data: &'a [f32]) -> Tensor<'a> {
    (name, Dtype::F32, bytemuck::cast_slice(data))
}

/// Writes a safetensors file.
pub(crate) fn write_tensors(path: &Path, tensors: &[Tensor<'_>]) -> Result<(), FieldError> {
    serialize(tensors)
        .map_err(std::io::Error::other)
        .and_then(|bytes| std::fs::write(path, bytes))
        .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })
}

fn serialize(tensors: &[Tensor<'_>]) -> Result<Vec<u8>, SafeTensorError> {
    let mut views = Vec::with_capacity(tensors.len());
    for &(name, kind, bytes) in tensors {
        let shape = vec![8 * bytes.len() / kind.bitsize()];
        views.push((name, TensorView::new(kind, shape, bytes)?));
    }
    safetensors::serialize(views, None)
}

/// Opens a safetensors file and reads it by `read`, whose error is a reason; errors name the file.
pub(crate) fn read_tensors<T>(
    path: &Path,
    read: impl FnOnce(&SafeTensors<'_>) -> Result<T, String>,
) -> Result<T, FieldError> {
    let bytes = std::fs::read(path)
        .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })?;
    SafeTensors::deserialize(&bytes)
        .map_err(|problem| problem.to_string())
        .and_then(|tensors| read(&tensors))
        .map_err(|reason| FieldError::Format { path: path.to_path_buf(), reason })
}

/// Reads a tensor of type `kind`, that of `T`, with as many elements as `into`.
pub(crate) fn read_tensor<T: Pod>(
    tensors: &SafeTensors<'_>,
    name: &str,
    kind: Dtype,
    into: &mut [T],
) -> Result<(), String> {
    let tensor = tensors.tensor(name).map_err(|problem| format!("tensor {name}: {problem}"))?;
    let (count, bytes) = (into.len(), bytemuck::cast_slice_mut(into));
    if tensor.dtype() != kind || tensor.data().len() != bytes.len() {
        let (found, shape) = (tensor.dtype(), tensor.shape());
        return Err(format!("tensor {name}: expected {count} {kind:?}, found {found:?} {shape:?}"));
    }
    bytes.copy_from_slice(tensor.data());
    Ok(())
}
