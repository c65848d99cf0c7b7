use artifact::{Failure, bail_usage};

/// LR and HR size, (width, height) in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sizes {
    /// Size of the LR images.
    pub(crate) lr: (u32, u32),
    /// Size of the HR images.
    pub(crate) hr: (u32, u32),
}

impl Sizes {
    /// True if the HR size is an integer multiple of the LR size along both axes.
    pub(crate) fn has_integer_scale(&self) -> bool {
        self.hr.0.is_multiple_of(self.lr.0) && self.hr.1.is_multiple_of(self.lr.1)
    }
}

/// Returns LR and HR size from `lr_width` and `scale`; heights follow the native aspect ratio.
pub(crate) fn downscaled_sizes(
    native: (u32, u32),
    lr_width: Option<u32>,
    scale: f64,
) -> Result<Sizes, Failure> {
    let (lr_width, hr_width) = match lr_width {
        Some(lr_width) => (lr_width, scaled_by(lr_width, scale)),
        None => (scaled_by(native.0, 1.0 / scale), native.0),
    };
    if lr_width == 0 {
        bail_usage!(
            "parameters: scale = {scale} reduces a width of {hr_width} pixels to 0; choose a \
            smaller scale"
        );
    }
    if scale > 1.0 && lr_width == hr_width {
        bail_usage!(
            "parameters: scale = {scale} gives LR and HR images the same width of {hr_width} \
            pixels; choose scale = 1, or a larger lr_width or scale"
        );
    }
    if hr_width > native.0 {
        bail_usage!(
            "parameters: lr_width = {lr_width} and scale = {scale} give HR images of {hr_width} \
            pixels, but the data set's images are {} pixels wide; choose a smaller lr_width or \
            scale",
            native.0
        );
    }
    let [lr, hr] =
        [lr_width, hr_width].map(|width| (width, scaled_length(native.1, native.0, width)));
    Ok(Sizes { lr, hr })
}

fn scaled_by(length: u32, scale: f64) -> u32 {
    (f64::from(length) * scale).round() as u32
}

/// Scales a length by `to / from`, rounded to at least one pixel.
pub(crate) fn scaled_length(length: u32, from: u32, to: u32) -> u32 {
    ((f64::from(length) * f64::from(to) / f64::from(from)).round() as u32).max(1)
}

/// Returns LR and HR size where the photographs are the LR images.
pub(crate) fn enlarged_sizes(native: (u32, u32), scale: f64) -> Sizes {
    Sizes { lr: native, hr: (scaled_by(native.0, scale), scaled_by(native.1, scale)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_follow_from_width_and_scale() {
        let native = (800, 800);
        for (native, lr, scale, expected) in [
            (native, Some(100), 2.0, Sizes { lr: (100, 100), hr: (200, 200) }),
            (native, None, 2.0, Sizes { lr: (400, 400), hr: native }),
            ((504, 378), None, 4.0, Sizes { lr: (126, 95), hr: (504, 378) }),
        ] {
            assert_eq!(downscaled_sizes(native, lr, scale).unwrap(), expected);
        }
        assert!(!downscaled_sizes((504, 378), None, 4.0).unwrap().has_integer_scale());
        assert_eq!(enlarged_sizes((90, 61), 1.5), Sizes { lr: (90, 61), hr: (135, 92) });
    }

    #[test]
    fn enlarging_and_empty_sizes_are_refused() {
        for (native, lr, scale, expected) in [
            (800, Some(900), 1.0, "lr_width = 900 and scale = 1 give HR images of 900 pixels"),
            (
                800,
                Some(500),
                2.0,
                "images of 1000 pixels, but the data set's images are 800 pixels",
            ),
            (4, None, 16.0, "scale = 16 reduces a width of 4 pixels to 0"),
            (1, None, 2.0, "scale = 2 gives LR and HR images the same width of 1 pixels"),
            (10, Some(10), 1.01, "scale = 1.01 gives LR and HR images the same width of 10 pixels"),
        ] {
            let message = downscaled_sizes((native, native), lr, scale).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        assert_eq!(downscaled_sizes((1, 1), None, 1.0).unwrap(), Sizes { lr: (1, 1), hr: (1, 1) });
    }
}
