use std::collections::BTreeMap;

use metrics::{Figure, Score, Scores};
use pixels::Rgba8;

use crate::scored_view::{ScoredScene, ScoredView};

/// Something that views are scored by. A new one is a type in `scoring/mod.rs`, and its line in the
/// list there: `metrics.json`, the page and the summary follow from what it says of itself.
pub(crate) trait Metric: Sync {
    /// Its key among the conventions, and the name of its pictures.
    fn name(&self) -> &'static str;
    /// Its figures, the most important first.
    fn figures(&self) -> Vec<Figure>;
    /// How its figures are made, in words.
    fn convention(&self, scene: &ScoredScene<'_>) -> String;
    /// Scores a view; no scores where the view lacks what the metric needs. Pixels that don't count
    /// are equal in both images, so their error is 0: divide a mean error over all pixels by
    /// [`ScoredView::counted_share`], at LR by that of its `lr`.
    fn score(&self, view: &ScoredView<'_>) -> anyhow::Result<Measured>;
    /// Title of its pictures on the page: a caption, and a note in brackets. Pictures without a
    /// title aren't shown.
    fn picture_title(&self) -> Option<&'static str> {
        None
    }
    /// What a line for people says of means over all views.
    fn in_words(&self, _mean: &Scores) -> Option<String> {
        None
    }
}

/// What a metric found of a view.
#[derive(Default)]
pub(crate) struct Measured {
    pub(crate) scores: Scores,
    /// A picture of what was compared, where that is worth a look.
    pub(crate) picture: Option<Rgba8>,
}

impl Measured {
    pub(crate) fn one(name: &str, score: Score) -> Self {
        Self { scores: [(name.to_owned(), score)].into(), picture: None }
    }
}

/// The number at a figure's path, where there is one.
pub(crate) fn value(scores: &Scores, path: &str) -> Option<f64> {
    match path.split_once('/') {
        None => match scores.get(path)? {
            Score::One(value) => Some(*value),
            Score::Several(_) => None,
        },
        Some((name, part)) => match scores.get(name)? {
            Score::One(_) => None,
            Score::Several(parts) => parts.get(part).copied(),
        },
    }
}

/// Means of the values of the views that have them.
pub(crate) fn mean_of<'a>(views: impl Iterator<Item = &'a Scores>) -> Scores {
    let mut sums = Sums::new();
    for (name, score) in views.flatten() {
        match score {
            Score::One(value) => add(&mut sums, (name.clone(), None), *value),
            Score::Several(parts) => {
                for (part, value) in parts {
                    add(&mut sums, (name.clone(), Some(part.clone())), *value);
                }
            }
        }
    }
    let mut means = Scores::new();
    for ((name, part), (sum, count)) in sums {
        let mean = sum / count as f64;
        match part {
            None => {
                means.insert(name, Score::One(mean));
            }
            Some(part) => {
                let several = means.entry(name).or_insert_with(|| Score::several([]));
                if let Score::Several(parts) = several {
                    parts.insert(part, mean);
                }
            }
        }
    }
    means
}

/// Sums of values and how many there are, by name and part.
type Sums = BTreeMap<(String, Option<String>), (f64, usize)>;

fn add(sums: &mut Sums, key: (String, Option<String>), value: f64) {
    let (sum, count) = sums.entry(key).or_default();
    *sum += value;
    *count += 1;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_of_the_views_that_have_a_value() {
        let one = |value| Scores::from([("psnr".to_owned(), Score::One(value))]);
        let mut with_depth = one(32.0);
        with_depth.insert("depth".to_owned(), Score::several([("missed", 0.5)]));
        let mean = mean_of([one(30.0), with_depth, Scores::new()].iter());
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
