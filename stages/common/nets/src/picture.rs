use pixels::Picture;
use tch::{TchError, Tensor};

/// A picture as 1 × channels × rows × columns.
pub fn tensor_of(picture: &Picture) -> Result<Tensor, TchError> {
    let shape = [picture.height, picture.width, picture.channels].map(|d| d as i64);
    Tensor::f_from_slice(&picture.data)?.f_reshape(shape)?.f_permute([2, 0, 1])?.f_unsqueeze(0)
}

/// The picture that [`tensor_of`] gives a tensor for.
pub fn picture_of(tensor: &Tensor) -> Result<Picture, TchError> {
    let [_, channels, height, width] = tensor.size()[..] else {
        return Err(TchError::Shape(format!("{:?} is no picture's shape", tensor.size())));
    };
    let flat = tensor.f_permute([0, 2, 3, 1])?.f_contiguous()?.f_view([-1])?;
    Ok(Picture::new(width as usize, height as usize, channels as usize, Vec::<f32>::try_from(&flat)?))
}
