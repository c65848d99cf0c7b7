//! How a colour changes with the direction it is seen from: spherical harmonics up to degree 2 a
//! voxel, of which a scene's few strongest combinations are kept (principal components).

use nalgebra::{DMatrix, SMatrix, SVector, SymmetricEigen};
use radiance::spec::BASIS;
use radiance::spherical_harmonics;

/// Numbers that say how a colour depends on the direction: nine of each of red, green and blue.
pub(crate) const NUMBERS: usize = 3 * BASIS;
/// Weight of small numbers beside small errors, for each direction: what directions don't say is 0.
const RIDGE: f64 = 0.001;

/// The numbers, channel by channel, whose function of the direction is nearest to some colours less
/// their mean; and this mean.
pub(crate) fn fit(directions: &[[f32; 3]], colours: &[[f32; 3]]) -> ([f32; 3], [f32; NUMBERS]) {
    let share = 1.0 / colours.len().max(1) as f32;
    let mean: [f32; 3] = std::array::from_fn(|c| share * colours.iter().map(|v| v[c]).sum::<f32>());
    let mut normal = SMatrix::<f64, BASIS, BASIS>::identity() * (RIDGE * directions.len() as f64);
    let mut right = SMatrix::<f64, BASIS, 3>::zeros();
    for (direction, colour) in directions.iter().zip(colours) {
        let basis = SVector::from(spherical_harmonics(*direction).map(f64::from));
        normal += basis * basis.transpose();
        let rest = SVector::<f64, 3>::from_fn(|c, _| f64::from(colour[c] - mean[c]));
        right += basis * rest.transpose();
    }
    let numbers = match normal.cholesky() {
        Some(cholesky) => cholesky.solve(&right),
        // Without directions there is nothing to solve.
        None => SMatrix::zeros(),
    };
    (mean, std::array::from_fn(|i| numbers[(i % BASIS, i / BASIS)] as f32))
}

/// The strongest combinations of a scene's numbers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Components {
    /// Orthonormal, the strongest first.
    pub(crate) axes: Vec<[f32; NUMBERS]>,
    /// What a component is at most, beside a few that are cut.
    pub(crate) scales: Vec<f32>,
}

/// Standard deviations that a component's scale reaches to.
const SCALE_DEVIATIONS: f64 = 4.0;

impl Components {
    /// The `count` strongest, of numbers with weights.
    pub(crate) fn of<'a>(
        numbers: impl Iterator<Item = (&'a [f32; NUMBERS], f32)>,
        count: usize,
    ) -> Self {
        let mut moments = DMatrix::<f64>::zeros(NUMBERS, NUMBERS);
        let mut sum = 0.0;
        for (numbers, weight) in numbers {
            let weight = f64::from(weight);
            sum += weight;
            for i in 0..NUMBERS {
                let part = weight * f64::from(numbers[i]);
                for j in 0..=i {
                    moments[(i, j)] += part * f64::from(numbers[j]);
                }
            }
        }
        moments /= sum.max(f64::MIN_POSITIVE);
        // Of a symmetric matrix the lower half is read.
        let eigen = SymmetricEigen::new(moments);
        let mut order: Vec<usize> = (0..NUMBERS).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        order.truncate(count);
        let axis = |&k: &usize| std::array::from_fn(|i| eigen.eigenvectors[(i, k)] as f32);
        let scale =
            |&k: &usize| (SCALE_DEVIATIONS * eigen.eigenvalues[k].max(0.0).sqrt()).max(1e-6) as f32;
        Self { axes: order.iter().map(axis).collect(), scales: order.iter().map(scale).collect() }
    }

    /// Red, green and blue of each axis's spherical harmonics times its scale, as the shader has
    /// them.
    pub(crate) fn for_shader(&self) -> Vec<f32> {
        let axes = self.axes.iter().zip(&self.scales);
        axes.flat_map(|(axis, scale)| {
            (0..NUMBERS).map(move |i| scale * axis[BASIS * (i % 3) + i / 3])
        })
        .collect()
    }

    /// A voxel's components, over their scales: from -1 to 1.
    pub(crate) fn of_voxel(&self, numbers: &[f32; NUMBERS]) -> impl Iterator<Item = f32> {
        self.axes.iter().zip(&self.scales).map(move |(axis, scale)| {
            let along: f32 = axis.iter().zip(numbers).map(|(a, b)| a * b).sum();
            (along / scale).max(-1.0).min(1.0)
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

    fn at(numbers: &[f32; NUMBERS], direction: [f32; 3]) -> [f32; 3] {
        let basis = spherical_harmonics(direction);
        std::array::from_fn(|c| (0..BASIS).map(|i| numbers[c * BASIS + i] * basis[i]).sum())
    }

    #[test]
    fn a_smooth_function_is_found_again() {
        let directions = directions();
        let colours: Vec<[f32; 3]> =
            directions.iter().map(|[x, y, z]| [0.3 + 0.5 * x, x * y - 0.2 * z, -1.0]).collect();
        let (mean, numbers) = fit(&directions, &colours);
        for (direction, colour) in directions.iter().zip(&colours) {
            let found = at(&numbers, *direction);
            for c in 0..3 {
                assert!((mean[c] + found[c] - colour[c]).abs() < 0.08, "{colour:?} {found:?}");
            }
        }
        assert_eq!(fit(&[], &[]), ([0.0; 3], [0.0; NUMBERS]));
    }

    fn on_plane(a: f32, b: f32) -> [f32; NUMBERS] {
        std::array::from_fn(|i| a * (i as f32 * 0.7).sin() + b * (i as f32 * 1.3).cos())
    }

    /// Numbers on a plane are two components.
    #[test]
    fn few_combinations_say_all() {
        let all: Vec<[f32; NUMBERS]> =
            (0..50).map(|i| on_plane((i as f32).sin(), 0.3 * (2.0 * i as f32).cos())).collect();
        let components = Components::of(all.iter().map(|numbers| (numbers, 1.0)), 2);
        for numbers in &all {
            let mut rebuilt = [0.0; NUMBERS];
            let found = components.of_voxel(numbers);
            for ((value, axis), scale) in found.zip(&components.axes).zip(&components.scales) {
                rebuilt.iter_mut().zip(axis).for_each(|(sum, a)| *sum += value * scale * a);
            }
            for (a, b) in rebuilt.iter().zip(numbers) {
                assert!((a - b).abs() < 1e-4, "{a} {b}");
            }
        }
        assert!(components.scales[0] > components.scales[1]);
    }
}
