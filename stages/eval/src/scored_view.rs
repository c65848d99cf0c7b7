use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput, bail_bad_input};
use pixels::{Degradation, Filter, Image, Mask, Resampling};
use scene::{View, Views};

/// Rendered views and their ground truth.
pub(crate) struct ScoredScene<'a> {
    pub(crate) views_input: &'a GivenInput,
    pub(crate) views: &'a Views,
    pub(crate) truth_input: &'a GivenInput,
    pub(crate) truth: &'a Views,
    /// Degradation that made the LR images, if known.
    pub(crate) degradation: Option<Degradation>,
}

/// View to score. Images are composited over the background and clamped to 0..1.
pub(crate) struct ScoredView<'a> {
    pub(crate) scene: &'a ScoredScene<'a>,
    pub(crate) view: &'a View,
    pub(crate) true_view: &'a View,
    pub(crate) render: Image,
    /// HR truth, if any; equal to the render at pixels that don't count.
    pub(crate) truth: Option<Image>,
    /// Mask of the pixels that count, of the size of [`ScoredView::compared_images`]; `None` for
    /// all.
    pub(crate) mask: Option<Mask>,
    /// Fraction of the HR pixels that count by the mask; 1 without HR truth.
    pub(crate) counted_share: f64,
    pub(crate) lr: Option<LrPair>,
}

/// Render shrunk to LR, and the view's LR image.
pub(crate) struct LrPair {
    pub(crate) render: Image,
    pub(crate) truth: Image,
    /// Fraction of the LR pixels that count by the mask.
    pub(crate) counted_share: f64,
}

impl<'a> ScoredView<'a> {
    /// Reads a rendered view and its ground truth.
    pub(crate) fn read(scene: &'a ScoredScene<'a>, true_view: &'a View) -> anyhow::Result<Self> {
        let name = &true_view.camera.name;
        let view = scene.views.views.iter().find(|view| view.camera.name == *name);
        let view = view.ok_or_else(|| {
            let problem = "is missing, but the truth has it; render the same scene's cameras";
            Failure::BadInput(format!("views: view {name} {problem}"))
        })?;
        let file = view.image.as_ref().with_context(|| format!("view {name} has no image"));
        let render = read_image(scene.views_input, scene.views, view, file.bad_input("views")?)?;
        let truth = read_true_image(scene, true_view, true_view.image.as_deref())?;
        check_sizes(true_view, &render, truth.as_ref())?;
        let lr = read_true_image(scene, true_view, true_view.low_resolution.as_deref())?;
        if truth.is_none() && lr.is_none() {
            bail_bad_input!("truth: view {name} has neither an HR nor an LR image");
        }
        let filter =
            scene.degradation.map_or(Filter::Box, |degradation| degradation.kernel.filter());
        let lr = lr.map(|truth| LrPair {
            render: shrink(&render, &truth, filter),
            truth,
            counted_share: 1.0,
        });
        let (mask, counted_share) = (None, 1.0);
        let mut scored = Self { scene, view, true_view, render, truth, mask, counted_share, lr };
        scored.apply_mask()?;
        Ok(scored)
    }

    /// Returns render and truth for the error map: at HR, or at LR if there is no HR truth.
    pub(crate) fn compared_images(&self) -> (&Image, &Image) {
        let hr = self.truth.as_ref().map(|truth| (&self.render, truth));
        hr.or_else(|| self.lr.as_ref().map(|lr| (&lr.render, &lr.truth)))
            .expect("views without HR and LR truth are refused")
    }

    /// Replaces the truth by the render at pixels that don't count.
    fn apply_mask(&mut self) -> anyhow::Result<()> {
        let name = &self.true_view.camera.name;
        let (_, truth) = self.compared_images();
        let mask = self.true_view.read_mask(self.scene.truth_input, (truth.width, truth.height));
        let Some(mask) = mask.bad_input(format!("view {name}"))? else { return Ok(()) };
        if let Some(truth) = &mut self.truth {
            self.counted_share = fill_masked(name, &mask, truth, &self.render)?;
        }
        if let Some(lr) = &mut self.lr {
            lr.counted_share = fill_masked(name, &mask, &mut lr.truth, &lr.render)?;
        }
        self.mask = Some(mask);
        Ok(())
    }
}

/// Copies the render into the truth at pixels that don't count. Returns the fraction that counts.
fn fill_masked(name: &str, mask: &Mask, truth: &mut Image, render: &Image) -> anyhow::Result<f64> {
    let mask = mask.resized((truth.width, truth.height), 0);
    mask.fill(truth, render);
    if mask.counted_fraction() == 0.0 {
        bail_bad_input!("view {name}: the mask excludes every pixel; remove the view or its mask");
    }
    Ok(mask.counted_fraction())
}

/// Fails if the render or the HR truth has another size than the true camera.
fn check_sizes(true_view: &View, render: &Image, truth: Option<&Image>) -> anyhow::Result<()> {
    let (name, k) = (&true_view.camera.name, &true_view.camera.intrinsics);
    let expected = (k.width as usize, k.height as usize);
    if expected != (render.width, render.height) {
        bail_bad_input!(
            "view {name}: rendered at {}×{}, but the truth has {}×{}; set size in render-depth",
            render.width,
            render.height,
            k.width,
            k.height
        );
    }
    if let Some(truth) = truth.filter(|truth| (truth.width, truth.height) != expected) {
        bail_bad_input!(
            "truth: view {name}: the image has {}×{} pixels, its camera {}×{}; run prep again",
            truth.width,
            truth.height,
            k.width,
            k.height
        );
    }
    Ok(())
}

/// Shrinks a render to the size of an LR image. The result is clamped like 8-bit images, since
/// kernels with negative lobes overshoot.
fn shrink(render: &Image, lr: &Image, filter: Filter) -> Image {
    let (from, to) = ((render.width, render.height), (lr.width, lr.height));
    clamped(Resampling::new(filter, from, to).apply(render))
}

fn read_true_image(
    scene: &ScoredScene<'_>,
    view: &View,
    file: Option<&str>,
) -> anyhow::Result<Option<Image>> {
    file.map(|file| read_image(scene.truth_input, scene.truth, view, file)).transpose()
}

/// Reads an image of a view over the background, clamped to 0..1.
pub(crate) fn read_image(
    input: &GivenInput,
    views: &Views,
    view: &View,
    file: &str,
) -> anyhow::Result<Image> {
    let name = format!("view {}", view.camera.name);
    Ok(clamped(views.read_over(&input.path(file)).bad_input(&name)?))
}

fn clamped(mut image: Image) -> Image {
    for sample in &mut image.data {
        *sample = sample.clamp(0.0, 1.0);
    }
    image
}
