use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput};
use pixels::{Degradation, Filter, Image, Mask, Resampling};
use scene::{View, Views};

/// What is scored: rendered views, and what they should be.
pub(crate) struct ScoredScene<'a> {
    pub(crate) views_in: &'a GivenInput,
    pub(crate) views: &'a Views,
    pub(crate) truth_in: &'a GivenInput,
    pub(crate) truth: &'a Views,
    /// What made the LR images, as far as is known.
    pub(crate) made: Option<Degradation>,
}

/// A view to score, its images over their backgrounds and in [0, 1].
pub(crate) struct ScoredView<'a> {
    pub(crate) scene: &'a ScoredScene<'a>,
    pub(crate) view: &'a View,
    pub(crate) true_view: &'a View,
    pub(crate) found: Image,
    /// HR truth, where there is any; what doesn't count is as found.
    pub(crate) expected: Option<Image>,
    /// Share of the pixels that count: those that the mask leaves.
    pub(crate) counted_share: f64,
    pub(crate) lr: Option<LrPair>,
}

/// A render shrunk to LR, and the view's LR image.
pub(crate) struct LrPair {
    pub(crate) shrunk: Image,
    pub(crate) expected: Image,
    /// As [`ScoredView::counted_share`].
    pub(crate) counted_share: f64,
}

impl<'a> ScoredView<'a> {
    /// Reads a view and what it should be.
    pub(crate) fn read(scene: &'a ScoredScene<'a>, true_view: &'a View) -> anyhow::Result<Self> {
        let name = &true_view.camera.name;
        let view = scene.views.views.iter().find(|view| view.camera.name == *name);
        let view = view.ok_or_else(|| {
            Failure::BadInput(format!("views: none is named {name}, which the truth has"))
        })?;
        let image = view.image.as_ref().with_context(|| format!("view {name}: it has no image"));
        let image = image.bad_input("views")?;
        let found = read_image(scene.views_in, scene.views, view, image)?;
        let read_true = |file| read_image(scene.truth_in, scene.truth, true_view, file);
        let expected = true_view.image.as_deref().map(read_true).transpose()?;
        check_sizes(true_view, &found, expected.as_ref())?;
        let lr = true_view.low_resolution.as_deref().map(read_true).transpose()?;
        if expected.is_none() && lr.is_none() {
            let message = format!("truth: view {name} has no image at all");
            return Err(Failure::BadInput(message).into());
        }
        let filter = scene.made.map_or(Filter::Box, |made| made.kernel.filter());
        let lr = lr.map(|expected| LrPair {
            shrunk: shrunk(&found, &expected, filter),
            expected,
            counted_share: 1.0,
        });
        let counted_share = 1.0;
        let mut scored = Self { scene, view, true_view, found, expected, counted_share, lr };
        scored.fill_what_does_not_count()?;
        Ok(scored)
    }

    /// The pair of images whose error is shown: HR, or LR where there is no HR truth.
    pub(crate) fn shown(&self) -> Option<(&Image, &Image)> {
        let hr = self.expected.as_ref().map(|expected| (&self.found, expected));
        hr.or_else(|| self.lr.as_ref().map(|lr| (&lr.shrunk, &lr.expected)))
    }

    /// What doesn't count can't differ.
    fn fill_what_does_not_count(&mut self) -> anyhow::Result<()> {
        let name = &self.true_view.camera.name;
        let Some((_, shown)) = self.shown() else { return Ok(()) };
        let mask = self.true_view.read_mask(self.scene.truth_in, (shown.width, shown.height));
        let Some(mask) = mask.bad_input(format!("view {name}"))? else { return Ok(()) };
        if let Some(expected) = &mut self.expected {
            self.counted_share = fill(name, &mask, expected, &self.found)?;
        }
        if let Some(lr) = &mut self.lr {
            lr.counted_share = fill(name, &mask, &mut lr.expected, &lr.shrunk)?;
        }
        Ok(())
    }
}

/// Gives the truth what was found where that doesn't count. Returns the share that counts.
fn fill(name: &str, mask: &Mask, truth: &mut Image, found: &Image) -> anyhow::Result<f64> {
    let mask = mask.resized((truth.width, truth.height), 0);
    mask.fill(truth, found);
    if mask.counted_fraction() == 0.0 {
        let message =
            format!("view {name}: its mask leaves no pixel to score; remove the view or its mask");
        return Err(Failure::BadInput(message).into());
    }
    Ok(mask.counted_fraction())
}

/// Refuses a render, or HR truth, of another size than the true camera's.
fn check_sizes(true_view: &View, found: &Image, expected: Option<&Image>) -> anyhow::Result<()> {
    let (name, k) = (&true_view.camera.name, &true_view.camera.intrinsics);
    let wanted = (k.width as usize, k.height as usize);
    if wanted != (found.width, found.height) {
        let message = format!(
            "view {name}: rendered at {}×{} where the truth has {}×{}; set size in render-depth",
            found.width, found.height, wanted.0, wanted.1
        );
        return Err(Failure::BadInput(message).into());
    }
    if let Some(expected) = expected.filter(|e| (e.width, e.height) != wanted) {
        let message = format!(
            "view {name}: its image has {}×{} pixels, its camera others",
            expected.width, expected.height
        );
        return Err(Failure::BadInput(message).into());
    }
    Ok(())
}

/// A render at the size of an LR image. As 8 bits would, it is clamped: a kernel with negative
/// lobes overshoots.
fn shrunk(found: &Image, lr: &Image, filter: Filter) -> Image {
    let (from, to) = ((found.width, found.height), (lr.width, lr.height));
    let mut shrunk = Resampling::new(filter, from, to).apply(found);
    shrunk.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    shrunk
}

/// An image of a view over its background, clamped to [0, 1].
pub(crate) fn read_image(
    input: &GivenInput,
    views: &Views,
    view: &View,
    file: &str,
) -> anyhow::Result<Image> {
    let place = format!("view {}", view.camera.name);
    let mut image = views.read_over(&input.path(file)).bad_input(&place)?;
    image.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    Ok(image)
}
