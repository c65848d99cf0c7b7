//! View dependence of a voxel's colour: spherical harmonics up to degree 2, reduced to a scene's
//! strongest principal components (docs/design/042).

use nalgebra::{DMatrix, SMatrix, SVector, SymmetricEigen};
use radiance::spec::BASIS;
use radiance::spherical_harmonics;

/// Number of coefficients of view dependence: nine for each of red, green and blue.
pub(crate) const COEFFICIENTS: usize = 3 * BASIS;
/// Ridge penalty per direction: coefficients that no direction determines are 0. Chosen by hand.
const RIDGE: f64 = 0.001;

/// Fits coefficients, channel by channel, to the differences of colours from their mean, by ridge
/// regression. Returns the mean and the coefficients.
pub(crate) fn fit(
    directions: &[[f32; 3]],
    colours: &[[f32; 3]],
) -> ([f32; 3], [f32; COEFFICIENTS]) {
    let scale = 1.0 / colours.len().max(1) as f32;
    let mean: [f32; 3] = std::array::from_fn(|c| scale * colours.iter().map(|v| v[c]).sum::<f32>());
    let mut gram = SMatrix::<f64, BASIS, BASIS>::identity() * (RIDGE * directions.len() as f64);
    let mut products = SMatrix::<f64, BASIS, 3>::zeros();
    for (direction, colour) in directions.iter().zip(colours) {
        let basis = SVector::from(spherical_harmonics(*direction).map(f64::from));
        gram += basis * basis.transpose();
        let residual = SVector::<f64, 3>::from_fn(|c, _| f64::from(colour[c] - mean[c]));
        products += basis * residual.transpose();
    }
    let solution = match gram.cholesky() {
        Some(cholesky) => cholesky.solve(&products),
        // Without directions the matrix is 0.
        None => SMatrix::zeros(),
    };
    (mean, std::array::from_fn(|i| solution[(i % BASIS, i / BASIS)] as f32))
}

/// Principal components of a scene's coefficients about 0, the strongest first. No mean is
/// subtracted: a voxel without view dependence stays at 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Components(Vec<Component>);

/// A principal component.
#[derive(Clone, Debug, PartialEq)]
struct Component {
    /// Unit axis, orthogonal to those of the other components.
    axis: [f32; COEFFICIENTS],
    /// Magnitude beyond which values are clamped.
    scale: f32,
}

/// Ratio of a component's scale to the root mean square of the component's values. Few values are
/// beyond the scale. Chosen by hand.
const SCALE_RMS: f64 = 4.0;

impl Components {
    /// Finds the `count` strongest components of voxels' coefficients, weighted by opacity.
    pub(crate) fn of<'a>(
        coefficients: impl Iterator<Item = (&'a [f32; COEFFICIENTS], f32)>,
        count: usize,
    ) -> Self {
        let mut moments = DMatrix::<f64>::zeros(COEFFICIENTS, COEFFICIENTS);
        let mut sum = 0.0;
        for (voxel, weight) in coefficients {
            let weight = f64::from(weight);
            sum += weight;
            for i in 0..COEFFICIENTS {
                let part = weight * f64::from(voxel[i]);
                for j in 0..=i {
                    moments[(i, j)] += part * f64::from(voxel[j]);
                }
            }
        }
        moments /= sum.max(f64::MIN_POSITIVE);
        // Only the lower half of a symmetric matrix is read.
        let eigen = SymmetricEigen::new(moments);
        let mut order: Vec<usize> = (0..COEFFICIENTS).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        order.truncate(count);
        let mut components = Vec::new();
        for k in order {
            let rms = eigen.eigenvalues[k].max(0.0).sqrt();
            components.push(Component {
                axis: std::array::from_fn(|i| eigen.eigenvectors[(i, k)] as f32),
                // The minimum, chosen by hand, avoids a division by 0.
                scale: (SCALE_RMS * rms).max(1e-6) as f32,
            });
        }
        Self(components)
    }

    /// Returns the product of each component's axis and scale, in the shader's order: red, green
    /// and blue of each spherical harmonic in turn.
    pub(crate) fn for_shader(&self) -> Vec<f32> {
        let mut numbers = Vec::with_capacity(self.0.len() * COEFFICIENTS);
        for Component { axis, scale } in &self.0 {
            numbers.extend((0..COEFFICIENTS).map(|i| scale * axis[BASIS * (i % 3) + i / 3]));
        }
        numbers
    }

    /// Projects a voxel's coefficients onto the components, divided by their scales: from -1 to 1.
    pub(crate) fn project(&self, voxel: &[f32; COEFFICIENTS]) -> impl Iterator<Item = f32> {
        self.0.iter().map(move |Component { axis, scale }| {
            let product: f32 = (0..COEFFICIENTS).map(|i| axis[i] * voxel[i]).sum();
            (product / scale).max(-1.0).min(1.0)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directions() -> Vec<[f32; 3]> {
        (0..40)
            .map(|i| {
                let (z, turn) = (i as f32 / 40.0, i as f32 * 2.4);
                let level = (1.0 - z * z).sqrt();
                [level * turn.cos(), level * turn.sin(), z]
            })
            .collect()
    }

    /// Evaluates spherical harmonics in a direction.
    fn evaluate(coefficients: &[f32; COEFFICIENTS], direction: [f32; 3]) -> [f32; 3] {
        let basis = spherical_harmonics(direction);
        std::array::from_fn(|c| (0..BASIS).map(|i| coefficients[c * BASIS + i] * basis[i]).sum())
    }

    #[test]
    fn a_smooth_function_is_reconstructed() {
        let directions = directions();
        let colours: Vec<[f32; 3]> =
            directions.iter().map(|[x, y, z]| [0.3 + 0.5 * x, x * y - 0.2 * z, -1.0]).collect();
        let (mean, coefficients) = fit(&directions, &colours);
        for (direction, colour) in directions.iter().zip(&colours) {
            let found = evaluate(&coefficients, *direction);
            for c in 0..3 {
                assert!((mean[c] + found[c] - colour[c]).abs() < 0.08, "{colour:?} {found:?}");
            }
        }
        assert_eq!(fit(&[], &[]), ([0.0; 3], [0.0; COEFFICIENTS]));
    }

    /// Returns the coefficients at a position in a plane.
    fn on_plane(a: f32, b: f32) -> [f32; COEFFICIENTS] {
        std::array::from_fn(|i| a * (i as f32 * 0.7).sin() + b * (i as f32 * 1.3).cos())
    }

    #[test]
    fn two_components_represent_a_plane() {
        let all: Vec<[f32; COEFFICIENTS]> =
            (0..50).map(|i| on_plane((i as f32).sin(), 0.3 * (2.0 * i as f32).cos())).collect();
        let components = Components::of(all.iter().map(|coefficients| (coefficients, 1.0)), 2);
        for coefficients in &all {
            let mut rebuilt = [0.0; COEFFICIENTS];
            let found = components.project(coefficients);
            for (value, Component { axis, scale }) in found.zip(&components.0) {
                for i in 0..COEFFICIENTS {
                    rebuilt[i] += value * scale * axis[i];
                }
            }
            for (a, b) in rebuilt.iter().zip(coefficients) {
                assert!((a - b).abs() < 1e-4, "{a} {b}");
            }
        }
        assert!(components.0[0].scale > components.0[1].scale);
    }
}
