use proptest::prelude::*;

use super::*;

/// Generates lenses that bend rays, but fold no corner of a common image.
pub(crate) fn mild() -> impl Strategy<Value = Distortion> {
    let (tangential, k3) = (-0.01..0.01f64, -0.02..0.02f64);
    (-0.15..0.3f64, -0.05..0.05f64, k3, tangential.clone(), tangential)
        .prop_map(|(k1, k2, k3, p1, p2)| Distortion::brown([k1, k2, k3], [p1, p2]))
}

/// Generates perspective lenses with a fourth radial term, and with a denominator.
pub(crate) fn higher() -> impl Strategy<Value = Distortion> {
    (mild(), -0.01..0.01f64, -0.05..0.1f64, -0.02..0.02f64, -0.01..0.01f64).prop_map(
        |(brown, k4, d1, d2, d3)| {
            let [k1, k2, k3, _] = brown.radial;
            Distortion { radial: [k1, k2, k3, k4], denominator: [d1, d2, d3], ..brown }
        },
    )
}

/// Generates fisheye lenses that fold nowhere before 89°.
pub(crate) fn fisheye() -> impl Strategy<Value = Distortion> {
    let tangential = -0.001..0.001f64;
    let tangential =
        prop_oneof![Just([0.0; 2]), (tangential.clone(), tangential).prop_map(<[f64; 2]>::from)];
    (-0.04..0.06f64, -0.01..0.01f64, -0.001..0.001f64, -0.0002..0.0002f64, tangential).prop_map(
        |(k1, k2, k3, k4, tangential)| Distortion {
            tangential,
            ..Distortion::fisheye([k1, k2, k3, k4])
        },
    )
}

fn central_difference(d: &Distortion, a: [f64; 2], b: [f64; 2], step: f64) -> [f64; 2] {
    let (a, b) = (d.distort(a), d.distort(b));
    [0, 1].map(|i| (a[i] - b[i]) / (2.0 * step))
}

/// Returns the slopes of a ray at an angle from the axis.
fn ray_at_angle(degrees: f64, azimuth: f64) -> [f64; 2] {
    scaled([azimuth.cos(), azimuth.sin()], degrees.to_radians().tan())
}

/// Distortion follows Brown's formula with a fourth term, and OpenCV's rational model.
#[test]
fn higher_terms_follow_the_formula() {
    let lens = Distortion {
        radial: [0.11, -0.07, 0.02, 0.013],
        tangential: [0.003, -0.002],
        ..Distortion::default()
    };
    let rational = Distortion { denominator: [0.2, -0.05, 0.01], ..lens };
    for [x, y] in [[0.9, 0.7], [-0.9, 0.7], [0.9, -0.7], [-0.9, -0.7], [0.1, 0.4], [0.0, 0.0]] {
        let square: f64 = x * x + y * y;
        let radial = 1.0 + 0.11 * square - 0.07 * square.powi(2)
            + 0.02 * square.powi(3)
            + 0.013 * square.powi(4);
        let denominator_value = 1.0 + 0.2 * square - 0.05 * square.powi(2) + 0.01 * square.powi(3);
        let tangential = [
            2.0 * 0.003 * x * y - 0.002 * (square + 2.0 * x * x),
            0.003 * (square + 2.0 * y * y) - 2.0 * 0.002 * x * y,
        ];
        for (lens, r) in [(lens, radial), (rational, radial / denominator_value)] {
            let distorted = lens.distort([x, y]);
            assert!((distorted[0] - (x * r + tangential[0])).abs() < 1e-14);
            assert!((distorted[1] - (y * r + tangential[1])).abs() < 1e-14);
            let found = lens.undistort(distorted);
            assert!((found[0] - x).abs().max((found[1] - y).abs()) < 1e-12, "{found:?}");
        }
    }
}

/// Distortion follows OpenCV's fisheye formula up to the limit of 89°. Beyond the limit, rays are
/// clamped.
#[test]
fn a_fisheye_radius_is_the_polynomial_of_the_angle() {
    let lens = Distortion::fisheye([-0.02, 0.006, -0.003, 0.0005]);
    for degrees in [0.0, 1e-7, 3.0, 45.0, 60.0, 80.0, 88.9] {
        let angle = f64::to_radians(degrees);
        let distorted = lens.distort(ray_at_angle(degrees, 0.7));
        let expected = angle
            * (1.0 - 0.02 * angle.powi(2) + 0.006 * angle.powi(4) - 0.003 * angle.powi(6)
                + 0.0005 * angle.powi(8));
        assert!((distorted[0].hypot(distorted[1]) - expected).abs() < 1e-13, "{degrees}");
        let [x, y] = lens.undistort(distorted);
        assert!(
            (x.hypot(y).atan() - angle).abs() < 1e-13 && !lens.is_clamped(distorted),
            "{degrees}"
        );
    }
    for radius in [1.6, 2.0, 10.0, 1e9] {
        let distorted = scaled([0.6, -0.8], radius);
        let [x, y] = lens.undistort(distorted);
        assert!((x.hypot(y).atan().to_degrees() - 89.0).abs() < 1e-9 && lens.is_clamped(distorted));
        assert!(x > 0.0 && y < 0.0);
    }
}

/// A lens whose polynomial decreases before 89° has no ray beyond the polynomial's maximum.
#[test]
fn folded_points_are_not_invertible() {
    let folded = Distortion::fisheye([-0.2, 0.0, 0.0, 0.0]);
    // The polynomial of the angle rises up to angle 1.29, where its value is 0.86.
    assert!(folded.is_invertible_at([0.8, 0.0]) && !folded.is_invertible_at([0.9, 0.0]));
    let [x, _] = folded.undistort([0.8, 0.0]);
    assert!((x.atan() * (1.0 - 0.2 * x.atan().powi(2)) - 0.8).abs() < 1e-12);
    assert!(!Distortion::fisheye([f64::NAN, 0.0, 0.0, 0.0]).is_invertible_at([0.5, 0.0]));
    let [x, y] = Distortion::fisheye([1e300, -1e300, 0.0, 0.0]).undistort([0.5, 0.1]);
    assert!(x.is_finite() && y.is_finite());
    let pole = Distortion { denominator: [-4.0, 0.0, 0.0], ..Distortion::default() };
    assert!(pole.is_invertible_at([0.2, 0.0]) && !pole.is_invertible_at([-0.9, 0.6]));
}

#[test]
fn three_radial_terms_keep_their_json() {
    let brown = Distortion::brown([0.1, 0.0, -0.5], [0.0, 0.25]);
    let text = r#"{"radial":[0.1,0.0,-0.5],"tangential":[0.0,0.25]}"#;
    assert_eq!(serde_json::to_string(&brown).unwrap(), text);
    let all = Distortion {
        radial: [0.1, 0.2, 0.3, 0.4],
        denominator: [0.5, 0.0, 0.0],
        ..Distortion { projection: Projection::Fisheye, ..brown }
    };
    for lens in [brown, all, Distortion::fisheye([0.0; 4])] {
        let text = serde_json::to_string(&lens).unwrap();
        assert_eq!(serde_json::from_str::<Distortion>(&text).unwrap(), lens);
    }
    let short = serde_json::from_str::<Distortion>(r#"{"radial":[0.1],"tangential":[0,0]}"#);
    assert!(short.unwrap_err().to_string().contains("3 or 4 radial terms"));
}

proptest! {
    #[test]
    fn the_jacobian_matches_central_differences(
        d in prop_oneof![mild(), higher(), fisheye()],
        x in -0.6..0.6f64, y in -0.5..0.5f64
    ) {
        let step = 1e-6;
        let [xx, yx] = central_difference(&d, [x + step, y], [x - step, y], step);
        let [xy, yy] = central_difference(&d, [x, y + step], [x, y - step], step);
        let [by_x, by_y] = d.jacobian([x, y]);
        for (slope, difference) in [(by_x[0], xx), (by_x[1], xy), (by_y[0], yx), (by_y[1], yy)] {
            prop_assert!((slope - difference).abs() < 1e-8, "{slope} {difference}");
        }
    }

    /// Undistortion inverts a fisheye's distortion up to the limit.
    #[test]
    fn fisheye_rays_round_trip(d in fisheye(), degrees in 0.0..88.9f64, azimuth in 0.0..6.3f64) {
        let ray = ray_at_angle(degrees, azimuth);
        let distorted = d.distort(ray);
        prop_assert!(d.is_invertible_at(distorted) && !d.is_clamped(distorted));
        let [x, y] = d.undistort(distorted);
        let error = (x - ray[0]).hypot(y - ray[1]) * degrees.to_radians().cos().powi(2);
        prop_assert!(error < 1e-10, "off by {error} radians");
    }
}

/// Coefficients have the names of the data sets' formats.
#[test]
fn coefficients_are_named_if_not_0() {
    let rational = Distortion {
        denominator: [0.25, 0.0, -0.5],
        ..Distortion::brown([-0.1, 0.0, 0.0], [0.0, 0.01])
    };
    for (lens, expected) in [
        (rational, "(k1 -0.1, p2 0.01, k4 0.25, k6 -0.5)"),
        (Distortion::fisheye([0.0, 0.0, 0.0, 0.125]), "(fisheye, k4 0.125)"),
    ] {
        assert_eq!(lens.to_string(), expected);
    }
}
