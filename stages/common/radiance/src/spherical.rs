use crate::spec::BASIS;

/// Real spherical harmonics up to degree 2 of a unit direction.
pub fn spherical_harmonics([x, y, z]: [f32; 3]) -> [f32; BASIS] {
    [
        0.282_094_8,
        -0.488_602_5 * y,
        0.488_602_5 * z,
        -0.488_602_5 * x,
        1.092_548_4 * x * y,
        -1.092_548_4 * y * z,
        0.315_391_57 * (3.0 * z * z - 1.0),
        -1.092_548_4 * x * z,
        0.546_274_2 * (x * x - y * y),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ∫ Yi·Yj over the sphere is 1 for i = j, else 0.
    #[test]
    fn orthonormal() {
        let n = 200;
        let mut gram = [[0.0f64; BASIS]; BASIS];
        for a in 0..n {
            for b in 0..n {
                let z = (2.0 * (f64::from(a) + 0.5) / f64::from(n)) - 1.0;
                let phi = std::f64::consts::TAU * (f64::from(b) + 0.5) / f64::from(n);
                let r = (1.0 - z * z).sqrt();
                let y =
                    spherical_harmonics([(r * phi.cos()) as f32, (r * phi.sin()) as f32, z as f32])
                        .map(f64::from);
                for i in 0..BASIS {
                    for j in 0..BASIS {
                        gram[i][j] += y[i] * y[j] * 4.0 * std::f64::consts::PI / f64::from(n * n);
                    }
                }
            }
        }
        for (i, row) in gram.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                assert!((value - f64::from(u8::from(i == j))).abs() < 1e-3, "{i} {j} {value}");
            }
        }
    }
}
