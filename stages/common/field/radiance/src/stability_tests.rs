//! Errors of single precision against f64 at the extremes. `make stability` puts the rows that the
//! test prints into docs/results/stability.md.

use glam::DVec3;
use scene::{Bounds, Frustum, Space};

use crate::chunk::Chunk;
use crate::composite::{optical_depths, weights};
use crate::math::{exp, one_minus_exp_neg};
use crate::ray::{NormalizedRay, Ray, clip};
use crate::reference::{Judge, example, samples};
use crate::spec::Strides;

/// Row of the table.
struct Row {
    part: &'static str,
    case: String,
    /// Largest error.
    error: f64,
    /// Maximum error that the test accepts.
    limit: f64,
    /// Unit of the error.
    unit: &'static str,
}

/// Returns the largest distance, in cube sides, of positions along rays in f32 from the exact rays.
fn position_error(bounds: &Bounds, rays: &[Ray]) -> f64 {
    let mut error: f64 = 0.0;
    for ray in rays {
        let clipped @ NormalizedRay { enter, leave, .. } = clip(bounds, ray);
        assert!(enter < leave, "{ray:?} misses");
        let [origin, direction] = [ray.origin, ray.direction].map(DVec3::from);
        let exact = |distance: f64| bounds.to_cube(origin + distance * direction);
        let nearest = -origin.dot(direction);
        for k in 0..=16 {
            let t = (leave - enter).mul_add(k as f32 / 16.0, enter);
            let position = DVec3::from(clipped.position(t).map(f64::from));
            let offset = if bounds.space == Space::Contraction {
                // The bounds' ball has radius 1 and centre 0.
                let radii = (origin + nearest * direction).length().max(1.0);
                exact(nearest + radii * (4.0 * f64::from(t)).sinh()) - position
            } else {
                // The ray is straight in the cube.
                let (a, b) = (exact(nearest.max(2.0)), exact(nearest.max(2.0) + 1.0));
                (position - a).reject_from(b - a)
            };
            error = error.max(offset.length());
        }
    }
    error
}

/// Creates rays from a distance to points near the centre of the bounds.
fn rays_from(distance: f64) -> Vec<Ray> {
    let ray = |k: u32| {
        let (angle, height) = (2.4 * f64::from(k), f64::from(k) / 20.0 - 0.5);
        let outward = DVec3::new(angle.cos(), angle.sin(), height).normalize();
        let target = 0.3 * DVec3::new(height, outward.x, outward.y);
        let direction = (target - distance * outward).normalize();
        Ray {
            origin: (distance * outward).to_array(),
            direction: direction.to_array(),
            ..Ray::default()
        }
    };
    (0..20).map(ray).collect()
}

fn measure_positions(rows: &mut Vec<Row>) {
    for distance in [4.0, 1e4, 1e9] {
        for space in [Space::Box, Space::Contraction] {
            let far = 2.0 * distance;
            let bounds = Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.0, far, space };
            let name = if space == Space::Box { "box" } else { "contraction" };
            rows.push(Row {
                part: "positions",
                case: format!("{name}, camera {distance:.0e} units away"),
                error: position_error(&bounds, &rays_from(distance)),
                limit: 2e-6,
                unit: "cube sides",
            });
        }
    }
    for ratio in [1e1, 1e3, 1e6, 1e9] {
        let camera_to_world = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.]];
        let frustum =
            Frustum { camera_to_world, min: [-0.6; 2], max: [0.6; 2], near: 1.0, far: ratio };
        let space = Space::Ndc(frustum);
        let bounds = Bounds { min: [-1.0; 3], max: [1.0; 3], near: 1.0, far: ratio, space };
        let rays: Vec<Ray> = (0..20)
            .map(|k| {
                let slope = f64::from(k) / 40.0 - 0.25;
                let direction = DVec3::new(slope, -0.7 * slope, -1.0).normalize().to_array();
                Ray { origin: [0.1, 0.05, 0.0], direction, ..Ray::default() }
            })
            .collect();
        rows.push(Row {
            part: "positions",
            case: format!("ndc, far = {ratio:.0e} × near"),
            error: position_error(&bounds, &rays),
            limit: 2e-6,
            unit: "cube sides",
        });
    }
}

fn measure_exponentials(rows: &mut Vec<Row>) {
    let relative = |approximate: f32, exact: f64| (f64::from(approximate) / exact - 1.0).abs();
    let steps = (0..200_000).map(|k| (k as f32 / 200_000.0).mul_add(172.0, -86.0));
    let error = steps.map(|x| relative(exp(x), f64::from(x).exp())).fold(0.0, f64::max);
    let (part, unit) = ("exponential", "relative");
    rows.push(Row { part, case: "e^-86 to e^86".into(), error, limit: 2e-7, unit });
    let depths = (0..200_000).map(|k| (k as f32 / 1_600.0 - 120.0).exp2());
    let error = depths.map(|x| relative(one_minus_exp_neg(x), -f64::from(-x).exp_m1()));
    let error = error.fold(0.0, f64::max);
    let case = "opacity of optical depths 2^-120 to 32".into();
    rows.push(Row { part, case, error, limit: 4e-7, unit });
}

/// Measures transmittances and weights of a ray of 512 samples with equal density.
fn measure_weights(rows: &mut Vec<Row>) {
    for raw in [f32::MIN, -20.0, 0.0, 5.0, 15.0, 88.0, f32::MAX] {
        const STEP: f32 = 1.0 / 512.0;
        let mut tau = [0.0; 512];
        optical_depths(&[raw; 512], STEP, &mut tau);
        let mut tau_before = [0.0; 512];
        for i in 1..512 {
            tau_before[i] = tau_before[i - 1] + tau[i - 1];
        }
        let (mut transmittance, mut weight) = ([0.0; 512], [0.0; 512]);
        weights(&tau_before, &tau, &mut transmittance, &mut weight);
        let optical_depth = f64::from(raw).exp() * f64::from(STEP);
        let mut error: f64 = 0.0;
        for i in 0..512 {
            let exact = if i == 0 { 1.0 } else { (-optical_depth * i as f64).exp() };
            let exact_weight = exact * -(-optical_depth).exp_m1();
            error = error.max((f64::from(transmittance[i]) - exact).abs());
            error = error.max((f64::from(weight[i]) - exact_weight).abs());
        }
        rows.push(Row {
            part: "weights",
            case: if raw.abs() < 1e3 {
                format!("density e^{raw}")
            } else {
                format!("density e^{raw:.0e}")
            },
            error,
            limit: 1e-5,
            unit: "absolute",
        });
    }
}

/// Measures colours of rays through a field whose parameters are multiplied by a factor.
fn measure_colours(rows: &mut Vec<Row>) {
    // With large factors, large products cancel: only finite colours are required.
    let limits = [(0.0, 1e-6), (1e-3, 1e-6), (1.0, 1e-5), (2.0, 1e-4), (16.0, 1.0), (1e5, 1.0)];
    for (factor, limit) in limits {
        let (mut field, rays) = example();
        let parameters = field.grid.iter_mut().chain(field.network.iter_mut());
        parameters.for_each(|x| *x *= factor);
        let clipped: Vec<_> = rays.iter().map(|ray| clip(&field.bounds, ray)).collect();
        let offsets = [0.5; 20];
        let mut chunk = Chunk::default();
        chunk.forward(&field, &clipped, &offsets, Strides::Single);
        let widen = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect();
        let judge =
            Judge { field: &field, grid: widen(&field.grid), network: widen(&field.network) };
        let samples = samples(&field, &clipped, &offsets, Strides::Single);
        let mut error: f64 = 0.0;
        for (r, sum) in chunk.sums.iter().enumerate() {
            let exact = judge.ray_colour(&rays[r], &samples[r]);
            for c in 0..3 {
                let colour = sum.transmittance.mul_add(rays[r].background[c], sum.colour[c]);
                assert!(
                    colour.is_finite() && exact[c].is_finite(),
                    "{factor}: {colour} {}",
                    exact[c]
                );
                error = error.max((f64::from(colour) - exact[c]).abs());
            }
        }
        rows.push(Row {
            part: "colours of rays",
            case: format!("parameters × {factor:e}"),
            error,
            limit,
            unit: "absolute",
        });
    }
}

#[test]
fn errors_of_single_precision_are_small() {
    let mut rows = Vec::new();
    measure_positions(&mut rows);
    measure_exponentials(&mut rows);
    measure_weights(&mut rows);
    measure_colours(&mut rows);
    for Row { part, case, error, unit, .. } in &rows {
        println!("|{part}|{case}|{error:.1e}|{unit}|");
    }
    for Row { part, case, error, limit, .. } in rows {
        assert!(error <= limit, "{part}, {case}: {error:e} is more than {limit:e}");
    }
}
