use pixels::{DepthMap, Mask};

/// Errors of a view's z-depth over the counted pixels with a surface in the ground truth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthError {
    /// Mean absolute error in scene units, dominated by edges.
    pub mean_absolute: f64,
    /// Median absolute error in scene units, typical of surfaces.
    pub median_absolute: f64,
    /// Fraction of the truth's surface pixels where the render's opacity is below one half.
    pub missed: f64,
}

/// Returns the errors of z-depth where the truth has a [surface](DepthMap::has_surface) and the
/// mask, if any, counts. `None` if there is no such pixel.
///
/// # Panics
/// If the truth has more pixels than the render or the mask.
pub fn depth_error(
    render: DepthMap<'_>,
    truth: DepthMap<'_>,
    mask: Option<&Mask>,
) -> Option<DepthError> {
    let counts = |i: &usize| truth.has_surface(*i) && mask.is_none_or(|mask| mask.counts[*i]);
    let (mut errors, mut missed) = (Vec::new(), 0usize);
    for i in (0..truth.depth.len()).filter(counts) {
        errors.push((f64::from(render.depth[i]) - f64::from(truth.depth[i])).abs());
        missed += usize::from(!render.has_surface(i));
    }
    if errors.is_empty() {
        return None;
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

    #[test]
    fn only_counted_surfaces_count() {
        let truth = DepthMap { depth: &[4.0, 5.0, 3.0, 0.0], opacity: &[1.0, 1.0, 1.0, 0.0] };
        let render = DepthMap { depth: &[4.5, 5.0, 3.1, 9.0], opacity: &[1.0, 0.2, 1.0, 1.0] };
        let mask = |counts: [bool; 4]| Mask { width: 2, height: 2, counts: counts.into() };
        let all = depth_error(render, truth, None).unwrap();
        assert!((all.mean_absolute - 0.2).abs() < 1e-6 && (all.median_absolute - 0.1).abs() < 1e-6);
        assert!((all.missed - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(depth_error(render, truth, Some(&mask([true; 4]))), Some(all));
        let last_two = mask([false, false, true, true]);
        let masked = depth_error(render, truth, Some(&last_two)).unwrap();
        assert!((masked.mean_absolute - 0.1).abs() < 1e-6 && masked.missed == 0.0);
        // A view without a surface has no error, not one of 0.
        assert_eq!(depth_error(render, truth, Some(&mask([false, false, false, true]))), None);
        let empty = DepthMap { opacity: &[0.0; 4], ..truth };
        assert_eq!(depth_error(render, empty, None), None);
    }
}
