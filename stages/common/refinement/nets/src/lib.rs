//! libtorch code shared by stages with networks; the networks themselves are in the crates that use
//! them.
//!
//! * [`deterministic`]: restricts libtorch to one thread within an operation. Stages parallelise
//!   over images instead, so bytes don't depend on the number of threads.
//! * [`device`]: parses and checks `--device`.
//! * [`tensor_of`], [`image_of`]: convert between images and tensors.
//! * [`Adam`]: the optimiser, on gradients that the caller computes.
//! * [`Weights`], [`write()`]: named tensors of a safetensors file, with checked shapes; [`Conv`]:
//!   a convolution with such tensors.
//!
//! ```no_run,standalone_crate
//! nets::deterministic();
//! let weights = nets::Weights::read("squeezenet1_1.safetensors".as_ref())?;
//! let kernel = weights.tensor("features.0.weight", &[64, 3, 3, 3])?;
//! # Ok::<(), nets::WeightsError>(())
//! ```

mod adam;
mod weights;

use pixels::Image;
use tch::{Cuda, TchError, Tensor};

pub use adam::{Adam, add_gradients, all_finite, cosine_rate};
pub use tch::Device;
pub use weights::{Conv, Weights, WeightsError, write};

/// Makes libtorch's results reproducible: libtorch splits sums by thread, so it gets one thread.
pub fn deterministic() {
    tch::set_num_threads(1);
}

/// Error returned when `--device` names an unknown or unusable device.
#[derive(Debug, thiserror::Error)]
#[error("--device {name}: {reason}")]
pub struct DeviceError {
    /// Name of the device.
    name: String,
    /// Reason why the device can't be used, with a remedy.
    reason: String,
}

/// Returns the device that `--device` names: `cpu`, `cuda` or `cuda:N`.
pub fn device(name: &str) -> Result<Device, DeviceError> {
    let index = match name.strip_prefix("cuda") {
        None if name == "cpu" => return Ok(Device::Cpu),
        Some("") => Some(0),
        Some(index) => index.strip_prefix(':').and_then(|i| i.parse::<usize>().ok()),
        None => None,
    };
    usable_cuda_device(index).map_err(|reason| DeviceError { name: name.to_owned(), reason })
}

/// Returns the GPU with this index, or the reason why it can't be used.
fn usable_cuda_device(index: Option<usize>) -> Result<Device, String> {
    let Some(index) = index else {
        return Err("no such device; expected cpu, cuda or cuda:N".to_owned());
    };
    load_cuda();
    let count = Cuda::device_count();
    if !Cuda::is_available() || count == 0 {
        return Err("no usable GPU; omit --device, or build with LIBTORCH_USE_PYTORCH=1 and a \
                    PyTorch with CUDA, on a machine with an NVIDIA driver"
            .to_owned());
    }
    if index as i64 >= count {
        return Err(format!("GPU not found; this machine has {count}, numbered from 0"));
    }
    Ok(Device::Cuda(index))
}

/// Loads libtorch's CUDA library if it is installed. Linkers drop it, since programs use none of
/// its symbols.
#[cfg(unix)]
fn load_cuda() {
    // SAFETY: loading runs the library's constructors, which register its kernels with libtorch, as
    // in Python. It stays loaded.
    unsafe { libc::dlopen(c"libtorch_cuda.so".as_ptr(), libc::RTLD_NOW | libc::RTLD_GLOBAL) };
}

#[cfg(not(unix))]
fn load_cuda() {}

/// Returns whether libtorch ran out of memory, so that a smaller batch may succeed.
pub fn is_out_of_memory(error: &TchError) -> bool {
    error.to_string().contains("out of memory")
}

/// Converts an image to a tensor (1 × channels × rows × columns).
pub fn tensor_of(image: &Image) -> Result<Tensor, TchError> {
    let shape = [image.height, image.width, image.channels].map(|d| d as i64);
    Tensor::f_from_slice(&image.data)?.f_reshape(shape)?.f_permute([2, 0, 1])?.f_unsqueeze(0)
}

/// Converts a tensor (1 × channels × rows × columns) to an image.
pub fn image_of(tensor: &Tensor) -> Result<Image, TchError> {
    let [_, channels, height, width] = tensor.size()[..] else {
        let reason = format!("expected four dimensions, found shape {:?}", tensor.size());
        return Err(TchError::Shape(reason));
    };
    let flat = tensor.f_permute([0, 2, 3, 1])?.f_contiguous()?.f_view([-1])?;
    Ok(Image::new(width as usize, height as usize, channels as usize, Vec::<f32>::try_from(&flat)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_named_or_refused() {
        assert_eq!(device("cpu").unwrap(), Device::Cpu);
        for name in ["gpu", "cuda:x", "cuda0", "cuda:99", ""] {
            let message = device(name).unwrap_err().to_string();
            assert!(message.starts_with(&format!("--device {name}: ")), "{message}");
        }
        if !Cuda::is_available() {
            assert!(device("cuda").unwrap_err().to_string().contains("omit --device"));
        }
    }
}
