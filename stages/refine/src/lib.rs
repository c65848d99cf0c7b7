//! `refine`: gives rendered views the detail they systematically lack, by a network that
//! `train-refine` trained.
//!
//! A network that was trained with references takes them from the inputs `references` (true images
//! at HR) and `reference-views` (the same views as rendered, for what the field sees where).
//!
//! The paper's own network (`train-refine`'s `net: paper`) redraws patches from references' patches
//! instead of adding to the view.
//!
//! What a network that learnt from other images makes of a view's own photograph (input `enlarged`)
//! errs in another way: the mean of both is taken.
//!
//! A view whose own LR photograph is known (input `photographs`; in the paper's split all are
//! trained on and scored) is then moved as little as it takes to be consistent with that; before,
//! too, where the network learnt on views that are.
//!
//! Colours change; opacity, depth and cameras stay what the field made them.

use std::path::Path;

use artifact::{Context, Failure, FailureExt as _, GivenInput, Input, Output, Stage, counted};
use paper_refiner::{OVERLAP, PaperRefiner};
use pixels::{
    Channel, ExrImage, Image, PixelError, VIEW_CHANNELS, VIEW_NOTE, read_exr, write_exr, write_png,
};
use refinement::{
    Guidance, KnownView, LrObservations, Network, REFINER_FILE, Refiner, RefinerFile, Rendered,
    Use, WEIGHTS_FILE, with_references,
};
use scene::{Background, Camera, Photograph, VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `refine`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Share of the predicted residual that is added. Default: the best share for views that the
    /// refiner's training left out.
    #[schemars(range(min = 0.0, max = 2.0), extend("x-default" = "by refiner"))]
    pub residual_weight: Option<f64>,
    /// Maximum number of HR references: the first ones of input `references` are used.
    #[schemars(extend("x-default" = "all"))]
    pub max_references: Option<u32>,
    /// Turned and mirrored versions of a view whose residuals are averaged (geometric
    /// self-ensemble). Time grows with their number.
    #[schemars(range(min = 1, max = 8))]
    pub self_ensemble: u32,
    /// For refiners of `net: paper`: pixels by which patches of 64 pixels overlap.
    #[schemars(range(min = 0, max = 32))]
    pub overlap: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            residual_weight: None,
            max_references: None,
            self_ensemble: 4,
            overlap: OVERLAP as u32,
        }
    }
}

/// The stage.
pub struct Refine;

impl Stage for Refine {
    type Params = Params;
    const NAME: &'static str = "refine";
    const SUMMARY: &'static str = "Gives rendered views the detail they systematically lack.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![
            ("views", Input::required(&["views"], "rendered views")),
            ("refiner", Input::required(&["refiner"], "a trained refiner")),
            (
                "references",
                Input::optional(
                    &["scene/references", "scene/truth"],
                    "true images of some other views, at HR",
                ),
            ),
            ("reference-views", Input::optional(&["views"], "those views as rendered")),
            (
                "photographs",
                Input::optional(
                    &["scene/train"],
                    "LR photographs; a view of the same camera is made consistent with its own",
                ),
            ),
            (
                "enlarged",
                Input::optional(
                    &["views"],
                    "photographs enlarged to the views' size; a view of the same camera becomes \
                    the mean of both",
                ),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("views")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        let refiner = context.input("refiner")?;
        let file: RefinerFile = refiner.read_json(REFINER_FILE)?;
        let network = AnyRefiner::read(refiner, &file)?;
        let strength = params.residual_weight.unwrap_or(file.strength) as f32;
        let input = context.input("views")?;
        let mut views = Views::read(input)?;
        let mut references = references(context, network.takes_references(), views.background)?;
        references.truncate(params.max_references.map_or(usize::MAX, |most| most as usize));
        let photographs =
            context.optional_input("photographs").map(LrObservations::read).transpose()?;
        // Those that the network learnt by were consistent, too.
        if let Some(own) = photographs.as_ref().filter(|_| file.agreeing) {
            let consistent = |KnownView { rendered, truth }| {
                anyhow::Ok(KnownView { rendered: own.make_consistent(rendered)?, truth })
            };
            references = references.into_iter().map(consistent).collect::<Result<_, _>>()?;
        }
        let mut job = RefineJob {
            context,
            input,
            background: views.background.shown(),
            network,
            strength,
            turns: params.self_ensemble,
            overlap: params.overlap as usize,
            references,
            photographs,
            enlarged: context.optional_input("enlarged").map(Enlarged::read).transpose()?,
            takes_consistent: file.agreeing,
        };
        if let Some(guidance) = job.network.guidance().filter(|_| !job.references.is_empty()) {
            job.leave_out(&views, guidance, LITTLE * file.trusted.unwrap_or(1.0))?;
        }
        let mut consistent = 0;
        let mut uses = vec![Use::default(); job.references.len()];
        let progress = context.progress("refining", views.views.len() as u64);
        for view in &mut views.views {
            context.check_interrupt()?;
            let name = &view.camera.name;
            let [image, preview] = [format!("images/{name}.exr"), format!("previews/{name}.png")];
            let made: Made =
                context.part(name, &[&image, &preview], || job.refine(view, &image, &preview))?;
            consistent += usize::from(made.is_consistent);
            uses.iter_mut().zip(&made.uses).for_each(|(sum, of_use)| sum.add(of_use));
            view.depth = view.depth.as_ref().map(|_| image.clone());
            view.image = Some(image);
            progress.add(1);
        }
        if job.takes_consistent && consistent < views.views.len() {
            context.say(
                "the network was trained on views consistent with LR photographs of their \
                own, which some of these haven't: train one without",
            );
        }
        context.write_json(VIEWS_FILE, &views)?;
        let by = job.say_of(&uses);
        let own = if consistent == 0 {
            String::new()
        } else {
            format!("; {consistent} of them agree with their own photographs")
        };
        let is_mean = |view: &&View| {
            job.enlarged
                .as_ref()
                .is_some_and(|enlarged| enlarged.views.taken_by(&view.camera).is_some())
        };
        let all = counted(views.views.len(), "view");
        let means = match views.views.iter().filter(is_mean).count() {
            0 => String::new(),
            count => format!("; {count} are means with their enlarged photographs"),
        };
        context.write_summary(&format!(
            "{all}{by}, with {strength:.2} of what the network adds{means}{own}"
        ))
    }
}

/// The references that a reference-based network asks for; what another is given is said and left
/// out.
fn references(
    context: &Context,
    wanted: bool,
    background: Background,
) -> anyhow::Result<Vec<KnownView>> {
    let given = context.optional_input("references").zip(context.optional_input("reference-views"));
    let Some((images, rendered)) = given else {
        if wanted {
            context.say(
                "the network knows how to use references, but there are none: give inputs \
                    references and reference-views",
            );
        }
        return Ok(Vec::new());
    };
    if !wanted {
        context.say(
            "the network was trained without references: those given are left out; set \
                train-refine's parameter references_per_view",
        );
        return Ok(Vec::new());
    }
    let (images_list, rendered_list) = (Views::read(images)?, Views::read(rendered)?);
    let shown = background.shown();
    let reference = |image: &View| -> anyhow::Result<Option<KnownView>> {
        let name = &image.camera.name;
        let Some(truth) = image.read_photograph(images).bad_input(format!("reference {name}"))?
        else {
            return Ok(None);
        };
        let view = rendered_list.taken_by(&image.camera).ok_or_else(|| {
            Failure::BadInput(format!(
                "input reference-views: no view {name} with that pose; \
                render it for input references"
            ))
        })?;
        let known = KnownView::new(read(rendered, view, shown)?.0, truth.over(shown))
            .bad_input("input reference-views")?;
        Ok(Some(same_exposure(context, known)))
    };
    images_list.views.iter().filter_map(|image| reference(image).transpose()).collect()
}

/// A reference as it would look with the exposure of the images that the field learnt from.
fn same_exposure(context: &Context, reference: KnownView) -> KnownView {
    let Some(exposure) = reference.exposure().filter(|exposure| !exposure.is_none()) else {
        return reference;
    };
    let [r, g, b] = exposure.gain;
    let name = &reference.rendered.camera.name;
    context.say(format!(
        "reference {name} has another exposure ({r:.2}, {g:.2}, {b:.2} times as bright): taken back"
    ));
    reference.without(&exposure)
}

/// A rendered view, and its file's channels.
fn read(input: &GivenInput, view: &View, background: f32) -> anyhow::Result<(Rendered, ExrImage)> {
    let name = &view.camera.name;
    let file = view
        .image
        .as_ref()
        .ok_or_else(|| Failure::BadInput(format!("view {name}: it has no image")))?;
    let image = read_exr(&input.path(file)).bad_input(format!("view {name}"))?;
    Ok((Rendered::new(view.camera.clone(), &image, background).bad_input("rendered views")?, image))
}

/// Photographs enlarged by a method that looks at each alone.
struct Enlarged<'a> {
    input: &'a GivenInput,
    views: Views,
}

impl<'a> Enlarged<'a> {
    fn read(input: &'a GivenInput) -> anyhow::Result<Self> {
        Ok(Self { input, views: Views::read(input)? })
    }

    /// The mean of an image and what was made of the same camera's photograph, where its mask
    /// leaves it; the image where there is none.
    fn mean(&self, mut image: Image, camera: &Camera) -> anyhow::Result<Image> {
        let Some(view) = self.views.taken_by(camera) else { return Ok(image) };
        let place = || format!("input enlarged: view {}", camera.name);
        let Some(photograph) = view.read_photograph(self.input).bad_input(place())? else {
            return Ok(image);
        };
        let Photograph { image: mut other, mask } = photograph.over(self.views.background.shown());
        if (other.width, other.height) != (image.width, image.height) {
            let sizes = format!(
                "{}×{} pixels where the view to refine has {}×{}",
                other.width, other.height, image.width, image.height
            );
            return Err(Failure::BadInput(format!("{}: {sizes}", place())).into());
        }
        if let Some(mask) = mask {
            mask.fill(&mut other, &image);
        }
        image.data.iter_mut().zip(&other.data).for_each(|(v, other)| *v = 0.5 * (*v + other));
        Ok(image)
    }
}

/// Either network.
enum AnyRefiner {
    Compact(Refiner),
    /// The paper's, and how many reference patches each patch gets.
    Paper(PaperRefiner, usize),
}

impl AnyRefiner {
    fn read(input: &GivenInput, file: &RefinerFile) -> anyhow::Result<Self> {
        let path = input.path(WEIGHTS_FILE);
        match file.network {
            Network::Compact(architecture) => Refiner::read(&path, architecture).map(Self::Compact),
            Network::Paper { width, patches } => {
                PaperRefiner::read(&path, width).map(|n| Self::Paper(n, patches as usize))
            }
        }
        .bad_input("input refiner")
    }

    /// How it takes references, where it is ours and does.
    fn guidance(&self) -> Option<Guidance> {
        let Self::Compact(network) = self else { return None };
        network.architecture().guidance
    }

    fn takes_references(&self) -> bool {
        self.guidance().is_some() || matches!(self, Self::Paper(..))
    }
}

/// Something must be wrong with a reference whose confidence is less than this share of that in
/// those of the downscaled field.
const LITTLE: f64 = 0.75;

/// Unless the confidence in it is so many times as high as with all depths nearer or farther by
/// that share.
const SENSITIVE: f64 = 1.1;
const ELSEWHERE: f32 = 0.1;

/// Views, spread over all, by which that is judged.
const JUDGES: usize = 8;

/// How a view was refined.
#[derive(Serialize, Deserialize)]
struct Made {
    /// Whether it was made consistent with its own LR observation.
    #[serde(rename = "agreed")]
    is_consistent: bool,
    /// What each reference was of use for.
    uses: Vec<Use>,
}

/// What all views share.
struct RefineJob<'a> {
    context: &'a Context,
    input: &'a GivenInput,
    background: f32,
    network: AnyRefiner,
    strength: f32,
    turns: u32,
    overlap: usize,
    references: Vec<KnownView>,
    photographs: Option<LrObservations<'a>>,
    enlarged: Option<Enlarged<'a>>,
    /// Whether the network was trained on views that are consistent with their own LR observations.
    takes_consistent: bool,
}

impl RefineJob<'_> {
    /// Refines one view and writes its files.
    fn refine(&self, view: &View, image: &str, preview: &str) -> anyhow::Result<Made> {
        let (rendered, file, own) = self.shown(view)?;
        let mut uses = vec![Use::default(); self.references.len()];
        let redrawn = self.redraw(&rendered, &mut uses)?;
        let mean = match &self.enlarged {
            Some(enlarged) => enlarged.mean(redrawn, &view.camera)?,
            None => redrawn,
        };
        let refined = self.make_consistent(mean, own.as_ref());
        self.write(&self.context.output_path(image)?, &file, &refined, &rendered.opacity)?;
        write_png(&self.context.output_path(preview)?, &refined.to_rgba8())?;
        Ok(Made { is_consistent: own.is_some(), uses })
    }

    /// A view as the network takes it, its file's channels, and its own photograph.
    fn shown(&self, view: &View) -> anyhow::Result<(Rendered, ExrImage, Option<Photograph>)> {
        let (rendered, image) = read(self.input, view, self.background)?;
        let own = self
            .photographs
            .as_ref()
            .map(|photographs| photographs.of(&view.camera))
            .transpose()?
            .flatten();
        if !self.takes_consistent {
            return Ok((rendered, image, own));
        }
        let colours = self.make_consistent(rendered.colours(), own.as_ref());
        Ok((rendered.with_colours(&colours), image, own))
    }

    /// An image of a view that is consistent with its own LR observation, where there is one.
    fn make_consistent(&self, image: Image, own: Option<&Photograph>) -> Image {
        match self.photographs.as_ref().zip(own) {
            Some((photographs, own)) => photographs.project(&image, own),
            None => image,
        }
    }

    /// What the network makes of a view: colours in 0..1. What each reference was of use for is
    /// added to `uses`.
    fn redraw(&self, rendered: &Rendered, uses: &mut [Use]) -> anyhow::Result<Image> {
        let references: Vec<&KnownView> = self.references.iter().collect();
        match &self.network {
            AnyRefiner::Compact(network) => {
                let Some(guidance) = self.network.guidance() else {
                    return Ok(network.refine_by(&rendered.view, self.strength, self.turns)?);
                };
                let conditioned = with_references(rendered, &references, guidance);
                uses.iter_mut().zip(&conditioned.uses).for_each(|(sum, of_use)| sum.add(of_use));
                Ok(network.refine_by(&conditioned.view, self.strength, self.turns)?)
            }
            AnyRefiner::Paper(network, patches) => {
                let mut drawn = network
                    .refine(rendered, &references, *patches, self.overlap)
                    .bad_input("input views")?;
                for (to, from) in
                    drawn.data.chunks_exact_mut(3).zip(rendered.view.data.chunks_exact(4))
                {
                    (0..3).for_each(|c| {
                        to[c] = (from[c] + self.strength * (to[c] - from[c])).clamp(0.0, 1.0);
                    });
                }
                Ok(drawn)
            }
        }
    }

    /// Leaves references out that look otherwise than what is rendered: those in which confidence
    /// is less than a share of what they see, unless it would be clearly less still were all depths
    /// others. Then depths are right, and confidence is low for another reason: seen from far
    /// aside, surfaces look otherwise.
    fn leave_out(&mut self, views: &Views, guidance: Guidance, least: f64) -> anyhow::Result<()> {
        let confidence = self.confidence(&self.references, views, guidance, 1.0)?;
        let references = std::mem::take(&mut self.references);
        for (reference, share) in references.into_iter().zip(confidence) {
            // At another depth a reference sees nothing by its own.
            let blind = Guidance { occlusion: false, ..guidance };
            let through = |by: f32| {
                anyhow::Ok(self.confidence(std::slice::from_ref(&reference), views, blind, by)?[0])
            };
            let is_right = || -> anyhow::Result<bool> {
                let elsewhere = f64::max(through(1.0 - ELSEWHERE)?, through(1.0 + ELSEWHERE)?);
                Ok(through(1.0)? >= SENSITIVE * elsewhere)
            };
            if share >= least || is_right()? {
                self.references.push(reference);
                continue;
            }
            let name = &reference.rendered.camera.name;
            self.context.say(format!(
                "reference {name} looks otherwise than what is rendered (confidence {:.0} %) and \
                is left out: wrong depth, a wrong pose, or \
                 something that moved?",
                100.0 * share
            ));
        }
        Ok(())
    }

    /// Confidence in each reference, as a share of what it sees of some views spread over all, were
    /// depths so many times what they are.
    fn confidence(
        &self,
        references: &[KnownView],
        views: &Views,
        guidance: Guidance,
        depths: f32,
    ) -> anyhow::Result<Vec<f64>> {
        let every = views.views.len().div_ceil(JUDGES).max(1);
        let mut uses = vec![Use::default(); references.len()];
        let references: Vec<&KnownView> = references.iter().collect();
        for view in views.views.iter().step_by(every) {
            let mut shown = self.shown(view)?.0;
            shown.depth.iter_mut().for_each(|depth| *depth *= depths);
            let conditioned = with_references(&shown, &references, guidance);
            uses.iter_mut().zip(&conditioned.uses).for_each(|(sum, of_use)| sum.add(of_use));
        }
        Ok(uses.iter().map(Use::confidence_share).collect())
    }

    /// Says which references were of no use; in a word or two, of what use all were.
    fn say_of(&self, uses: &[Use]) -> String {
        if self.references.is_empty() {
            return String::new();
        }
        let references = counted(self.references.len(), "reference");
        if self.network.guidance().is_none() {
            return format!(" by {references}");
        }
        let mut all = Use::default();
        for (reference, of_use) in self.references.iter().zip(uses) {
            all.add(of_use);
            if of_use.seen == 0 {
                self.context.say(format!(
                    "reference {} sees nothing of these views",
                    reference.rendered.camera.name
                ));
            }
        }
        if all.seen == 0 {
            return format!(" by {references} that see nothing of them");
        }
        format!(" by {references}, trusted by {:.0} %", 100.0 * all.confidence_share())
    }

    /// A view's file with other colours.
    fn write(
        &self,
        path: &Path,
        image: &ExrImage,
        refined: &Image,
        opacity: &[f32],
    ) -> anyhow::Result<()> {
        // All but the colours stay.
        let kept: Vec<(Channel, Option<&[f32]>)> = VIEW_CHANNELS
            .into_iter()
            .enumerate()
            .filter_map(|(i, channel)| {
                Some((channel, image.channel(channel.name).map(|s| (i >= 3).then_some(s))?))
            })
            .collect();
        let channels: Vec<Channel> = kept.iter().map(|(c, _)| *c).collect();
        let written = write_exr(
            path,
            (image.width, image.height),
            &channels,
            VIEW_NOTE,
            |first, rows, samples| {
                let pixels = first * image.width..(first + rows) * image.width;
                for (i, sample) in pixels.zip(samples.chunks_exact_mut(kept.len())) {
                    for (c, (value, (_, same))) in sample.iter_mut().zip(&kept).enumerate() {
                        *value = same.map_or_else(
                            || refined.data[i * 3 + c] - (1.0 - opacity[i]) * self.background,
                            |s| s[i],
                        );
                    }
                }
                Ok::<(), PixelError>(())
            },
        );
        written.map_err(|error| match error {
            PixelError::NotFinite { .. } => Failure::Numerical(error.to_string()).into(),
            error => error.into(),
        })
    }
}
