//! libtorch glue that stages with networks share: determinism and weights. The networks themselves
//! live where they are used.
//!
//! * [`deterministic`]: one intra-op thread; stages work in parallel over images instead, so bytes
//!   don't depend on threads.
//! * [`device`]: the device that a stage was asked to use, or why it can't be.
//! * [`tensor_of`], [`image_of`]: images as tensors.
//! * [`Adam`]: the optimiser, on gradients that are given.
//! * [`Weights`], [`write()`]: tensors of a safetensors file, by name, each with the shape it must
//!   have; [`Conv`]: a layer of them.
//!
//! ```no_run,standalone_crate
//! nets::deterministic();
//! let weights = nets::Weights::read("squeezenet1_1.safetensors".as_ref())?;
//! let kernel = weights.tensor("features.0.weight", &[64, 3, 3, 3])?;
//! # Ok::<(), nets::WeightsError>(())
//! ```

mod adam;
mod conv;
mod image;
mod weights;

use tch::{Cuda, Device, TchError};

pub use adam::{Adam, all_finite};
pub use conv::Conv;
pub use image::{image_of, tensor_of};
pub use weights::{Weights, WeightsError, write};

/// Makes libtorch repeat its bytes: sums are split by thread, so it gets one.
pub fn deterministic() {
    tch::set_num_threads(1);
}

/// A device that can't be used.
#[derive(Debug, thiserror::Error)]
#[error("--device {name}: {reason}")]
pub struct DeviceError {
    name: String,
    reason: String,
}

/// The device of `--device`: `cpu`, `cuda` or `cuda:N`.
pub fn device(name: &str) -> Result<Device, DeviceError> {
    let refuse = |reason: String| Err(DeviceError { name: name.to_owned(), reason });
    let index = match name.strip_prefix("cuda") {
        None if name == "cpu" => return Ok(Device::Cpu),
        Some("") => Some(0),
        Some(index) => index.strip_prefix(':').and_then(|i| i.parse::<usize>().ok()),
        None => None,
    };
    let Some(index) = index else {
        return refuse("no such device; cpu, cuda or cuda:N is expected".to_owned());
    };
    load_cuda();
    let found = Cuda::device_count();
    if !Cuda::is_available() || found == 0 {
        return refuse(
            "no GPU can be used here; leave --device away, or build with LIBTORCH_USE_PYTORCH=1 \
            beside a PyTorch that has CUDA, on a \
             machine with an NVIDIA driver"
                .to_owned(),
        );
    }
    if index as i64 >= found {
        return refuse(format!("there are {found} GPUs, counted from 0"));
    }
    Ok(Device::Cuda(index))
}

/// Loads libtorch's part for CUDA, where there is one. Linkers leave it out, since a program uses
/// none of its symbols.
#[cfg(unix)]
fn load_cuda() {
    // SAFETY: loading runs the library's constructors, which register its kernels with libtorch, as
    // in Python. It stays loaded.
    unsafe { libc::dlopen(c"libtorch_cuda.so".as_ptr(), libc::RTLD_NOW | libc::RTLD_GLOBAL) };
}

#[cfg(not(unix))]
fn load_cuda() {}

/// Whether libtorch failed for want of memory: then a smaller piece may do.
pub fn is_out_of_memory(error: &TchError) -> bool {
    error.to_string().contains("out of memory")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_named_or_refused() {
        assert_eq!(device("cpu").unwrap(), Device::Cpu);
        for name in ["gpu", "cuda:x", "cuda0", "cuda:99", ""] {
            let said = device(name).unwrap_err().to_string();
            assert!(said.starts_with(&format!("--device {name}: ")), "{said}");
        }
        if !Cuda::is_available() {
            assert!(device("cuda").unwrap_err().to_string().contains("leave --device away"));
        }
    }
}
