use std::collections::BTreeMap;

use metrics::{Score, ScoreFormat, Scores};
use pixels::Rgba8;

use crate::scored_view::{ScoredScene, ScoredView};

/// Metric that scores views. A new metric is a type that implements this trait, and a line in the
/// list of `scoring/mod.rs`; `metrics.json`, the page and the summary follow from its methods.
pub(crate) trait Metric: Sync {
    /// Returns the key of the metric's convention, which is also the name of its pictures.
    fn name(&self) -> &'static str;
    /// Returns the formats of the metric's scores, the most important first.
    fn figures(&self) -> Vec<ScoreFormat>;
    /// Describes the definition of the scores.
    fn convention(&self, scene: &ScoredScene<'_>) -> String;
    /// Scores a view. Returns no scores if the view lacks an image that the metric needs. Pixels
    /// that don't count are equal in both images, so a mean error over all pixels must be divided
    /// by the `counted_share` of the images' resolution, HR or LR.
    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measurement>;
    /// Returns the title of the metric's pictures on the page: a caption, and a note in brackets.
    /// Pictures without a title don't appear.
    fn picture_title(&self) -> Option<&'static str> {
        None
    }
    /// Returns the summary's text for means over all views.
    fn summary(&self, _mean: &Scores) -> Option<String> {
        None
    }
}

/// Scores of a view by one metric.
#[derive(Default)]
pub(crate) struct Measurement {
    pub(crate) scores: Scores,
    /// Picture of the comparison, if any.
    pub(crate) picture: Option<Rgba8>,
}

impl Measurement {
    pub(crate) fn one(name: &str, score: Score) -> Self {
        Self { scores: [(name.to_owned(), score)].into(), picture: None }
    }
}

/// Returns the value at a figure's path, if any.
pub(crate) fn value(scores: &Scores, path: &str) -> Option<f64> {
    let (name, part) = path.split_once('/').unwrap_or((path, ""));
    match scores.get(name)? {
        Score::One(value) => part.is_empty().then_some(*value),
        Score::Several(parts) => parts.get(part).copied(),
    }
}

/// Returns the mean of each value over the views that have it.
pub(crate) fn mean_of<'a>(views: impl Iterator<Item = &'a Scores>) -> Scores {
    // Sum and number of values, by name and part.
    let mut sums: BTreeMap<(&str, Option<&str>), (f64, usize)> = BTreeMap::new();
    let mut add = |key, value: &f64| {
        let (sum, count) = sums.entry(key).or_default();
        *sum += value;
        *count += 1;
    };
    for (name, score) in views.flatten() {
        match score {
            Score::One(value) => add((name, None), value),
            Score::Several(parts) => {
                parts.iter().for_each(|(part, value)| add((name, Some(part)), value));
            }
        }
    }
    let mut means = Scores::new();
    for ((name, part), (sum, count)) in sums {
        let mean = sum / count as f64;
        let several = part.map(|part| Score::several([(part, mean)]));
        match (means.get_mut(name), several) {
            (Some(Score::Several(parts)), Some(Score::Several(more))) => parts.extend(more),
            (_, several) => {
                means.insert(name.to_owned(), several.unwrap_or(Score::One(mean)));
            }
        }
    }
    means
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_over_the_views_that_have_a_value() {
        let psnr = |value| Scores::from([("psnr".to_owned(), Score::One(value))]);
        let mut with_depth = psnr(32.0);
        with_depth.insert("depth".to_owned(), Score::several([("missed", 0.5)]));
        let mean = mean_of([psnr(30.0), with_depth, Scores::new()].iter());
        assert_eq!((value(&mean, "psnr"), value(&mean, "depth/missed")), (Some(31.0), Some(0.5)));
        for path in ["ssim", "depth", "psnr/missed", "depth/none"] {
            assert_eq!(value(&mean, path), None, "{path}");
        }
        assert_eq!(
            serde_json::to_value(&mean).unwrap(),
            serde_json::json!({"psnr": 31.0, "depth": {"missed": 0.5}})
        );
    }
}
