use artifact::{Failure, bail_usage};
use dataset::{Dataset, Split};
use glam::DVec3;

use crate::params::{Params, SplitKind};

/// Divides the frames into training and test views; `test_views` limits the latter.
pub(crate) fn split_views(set: &Dataset, params: &Params) -> Result<Split, Failure> {
    let mut split = full_split(set, params)?;
    if let Some(limit) = params.test_views {
        let (limit, count) = (limit as usize, split.test.len());
        if limit < count {
            split.test = (0..limit).map(|i| split.test[i * count / limit]).collect();
        }
    }
    Ok(split)
}

fn full_split(set: &Dataset, params: &Params) -> Result<Split, Failure> {
    let count = set.frames.len();
    match (params.split, &set.split) {
        (Some(SplitKind::Given) | None, Some(given)) => Ok(given.clone()),
        (Some(SplitKind::Given), None) => {
            bail_usage!(
                "parameter split: the data set has no split of its own; choose holdout or paper"
            )
        }
        (Some(SplitKind::Holdout) | None, _) => Ok(Split::hold_out(count)),
        (Some(SplitKind::Paper), _) => {
            let mut split = Split::all(count);
            let limit = (params.hr_references as usize).min(count.saturating_sub(1));
            let centres = set.frames.iter().map(|frame| frame.camera().centre());
            let references = choose_references(centres, limit);
            split.test.retain(|i| !references.contains(i));
            Ok(split)
        }
    }
}

/// Chooses views as references: the first one, then repeatedly the one whose camera is farthest
/// from those already chosen, so that together they observe much of the scene. A smaller `count`
/// gives a prefix of a larger one's choice.
pub(crate) fn choose_references(centres: impl Iterator<Item = DVec3>, count: usize) -> Vec<usize> {
    let centres: Vec<DVec3> = centres.collect();
    let mut distances = vec![f64::INFINITY; centres.len()];
    let mut chosen = Vec::new();
    while chosen.len() < count {
        // The first of several at equal distance.
        let next = (0..centres.len())
            .filter(|i| !chosen.contains(i))
            .reduce(|best, i| if distances[i] > distances[best] { i } else { best });
        let Some(next) = next else { break };
        for (i, distance) in distances.iter_mut().enumerate() {
            *distance = distance.min(centres[i].distance(centres[next]));
        }
        chosen.push(next);
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along_x(xs: &[f64]) -> std::vec::IntoIter<DVec3> {
        xs.iter().map(|&x| DVec3::new(x, 0.0, 0.0)).collect::<Vec<_>>().into_iter()
    }

    #[test]
    fn references_are_spread() {
        let cameras = || along_x(&[0.0, 1.0, 2.0, 3.0, 9.0, 10.0]);
        assert_eq!(choose_references(cameras(), 4), [0, 5, 3, 1]);
        assert_eq!(choose_references(cameras(), 2), [0, 5]);
        assert_eq!(choose_references(cameras(), 99).len(), 6);
        assert!(choose_references(cameras(), 0).is_empty());
        // Equal and undefined positions.
        assert_eq!(choose_references(along_x(&[1.0, 1.0, f64::NAN]), 3).len(), 3);
    }
}
