/// LR and HR size, (width, height).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// Size of the LR images.
    pub lr: (u32, u32),
    /// Size of the HR images.
    pub hr: (u32, u32),
}

impl Sizes {
    /// Whether the HR size is a whole multiple of the LR size on both axes.
    pub fn is_integer(&self) -> bool {
        self.hr.0.is_multiple_of(self.lr.0) && self.hr.1.is_multiple_of(self.lr.1)
    }
}

/// Sizes that can't be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SizeError {
    /// All three given, and they contradict each other.
    #[error(
        "lr_width = {lr}, hr_width = {hr} and scale = {scale} contradict each other; give two of \
        them"
    )]
    Contradiction {
        /// LR width.
        lr: u32,
        /// HR width.
        hr: u32,
        /// Scale.
        scale: f64,
    },
    /// An image would have to be enlarged.
    #[error(
        "{name} = {asked} pixels wide is larger than {larger} = {limit}; choose a smaller {name}"
    )]
    TooLarge {
        /// Which size.
        name: &'static str,
        /// Its width.
        asked: u32,
        /// What it must not exceed.
        larger: &'static str,
        /// That width.
        limit: u32,
    },
    /// LR images would be the HR ones.
    #[error(
        "scale = {scale} makes LR images of {hr} pixels from HR images of {hr}; give larger \
        images, or choose scale = 1"
    )]
    Unchanged {
        /// Scale.
        scale: f64,
        /// HR width.
        hr: u32,
    },
    /// Nothing would be left.
    #[error("scale = {scale} leaves no pixel of {hr}; choose a smaller scale")]
    Nothing {
        /// Scale.
        scale: f64,
        /// HR width.
        hr: u32,
    },
}

/// LR and HR size from what is given of `lr_width`, `hr_width` and `scale`. Widths are given;
/// heights follow the data's aspect.
pub fn sizes(
    native: (u32, u32),
    lr: Option<u32>,
    hr: Option<u32>,
    scale: Option<f64>,
) -> Result<Sizes, SizeError> {
    let times = |w: u32, s: f64| (f64::from(w) * s).round() as u32;
    // Where both widths are given, they say the scale.
    let given = if lr.is_some() && hr.is_some() { scale } else { Some(scale.unwrap_or(2.0)) };
    let (lr, hr) = match (lr, hr, scale) {
        (Some(lr), Some(hr), Some(scale)) if times(lr, scale) != hr => {
            return Err(SizeError::Contradiction { lr, hr, scale });
        }
        (Some(lr), Some(hr), _) => (lr, hr),
        (Some(lr), None, scale) => (lr, times(lr, scale.unwrap_or(2.0))),
        (None, hr, scale) => {
            let hr = hr.unwrap_or(native.0);
            (times(hr, 1.0 / scale.unwrap_or(2.0)), hr)
        }
    };
    if lr == 0 {
        return Err(SizeError::Nothing { scale: scale.unwrap_or(2.0), hr });
    }
    if let Some(scale) = given.filter(|scale| *scale > 1.0 && lr == hr) {
        return Err(SizeError::Unchanged { scale, hr });
    }
    if hr > native.0 {
        let name = if lr > native.0 { "lr_width" } else { "hr_width" };
        let asked = if lr > native.0 { lr } else { hr };
        return Err(SizeError::TooLarge {
            name,
            asked,
            larger: "the data's images",
            limit: native.0,
        });
    }
    if lr > hr {
        return Err(SizeError::TooLarge {
            name: "lr_width",
            asked: lr,
            larger: "hr_width",
            limit: hr,
        });
    }
    let height = |width: u32| scaled(native.1, native.0, width);
    Ok(Sizes { lr: (lr, height(lr)), hr: (hr, height(hr)) })
}

/// A length where `from` becomes `to`, in whole pixels.
pub(crate) fn scaled(length: u32, from: u32, to: u32) -> u32 {
    ((f64::from(length) * f64::from(to) / f64::from(from)).round() as u32).max(1)
}

/// LR and HR size where the photographs are the LR images: HR from `hr_width` or `scale`.
pub fn enlarged(
    native: (u32, u32),
    hr: Option<u32>,
    scale: Option<f64>,
) -> Result<Sizes, SizeError> {
    let scale = match (hr, scale) {
        (Some(hr), Some(scale)) if (f64::from(native.0) * scale).round() != f64::from(hr) => {
            return Err(SizeError::Contradiction { lr: native.0, hr, scale });
        }
        (Some(hr), _) => f64::from(hr) / f64::from(native.0),
        (None, scale) => scale.unwrap_or(2.0),
    };
    if scale < 1.0 {
        return Err(SizeError::TooLarge {
            name: "lr_width",
            asked: native.0,
            larger: "hr_width",
            limit: hr.unwrap_or_default(),
        });
    }
    let times = |length: u32| (f64::from(length) * scale).round() as u32;
    Ok(Sizes { lr: native, hr: (times(native.0), times(native.1)) })
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
            assert_eq!(sizes(native, lr, hr, scale), Ok(expected));
        }
        assert_eq!(sizes(native, None, None, None), Ok(Sizes { lr: (400, 400), hr: native }));
        assert_eq!(
            sizes((504, 378), None, None, Some(4.0)),
            Ok(Sizes { lr: (126, 95), hr: (504, 378) })
        );
        assert!(!sizes((504, 378), None, None, Some(4.0)).unwrap().is_integer());
    }

    #[test]
    fn photographs_can_be_the_lr_images() {
        let expected = Sizes { lr: (90, 61), hr: (135, 92) };
        for (hr, scale) in [(Some(135), None), (None, Some(1.5)), (Some(135), Some(1.5))] {
            assert_eq!(enlarged((90, 61), hr, scale), Ok(expected));
        }
        assert_eq!(enlarged((90, 61), None, None).map(|s| s.hr), Ok((180, 122)));
        assert!(matches!(
            enlarged((90, 61), Some(80), None),
            Err(SizeError::TooLarge { name: "lr_width", asked: 90, limit: 80, .. })
        ));
        assert!(matches!(
            enlarged((90, 61), Some(200), Some(2.0)),
            Err(SizeError::Contradiction { .. })
        ));
    }

    #[test]
    fn enlarging_and_contradictions_are_refused() {
        assert!(matches!(
            sizes((800, 800), Some(900), None, Some(1.0)),
            Err(SizeError::TooLarge { name: "lr_width", asked: 900, .. })
        ));
        assert!(matches!(
            sizes((800, 800), Some(500), None, Some(2.0)),
            Err(SizeError::TooLarge { name: "hr_width", asked: 1000, .. })
        ));
        assert!(matches!(
            sizes((800, 800), Some(500), Some(400), None),
            Err(SizeError::TooLarge { larger: "hr_width", .. })
        ));
        assert!(matches!(
            sizes((800, 800), Some(100), Some(300), Some(2.0)),
            Err(SizeError::Contradiction { .. })
        ));
        assert!(matches!(sizes((4, 4), None, None, Some(16.0)), Err(SizeError::Nothing { .. })));
        assert_eq!(
            sizes((1, 1), None, None, None),
            Err(SizeError::Unchanged { scale: 2.0, hr: 1 })
        );
        assert_eq!(
            sizes((10, 10), Some(10), None, Some(1.01)),
            Err(SizeError::Unchanged { scale: 1.01, hr: 10 })
        );
        assert_eq!(sizes((1, 1), None, None, Some(1.0)), Ok(Sizes { lr: (1, 1), hr: (1, 1) }));
        assert_eq!(sizes((9, 9), Some(9), Some(9), None), Ok(Sizes { lr: (9, 9), hr: (9, 9) }));
    }
}
