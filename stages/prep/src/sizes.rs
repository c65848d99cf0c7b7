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

/// Default ratio of HR to LR width.
const DEFAULT_SCALE: f64 = 2.0;

/// Error returned when `lr_width`, `hr_width` and `scale` don't give valid sizes.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum SizeError {
    #[error(
        "lr_width = {lr}, hr_width = {hr} and scale = {scale} contradict each other; give two of \
        them"
    )]
    Contradiction { lr: u32, hr: u32, scale: f64 },
    /// A width that would enlarge an image; `larger` names the exceeded width.
    #[error(
        "{name} = {requested} pixels is larger than {larger} = {limit}; choose a smaller {name}"
    )]
    TooLarge { name: &'static str, requested: u32, larger: &'static str, limit: u32 },
    #[error(
        "scale = {scale} gives LR and HR images the same width of {hr} pixels; give larger images, \
        or choose scale = 1"
    )]
    Unchanged { scale: f64, hr: u32 },
    #[error(
        "hr_width = {hr} and scale = {scale} contradict each other for photographs {native} pixels \
        wide; give one of them"
    )]
    EnlargedContradiction { native: u32, hr: u32, scale: f64 },
    #[error(
        "hr_width = {hr} is less than the photographs' width of {native} pixels; choose a larger \
        hr_width"
    )]
    BelowPhotographs { hr: u32, native: u32 },
    #[error("scale = {scale} reduces a width of {hr} pixels to 0; choose a smaller scale")]
    Empty { scale: f64, hr: u32 },
}

/// Returns LR and HR size from any of `lr_width`, `hr_width` and `scale`; heights follow the native
/// aspect ratio.
pub(crate) fn downscaled_sizes(
    native: (u32, u32),
    lr: Option<u32>,
    hr: Option<u32>,
    scale: Option<f64>,
) -> Result<Sizes, SizeError> {
    // Two widths imply a scale: the default doesn't apply.
    let effective_scale =
        if lr.is_some() && hr.is_some() { scale } else { scale.or(Some(DEFAULT_SCALE)) };
    let (lr, hr) = match (lr, hr, scale) {
        (Some(lr), Some(hr), Some(scale)) if scaled_by(lr, scale) != hr => {
            return Err(SizeError::Contradiction { lr, hr, scale });
        }
        (Some(lr), Some(hr), _) => (lr, hr),
        (Some(lr), None, scale) => (lr, scaled_by(lr, scale.unwrap_or(DEFAULT_SCALE))),
        (None, hr, scale) => {
            let hr = hr.unwrap_or(native.0);
            (scaled_by(hr, 1.0 / scale.unwrap_or(DEFAULT_SCALE)), hr)
        }
    };
    if lr == 0 {
        return Err(SizeError::Empty { scale: scale.unwrap_or(DEFAULT_SCALE), hr });
    }
    if let Some(scale) = effective_scale.filter(|scale| *scale > 1.0 && lr == hr) {
        return Err(SizeError::Unchanged { scale, hr });
    }
    if hr > native.0 {
        let (name, requested) = if lr > native.0 { ("lr_width", lr) } else { ("hr_width", hr) };
        let larger = "the data set's image width";
        return Err(SizeError::TooLarge { name, requested, larger, limit: native.0 });
    }
    if lr > hr {
        let (name, larger) = ("lr_width", "hr_width");
        return Err(SizeError::TooLarge { name, requested: lr, larger, limit: hr });
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

/// Returns LR and HR size where the photographs are the LR images: HR from `hr_width` or `scale`.
pub(crate) fn enlarged_sizes(
    native: (u32, u32),
    hr: Option<u32>,
    scale: Option<f64>,
) -> Result<Sizes, SizeError> {
    let scale = match (hr, scale) {
        (Some(hr), Some(scale)) if (f64::from(native.0) * scale).round() != f64::from(hr) => {
            return Err(SizeError::EnlargedContradiction { native: native.0, hr, scale });
        }
        (Some(hr), _) => f64::from(hr) / f64::from(native.0),
        (None, scale) => scale.unwrap_or(DEFAULT_SCALE),
    };
    if scale < 1.0 {
        return Err(SizeError::BelowPhotographs { hr: hr.unwrap_or_default(), native: native.0 });
    }
    Ok(Sizes { lr: native, hr: (scaled_by(native.0, scale), scaled_by(native.1, scale)) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_two_of_three() {
        let expected = Sizes { lr: (100, 100), hr: (200, 200) };
        let native = (800, 800);
        for (lr, hr, scale) in [
            (Some(100), Some(200), None),
            (Some(100), None, Some(2.0)),
            (None, Some(200), Some(2.0)),
            (Some(100), None, None),
            (Some(100), Some(200), Some(2.0)),
        ] {
            assert_eq!(downscaled_sizes(native, lr, hr, scale), Ok(expected));
        }
        assert_eq!(
            downscaled_sizes(native, None, None, None),
            Ok(Sizes { lr: (400, 400), hr: native })
        );
        assert_eq!(
            downscaled_sizes((504, 378), None, None, Some(4.0)),
            Ok(Sizes { lr: (126, 95), hr: (504, 378) })
        );
        assert!(!downscaled_sizes((504, 378), None, None, Some(4.0)).unwrap().is_integer());
    }

    #[test]
    fn photographs_can_be_the_lr_images() {
        let expected = Sizes { lr: (90, 61), hr: (135, 92) };
        for (hr, scale) in [(Some(135), None), (None, Some(1.5)), (Some(135), Some(1.5))] {
            assert_eq!(enlarged_sizes((90, 61), hr, scale), Ok(expected));
        }
        assert_eq!(enlarged_sizes((90, 61), None, None).map(|s| s.hr), Ok((180, 122)));
        assert!(matches!(
            enlarged_sizes((90, 61), Some(80), None),
            Err(SizeError::BelowPhotographs { hr: 80, native: 90 })
        ));
        assert!(matches!(
            enlarged_sizes((90, 61), Some(200), Some(2.0)),
            Err(SizeError::EnlargedContradiction { native: 90, hr: 200, .. })
        ));
    }

    #[test]
    fn enlarging_and_contradictions_are_refused() {
        assert!(matches!(
            downscaled_sizes((800, 800), Some(900), None, Some(1.0)),
            Err(SizeError::TooLarge { name: "lr_width", requested: 900, .. })
        ));
        assert!(matches!(
            downscaled_sizes((800, 800), Some(500), None, Some(2.0)),
            Err(SizeError::TooLarge { name: "hr_width", requested: 1000, .. })
        ));
        assert!(matches!(
            downscaled_sizes((800, 800), Some(500), Some(400), None),
            Err(SizeError::TooLarge { larger: "hr_width", .. })
        ));
        assert!(matches!(
            downscaled_sizes((800, 800), Some(100), Some(300), Some(2.0)),
            Err(SizeError::Contradiction { .. })
        ));
        assert!(matches!(
            downscaled_sizes((4, 4), None, None, Some(16.0)),
            Err(SizeError::Empty { .. })
        ));
        assert_eq!(
            downscaled_sizes((1, 1), None, None, None),
            Err(SizeError::Unchanged { scale: 2.0, hr: 1 })
        );
        assert_eq!(
            downscaled_sizes((10, 10), Some(10), None, Some(1.01)),
            Err(SizeError::Unchanged { scale: 1.01, hr: 10 })
        );
        assert_eq!(
            downscaled_sizes((1, 1), None, None, Some(1.0)),
            Ok(Sizes { lr: (1, 1), hr: (1, 1) })
        );
        assert_eq!(
            downscaled_sizes((9, 9), Some(9), Some(9), None),
            Ok(Sizes { lr: (9, 9), hr: (9, 9) })
        );
    }
}
