use pixels::Image;

/// Where a block of a reference's pixels begins: the last of a row or column ends with the image.
pub(crate) fn block_start(block: usize, block_length: usize, length: usize) -> usize {
    (block * block_length).min(length.saturating_sub(block_length))
}

/// Means over blocks of an image's pixels, of those that are known.
pub(crate) fn block_means(image: &Image, block: [usize; 2]) -> Image {
    let (width, height) = (image.width.div_ceil(block[0]), image.height.div_ceil(block[1]));
    let mut data = Vec::with_capacity(width * height * image.channels);
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
        let (left, top) =
            (block_start(x, block[0], image.width), block_start(y, block[1], image.height));
        let rows = top..(top + block[1]).min(image.height);
        let pixels = rows.flat_map(|j| {
            (left..(left + block[0]).min(image.width)).map(move |i| j * image.width + i)
        });
        data.extend((0..image.channels).map(|c| {
            let known = pixels
                .clone()
                .map(|pixel| image.data[pixel * image.channels + c])
                .filter(|v| !v.is_nan());
            let (sum, count) = known.fold((0.0, 0.0), |(sum, count), v| (sum + v, count + 1.0f32));
            sum / count
        }));
    }
    Image::new(width, height, image.channels, data)
}
