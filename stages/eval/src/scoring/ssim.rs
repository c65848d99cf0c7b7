use pixels::Image;

/// Mean structural similarity, by what the window does at the border.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ssim {
    /// The image is mirrored without repeating its edge, as PyTorch pads: every pixel counts.
    pub reflected: f64,
    /// Only pixels whose window lies inside count: scikit-image's scalar. Where there is none, all
    /// count.
    pub valid: f64,
}

const RADIUS: usize = 5;

/// Mean structural similarity (Wang et al. 2004): Gaussian window of 11×11 with σ 1.5, data range
/// 1, in f64; mean over the channels. An image narrower than the window is reflected as often as it
/// takes.
pub fn ssim(a: &Image, b: &Image) -> Ssim {
    let channel = |c: usize| of_planes(&plane(a, c), &plane(b, c), a.width, a.height);
    let channels: Vec<Ssim> = (0..a.channels).map(channel).collect();
    let mean = |of: fn(&Ssim) -> f64| channels.iter().map(of).sum::<f64>() / a.channels as f64;
    Ssim { reflected: mean(|s| s.reflected), valid: mean(|s| s.valid) }
}

fn plane(image: &Image, c: usize) -> Vec<f64> {
    image.channel(c).iter().map(|&v| f64::from(v)).collect()
}

fn of_planes(x: &[f64], y: &[f64], width: usize, height: usize) -> Ssim {
    let product =
        |a: &[f64], b: &[f64]| -> Vec<f64> { a.iter().zip(b).map(|(a, b)| a * b).collect() };
    let blurred = |plane: &[f64]| blur(plane, width, height);
    let (mx, my) = (blurred(x), blurred(y));
    let (xx, yy, xy) = (blurred(&product(x, x)), blurred(&product(y, y)), blurred(&product(x, y)));
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let similarities = (0..width * height).map(|i| {
        let (vx, vy, cov) = (xx[i] - mx[i] * mx[i], yy[i] - my[i] * my[i], xy[i] - mx[i] * my[i]);
        ((2.0 * mx[i] * my[i] + c1) * (2.0 * cov + c2))
            / ((mx[i] * mx[i] + my[i] * my[i] + c1) * (vx + vy + c2))
    });
    let similarities: Vec<f64> = similarities.collect();
    let inside = |margin: usize| mean_inside(&similarities, width, height, margin);
    let reflected = inside(0);
    let valid = if width > 2 * RADIUS && height > 2 * RADIUS { inside(RADIUS) } else { reflected };
    Ssim { reflected, valid }
}

/// Mean over the pixels that lie farther than a margin from the border.
fn mean_inside(plane: &[f64], width: usize, height: usize, margin: usize) -> f64 {
    let pixels = (margin..height - margin)
        .flat_map(|j| (margin..width - margin).map(move |i| j * width + i));
    pixels.map(|i| plane[i]).sum::<f64>() / ((width - 2 * margin) * (height - 2 * margin)) as f64
}

/// Gaussian blur, reflected at the border.
fn blur(plane: &[f64], width: usize, height: usize) -> Vec<f64> {
    let raw: Vec<f64> = (0..=2 * RADIUS)
        .map(|k| (-((k as f64 - RADIUS as f64).powi(2)) / (2.0 * 1.5 * 1.5)).exp())
        .collect();
    let sum: f64 = raw.iter().sum();
    let taps: Vec<f64> = raw.iter().map(|w| w / sum).collect();
    blur_along(&blur_along(plane, &taps, 1, width), &taps, width, height)
}

/// Blurs lines of so many samples, which lie `stride` apart from each other.
fn blur_along(plane: &[f64], taps: &[f64], stride: usize, length: usize) -> Vec<f64> {
    let blurred = (0..plane.len()).map(|i| {
        let at = i / stride % length;
        let line = i - at * stride;
        let near = taps.iter().enumerate();
        near.map(|(k, w)| w * plane[line + stride * reflected(at + k, length)]).sum::<f64>()
    });
    blurred.collect()
}

/// Index `shifted - RADIUS` mirrored into 0..length without repeating the ends.
fn reflected(shifted: usize, length: usize) -> usize {
    if length == 1 {
        return 0;
    }
    let period = 2 * (length - 1);
    let at = (shifted + period * RADIUS - RADIUS) % period;
    at.min(period - at)
}
