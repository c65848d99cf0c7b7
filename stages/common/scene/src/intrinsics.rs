use pixels::Mask;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::lens::Distortion;

/// A camera's inside, in pixels: a pinhole, and how its lens isn't one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x; the image's left edge is 0.
    pub cx: f64,
    /// Principal point, y; the image's top edge is 0.
    pub cy: f64,
    /// The lens's projection and distortion; a pinhole's by default.
    #[serde(default, skip_serializing_if = "Distortion::is_none")]
    pub distortion: Distortion,
}

/// How far, in units of the image, undoing a distortion may cut its border off at most.
const MOST_ZOOM: f64 = 4.0;

/// Places along each side of an image at which a distortion is looked at.
const BORDER_PLACES: u32 = 64;

/// Maximum of half a side over the focal length for a pinhole camera that takes a fisheye's place:
/// tan 50°. At 100° across, the border has 2.4 times as many pixels per degree as the middle; wider
/// views would spend ever more of the image on their borders.
const MAX_PINHOLE_SLOPE: f64 = 1.191_753_592_594_21;

impl Intrinsics {
    /// A centred camera with square pixels that sees `angle_x` radians from left to right edge.
    pub fn from_angle_x(width: u32, height: u32, angle_x: f64) -> Self {
        let focal = 0.5 * f64::from(width) / (0.5 * angle_x).tan();
        let (cx, cy) = (0.5 * f64::from(width), 0.5 * f64::from(height));
        Self { width, height, fx: focal, fy: focal, cx, cy, distortion: Distortion::default() }
    }

    /// The same camera with another number of pixels on the same sensor. The scale may differ per
    /// axis.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) =
            (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            ..*self
        }
    }

    /// Where in its image a camera without the distortion sees what this one sees at a position, in
    /// pixels.
    pub fn undistort(&self, at: [f64; 2]) -> [f64; 2] {
        if self.distortion.is_none() {
            return at;
        }
        let [x, y] =
            self.distortion.undistort([(at[0] - self.cx) / self.fx, (at[1] - self.cy) / self.fy]);
        [self.fx.mul_add(x, self.cx), self.fy.mul_add(y, self.cy)]
    }

    /// Where in its image this camera sees what one without the distortion sees at a position, in
    /// pixels.
    pub fn distort(&self, at: [f64; 2]) -> [f64; 2] {
        if self.distortion.is_none() {
            return at;
        }
        let [u, v] =
            self.distortion.distort([(at[0] - self.cx) / self.fx, (at[1] - self.cy) / self.fy]);
        [self.fx.mul_add(u, self.cx), self.fy.mul_add(v, self.cy)]
    }

    /// The pinhole camera of the same size that sees as much as it can and nothing that this one
    /// doesn't; in place of a fisheye lens it sees at most 100° across its longer side. `None` where
    /// the distortion is beyond sense: its image would have to be cut to a quarter and less.
    pub fn pinhole(&self) -> Option<Self> {
        let pinhole = Self { distortion: Distortion::default(), ..*self };
        if self.distortion.is_none() {
            return Some(pinhole);
        }
        let zoomed = |zoom: f64| Self { fx: self.fx * zoom, fy: self.fy * zoom, ..pinhole };
        let fits = |zoom: f64| self.sees_all_of(&zoomed(zoom));
        let (mut low, mut high) = (self.least_zoom(), MOST_ZOOM);
        if !fits(high) {
            return None;
        }
        if fits(low) {
            return Some(zoomed(low));
        }
        // Bisection of the zoom, until it moves no corner by a hundredth of a pixel.
        while (high - low) * f64::from(self.width.max(self.height)) > 0.01 {
            let middle = 0.5 * (low + high);
            if fits(middle) { high = middle } else { low = middle }
        }
        Some(zoomed(high))
    }

    /// Returns the least zoom of a pinhole camera that takes this one's place.
    fn least_zoom(&self) -> f64 {
        let least = 1.0 / MOST_ZOOM;
        if !self.distortion.is_fisheye() {
            return least;
        }
        let zoom = |size: u32, focal: f64| 0.5 * f64::from(size) / (focal * MAX_PINHOLE_SLOPE);
        least.max(zoom(self.width, self.fx)).max(zoom(self.height, self.fy)).min(MOST_ZOOM)
    }

    /// Returns a pinhole's angles of view across width and height, in degrees.
    pub fn pinhole_angles(&self) -> [f64; 2] {
        let angle = |centre: f64, size: u32, focal: f64| {
            let sides = [centre, f64::from(size) - centre];
            sides.map(|side| libm::atan(side / focal)).iter().sum::<f64>().to_degrees()
        };
        [angle(self.cx, self.width, self.fx), angle(self.cy, self.height, self.fy)]
    }

    /// Returns the mask of pixels whose centre's ray isn't cut, or `None` if no ray is: those of a
    /// fisheye lens are, 89° from the axis.
    pub fn lens_mask(&self) -> Option<Mask> {
        if !self.has_cut_rays() {
            return None;
        }
        let (width, height) = (self.width as usize, self.height as usize);
        let centre = |i: usize| [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5];
        let counts = (0..width * height).map(|i| !self.is_cut(centre(i))).collect();
        Some(Mask { width, height, counts })
    }

    /// True if rays of the image are cut, as those of a fisheye lens are 89° from the axis.
    pub fn has_cut_rays(&self) -> bool {
        self.border().any(|at| self.is_cut(at))
    }

    /// True if the ray at a position, in pixels, is that of another: a fisheye's ray is cut 89°
    /// from the axis.
    pub fn is_cut(&self, [x, y]: [f64; 2]) -> bool {
        self.distortion.is_cut([(x - self.cx) / self.fx, (y - self.cy) / self.fy])
    }

    /// Where in this camera's image what another, at the same place, sees at a position.
    pub fn source(&self, other: &Self, at: [f64; 2]) -> [f64; 2] {
        let [x, y] = other.undistort(at);
        self.distort([
            self.fx.mul_add((x - other.cx) / other.fx, self.cx),
            self.fy.mul_add((y - other.cy) / other.fy, self.cy),
        ])
    }

    /// Positions along the image's border: its corners, and what lies between them where lines may
    /// be bent.
    pub fn border(&self) -> impl Iterator<Item = [f64; 2]> {
        let steps = if self.distortion.is_none() { 1 } else { BORDER_PLACES };
        let (width, height) = (f64::from(self.width), f64::from(self.height));
        (0..steps).flat_map(move |i| {
            let share = f64::from(i) / f64::from(steps);
            [
                [share * width, 0.0],
                [width, share * height],
                [(1.0 - share) * width, height],
                [0.0, (1.0 - share) * height],
            ]
        })
    }

    /// Whether each place in the image belongs to one ray.
    pub(crate) fn has_rays(&self) -> bool {
        let place = |[x, y]: [f64; 2]| [(x - self.cx) / self.fx, (y - self.cy) / self.fy];
        self.distortion.is_none() || self.border().all(|at| self.distortion.can_undo(place(at)))
    }

    /// Whether the whole border of a pinhole image lies inside this camera's, and in order.
    fn sees_all_of(&self, pinhole: &Self) -> bool {
        // Of a bent image's border, as many places as of its own.
        Self { distortion: self.distortion, ..*pinhole }
            .border()
            .all(|at| self.holds(self.source(pinhole, at)) && self.keeps_order(pinhole, at))
    }

    /// Whether a position lies in the image, or beside it by no more than a rounding error.
    fn holds(&self, [x, y]: [f64; 2]) -> bool {
        let (width, height) = (f64::from(self.width), f64::from(self.height));
        let slack = 1e-6;
        (-slack..=width + slack).contains(&x) && (-slack..=height + slack).contains(&y)
    }

    /// Whether on the way from a pinhole's principal point out to a position, what is seen moves
    /// outwards, too.
    fn keeps_order(&self, pinhole: &Self, [x, y]: [f64; 2]) -> bool {
        let mut last = -1.0;
        (0..=16).all(|i| {
            let share = f64::from(i) / 16.0;
            let at = |from: f64, to: f64| share.mul_add(to - from, from);
            let [u, v] = self.source(pinhole, [at(pinhole.cx, x), at(pinhole.cy, y)]);
            let radius = (u - self.cx).hypot(v - self.cy);
            let grows = radius > last;
            last = radius;
            grows
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn camera(distortion: Distortion) -> Intrinsics {
        Intrinsics {
            width: 400,
            height: 300,
            fx: 350.0,
            fy: 355.0,
            cx: 203.0,
            cy: 148.0,
            distortion,
        }
    }

    #[test]
    fn a_pinhole_stays_as_it_is() {
        let pinhole = camera(Distortion::default());
        assert_eq!(pinhole.pinhole(), Some(pinhole));
        let [x, y] = pinhole.source(&pinhole, [17.5, 3.25]);
        assert!((x - 17.5).abs() < 1e-12 && (y - 3.25).abs() < 1e-12);
        assert_eq!(pinhole.border().count(), 4);
    }

    #[test]
    fn nonsense_is_no_lens() {
        let bent = |radial, tangential| camera(Distortion::brown(radial, tangential));
        let folded = bent([-40.0, 0.0, 0.0], [0.0; 2]);
        assert_eq!(folded.pinhole(), None);
        assert!(!folded.has_rays());
        assert!(!bent([f64::NAN, 0.0, 0.0], [0.0; 2]).has_rays());
        // Bent a little further than any mild lens, the image folds in one corner alone.
        assert!(!bent([-0.193, -0.047, -0.0156], [-0.0056, 0.0078]).has_rays());
    }

    /// A fisheye camera that sees so many degrees from left to right, without distortion.
    fn fisheye(degrees: f64) -> Intrinsics {
        let focal = 400.0 / degrees.to_radians();
        Intrinsics { fx: focal, fy: focal, ..camera(Distortion::fisheye([0.0; 4])) }
    }

    /// Pixels beyond 89° are masked, by the angle of their centres.
    #[test]
    fn pixels_beyond_the_last_ray_are_masked() {
        let wide = fisheye(200.0);
        assert!(wide.has_rays());
        let mask = wide.lens_mask().unwrap();
        for (i, counts) in mask.counts.iter().enumerate() {
            let (x, y) = ((i % 400) as f64 + 0.5 - wide.cx, (i / 400) as f64 + 0.5 - wide.cy);
            assert_eq!(*counts, (x.hypot(y) / wide.fx).to_degrees() < 89.0, "{x} {y}");
        }
        assert_eq!(fisheye(140.0).lens_mask(), None);
        assert_eq!(camera(Distortion::default()).lens_mask(), None);
    }

    /// In place of a fisheye a pinhole sees at most 100° across, and less if the lens does.
    #[test]
    fn a_fisheyes_pinhole_has_a_known_angle() {
        for (degrees, expected) in [(200.0, 100.0), (120.0, 100.0)] {
            let pinhole = fisheye(degrees).pinhole().unwrap();
            let [across, down] = pinhole.pinhole_angles();
            assert!((across - expected).abs() < 0.1 && down < across, "{degrees}: {across} {down}");
            assert!(pinhole.distortion.is_none());
        }
        let [across, _] = fisheye(60.0).pinhole().unwrap().pinhole_angles();
        assert!((50.0..60.0).contains(&across), "{across}");
    }

    /// Cameras with lenses that bend, but fold no corner of the image.
    fn mild() -> impl Strategy<Value = Intrinsics> {
        use crate::lens::tests::{fisheye, higher, mild};
        prop_oneof![mild(), higher(), fisheye()].prop_map(camera)
    }

    proptest! {
        /// What the pinhole camera sees lies inside the image, and a slightly wider one would see
        /// past it.
        #[test]
        fn a_pinhole_sees_as_much_as_there_is(camera in mild()) {
            let pinhole = camera.pinhole().expect("a mild distortion");
            prop_assert!(camera.sees_all_of(&pinhole));
            let wider = Intrinsics { fx: pinhole.fx * 0.99, fy: pinhole.fy * 0.99, ..pinhole };
            prop_assert!(!camera.sees_all_of(&wider));
        }

        #[test]
        fn undistorting_undoes_distorting(camera in mild(), x in 0.0..400.0f64,
            y in 0.0..300.0f64) {
            prop_assert!(camera.has_rays());
            let [u, v] = camera.distort(camera.undistort([x, y]));
            prop_assert!((u - x).hypot(v - y) < 1e-9, "{u} {v}");
        }
    }
}
