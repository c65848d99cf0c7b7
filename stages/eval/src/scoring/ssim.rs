use pixels::Image;

/// Mean structural similarity with both treatments of the border.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ssim {
    /// Mean over all pixels; the image is mirrored without repeating its edge, like PyTorch's
    /// `reflect` padding.
    pub reflected: f64,
    /// Mean over the pixels whose window lies inside the image, like scikit-image; over all pixels
    /// if there is none.
    pub valid: f64,
}

/// Radius of the window in pixels (Wang et al. 2004).
const RADIUS: usize = 5;

/// Returns the mean structural similarity (Wang et al. 2004): Gaussian window of 11×11 with σ 1.5,
/// data range 1, in f64; mean over the channels. An image narrower than the window is reflected
/// repeatedly.
pub fn ssim(a: &Image, b: &Image) -> Ssim {
    let mut sum = Ssim { reflected: 0.0, valid: 0.0 };
    for c in 0..a.channels {
        let ssim = plane_ssim(&plane(a, c), &plane(b, c), a.width, a.height);
        sum.reflected += ssim.reflected;
        sum.valid += ssim.valid;
    }
    let channels = a.channels as f64;
    Ssim { reflected: sum.reflected / channels, valid: sum.valid / channels }
}

/// Returns a channel in f64.
fn plane(image: &Image, c: usize) -> Vec<f64> {
    image.channel(c).iter().map(|&v| f64::from(v)).collect()
}

/// Returns the product of two planes, pixel by pixel.
fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

/// Returns the structural similarity of two planes.
fn plane_ssim(x: &[f64], y: &[f64], width: usize, height: usize) -> Ssim {
    let [mx, my] = [x, y].map(|plane| blur(plane, width, height));
    let [xx, yy, xy] = [(x, x), (y, y), (x, y)].map(|(a, b)| blur(&product(a, b), width, height));
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let similarities = (0..width * height).map(|i| {
        let (vx, vy, cov) = (xx[i] - mx[i] * mx[i], yy[i] - my[i] * my[i], xy[i] - mx[i] * my[i]);
        ((2.0 * mx[i] * my[i] + c1) * (2.0 * cov + c2))
            / ((mx[i] * mx[i] + my[i] * my[i] + c1) * (vx + vy + c2))
    });
    let similarities: Vec<f64> = similarities.collect();
    let has_valid = width > 2 * RADIUS && height > 2 * RADIUS;
    let valid_margin = if has_valid { RADIUS } else { 0 };
    Ssim {
        reflected: mean_inside(&similarities, width, height, 0),
        valid: mean_inside(&similarities, width, height, valid_margin),
    }
}

/// Returns the mean over the pixels at least `margin` away from the border.
fn mean_inside(plane: &[f64], width: usize, height: usize, margin: usize) -> f64 {
    let pixels = (margin..height - margin)
        .flat_map(|j| (margin..width - margin).map(move |i| j * width + i));
    pixels.map(|i| plane[i]).sum::<f64>() / ((width - 2 * margin) * (height - 2 * margin)) as f64
}

/// Blurs a plane by the Gaussian window, reflected at the border.
fn blur(plane: &[f64], width: usize, height: usize) -> Vec<f64> {
    let raw: Vec<f64> = (0..=2 * RADIUS)
        .map(|k| (-((k as f64 - RADIUS as f64).powi(2)) / (2.0 * 1.5 * 1.5)).exp())
        .collect();
    let sum: f64 = raw.iter().sum();
    let taps: Vec<f64> = raw.iter().map(|w| w / sum).collect();
    blur_along(&blur_along(plane, &taps, 1, width), &taps, width, height)
}

/// Blurs lines of `length` samples, whose samples are `stride` apart.
fn blur_along(plane: &[f64], taps: &[f64], stride: usize, length: usize) -> Vec<f64> {
    let blurred = (0..plane.len()).map(|i| {
        let position = i / stride % length;
        let start = i - position * stride;
        let taps = taps.iter().enumerate();
        taps.map(|(k, w)| w * plane[start + stride * reflected(position + k, length)]).sum::<f64>()
    });
    blurred.collect()
}

/// Mirrors the index `shifted - RADIUS` into 0..length without repeating the ends.
fn reflected(shifted: usize, length: usize) -> usize {
    if length == 1 {
        return 0;
    }
    let period = 2 * (length - 1);
    let index = (shifted + period * RADIUS - RADIUS) % period;
    index.min(period - index)
}
