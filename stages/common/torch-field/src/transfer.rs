use tch::{Device, Kind, TchError, Tensor};

/// Numbers as a matrix on a device.
pub(crate) fn matrix(numbers: &[f32], shape: [i64; 2], device: Device) -> Result<Tensor, TchError> {
    Tensor::f_from_slice(numbers)?.f_reshape(shape)?.f_to_device(device)
}

/// `N` numbers of each of n rays: n × N.
pub(crate) fn columns<T, const N: usize>(
    rays: &[T],
    device: Device,
    of: impl Fn(&T) -> [f32; N],
) -> Result<Tensor, TchError> {
    let values: Vec<f32> = rays.iter().flat_map(of).collect();
    matrix(&values, [rays.len() as i64, N as i64], device)
}

/// A tensor's numbers in f32.
pub(crate) fn host(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    let flat = tensor
        .f_detach()?
        .f_to_device(Device::Cpu)?
        .f_to_kind(Kind::Float)?
        .f_contiguous()?
        .f_view([-1])?;
    Vec::<f32>::try_from(flat)
}
