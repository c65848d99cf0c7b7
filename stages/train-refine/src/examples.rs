use artifact::{Failure, FailureExt as _, GivenInput};
use refinement::{KnownView, LrObservations, Rendered};
use scene::{View, Views};
use stage::Context;

/// One view in so many is left out of training.
const HOLD_OUT_EVERY: usize = 8;

/// Views whose truth is known.
#[derive(Debug)]
pub(crate) struct Examples<T = KnownView> {
    /// Those to train on.
    pub(crate) training: Vec<T>,
    /// Those by which the network is judged.
    pub(crate) left_out: Vec<T>,
}

impl<T: Clone> Examples<T> {
    /// Every eighth is left out, the middle one of each eight; a single one is both.
    fn split(all: Vec<T>) -> Self {
        if all.len() == 1 {
            return Self { training: all.clone(), left_out: all };
        }
        let middle = (HOLD_OUT_EVERY / 2).min(all.len().saturating_sub(1));
        let mut examples = Self { training: Vec::new(), left_out: Vec::new() };
        for (i, example) in all.into_iter().enumerate() {
            let is_left_out = i % HOLD_OUT_EVERY == middle;
            if is_left_out { &mut examples.left_out } else { &mut examples.training }.push(example);
        }
        examples
    }
}

impl Examples {
    /// Rendered views beside their truth; consistent with `own` photographs where these are given.
    pub(crate) fn read(
        views: &GivenInput,
        truth: &GivenInput,
        own: Option<&LrObservations<'_>>,
    ) -> Result<Self, Failure> {
        let (rendered, known) = (Views::read(views)?, Views::read(truth)?);
        let mut all = Vec::new();
        for view in &rendered.views {
            if let Some(true_view) = known.taken_by(&view.camera) {
                let sources = Sources { views, truth, own, background: known.background.shown() };
                all.extend(sources.read(view, true_view)?);
            }
        }
        if all.is_empty() {
            return Err(Failure::BadInput(
                "input views: none of them has an image, by name and pose, in input truth"
                    .to_owned(),
            ));
        }
        Ok(Self::split(all))
    }
}

/// Where an example comes from.
struct Sources<'a> {
    views: &'a GivenInput,
    truth: &'a GivenInput,
    own: Option<&'a LrObservations<'a>>,
    background: f32,
}

impl Sources<'_> {
    /// A view beside its truth; none where one of them has no image.
    fn read(&self, view: &View, true_view: &View) -> Result<Option<KnownView>, Failure> {
        let place = || format!("view {}", view.camera.name);
        let Some(photograph) = true_view.read_photograph(self.truth).bad_input(place())? else {
            return Ok(None);
        };
        let Some((mut rendered, _)) = Rendered::read(self.views, view, self.background)? else {
            return Ok(None);
        };
        if let Some(own) = self.own {
            rendered = own.make_consistent(rendered)?;
        }
        let truth = photograph.over(self.background);
        Ok(Some(KnownView::new(rendered, truth).bad_input("input views")?))
    }
}

/// LR photographs of the downscaled field's views, where those of the views to be refined will be
/// known, too: the task is to be the same.
pub(crate) fn lr_observations(context: &Context) -> Result<Option<LrObservations<'_>>, Failure> {
    let Some((photographs, cameras)) =
        context.optional_input("photographs").zip(context.optional_input("cameras"))
    else {
        return Ok(None);
    };
    let own = LrObservations::read(photographs)?;
    if !own.are_of_all(&Views::read(cameras)?) {
        return Ok(None);
    }
    context.say(
        "all views to be refined have LR photographs of their own: the network learns on views \
        that are consistent with theirs",
    );
    Ok(Some(own))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_eighth_is_left_out_and_none_is_lost() {
        for count in 2..40usize {
            let Examples { training, left_out } = Examples::split((0..count).collect());
            let mut all = [training.clone(), left_out.clone()].concat();
            all.sort_unstable();
            assert_eq!(all, (0..count).collect::<Vec<_>>(), "{count}");
            assert!(!training.is_empty() && !left_out.is_empty(), "{count}");
            assert!(left_out.len() <= count.div_ceil(HOLD_OUT_EVERY), "{count}: {left_out:?}");
        }
        assert_eq!(Examples::split((0..16).collect::<Vec<_>>()).left_out, [4, 12]);
    }

    #[test]
    fn a_single_one_is_both() {
        let Examples { training, left_out } = Examples::split(vec![7]);
        assert_eq!((training, left_out), (vec![7], vec![7]));
    }
}
