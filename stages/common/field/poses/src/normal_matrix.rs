//! Robust least squares for a camera's motion.

use glam::{DMat3, DVec3};

/// Threshold of the Huber loss. Larger colour errors count linearly, since they come from outliers:
/// moved objects, or parts of the scene that no image covers. Chosen by hand.
pub(crate) const HUBER_THRESHOLD: f64 = 0.1;

/// Returns twice the Huber loss of an error: its square up to the threshold.
pub(crate) fn huber(error: f64) -> f64 {
    let size = error.abs();
    if size > HUBER_THRESHOLD {
        HUBER_THRESHOLD * (2.0 * size - HUBER_THRESHOLD)
    } else {
        size * size
    }
}

/// Symmetric 6×6 matrix by its blocks: three rows of rotation, then three of translation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NormalMatrix {
    rotation: DMat3,
    /// Rows of rotation, columns of translation.
    cross: DMat3,
    translation: DMat3,
}

impl NormalMatrix {
    pub(crate) const ZERO: Self =
        Self { rotation: DMat3::ZERO, cross: DMat3::ZERO, translation: DMat3::ZERO };

    /// Adds the weighted outer product of a row with itself.
    pub(crate) fn add(&mut self, weight: f64, [rotation, translation]: [DVec3; 2]) {
        self.rotation += outer(weight * rotation, rotation);
        self.cross += outer(weight * rotation, translation);
        self.translation += outer(weight * translation, translation);
    }

    /// Returns the matrix with Levenberg's and Marquardt's damping: the diagonal grows by the
    /// factor 1 + `damping`, and by 1e-9 of the trace in case a direction has no gradient.
    pub(crate) fn damped(&self, damping: f64) -> Self {
        let [rotation, translation] = [self.rotation, self.translation].map(diagonal);
        let floor = DVec3::splat(1e-9 * (rotation.element_sum() + translation.element_sum()));
        Self {
            rotation: self.rotation + DMat3::from_diagonal(damping * rotation + floor),
            cross: self.cross,
            translation: self.translation + DMat3::from_diagonal(damping * translation + floor),
        }
    }

    /// Solves by the Schur complement of rotation; `None` unless the matrix is positive definite.
    pub(crate) fn solve(&self, [rotation, translation]: [DVec3; 2]) -> Option<[DVec3; 2]> {
        let inverse = positive_inverse(self.rotation)?;
        let across = self.cross.transpose() * inverse;
        let complement = positive_inverse(self.translation - across * self.cross)?;
        let translated = complement * (translation - across * rotation);
        let rotated = inverse * (rotation - self.cross * translated);
        (rotated.is_finite() && translated.is_finite()).then_some([rotated, translated])
    }
}

fn outer(column: DVec3, row: DVec3) -> DMat3 {
    DMat3::from_cols(column * row.x, column * row.y, column * row.z)
}

fn diagonal(matrix: DMat3) -> DVec3 {
    DVec3::new(matrix.x_axis.x, matrix.y_axis.y, matrix.z_axis.z)
}

/// Returns the inverse of a symmetric matrix; `None` unless the matrix is positive definite, by its
/// leading minors (Sylvester).
fn positive_inverse(matrix: DMat3) -> Option<DMat3> {
    let [x, y] = [matrix.x_axis, matrix.y_axis];
    let minors = [x.x, x.x * y.y - x.y * y.x, matrix.determinant()];
    minors.iter().all(|minor| *minor > 0.0).then(|| matrix.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROWS: [[DVec3; 2]; 6] = [
        [DVec3::new(1.0, 0.2, -0.3), DVec3::new(0.9, 0.1, 0.4)],
        [DVec3::new(-0.5, 2.0, 0.1), DVec3::new(0.3, -1.8, 0.0)],
        [DVec3::new(0.4, 0.3, 0.7), DVec3::new(-0.2, 0.6, 1.1)],
        [DVec3::new(0.0, -0.6, 0.2), DVec3::new(1.4, 0.2, -0.5)],
        [DVec3::new(0.8, 0.0, 1.5), DVec3::new(0.0, 0.3, 0.6)],
        [DVec3::new(0.1, 0.9, -1.0), DVec3::new(0.5, -0.4, 2.0)],
    ];

    #[test]
    fn solve_recovers_the_motion_of_its_rows() {
        let expected = [DVec3::new(0.3, -0.7, 0.2), DVec3::new(-1.1, 0.4, 2.5)];
        let (mut matrix, mut right) = (NormalMatrix::ZERO, [DVec3::ZERO; 2]);
        for (i, row) in ROWS.into_iter().enumerate() {
            let weight = 1.0 + i as f64;
            let value = weight * (row[0].dot(expected[0]) + row[1].dot(expected[1]));
            matrix.add(weight, row);
            right = [0, 1].map(|part| right[part] + value * row[part]);
        }
        let found = matrix.solve(right).unwrap();
        for (found, expected) in found.into_iter().zip(expected) {
            assert!((found - expected).length() < 1e-9, "found {found}, expected {expected}");
        }
    }

    #[test]
    fn damping_bounds_directions_without_rows() {
        let mut matrix = NormalMatrix::ZERO;
        matrix.add(4.0, [DVec3::X, DVec3::ZERO]);
        assert!(matrix.solve([DVec3::X, DVec3::ZERO]).is_none());
        let [rotation, translation] =
            matrix.damped(1.0).solve([8.0 * DVec3::X, DVec3::ZERO]).unwrap();
        assert!(
            (rotation - DVec3::X).length() < 1e-6 && translation == DVec3::ZERO,
            "{rotation} {translation}"
        );
    }

    #[test]
    fn matrices_that_are_not_positive_definite_have_no_solution() {
        for diagonal in [DVec3::new(-1.0, -1.0, 1.0), DVec3::new(1.0, -1.0, -1.0), -DVec3::X] {
            let rotation = DMat3::from_diagonal(diagonal);
            let matrix =
                NormalMatrix { rotation, translation: DMat3::IDENTITY, ..NormalMatrix::ZERO };
            assert!(matrix.solve([DVec3::ONE; 2]).is_none(), "{diagonal}");
            let matrix =
                NormalMatrix { rotation: DMat3::IDENTITY, translation: rotation, ..matrix };
            assert!(matrix.solve([DVec3::ONE; 2]).is_none(), "{diagonal}");
        }
    }

    #[test]
    fn empty_and_overflowing_matrices_have_no_solution() {
        assert!(NormalMatrix::ZERO.damped(1e-3).solve([DVec3::ZERO; 2]).is_none());
        for value in [f64::NAN, f64::INFINITY, 1e200] {
            let mut matrix = NormalMatrix::ZERO;
            matrix.add(1.0, [DVec3::splat(value), DVec3::ONE]);
            assert!(matrix.damped(1e-3).solve([DVec3::ONE; 2]).is_none(), "{value}");
        }
    }
}
