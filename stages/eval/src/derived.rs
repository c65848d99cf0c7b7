//! Scores over several views: the smallest gain over another result, and the mean scores of the
//! views near a reference.

use artifact::{GivenInput, bail_bad_input};
use metrics::{METRICS_FILE, Metrics, NearReferences, ViewScores};
use scene::{Camera, Views};

use crate::metric::value;

/// Maximum angle between the optical axes of a view and a reference near it, in degrees (design
/// note 034).
const MAX_NEAR_ANGLE_DEGREES: f64 = 60.0;

/// Returns the smallest PSNR gain of any view over the same view of another result, in dB. Views
/// without HR truth are skipped.
pub(crate) fn least_gain(
    scored: &[ViewScores],
    baseline: &GivenInput,
) -> anyhow::Result<Option<f64>> {
    let baseline: Metrics = baseline.read_json(METRICS_FILE)?;
    let mut least: Option<f64> = None;
    for view in scored {
        let Some(before) = baseline.views.iter().find(|before| before.name == view.name) else {
            bail_bad_input!("input baseline: no view {}; score both on the same views", view.name);
        };
        if let Some(psnr) = value(&view.scores, "psnr")
            && let Some(psnr_before) = value(&before.scores, "psnr")
        {
            let gain = psnr - psnr_before;
            least = Some(least.map_or(gain, |least| least.min(gain)));
        }
    }
    Ok(least)
}

/// Returns the scores of the views near a reference; `None` if there are none.
pub(crate) fn near_references(
    scored: &[ViewScores],
    truth: &Views,
    references: &Views,
) -> Option<NearReferences> {
    let min_cosine = MAX_NEAR_ANGLE_DEGREES.to_radians().cos();
    let mut near = Vec::new();
    for (i, view) in truth.views.iter().enumerate() {
        let is_near = (references.views.iter())
            .any(|reference| cosine(&view.camera, &reference.camera) >= min_cosine);
        if is_near && let Some(psnr) = value(&scored[i].scores, "psnr") {
            near.push(psnr);
        }
    }
    (!near.is_empty()).then(|| NearReferences {
        views: near.len(),
        psnr: near.iter().sum::<f64>() / near.len() as f64,
    })
}

/// Returns the cosine of the angle between two cameras' optical axes.
fn cosine(one: &Camera, other: &Camera) -> f64 {
    (0..3).map(|row| one.camera_to_world[row][2] * other.camera_to_world[row][2]).sum()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::Path;

    use super::*;
    use metrics::{Score, Scores};
    use scene::{Background, Bounds, Distortion, Intrinsics, View};

    fn scores(name: &str, psnr: Option<f64>) -> ViewScores {
        ViewScores {
            name: name.to_owned(),
            scores: psnr.map(|psnr| ("psnr".to_owned(), Score::One(psnr))).into_iter().collect(),
            error_map: String::new(),
            pictures: BTreeMap::new(),
        }
    }

    fn camera(degrees: f64) -> Camera {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        let pose = [[cosine, 0.0, sine, 0.0], [0.0, 1.0, 0.0, 0.0], [-sine, 0.0, cosine, 0.0]];
        let intrinsics = Intrinsics {
            width: 4,
            height: 4,
            fx: 4.0,
            fy: 4.0,
            cx: 2.0,
            cy: 2.0,
            distortion: Distortion::default(),
        };
        Camera { name: degrees.to_string(), intrinsics, camera_to_world: pose }
    }

    /// Returns views along z, each turned about y by an angle in degrees.
    fn views(angles: &[f64]) -> Views {
        let view = |degrees: &f64| View::camera_only(camera(*degrees));
        Views::new(Background::White, Bounds::default(), angles.iter().map(view).collect())
    }

    #[test]
    fn views_within_sixty_degrees_are_near() {
        let scored = [
            scores("0", Some(30.0)),
            scores("59", Some(32.0)),
            scores("61", Some(50.0)),
            scores("180", Some(60.0)),
        ];
        let near =
            near_references(&scored, &views(&[0.0, 59.0, 61.0, 180.0]), &views(&[0.0])).unwrap();
        assert_eq!((near.views, near.psnr), (2, 31.0));
        assert_eq!(near_references(&scored[3..], &views(&[180.0]), &views(&[0.0])), None);
        assert_eq!(near_references(&[scores("0", None)], &views(&[0.0]), &views(&[0.0])), None);
    }

    fn write_baseline(folder: &Path, psnrs: &[(&str, f64)]) -> GivenInput {
        let views: Vec<ViewScores> =
            psnrs.iter().map(|(name, psnr)| scores(name, Some(*psnr))).collect();
        let metrics = Metrics {
            conventions: BTreeMap::new(),
            figures: Vec::new(),
            picture_titles: BTreeMap::new(),
            mean: Scores::new(),
            least_gain: None,
            near_references: None,
            views,
        };
        artifact::write_json(&folder.join(METRICS_FILE), &metrics).unwrap();
        GivenInput::open("baseline", folder).unwrap()
    }

    #[test]
    fn the_least_gain_is_that_of_the_worst_view() {
        let folder = tempfile::tempdir().unwrap();
        let scored = [scores("a", Some(31.0)), scores("b", Some(29.5)), scores("c", None)];
        let baseline = write_baseline(folder.path(), &[("a", 30.0), ("b", 30.0), ("c", 1.0)]);
        assert_eq!(least_gain(&scored, &baseline).unwrap(), Some(-0.5));
        let problem = least_gain(&scored, &write_baseline(folder.path(), &[("a", 30.0)]))
            .unwrap_err()
            .to_string();
        assert!(problem.contains("input baseline: no view b"), "{problem}");
    }
}
