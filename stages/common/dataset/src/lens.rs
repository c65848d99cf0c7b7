use scene::Intrinsics;

/// The inside of a camera with a real lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// The pinhole camera that it would be.
    pub intrinsics: Intrinsics,
    /// How it isn't one.
    pub distortion: Distortion,
}

/// Radial and tangential distortion (Brown 1966), as OpenCV and COLMAP have it: a ray that a pinhole sees at (x, y), in units of the
/// focal length, is seen at (x·r + 2·p1·x·y + p2·(ρ + 2x²), y·r + p1·(ρ + 2y²) + 2·p2·x·y) with ρ = x² + y² and
/// r = 1 + k1·ρ + k2·ρ² + k3·ρ³. y points down.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// k1, k2, k3.
    pub radial: [f64; 3],
    /// p1, p2.
    pub tangential: [f64; 2],
}

/// How far, in units of the picture, undoing a distortion may cut its border off at most.
const MOST_ZOOM: f64 = 4.0;

impl Distortion {
    /// Whether it is a pinhole after all.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Where a pinhole's (x, y) is seen.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
        let square = x * x + y * y;
        let radial = 1.0 + square * (k1 + square * (k2 + square * k3));
        [x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x), y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y]
    }

    pub(crate) fn check(&self) -> Result<(), String> {
        match self.radial.iter().chain(&self.tangential).find(|k| !k.is_finite()) {
            Some(value) => Err(format!("a coefficient of distortion is {value}; all must be finite")),
            None => Ok(()),
        }
    }
}

impl Lens {
    /// A pinhole.
    pub fn pinhole(intrinsics: Intrinsics) -> Self {
        Self { intrinsics, distortion: Distortion::default() }
    }

    /// The same lens in front of another number of pixels.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        Self { intrinsics: self.intrinsics.resized(width, height), ..*self }
    }

    /// Where a pixel position of a pinhole picture lies in this lens's picture.
    pub fn source(&self, pinhole: &Intrinsics, x: f64, y: f64) -> [f64; 2] {
        let k = &self.intrinsics;
        let [u, v] = self.distortion.distort([(x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy]);
        [k.fx.mul_add(u, k.cx), k.fy.mul_add(v, k.cy)]
    }

    /// The pinhole camera of the same size that sees as much as it can and nothing that this lens doesn't. `None` where the distortion
    /// is beyond sense: its picture would have to be cut to a quarter and less.
    pub fn undistorted(&self) -> Option<Intrinsics> {
        let k = self.intrinsics;
        if self.distortion.is_none() {
            return Some(k);
        }
        let zoomed = |zoom: f64| Intrinsics { fx: k.fx * zoom, fy: k.fy * zoom, ..k };
        let fits = |zoom: f64| self.sees_all_of(&zoomed(zoom));
        let (mut low, mut high) = (1.0 / MOST_ZOOM, MOST_ZOOM);
        if !fits(high) {
            return None;
        }
        if fits(low) {
            return Some(zoomed(low));
        }
        // Bisection of the zoom, until it moves no corner by a hundredth of a pixel.
        while (high - low) * f64::from(k.width.max(k.height)) > 0.01 {
            let middle = 0.5 * (low + high);
            if fits(middle) { high = middle } else { low = middle }
        }
        Some(zoomed(high))
    }

    /// Whether the whole border of a pinhole picture lies inside this lens's, and in order: beyond a radius a distortion may fold back.
    fn sees_all_of(&self, pinhole: &Intrinsics) -> bool {
        const STEPS: u32 = 64;
        let (width, height) = (f64::from(pinhole.width), f64::from(pinhole.height));
        let inside = |[x, y]: [f64; 2]| {
            let slack = 1e-6;
            (-slack..=width + slack).contains(&x) && (-slack..=height + slack).contains(&y)
        };
        let in_order = |x: f64, y: f64| {
            // From the principal point outwards, what is seen must move outwards, too.
            let mut last = -1.0;
            (0..=16).all(|i| {
                let share = f64::from(i) / 16.0;
                let at = |from: f64, to: f64| share.mul_add(to - from, from);
                let [u, v] = self.source(pinhole, at(pinhole.cx, x), at(pinhole.cy, y));
                let radius = (u - self.intrinsics.cx).hypot(v - self.intrinsics.cy);
                let grows = radius > last;
                last = radius;
                grows
            })
        };
        (0..=STEPS).all(|i| {
            let share = f64::from(i) / f64::from(STEPS);
            [(share * width, 0.0), (share * width, height), (0.0, share * height), (width, share * height)]
                .into_iter()
                .all(|(x, y)| inside(self.source(pinhole, x, y)) && in_order(x, y))
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn lens(radial: [f64; 3], tangential: [f64; 2]) -> Lens {
        let intrinsics = Intrinsics { width: 400, height: 300, fx: 350.0, fy: 355.0, cx: 203.0, cy: 148.0 };
        Lens { intrinsics, distortion: Distortion { radial, tangential } }
    }

    #[test]
    fn a_pinhole_stays_as_it_is() {
        let pinhole = lens([0.0; 3], [0.0; 2]);
        assert_eq!(pinhole.undistorted(), Some(pinhole.intrinsics));
        let [x, y] = pinhole.source(&pinhole.intrinsics, 17.5, 3.25);
        assert!((x - 17.5).abs() < 1e-12 && (y - 3.25).abs() < 1e-12);
    }

    #[test]
    fn nonsense_is_no_lens() {
        assert_eq!(lens([-40.0, 0.0, 0.0], [0.0; 2]).undistorted(), None);
        assert!(Distortion { radial: [f64::NAN, 0.0, 0.0], tangential: [0.0; 2] }.check().is_err());
    }

    proptest! {
        /// What the pinhole camera sees lies inside the picture, and a slightly wider one would see past it.
        #[test]
        fn undistorting_keeps_as_much_as_there_is(
            k1 in -0.3..0.3f64, k2 in -0.05..0.05f64, p1 in -0.01..0.01f64, p2 in -0.01..0.01f64,
        ) {
            let lens = lens([k1, k2, 0.0], [p1, p2]);
            let pinhole = lens.undistorted().expect("a mild distortion");
            prop_assert!(lens.sees_all_of(&pinhole));
            let wider = Intrinsics { fx: pinhole.fx * 0.99, fy: pinhole.fy * 0.99, ..pinhole };
            prop_assert!(!lens.sees_all_of(&wider));
        }
    }
}
