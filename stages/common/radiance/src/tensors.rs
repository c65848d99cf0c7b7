use std::borrow::Cow;
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView, View};
use scene::Bounds;

use crate::ranges::OutOfRange;

/// A field that can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FieldError {
    /// The file can't be opened.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file isn't a field.
    #[error("{path}: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: FieldProblem,
    },
}

/// Why a file is neither a field nor a checkpoint.
#[derive(Debug, thiserror::Error)]
pub enum FieldProblem {
    /// The file isn't one of tensors.
    #[error(transparent)]
    NotTensors(#[from] SafeTensorError),
    /// A tensor can't be had.
    #[error("tensor {name}: {problem}")]
    Missing {
        /// The tensor.
        name: String,
        /// Why.
        problem: SafeTensorError,
    },
    /// A tensor has another type or length.
    #[error("tensor {name}: {found:?} {shape:?} where {count} {expected} are expected")]
    Unexpected {
        /// The tensor.
        name: String,
        /// Its type.
        found: Dtype,
        /// Its shape.
        shape: Vec<usize>,
        /// How many numbers a reader expects.
        count: usize,
        /// Their type.
        expected: &'static str,
    },
    /// No field has such an architecture.
    #[error(transparent)]
    Architecture(#[from] OutOfRange),
    /// Nothing lies inside the bounds.
    #[error("the box {0:?} has no inside")]
    NoInside(Box<Bounds>),
    /// A parameter isn't finite.
    #[error("a parameter is not finite")]
    NotFinite,
}

/// A tensor to write.
pub(crate) enum Tensor<'a> {
    F32(&'a [f32]),
    U8(&'a [u8]),
}

/// A tensor with its shape, whose bytes are made when they are written: a copy of the largest
/// tensor at a time.
struct Written<'a>(&'a Tensor<'a>, [usize; 1]);

impl View for Written<'_> {
    fn dtype(&self) -> Dtype {
        match self.0 {
            Tensor::F32(_) => Dtype::F32,
            Tensor::U8(_) => Dtype::U8,
        }
    }

    fn shape(&self) -> &[usize] {
        &self.1
    }

    fn data(&self) -> Cow<'_, [u8]> {
        match self.0 {
            Tensor::F32(numbers) => {
                Cow::Owned(numbers.iter().flat_map(|x| x.to_le_bytes()).collect())
            }
            Tensor::U8(bytes) => Cow::Borrowed(bytes),
        }
    }

    fn data_len(&self) -> usize {
        match self.0 {
            Tensor::F32(numbers) => size_of_val(*numbers),
            Tensor::U8(bytes) => bytes.len(),
        }
    }
}

impl Tensor<'_> {
    fn len(&self) -> usize {
        match self {
            Self::F32(numbers) => numbers.len(),
            Self::U8(bytes) => bytes.len(),
        }
    }
}

pub(crate) fn write_tensors(path: &Path, tensors: &[(&str, Tensor<'_>)]) -> Result<(), FieldError> {
    let views = tensors.iter().map(|(name, tensor)| (*name, Written(tensor, [tensor.len()])));
    let io = |source| FieldError::Io { path: path.to_path_buf(), source };
    let whole = safetensors::serialize(views, None)
        .map_err(|e| io(std::io::Error::other(e.to_string())))?;
    std::fs::write(path, whole).map_err(io)
}

pub(crate) fn read_f32(
    tensors: &SafeTensors<'_>,
    name: &str,
    into: &mut [f32],
) -> Result<(), FieldProblem> {
    let tensor = named(tensors, name)?;
    let (data, rest) = tensor.data().as_chunks::<4>();
    if tensor.dtype() != Dtype::F32 || data.len() != into.len() || !rest.is_empty() {
        return Err(unexpected(&tensor, name, into.len(), "f32"));
    }
    for (value, bytes) in into.iter_mut().zip(data) {
        *value = f32::from_le_bytes(*bytes);
    }
    Ok(())
}

pub(crate) fn read_u8(
    tensors: &SafeTensors<'_>,
    name: &str,
    len: usize,
) -> Result<Vec<u8>, FieldProblem> {
    let tensor = named(tensors, name)?;
    if tensor.dtype() != Dtype::U8 || tensor.data().len() != len {
        return Err(unexpected(&tensor, name, len, "u8"));
    }
    Ok(tensor.data().to_vec())
}

fn named<'a>(tensors: &SafeTensors<'a>, name: &str) -> Result<TensorView<'a>, FieldProblem> {
    let missing = |problem| FieldProblem::Missing { name: name.to_owned(), problem };
    tensors.tensor(name).map_err(missing)
}

fn unexpected(
    tensor: &TensorView<'_>,
    name: &str,
    count: usize,
    expected: &'static str,
) -> FieldProblem {
    let (found, shape) = (tensor.dtype(), tensor.shape().to_vec());
    FieldProblem::Unexpected { name: name.to_owned(), found, shape, count, expected }
}
