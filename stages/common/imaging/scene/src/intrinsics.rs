use pixels::{Mask, Rgba8, sample_cubic};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::lens::Distortion;

/// Intrinsic parameters of a camera in pixels: a pinhole's, and the lens's distortion.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Number of columns.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x; the image's left edge is 0.
    pub cx: f64,
    /// Principal point, y; the image's top edge is 0.
    pub cy: f64,
    /// Projection and distortion of the lens; a pinhole's by default.
    #[serde(default, skip_serializing_if = "Distortion::is_none")]
    pub distortion: Distortion,
}

/// Maximum factor by which undistortion may change the focal length; chosen by hand.
const MAX_ZOOM: f64 = 4.0;

/// Number of positions along each side of an image at which a distortion is checked; chosen by
/// hand.
const BORDER_SAMPLES: u32 = 64;

/// Number of intervals on the way from the centre to a border position in which it is checked that
/// the distortion doesn't fold the image; chosen by hand.
const ORDER_SAMPLES: u32 = 16;

/// Maximum tangent of the half field of view of a pinhole camera that replaces a fisheye: tan 50°.
/// At 100° across, the border has 2.4 times as many pixels per degree as the middle; wider views
/// would spend ever more of the image on their borders.
const MAX_PINHOLE_SLOPE: f64 = 1.191_753_592_594_21;

impl Intrinsics {
    /// Creates the intrinsics of a centred camera with square pixels and a horizontal angle of view
    /// of `angle_x` radians.
    pub fn from_angle_x(width: u32, height: u32, angle_x: f64) -> Self {
        let focal = 0.5 * f64::from(width) / libm::tan(0.5 * angle_x);
        let [cx, cy] = [width, height].map(|side| 0.5 * f64::from(side));
        Self { width, height, fx: focal, fy: focal, cx, cy, distortion: Distortion::default() }
    }

    /// Returns the intrinsics of another image size on the same sensor. The scale may differ per
    /// axis.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
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

    /// Returns the plane position, in focal lengths, of an image position in pixels.
    fn to_plane(self, [x, y]: [f64; 2]) -> [f64; 2] {
        [(x - self.cx) / self.fx, (y - self.cy) / self.fy]
    }

    /// Returns the image position, in pixels, of a plane position in focal lengths.
    fn to_image(self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.fx.mul_add(x, self.cx), self.fy.mul_add(y, self.cy)]
    }

    /// Converts a distorted image position to the undistorted one, in pixels.
    pub fn undistort(&self, position: [f64; 2]) -> [f64; 2] {
        if self.distortion.is_none() {
            return position;
        }
        self.to_image(self.distortion.undistort(self.to_plane(position)))
    }

    /// Converts an undistorted image position to the distorted one, in pixels.
    pub fn distort(&self, position: [f64; 2]) -> [f64; 2] {
        if self.distortion.is_none() {
            return position;
        }
        self.to_image(self.distortion.distort(self.to_plane(position)))
    }

    /// Returns the pinhole camera of the same size with the widest view inside this camera's; in
    /// place of a centred fisheye lens the view is at most 100° across its longer side. `None` if
    /// the pinhole would have to zoom by more than 4.
    pub fn pinhole(&self) -> Option<Self> {
        if self.distortion.is_none() {
            return Some(self.zoomed_pinhole(1.0));
        }
        let fits = |zoom| self.contains_view(&self.zoomed_pinhole(zoom));
        let (mut low, mut high) = (self.min_zoom(), MAX_ZOOM);
        if !fits(high) {
            return None;
        }
        if fits(low) {
            high = low;
        }
        // Bisection of the zoom, until it moves no corner by a hundredth of a pixel.
        while (high - low) * f64::from(self.width.max(self.height)) > 0.01 {
            let middle = 0.5 * (low + high);
            if fits(middle) {
                high = middle;
            } else {
                low = middle;
            }
        }
        Some(self.zoomed_pinhole(high))
    }

    fn zoomed_pinhole(&self, zoom: f64) -> Self {
        let distortion = Distortion::default();
        Self { fx: self.fx * zoom, fy: self.fy * zoom, distortion, ..*self }
    }

    /// Returns the minimum zoom of a pinhole camera that replaces this one.
    fn min_zoom(&self) -> f64 {
        let min = 1.0 / MAX_ZOOM;
        if !self.distortion.is_fisheye() {
            return min;
        }
        let [x, y] = [(self.width, self.fx), (self.height, self.fy)]
            .map(|(size, focal)| 0.5 * f64::from(size) / (focal * MAX_PINHOLE_SLOPE));
        min.max(x).max(y).min(MAX_ZOOM)
    }

    /// Returns a pinhole's angles of view across width and height, in degrees.
    pub fn pinhole_angles(&self) -> [f64; 2] {
        [(self.cx, self.width, self.fx), (self.cy, self.height, self.fy)].map(
            |(centre, size, focal)| {
                let sides = [centre, f64::from(size) - centre];
                sides.map(|side| libm::atan(side / focal)).iter().sum::<f64>().to_degrees()
            },
        )
    }

    /// Returns the mask of pixels with valid rays; `None` if all are valid. A clamped ray
    /// (see [`Intrinsics::is_clamped`]) is not valid.
    pub fn lens_mask(&self) -> Option<Mask> {
        if !self.has_clamped_rays() {
            return None;
        }
        let (width, height) = (self.width as usize, self.height as usize);
        let counts = (0..width * height)
            .map(|i| !self.is_clamped([(i % width) as f64 + 0.5, (i / width) as f64 + 0.5]))
            .collect();
        Some(Mask { width, height, counts })
    }

    /// True if a ray of the image is clamped (see [`Intrinsics::is_clamped`]).
    pub fn has_clamped_rays(&self) -> bool {
        self.border().any(|position| self.is_clamped(position))
    }

    /// True if the fisheye ray at a position, in pixels, is more than 89° from the axis and is
    /// clamped.
    pub fn is_clamped(&self, position: [f64; 2]) -> bool {
        self.distortion.is_clamped(self.to_plane(position))
    }

    /// Converts an image position of `other`, a camera with the same pose, to this camera's image.
    pub fn source_position(&self, other: &Self, position: [f64; 2]) -> [f64; 2] {
        self.distort(self.to_image(other.to_plane(other.undistort(position))))
    }

    /// Returns positions along the image's border: its corners and, if the lens bends lines,
    /// positions between them.
    pub fn border(&self) -> impl Iterator<Item = [f64; 2]> {
        let steps = if self.distortion.is_none() { 1 } else { BORDER_SAMPLES };
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

    /// Returns whether the distortion is invertible along the image's border, and hence every image
    /// position has exactly one ray.
    pub(crate) fn has_unique_rays(&self) -> bool {
        self.distortion.is_none()
            || self
                .border()
                .all(|position| self.distortion.is_invertible_at(self.to_plane(position)))
    }

    /// Returns whether the border of a pinhole's image is inside this camera's image, and the
    /// distortion doesn't fold it.
    fn contains_view(&self, pinhole: &Self) -> bool {
        // With this camera's distortion, `border` samples each side.
        Self { distortion: self.distortion, ..*pinhole }.border().all(|position| {
            self.contains(self.source_position(pinhole, position))
                && self.keeps_order(pinhole, position)
        })
    }

    /// Returns whether a position is inside the image, up to rounding errors.
    fn contains(&self, [x, y]: [f64; 2]) -> bool {
        const SLACK: f64 = 1e-6;
        (-SLACK..=f64::from(self.width) + SLACK).contains(&x)
            && (-SLACK..=f64::from(self.height) + SLACK).contains(&y)
    }

    /// Returns whether positions on the way from a pinhole's principal point to `[x, y]` move
    /// outwards in this camera's image, too.
    fn keeps_order(&self, pinhole: &Self, [x, y]: [f64; 2]) -> bool {
        let mut last = -1.0;
        (0..=ORDER_SAMPLES).all(|i| {
            let share = f64::from(i) / f64::from(ORDER_SAMPLES);
            let [u, v] = self.source_position(
                pinhole,
                [
                    share.mul_add(x - pinhole.cx, pinhole.cx),
                    share.mul_add(y - pinhole.cy, pinhole.cy),
                ],
            );
            let radius = (u - self.cx).hypot(v - self.cy);
            let grows = radius > last;
            last = radius;
            grows
        })
    }
}

/// Maximum deviation of an interpolated opacity from 1 that rounding of the weights causes.
const OPACITY_ROUNDING: f64 = 1e-9;

/// Resamples an image taken with a distorting lens to that of a pinhole camera of the same size and
/// pose. Cubic interpolation preserves sharpness. Colours are interpolated premultiplied by alpha,
/// so that those of transparent pixels have no influence.
pub fn undistort_image(image: &Rgba8, taken_with: &Intrinsics, pinhole: &Intrinsics) -> Rgba8 {
    let mut data = Vec::with_capacity(image.data.len());
    for y in 0..image.height {
        for x in 0..image.width {
            let source = taken_with.source_position(pinhole, [x as f64 + 0.5, y as f64 + 0.5]);
            let [r, g, b, a] = sample_cubic((image.width, image.height), source, |column, row| {
                let pixel = 4 * (row * image.width + column);
                let [r, g, b, a] = [0, 1, 2, 3].map(|c| f64::from(image.data[pixel + c]));
                let opacity = a / 255.0;
                [r * opacity, g * opacity, b * opacity, a]
            });
            let mut opacity = a / 255.0;
            if (opacity - 1.0).abs() < OPACITY_ROUNDING {
                // Opaque pixels keep their colours exactly.
                opacity = 1.0;
            }
            let alpha = (a + 0.5) as u8;
            let colour = if alpha == 0 { [0.0; 3] } else { [r, g, b].map(|v| v / opacity) };
            data.extend(colour.map(|v| (v + 0.5) as u8));
            data.push(alpha);
        }
    }
    Rgba8::new(image.width, image.height, data)
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
    fn a_pinhole_stays_unchanged() {
        let pinhole = camera(Distortion::default());
        assert_eq!(pinhole.pinhole(), Some(pinhole));
        let [x, y] = pinhole.source_position(&pinhole, [17.5, 3.25]);
        assert!((x - 17.5).abs() < 1e-12 && (y - 3.25).abs() < 1e-12);
        assert_eq!(pinhole.border().count(), 4);
    }

    #[test]
    fn folding_and_nan_distortions_are_rejected() {
        let distorted = |radial, tangential| camera(Distortion::brown(radial, tangential));
        let folded = distorted([-40.0, 0.0, 0.0], [0.0; 2]);
        assert_eq!(folded.pinhole(), None);
        assert!(!folded.has_unique_rays());
        assert!(!distorted([f64::NAN, 0.0, 0.0], [0.0; 2]).has_unique_rays());
        // With slightly more distortion than any mild lens, the image folds in only one corner.
        assert!(!distorted([-0.193, -0.047, -0.0156], [-0.0056, 0.0078]).has_unique_rays());
    }

    /// Creates a fisheye camera without distortion whose view is `degrees` wide.
    fn fisheye(degrees: f64) -> Intrinsics {
        let focal = 400.0 / degrees.to_radians();
        Intrinsics { fx: focal, fy: focal, ..camera(Distortion::fisheye([0.0; 4])) }
    }

    /// Pixels whose centres are at least 89° from the axis are masked.
    #[test]
    fn pixels_with_clamped_rays_are_masked() {
        let wide = fisheye(200.0);
        assert!(wide.has_unique_rays());
        let mask = wide.lens_mask().unwrap();
        for (i, is_valid) in mask.counts.iter().enumerate() {
            let (x, y) = ((i % 400) as f64 + 0.5 - wide.cx, (i / 400) as f64 + 0.5 - wide.cy);
            assert_eq!(*is_valid, (x.hypot(y) / wide.fx).to_degrees() < 89.0, "{x} {y}");
        }
        assert_eq!(fisheye(140.0).lens_mask(), None);
        assert_eq!(camera(Distortion::default()).lens_mask(), None);
    }

    /// A pinhole that replaces a fisheye is at most 100° wide, and less for a narrower lens.
    #[test]
    fn a_fisheyes_pinhole_has_a_limited_angle_of_view() {
        for (degrees, expected) in [(200.0, 100.0), (120.0, 100.0)] {
            let pinhole = fisheye(degrees).pinhole().unwrap();
            let [across, down] = pinhole.pinhole_angles();
            assert!((across - expected).abs() < 0.1 && down < across, "{degrees}: {across} {down}");
            assert!(pinhole.distortion.is_none());
        }
        let [across, _] = fisheye(60.0).pinhole().unwrap().pinhole_angles();
        assert!((50.0..60.0).contains(&across), "{across}");
    }

    /// White pixels stay white next to transparent black ones. Alpha is interpolated like a colour
    /// of an opaque image.
    #[test]
    fn colours_of_transparent_pixels_have_no_influence() {
        let lens = camera(Distortion::brown([-0.15, 0.0, 0.0], [0.0; 2]));
        let lens = lens.resized(40, 30);
        let is_white = |i: usize| (i % 40 / 4 + i / 160).is_multiple_of(2);
        let image = |pixel: fn(bool) -> [u8; 4]| {
            Rgba8::new(40, 30, (0..1200).flat_map(|i| pixel(is_white(i))).collect())
        };
        let undistorted =
            |image: &Rgba8| undistort_image(image, &lens, &lens.pinhole().unwrap()).data;
        let white = undistorted(&image(|white| if white { [255; 4] } else { [0; 4] }));
        let opaque = undistorted(&image(|white| [if white { 255 } else { 0 }, 9, 0, 255]));
        let mut partial = 0;
        for (white, opaque) in white.chunks_exact(4).zip(opaque.chunks_exact(4)) {
            assert_eq!(white, if opaque[0] == 0 { [0; 4] } else { [255, 255, 255, opaque[0]] });
            assert_eq!(opaque[1..], [9, 0, 255]);
            partial += usize::from((1..255).contains(&opaque[0]));
        }
        assert!(partial > 100, "{partial}");
    }

    /// Generates cameras whose distortion folds no corner of the image.
    fn mild() -> impl Strategy<Value = Intrinsics> {
        use crate::lens::tests::{fisheye, higher, mild};
        prop_oneof![mild(), higher(), fisheye()].prop_map(camera)
    }

    proptest! {
        /// The pinhole's view is inside the image; a slightly wider pinhole's view isn't.
        #[test]
        fn a_pinhole_has_the_widest_view_inside_the_image(camera in mild()) {
            let pinhole = camera.pinhole().expect("a mild distortion");
            prop_assert!(camera.contains_view(&pinhole));
            let wider = Intrinsics { fx: pinhole.fx * 0.99, fy: pinhole.fy * 0.99, ..pinhole };
            prop_assert!(!camera.contains_view(&wider));
        }

        #[test]
        fn undistorting_undoes_distorting(camera in mild(), x in 0.0..400.0f64,
            y in 0.0..300.0f64) {
            prop_assert!(camera.has_unique_rays());
            let [u, v] = camera.distort(camera.undistort([x, y]));
            prop_assert!((u - x).hypot(v - y) < 1e-9, "{u} {v}");
        }
    }
}
