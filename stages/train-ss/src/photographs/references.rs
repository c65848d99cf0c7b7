use anyhow::Context as _;
use pixels::{Exposure, Image, Kernel, Resampling, Rgba8, psnr_of, resize_pillow};
use scene::Camera;

use super::packed::straight;
use super::{NO_SPACE, PackedPhotograph, Photographs, PixelMemory};

/// Minimum PSNR between a shrunk reference and its own LR photograph, in dB; below it the reference
/// counts as another image (design note 019).
const MIN_REFERENCE_PSNR: f64 = 25.0;

/// Minimum alpha of an LR pixel whose HR pixels are all opaque, up to rounding.
const MIN_OPAQUE_ALPHA: f32 = 1.0 - 1e-4;

/// Prepares references for a training: corrects the exposure of each to that of its own LR
/// photograph, and drops references that differ from theirs. References without an LR photograph
/// stay unchanged. `kernel` made the LR photographs; `log` reports corrections and dropped
/// references.
///
/// Images with alpha are compared by their premultiplied colours, not over a background. There, the
/// kernel's overshoot at the border of an object would look like another exposure, because stored
/// images are clipped.
pub(crate) fn check_references(
    mut references: Photographs,
    photographs: &Photographs,
    kernel: Kernel,
    memory: &mut PixelMemory,
    log: &dyn Fn(String),
) -> anyhow::Result<Photographs> {
    let (mut views, mut images) = (Vec::new(), Vec::new());
    for (view, mut packed) in references.views.views.into_iter().zip(references.images) {
        let Some(own) = own_photograph(photographs, &view.camera) else {
            views.push(view);
            images.push(packed);
            continue;
        };
        let mut photograph = packed.unpack();
        let (name, reference) = (&view.camera.name, &mut photograph.image);
        let [mut shrunk, own] = comparable_images(reference, &own, kernel);
        if let Some(exposure) =
            Exposure::fit(&own, &shrunk, 1).filter(|exposure| !exposure.is_negligible())
        {
            let [r, g, b] = exposure.gain;
            log(format!(
                "reference {name} has another exposure ({r:.2}, {g:.2}, {b:.2} times as bright); \
                corrected"
            ));
            exposure.undo(reference);
            exposure.undo(&mut shrunk);
            packed = PackedPhotograph::new(&photograph, memory).context(NO_SPACE)?;
        }
        let psnr = premultiplied_psnr(&shrunk, &own);
        if psnr < MIN_REFERENCE_PSNR {
            log(format!(
                "reference {name} differs from its own LR photograph (PSNR {psnr:.1} dB) and is \
                left out; check that both show the same view"
            ));
        } else {
            views.push(view);
            images.push(packed);
        }
    }
    (references.views.views, references.images) = (views, images);
    Ok(references)
}

/// Returns a camera's LR photograph, if any.
fn own_photograph(photographs: &Photographs, camera: &Camera) -> Option<Image> {
    let view = photographs.views.taken_by(camera)?;
    let index = photographs.views.views.iter().position(|other| std::ptr::eq(other, view))?;
    Some(photographs.images[index].unmasked())
}

/// Returns a reference shrunk by the kernel, and its own LR photograph. As in `prep`, images with
/// alpha are shrunk from 8 bits to 8 bits, except by `average`.
fn comparable_images(reference: &Image, own: &Image, kernel: Kernel) -> [Image; 2] {
    let is_transparent = is_transparent(reference);
    if is_transparent && kernel != Kernel::Average {
        let shrunk = resize_pillow(&to_stored(reference), own.width, own.height, kernel.filter());
        return [Image::premultiplied(&shrunk), own.clone()];
    }
    let [from, to] = [reference, own].map(|image| (image.width, image.height));
    let mut pair = [Resampling::new(kernel.filter(), from, to).apply(reference), own.clone()];
    if is_transparent {
        // `average` takes the mean of straight colours, those of transparent pixels included: only
        // alpha is known where not all HR pixels are opaque.
        for pixel in 0..own.width * own.height {
            if own.data[4 * pixel + 3] < MIN_OPAQUE_ALPHA {
                for image in &mut pair {
                    image.data[4 * pixel..4 * pixel + 3].fill(0.0);
                }
            }
        }
    }
    pair
}

/// Converts an image with premultiplied alpha to its PNG's form: 8 bits, straight alpha.
fn to_stored(image: &Image) -> Rgba8 {
    let pixels = image.data.as_chunks::<4>().0.iter().copied();
    Rgba8::new(image.width, image.height, pixels.flat_map(straight).collect())
}

fn is_transparent(image: &Image) -> bool {
    image.channels == 4 && image.data.chunks_exact(4).any(|pixel| pixel[3] < 1.0)
}

/// Returns the PSNR of two images of one size in dB. The squared error includes alpha, and is
/// divided by the number of colour samples.
fn premultiplied_psnr(one: &Image, other: &Image) -> f64 {
    let channels = if is_transparent(one) || is_transparent(other) { 4 } else { 3 };
    let pairs = samples(one, channels).zip(samples(other, channels));
    let colours = (3 * one.width * one.height) as f64;
    psnr_of(pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / colours)
}

/// Returns the samples of an image's first channels.
fn samples(image: &Image, channels: usize) -> impl Iterator<Item = &f32> {
    image.data.chunks_exact(image.channels).flat_map(move |pixel| &pixel[..channels])
}

#[cfg(test)]
mod tests {
    use pixels::Filter;
    use scene::{Camera, Intrinsics};

    use super::*;

    /// Returns an image as the photograph of camera `name`.
    fn photographs(name: &str, image: Image) -> Photographs {
        let (width, height) = (image.width as u32, image.height as u32);
        let intrinsics = Intrinsics {
            width,
            height,
            fx: 20.0,
            fy: 20.0,
            cx: 8.0,
            cy: 8.0,
            distortion: Default::default(),
        };
        let camera_to_world = [[0., 0., 1., 3.], [1., 0., 0., 0.5], [0., 1., 0., 0.2]];
        let camera = Camera { name: name.into(), intrinsics, camera_to_world };
        Photographs::taken_by(camera, image)
    }

    /// Returns sample `i` of an image of random patches with fine stripes.
    fn hr_sample(i: usize) -> f32 {
        let (x, y, c) = (i / 3 % 32, i / 96, i % 3);
        0.2 + 0.5 * numerics::uniform(3, c as u64, (x / 8 * 9 + y / 8) as u64)
            + if (x + y) % 4 < 2 { 0.05 } else { -0.05 }
    }

    fn hr() -> Image {
        Image::new(32, 32, 3, (0..32 * 32 * 3).map(hr_sample).collect())
    }

    /// Checks the changed HR image of camera `name`. Returns the reference (`None` if it was left
    /// out), the number of references, and the log.
    fn check_changed(name: &str, change: &dyn Fn(f32) -> f32) -> (Option<Image>, usize, String) {
        let lr = Resampling::new(Filter::Lanczos, (32, 32), (16, 16)).apply(&hr());
        let lr = photographs("a", lr);
        let messages = std::cell::RefCell::new(String::new());
        let mut image = hr();
        image.data.iter_mut().for_each(|v| *v = change(*v));
        let log = |text: String| messages.borrow_mut().push_str(&text);
        let kept = check_references(
            photographs(name, image),
            &lr,
            Kernel::Lanczos,
            &mut PixelMemory::unlimited(),
            &log,
        )
        .unwrap();
        (
            kept.images.first().map(|packed| packed.unmasked().over(0.0)),
            kept.views.views.len(),
            messages.into_inner(),
        )
    }

    #[test]
    fn exposures_are_corrected_and_other_images_are_left_out() {
        let (same, views, message) = check_changed("a", &|v| v);
        assert!(same.unwrap().data == hr().data && views == 1 && message.is_empty(), "{message}");
        let (dark, views, message) = check_changed("a", &|v| 0.6 * v + 0.1);
        let error = dark
            .unwrap()
            .data
            .iter()
            .zip(&hr().data)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(
            error < 0.01 && views == 1 && message.contains("another exposure (0.60, 0.60, 0.60"),
            "{error} {message}"
        );
        let (other, views, message) = check_changed("a", &|v| 1.0 - v);
        assert!(other.is_none() && views == 0 && message.contains("left out"), "{message}");
        // Nothing is known of a view that has no LR photograph.
        let (unknown, _, message) = check_changed("b", &|v| 1.0 - v);
        assert!(unknown.is_some() && message.is_empty(), "{message}");
    }

    fn ball_pixel(size: usize, i: usize) -> [u8; 4] {
        let (x, y) = ((i % size) as f32 + 0.5, (i / size) as f32 + 0.5);
        let radius = (x - 0.45 * size as f32).hypot(y - 0.55 * size as f32);
        if radius < 0.3 * size as f32 { [250, 240, 90 + (x * 2.0) as u8 / 4, 255] } else { [0; 4] }
    }

    /// The image is a ball over a transparent background, stored as by `prep` at both sizes.
    /// Lanczos overshoots the ball's colour at its border.
    #[test]
    fn a_reference_with_alpha_is_kept_unchanged_at_any_size() {
        for size in [32, 48, 64, 100] {
            let hr = pixels::Rgba8::new(
                size,
                size,
                (0..size * size).flat_map(|i| ball_pixel(size, i)).collect(),
            );
            for kernel in [Kernel::Lanczos, Kernel::Bicubic, Kernel::Box, Kernel::Average] {
                let lr = match kernel {
                    Kernel::Average => {
                        let mut lr = pixels::average_pool(&hr, 2, 2).unwrap();
                        lr.data.chunks_exact_mut(4).for_each(|p| (0..3).for_each(|c| p[c] *= p[3]));
                        lr
                    }
                    _ => Image::premultiplied(&resize_pillow(
                        &hr,
                        size / 2,
                        size / 2,
                        kernel.filter(),
                    )),
                };
                let hr = Image::premultiplied(&hr);
                let messages = std::cell::RefCell::new(String::new());
                let given = photographs("a", lr.clone());
                let log = |text: String| messages.borrow_mut().push_str(&text);
                let memory = &mut PixelMemory::unlimited();
                let kept =
                    check_references(photographs("a", hr.clone()), &given, kernel, memory, &log)
                        .unwrap();
                assert_eq!(messages.into_inner(), "", "{size} {kernel:?}");
                assert_eq!(kept.images[0].unmasked(), hr);
                let [shrunk, own] = comparable_images(&hr, &lr, kernel);
                assert_eq!(premultiplied_psnr(&shrunk, &own), 100.0, "{size} {kernel:?}");
            }
        }
    }

    fn premultiplied_pixel((i, p): (usize, &[f32]), gain: f32, offset: f32) -> [f32; 4] {
        let alpha = [1.0, 0.5, 0.0][(i % 32 / 4) % 3];
        let [r, g, b] = [0, 1, 2].map(|c| alpha * (gain * p[c] + offset));
        [r, g, b, alpha]
    }

    /// Returns the HR image with an exposure, in stripes of different alpha.
    fn striped(gain: f32, offset: f32) -> Image {
        let hr = hr();
        Image::new(
            32,
            32,
            4,
            hr.data
                .chunks_exact(3)
                .enumerate()
                .flat_map(|pixel| premultiplied_pixel(pixel, gain, offset))
                .collect(),
        )
    }

    /// An offset is multiplied by alpha, like the colours.
    #[test]
    fn exposures_of_transparent_pixels_are_undone() {
        let mut dark = striped(0.6, 0.1);
        Exposure { gain: [0.6; 3], offset: [0.1; 3] }.undo(&mut dark);
        let error = dark
            .data
            .iter()
            .zip(&striped(1.0, 0.0).data)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f32::max);
        assert!(error < 1e-6, "{error}");
    }
}
