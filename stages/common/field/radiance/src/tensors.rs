use std::borrow::Cow;
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView, View};

use crate::architecture::OutOfRange;

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
        /// Reason.
        reason: FieldProblem,
    },
}

/// Reason why a field's file can't be used.
#[derive(Debug, thiserror::Error)]
pub enum FieldProblem {
    /// The file doesn't contain tensors.
    #[error(transparent)]
    NotTensors(#[from] SafeTensorError),
    /// A size is out of range.
    #[error(transparent)]
    Architecture(#[from] OutOfRange),
    /// The bounds or a tensor can't be used.
    #[error("{0}")]
    Unusable(String),
}

/// Vector to write. Its bytes are created only when they are appended to the file's buffer, so that
/// at most one vector is copied besides that buffer.
pub(crate) struct Tensor<'a> {
    data: TensorData<'a>,
    shape: [usize; 1],
}

enum TensorData<'a> {
    F32(&'a [f32]),
    U32(&'a [u32]),
    U8(&'a [u8]),
}

impl<'a> Tensor<'a> {
    pub(crate) fn of_floats(data: &'a [f32]) -> Self {
        Self { data: TensorData::F32(data), shape: [data.len()] }
    }

    pub(crate) fn of_integers(data: &'a [u32]) -> Self {
        Self { data: TensorData::U32(data), shape: [data.len()] }
    }

    pub(crate) fn of_bytes(data: &'a [u8]) -> Self {
        Self { data: TensorData::U8(data), shape: [data.len()] }
    }
}

impl View for &Tensor<'_> {
    fn dtype(&self) -> Dtype {
        match self.data {
            TensorData::F32(_) => Dtype::F32,
            TensorData::U32(_) => Dtype::U32,
            TensorData::U8(_) => Dtype::U8,
        }
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        match self.data {
            TensorData::F32(floats) => {
                Cow::Owned(floats.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            TensorData::U32(integers) => {
                Cow::Owned(integers.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            TensorData::U8(bytes) => Cow::Borrowed(bytes),
        }
    }

    fn data_len(&self) -> usize {
        self.shape[0] * self.dtype().bitsize() / 8
    }
}

/// Writes a safetensors file.
pub(crate) fn write_tensors(path: &Path, tensors: &[(&str, Tensor<'_>)]) -> Result<(), FieldError> {
    safetensors::serialize(tensors.iter().map(|(name, tensor)| (*name, tensor)), None)
        .map_err(|e| std::io::Error::other(e.to_string()))
        .and_then(|bytes| std::fs::write(path, bytes))
        .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })
}

/// Opens a safetensors file and reads it by `read`; errors name the file.
pub(crate) fn read_tensors<T>(
    path: &Path,
    read: impl FnOnce(&SafeTensors<'_>) -> Result<T, FieldProblem>,
) -> Result<T, FieldError> {
    let bytes = std::fs::read(path)
        .map_err(|source| FieldError::Io { path: path.to_path_buf(), source })?;
    SafeTensors::deserialize(&bytes)
        .map_err(FieldProblem::from)
        .and_then(|tensors| read(&tensors))
        .map_err(|reason| FieldError::Format { path: path.to_path_buf(), reason })
}

/// Reads a tensor of as many floats as `into` has.
pub(crate) fn read_f32(
    tensors: &SafeTensors<'_>,
    name: &str,
    into: &mut [f32],
) -> Result<(), FieldProblem> {
    read_elements(tensors, name, Dtype::F32, into, f32::from_le_bytes)
}

/// Reads a tensor of as many integers as `into` has.
pub(crate) fn read_u32(
    tensors: &SafeTensors<'_>,
    name: &str,
    into: &mut [u32],
) -> Result<(), FieldProblem> {
    read_elements(tensors, name, Dtype::U32, into, u32::from_le_bytes)
}

/// Reads a tensor of elements of 32 bits.
fn read_elements<T>(
    tensors: &SafeTensors<'_>,
    name: &str,
    kind: Dtype,
    into: &mut [T],
    convert: impl Fn([u8; 4]) -> T,
) -> Result<(), FieldProblem> {
    let tensor = find_tensor(tensors, name)?;
    let (data, rest) = tensor.data().as_chunks::<4>();
    if tensor.dtype() != kind || data.len() != into.len() || !rest.is_empty() {
        return Err(unexpected_tensor(&tensor, name, into.len(), kind));
    }
    for (value, bytes) in into.iter_mut().zip(data) {
        *value = convert(*bytes);
    }
    Ok(())
}

/// Reads a tensor of `len` bytes.
pub(crate) fn read_u8(
    tensors: &SafeTensors<'_>,
    name: &str,
    len: usize,
) -> Result<Vec<u8>, FieldProblem> {
    let tensor = find_tensor(tensors, name)?;
    if tensor.dtype() != Dtype::U8 || tensor.data().len() != len {
        return Err(unexpected_tensor(&tensor, name, len, Dtype::U8));
    }
    Ok(tensor.data().to_vec())
}

fn find_tensor<'a>(tensors: &SafeTensors<'a>, name: &str) -> Result<TensorView<'a>, FieldProblem> {
    tensors
        .tensor(name)
        .map_err(|problem| FieldProblem::Unusable(format!("tensor {name}: {problem}")))
}

fn unexpected_tensor(
    tensor: &TensorView<'_>,
    name: &str,
    count: usize,
    expected: Dtype,
) -> FieldProblem {
    let (found, shape) = (tensor.dtype(), tensor.shape());
    FieldProblem::Unusable(format!(
        "tensor {name}: expected {count} {expected:?}, found {found:?} {shape:?}"
    ))
}
