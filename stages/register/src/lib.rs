//! `register`: finds where photographs were taken from, by a field that knows the scene. Each
//! camera moves until what the field renders meets its photograph ([`poses::refine`]), from coarse
//! to fine.
//!
//! That is how test views are to be scored where poses aren't exact: the field lies where its own
//! training views say, and a camera that is wrong by a pixel costs more decibels than anything a
//! field gets wrong. Only LR photographs are looked at where there are any: HR ones are what views
//! are scored by.

use artifact::{FailureExt as _, GivenInput, WARNING, counted, with_warnings};
use contract::{Input, Output};
use pixels::{Image, PixelError};
use poses::{CameraMotion, MeanMotion, Options, Pyramid, refine};
use radiance::{RayField, RenderError};
use scene::{Camera, Photograph, VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Stage};

/// Parameters of `register`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// How often a photograph is halved at the start. More finds cameras that are farther off.
    #[schemars(range(min = 0, max = 8))]
    pub smaller: u32,
    /// Maximum number of renders for a photograph at each of its sizes.
    #[schemars(range(min = 2, max = 100))]
    pub renderings: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { smaller: 3, renderings: 8 }
    }
}

/// The stage.
pub struct Register;

impl Stage for Register {
    type Params = Params;
    const NAME: &'static str = "register";
    const SUMMARY: &'static str = "Finds where photographs were taken from, by a field.";
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        let photographs = ["scene/truth", "scene/train", "scene/references"];
        vec![
            ("field", Input::required(&["field"], "a trained field")),
            (
                "photographs",
                Input::required(&photographs, "photographs with cameras that are about right"),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("cameras")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let members = fields::Members::read(context.input("field")?, &context.device)?;
        let input = context.input("photographs")?;
        let given = Views::read(input)?;
        let shown = members.file.background.shown();
        let progress = context.progress("locating", given.views.len() as u64);
        let mut found = Vec::with_capacity(given.views.len());
        for view in &given.views {
            context.check_interrupt()?;
            let place = || format!("view {}", view.camera.name);
            let photograph = read(view, input).bad_input(place())?;
            let registered = match photograph {
                Some(photograph) => {
                    let image = photograph.over(shown).masked_image();
                    Registered::by(&members, &view.camera, &image, params, shown)
                        .map_err(|e| anyhow::anyhow!("{}: {e}", place()))?
                }
                None => Registered::unknown(&view.camera),
            };
            found.push(registered);
            progress.add(1);
        }
        let (summary, warning) = summary(&found);
        warning.iter().for_each(|warning| context.say(format!("{WARNING}{warning}")));
        let views = found.into_iter().map(|registered| View::camera_only(registered.to)).collect();
        context.write_json(VIEWS_FILE, &Views::new(given.background, given.bounds, views))?;
        context.write_summary(&with_warnings(&summary, warning.as_slice()))
    }
}

/// Where a photograph was taken from.
struct Registered {
    /// The given camera; its pixels are the photograph's.
    from: Camera,
    /// The camera that was found.
    to: Camera,
    /// Middle depth of what that sees.
    depth: Option<f64>,
    /// How the photograph is met from either; none where there is no photograph.
    errors: Option<[f64; 2]>,
}

impl Registered {
    /// Of a view without a photograph nothing is known.
    fn unknown(camera: &Camera) -> Self {
        Self { from: camera.clone(), to: camera.clone(), depth: None, errors: None }
    }

    /// By what a field renders, from coarse to fine. The given pose stays where the whole
    /// photograph is met no better from the one found: smaller sizes may have led astray.
    fn by(
        field: &dyn RayField,
        camera: &Camera,
        image: &Image,
        params: &Params,
        background: f32,
    ) -> Result<Self, RenderError> {
        let pyramid = Pyramid::new(image, params.smaller);
        let options = Options { max_renders: params.renderings, background, ..Options::default() };
        let given = refine(field, camera, &pyramid, 0, &Options { max_renders: 1, ..options })?;
        let mut to = camera.clone();
        for level in (1..=pyramid.smaller_levels()).rev() {
            to = refine(field, &to, &pyramid, level, &options)?.camera;
        }
        let last = refine(field, &to, &pyramid, 0, &options)?;
        let best = if last.after < given.before { last } else { given.clone() };
        let from = camera.resized(image.width as u32, image.height as u32);
        Ok(Self {
            from,
            to: best.camera,
            depth: best.depth,
            errors: Some([given.before, best.after]),
        })
    }
}

/// The LR photograph of a view, or the only one there is.
fn read(view: &View, input: &GivenInput) -> Result<Option<Photograph>, PixelError> {
    Ok(match view.read_lr_photograph(input)? {
        Some(photograph) => Some(photograph),
        None => view.read_photograph(input)?,
    })
}

/// How far cameras went, and what it was good for; a warning, where they went far.
fn summary(found: &[Registered]) -> (String, Option<String>) {
    let moved = MeanMotion::of_cameras(
        found.iter().map(|Registered { from, to, depth, .. }| CameraMotion {
            from,
            to,
            depth: *depth,
        }),
    );
    let errors: Vec<[f64; 2]> = found.iter().filter_map(|registered| registered.errors).collect();
    let mean =
        |i: usize| (errors.iter().map(|e| e[i]).sum::<f64>() / errors.len().max(1) as f64).sqrt();
    let (count, all, before, after) =
        (errors.len(), counted(found.len(), "camera"), mean(0), mean(1));
    let summary = format!(
        "{count} of {all} registered: {moved}; error (Huber's) {before:.4} before, {after:.4} after"
    );
    let warning = format!(
        "cameras have {moved}, which is far: unless the given poses are that far off, the field \
        or the photographs are of something else"
    );
    (summary, moved.is_far().then_some(warning))
}

#[cfg(test)]
mod tests;
