use pixels::{DepthMap, ExrImage};

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

/// Errors of z-depth where the truth has a [surface](DepthMap::has_surface). `None` where channels
/// `Z` and `A` are missing or sizes differ; all 0 where nothing is seen.
pub fn depth_error(found: &ExrImage, expected: &ExrImage) -> Option<DepthError> {
    if (found.width, found.height) != (expected.width, expected.height) {
        return None;
    }
    let (found, expected) = (DepthMap::of(found)?, DepthMap::of(expected)?);
    let seen: Vec<usize> = (0..expected.depth.len()).filter(|&i| expected.has_surface(i)).collect();
    if seen.is_empty() {
        return Some(DepthError::default());
    }
    let error = |&i: &usize| (f64::from(found.depth[i]) - f64::from(expected.depth[i])).abs();
    let mut errors: Vec<f64> = seen.iter().map(error).collect();
    errors.sort_by(f64::total_cmp);
    let count = seen.len() as f64;
    Some(DepthError {
        mean_absolute: errors.iter().sum::<f64>() / count,
        median_absolute: errors[errors.len() / 2],
        missed: seen.iter().filter(|&&i| !found.has_surface(i)).count() as f64 / count,
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
