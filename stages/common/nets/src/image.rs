use pixels::Image;
use tch::{TchError, Tensor};

/// An image as 1 × channels × rows × columns.
pub fn tensor_of(image: &Image) -> Result<Tensor, TchError> {
    let shape = [image.height, image.width, image.channels].map(|d| d as i64);
    Tensor::f_from_slice(&image.data)?.f_reshape(shape)?.f_permute([2, 0, 1])?.f_unsqueeze(0)
}

/// The image that [`tensor_of`] gives a tensor for.
pub fn image_of(tensor: &Tensor) -> Result<Image, TchError> {
    let [_, channels, height, width] = tensor.size()[..] else {
        return Err(TchError::Shape(format!("{:?} is no image's shape", tensor.size())));
    };
    let flat = tensor.f_permute([0, 2, 3, 1])?.f_contiguous()?.f_view([-1])?;
    Ok(Image::new(width as usize, height as usize, channels as usize, Vec::<f32>::try_from(&flat)?))
}
