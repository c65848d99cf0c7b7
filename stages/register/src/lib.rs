//! `register`: estimates the cameras of photographs from a trained field. Each camera moves, from
//! coarse to fine, until the field's render fits its photograph ([`poses::refine`]).
//!
//! Test views need registration if poses aren't exact: the field's frame follows its training
//! views, and a camera that is off by a pixel costs more decibels than any error of the field
//! (design note 025). LR photographs are preferred, because views are scored against the HR ones.

use artifact::{FailureExt as _, GivenInput, WARNING, format_count, with_warnings};
use pixels::{Image, PixelError};
use poses::{CameraMotion, MeanMotion, Options, Pyramid, refine};
use radiance::{RayField, RenderError};
use scene::{Camera, Photograph, VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::{Context, Input, Output, Stage};

/// Parameters of `register`: none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {}

/// Maximum number of times that a photograph is halved for the first fit. With more halvings, the
/// given cameras may have larger errors. Chosen by hand.
const PYRAMID_LEVELS: u32 = 3;
/// Maximum number of times that the field is rendered for a photograph, at each of its sizes;
/// chosen by hand.
const MAX_RENDERS: u32 = 8;

/// Stage `register`.
pub struct Register;

impl Stage for Register {
    type Params = Params;
    const NAME: &'static str = "register";
    const SUMMARY: &'static str = "Estimates the cameras of photographs from a trained field.";
    const LIBTORCH: bool = cfg!(feature = "torch");
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        let photographs = ["scene/truth", "scene/train", "scene/references"];
        vec![
            ("field", Input::required(&["field"], "a trained field")),
            ("photographs", Input::required(&photographs, "photographs with approximate cameras")),
        ]
    }

    fn output() -> Output {
        Output::kind("cameras")
    }

    fn run(context: &Context, _: &Params) -> anyhow::Result<()> {
        let members = fields::FieldArtifact::read(context.input("field")?, &context.device)?;
        let input = context.input("photographs")?;
        let given = Views::read(input)?;
        let background = members.file.background.grey_level();
        let progress = context.progress("locating", given.views.len() as u64);
        let mut registered = Vec::with_capacity(given.views.len());
        for view in &given.views {
            context.check_interrupt()?;
            let name = format!("view {}", view.camera.name);
            registered.push(match read_photograph(view, input).bad_input(&name)? {
                Some(photograph) => {
                    let image = photograph.over(background).masked_image();
                    Registered::from_image(&members, &view.camera, &image, background)
                        .map_err(|e| anyhow::anyhow!("{name}: {e}"))?
                }
                None => Registered::unchanged(&view.camera),
            });
            progress.add(1);
        }
        let (summary, warning) = summary(&registered);
        if let Some(warning) = &warning {
            context.log_line(format!("{WARNING}{warning}"));
        }
        let views = registered.into_iter().map(|view| View::camera_only(view.to)).collect();
        context.write_json(VIEWS_FILE, &Views::new(given.background, given.bounds, views))?;
        context.write_summary(&with_warnings(&summary, warning.as_slice()))
    }
}

/// Registered camera of a photograph.
struct Registered {
    /// Given camera, resized to the photograph.
    from: Camera,
    /// Estimated camera.
    to: Camera,
    /// Median depth of the render from the estimated camera.
    depth: Option<f64>,
    /// Error of the render from the given and from the estimated camera; `None` without a
    /// photograph that has informative pixels.
    errors: Option<[f64; 2]>,
}

impl Registered {
    /// Keeps the camera of a view without a photograph.
    fn unchanged(camera: &Camera) -> Self {
        Self { from: camera.clone(), to: camera.clone(), depth: None, errors: None }
    }

    /// Registers a camera from coarse to fine. Keeps the given pose unless the estimated one has a
    /// smaller error at full size, since smaller sizes can mislead.
    fn from_image(
        field: &dyn RayField,
        camera: &Camera,
        image: &Image,
        background: f32,
    ) -> Result<Self, RenderError> {
        let pyramid = Pyramid::new(image, PYRAMID_LEVELS);
        let options = Options { max_renders: MAX_RENDERS, background, ..Options::default() };
        let given = refine(field, camera, &pyramid, 0, &Options { max_renders: 1, ..options })?;
        let mut to = camera.clone();
        for level in (1..=pyramid.smaller_levels()).rev() {
            to = refine(field, &to, &pyramid, level, &options)?.camera;
        }
        let estimated = refine(field, &to, &pyramid, 0, &options)?;
        let before = given.before;
        let best = if estimated.after < before { estimated } else { given };
        Ok(Self {
            from: camera.resized(image.width as u32, image.height as u32),
            to: best.camera,
            depth: best.depth,
            // Without informative pixels nothing is compared.
            errors: pyramid.is_informative().then_some([before, best.after]),
        })
    }
}

/// Reads the LR photograph of a view, or the HR one if there is no LR photograph.
fn read_photograph(view: &View, input: &GivenInput) -> Result<Option<Photograph>, PixelError> {
    Ok(match view.read_lr_photograph(input)? {
        Some(photograph) => Some(photograph),
        None => view.read_photograph(input)?,
    })
}

/// Returns the summary, and a warning if cameras have moved far.
fn summary(registered: &[Registered]) -> (String, Option<String>) {
    let moves = registered.iter().map(|Registered { from, to, depth, .. }| CameraMotion {
        from,
        to,
        depth: *depth,
    });
    let moved = MeanMotion::of_cameras(moves);
    let errors: Vec<[f64; 2]> = registered.iter().filter_map(|view| view.errors).collect();
    let [before, after] = [0, 1]
        .map(|i| (errors.iter().map(|e| e[i]).sum::<f64>() / errors.len().max(1) as f64).sqrt());
    let summary = format!(
        "{} of {} registered: {moved}; error (Huber) {before:.4} before, {after:.4} after",
        errors.len(),
        format_count(registered.len(), "camera")
    );
    let warning = format!(
        "cameras have {moved}; unless the given poses are that far off, check that the field and \
        the photographs are of the same scene"
    );
    (summary, moved.exceeds_usual_error().then_some(warning))
}

#[cfg(test)]
mod tests;
