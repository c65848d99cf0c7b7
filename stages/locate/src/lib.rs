//! `locate`: finds where photographs were taken from, by a field that knows the scene. Each camera moves until what the field renders meets its
//! photograph ([`poses::refine`]), from coarse to fine.
//!
//! That is how test views are to be scored where poses aren't exact: the field lies where its own training views say, and a camera that is wrong
//! by a pixel costs more decibels than anything a field gets wrong. Only LR photographs are looked at where there are any: HR ones are what
//! views are scored by.

use artifact::{Context, FailureExt as _, GivenInput, Input, Output, Stage};
use pixels::PixelError;
use poses::{Moved, Options, Pyramid, refine};
use scene::{Camera, Photograph, VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `locate`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// How often the photograph is halved to begin with: more finds cameras that are farther off.
    #[schemars(range(min = 0, max = 8))]
    pub smaller: u32,
    /// Renderings at most for a photograph at each of its sizes.
    #[schemars(range(min = 2, max = 100))]
    pub renderings: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self { smaller: 3, renderings: 8 }
    }
}

/// The stage.
pub struct Locate;

impl Stage for Locate {
    type Params = Params;
    const NAME: &'static str = "locate";
    const SUMMARY: &'static str = "Finds where photographs were taken from, by a field.";
    const ENVIRONMENT: &'static [&'static str] = fields::ENVIRONMENT;

    fn inputs() -> Vec<(&'static str, Input)> {
        let photographs = ["scene/truth", "scene/train", "scene/references"];
        vec![
            ("field", Input::required(&["field"], "a trained field")),
            ("photographs", Input::required(&photographs, "photographs with cameras that are about right")),
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
        let mut cameras = Vec::with_capacity(given.views.len());
        let (mut located, mut errors) = (0u32, [0.0; 2]);
        for view in &given.views {
            context.check_interrupt()?;
            let place = || format!("view {}", view.camera.name);
            let mut camera = view.camera.clone();
            if let Some(photograph) = read(view, input).bad_input(place())? {
                let pyramid = Pyramid::new(&photograph.over(shown).known(), params.smaller);
                let found = |camera: &Camera, level: u32, renderings: u32| {
                    let options = Options { renderings, background: shown, ..Options::default() };
                    refine(&members, camera, &pyramid, level, &options).map_err(|e| anyhow::anyhow!("{}: {e}", place()))
                };
                errors[0] += found(&camera, 0, 1)?.before;
                for level in (1..=pyramid.smaller()).rev() {
                    camera = found(&camera, level, params.renderings)?.camera;
                }
                let last = found(&camera, 0, params.renderings)?;
                errors[1] += last.after;
                camera = last.camera;
                located += 1;
            }
            cameras.push(camera);
            progress.add(1);
        }
        let summary = summary(&given, &cameras, located, errors);
        let views = cameras.into_iter().map(View::camera_only).collect();
        context.write_json(VIEWS_FILE, &Views { hull: None, ..Views::new(given.background, given.bounds, views) })?;
        context.write_summary(&summary)
    }
}

/// The LR photograph of a view, or the only one there is.
fn read(view: &View, input: &GivenInput) -> Result<Option<Photograph>, PixelError> {
    Ok(match view.read_low_resolution(input)? {
        Some(photograph) => Some(photograph),
        None => view.read_photograph(input)?,
    })
}

/// How far cameras went, and what it was good for.
fn summary(given: &Views, cameras: &[Camera], located: u32, errors: [f64; 2]) -> String {
    let moved = Moved::between(given.views.iter().map(|view| &view.camera).zip(cameras));
    let [before, after] = errors.map(|e| (e / f64::from(located.max(1))).sqrt());
    format!("{located} of {} cameras located: {moved}; error (Huber's) {before:.4} before, {after:.4} after", cameras.len())
}
