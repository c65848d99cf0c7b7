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
    pub(crate) fn is_integer(&self) -> bool {
        self.hr.0.is_multiple_of(self.lr.0) && self.hr.1.is_multiple_of(self.lr.1)
    }
}

/// Error returned when `lr_width` and `scale` don't give valid sizes.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum SizeError {
    #[error(
        "lr_width = {lr} and scale = {scale} give HR images of {hr} pixels, but the data set's \
        images are {native} pixels wide; choose a smaller lr_width or scale"
    )]
    TooLarge { lr: u32, scale: f64, hr: u32, native: u32 },
    #[error(
        "scale = {scale} gives LR and HR images the same width of {hr} pixels; give larger images, \
        or choose scale = 1"
    )]
    Unchanged { scale: f64, hr: u32 },
    #[error("scale = {scale} reduces a width of {hr} pixels to 0; choose a smaller scale")]
    Empty { scale: f64, hr: u32 },
}

/// Returns LR and HR size from `lr_width` and `scale`; heights follow the native aspect ratio.
pub(crate) fn downscaled_sizes(
    native: (u32, u32),
    lr: Option<u32>,
    scale: f64,
) -> Result<Sizes, SizeError> {
    let (lr, hr) = match lr {
        Some(lr) => (lr, scaled_by(lr, scale)),
        None => (scaled_by(native.0, 1.0 / scale), native.0),
    };
    if lr == 0 {
        return Err(SizeError::Empty { scale, hr });
    }
    if scale > 1.0 && lr == hr {
        return Err(SizeError::Unchanged { scale, hr });
    }
    if hr > native.0 {
        return Err(SizeError::TooLarge { lr, scale, hr, native: native.0 });
    }
    let (lr_height, hr_height) =
        (scaled_length(native.1, native.0, lr), scaled_length(native.1, native.0, hr));
    Ok(Sizes { lr: (lr, lr_height), hr: (hr, hr_height) })
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
        assert_eq!(
            downscaled_sizes(native, Some(100), 2.0),
            Ok(Sizes { lr: (100, 100), hr: (200, 200) })
        );
        assert_eq!(downscaled_sizes(native, None, 2.0), Ok(Sizes { lr: (400, 400), hr: native }));
        assert_eq!(
            downscaled_sizes((504, 378), None, 4.0),
            Ok(Sizes { lr: (126, 95), hr: (504, 378) })
        );
        assert!(!downscaled_sizes((504, 378), None, 4.0).unwrap().is_integer());
        assert_eq!(enlarged_sizes((90, 61), 1.5), Sizes { lr: (90, 61), hr: (135, 92) });
    }

    #[test]
    fn enlarging_and_empty_sizes_are_refused() {
        for (native, lr, scale, expected) in [
            (
                800,
                Some(900),
                1.0,
                SizeError::TooLarge { lr: 900, scale: 1.0, hr: 900, native: 800 },
            ),
            (
                800,
                Some(500),
                2.0,
                SizeError::TooLarge { lr: 500, scale: 2.0, hr: 1000, native: 800 },
            ),
            (4, None, 16.0, SizeError::Empty { scale: 16.0, hr: 4 }),
            (1, None, 2.0, SizeError::Unchanged { scale: 2.0, hr: 1 }),
            (10, Some(10), 1.01, SizeError::Unchanged { scale: 1.01, hr: 10 }),
        ] {
            assert_eq!(downscaled_sizes((native, native), lr, scale), Err(expected));
        }
        assert_eq!(downscaled_sizes((1, 1), None, 1.0), Ok(Sizes { lr: (1, 1), hr: (1, 1) }));
    }
}
