use artifact::Failure;
use dataset::{Dataset, Split};

use crate::error::ParameterError;
use crate::params::{Params, SplitKind};
use crate::references;

/// One view in so many is held out.
const HOLD_OUT_EVERY: usize = 8;

/// Which frames are for what, no more test views than asked for.
pub(crate) fn split(set: &Dataset, params: &Params) -> Result<Split, Failure> {
    let mut split = all_views(set, params)?;
    if let Some(most) = params.test_views {
        let (most, all) = (most as usize, split.test.len());
        if most < all {
            split.test = (0..most).map(|i| split.test[i * all / most]).collect();
        }
    }
    Ok(split)
}

fn all_views(set: &Dataset, params: &Params) -> Result<Split, Failure> {
    let count = set.frames.len();
    match (params.split, &set.split) {
        (Some(SplitKind::Given) | None, Some(given)) => Ok(given.clone()),
        (Some(SplitKind::Given), None) => Err(ParameterError::NoSplit.into()),
        (Some(SplitKind::Holdout) | None, _) => Ok(Split::hold_out(count, HOLD_OUT_EVERY)),
        (Some(SplitKind::Paper), _) => {
            let mut split = Split::all(count);
            let most = (params.hr_references as usize).min(count.saturating_sub(1));
            let chosen = references::choose(set.frames.iter().map(|f| f.camera().centre()), most);
            split.test.retain(|i| !chosen.contains(i));
            Ok(split)
        }
    }
}
