use crate::image_buffer::{Image, Rgba8};

/// Mean of s×s blocks of 8-bit RGBA, colour and alpha apart and nothing rounded: the paper code's
/// `--ds_method avg`.
///
/// The reference implementation pools *straight* colour, so what hides behind transparent pixels
/// bleeds into edges; that is kept, for comparison's sake. `None` when the size isn't a multiple of
/// (sx, sy).
pub fn average_pool(image: &Rgba8, sx: usize, sy: usize) -> Option<Image> {
    if sx == 0 || sy == 0 || !image.width.is_multiple_of(sx) || !image.height.is_multiple_of(sy) {
        return None;
    }
    let (width, height) = (image.width / sx, image.height / sy);
    let mut data = Vec::with_capacity(width * height * 4);
    for y in 0..height {
        for x in 0..width {
            for c in 0..4 {
                let sum: u32 = (0..sy)
                    .flat_map(|b| (0..sx).map(move |a| (x * sx + a, y * sy + b)))
                    .map(|(i, j)| u32::from(image.data[(j * image.width + i) * 4 + c]))
                    .sum();
                data.push((f64::from(sum) / (255.0 * (sx * sy) as f64)) as f32);
            }
        }
    }
    Some(Image::new(width, height, 4, data))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_of_blocks() {
        let mut data = vec![0; 4 * 2 * 4];
        data[..4].copy_from_slice(&[255, 0, 0, 255]);
        data[16..20].copy_from_slice(&[255, 0, 255, 0]);
        let pooled = average_pool(&Rgba8::new(4, 2, data), 2, 2).unwrap();
        assert_eq!(&pooled.data[..4], &[0.5, 0.0, 0.25, 0.25]);
        assert_eq!((pooled.width, pooled.height), (2, 1));
        assert!(average_pool(&Rgba8::new(3, 2, vec![0; 24]), 2, 2).is_none());
    }
}
