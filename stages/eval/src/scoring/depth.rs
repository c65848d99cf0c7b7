use pixels::{DepthMap, ExrImage};

/// Errors of a view's z-depth over the pixels with a surface in the ground truth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthError {
    /// Mean absolute error in scene units, dominated by edges.
    pub mean_absolute: f64,
    /// Median absolute error in scene units, typical of surfaces.
    pub median_absolute: f64,
    /// Fraction of the truth's surface pixels where the render's opacity is below one half.
    pub missed: f64,
}

/// Returns the errors of z-depth where the truth has a [surface](DepthMap::has_surface). `None` if
/// channels `Z` and `A` are missing or sizes differ; all 0 if the truth has no surface.
pub fn depth_error(render: &ExrImage, truth: &ExrImage) -> Option<DepthError> {
    if (render.width, render.height) != (truth.width, truth.height) {
        return None;
    }
    let (render, truth) = (DepthMap::of(render)?, DepthMap::of(truth)?);
    let (mut errors, mut missed) = (Vec::new(), 0usize);
    for i in (0..truth.depth.len()).filter(|&i| truth.has_surface(i)) {
        errors.push((f64::from(render.depth[i]) - f64::from(truth.depth[i])).abs());
        missed += usize::from(!render.has_surface(i));
    }
    if errors.is_empty() {
        return Some(DepthError::default());
    }
    errors.sort_by(f64::total_cmp);
    let count = errors.len() as f64;
    Some(DepthError {
        mean_absolute: errors.iter().sum::<f64>() / count,
        median_absolute: errors[errors.len() / 2],
        missed: missed as f64 / count,
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
