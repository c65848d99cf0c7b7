use pixels::ExrImage;

/// How far depth is off, in scene units.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthError {
    /// Mean absolute error; edges weigh in heavily.
    pub mean_absolute: f64,
    /// Median absolute error: that of the surfaces.
    pub median_absolute: f64,
    /// Share of the pixels with a surface where the render's opacity is below one half.
    pub missed: f64,
}

/// Errors of z-depth over the pixels where the truth sees a surface (`A` at least one half). `None`
/// where channels `Z` and `A` are missing, sizes differ or nothing is seen.
pub fn depth_error(found: &ExrImage, expected: &ExrImage) -> Option<DepthError> {
    if (found.width, found.height) != (expected.width, expected.height) {
        return None;
    }
    let (z, a) = (found.channel("Z")?, found.channel("A")?);
    let (true_z, true_a) = (expected.channel("Z")?, expected.channel("A")?);
    let seen: Vec<usize> = (0..true_a.len()).filter(|&i| true_a[i] >= 0.5).collect();
    if seen.is_empty() {
        return Some(DepthError::default());
    }
    let mut errors: Vec<f64> =
        seen.iter().map(|&i| (f64::from(z[i]) - f64::from(true_z[i])).abs()).collect();
    errors.sort_by(f64::total_cmp);
    let count = seen.len() as f64;
    Some(DepthError {
        mean_absolute: errors.iter().sum::<f64>() / count,
        median_absolute: errors[errors.len() / 2],
        missed: seen.iter().filter(|&&i| a[i] < 0.5).count() as f64 / count,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(z: [f32; 4], a: [f32; 4]) -> ExrImage {
        ExrImage {
            width: 2,
            height: 2,
            channels: vec![("A".into(), a.to_vec()), ("Z".into(), z.to_vec())],
        }
    }

    #[test]
    fn only_surfaces_count() {
        let truth = image([4.0, 5.0, 3.0, 0.0], [1.0, 1.0, 1.0, 0.0]);
        let error =
            depth_error(&image([4.5, 5.0, 3.1, 9.0], [1.0, 0.2, 1.0, 1.0]), &truth).unwrap();
        assert!(
            (error.mean_absolute - 0.2).abs() < 1e-6 && (error.median_absolute - 0.1).abs() < 1e-6
        );
        assert!((error.missed - 1.0 / 3.0).abs() < 1e-12);
        assert!(depth_error(&ExrImage { width: 1, height: 1, channels: vec![] }, &truth).is_none());
    }
}
