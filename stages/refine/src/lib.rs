//! `refine`: gives rendered views the detail they systematically lack, by a network that `train-refine` trained.
//!
//! Colours change; opacity, depth and cameras stay what the field made them.

use artifact::{Context, Failure, FailureExt as _, GivenInput, Input, Output, Stage};
use pixels::{Channel, ExrImage, Picture, PixelError, Rgba8, SampleType, read_exr, to_u8, write_exr, write_png};
use refinement::{REFINER_FILE, Refiner, RefinerFile, WEIGHTS_FILE, view_over};
use scene::{VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `refine`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Share of what the network predicts that is added. Without it: what was best for the views that its training left out.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub strength: Option<f64>,
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
        ]
    }

    fn output() -> Output {
        Output::kind("views")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        let refiner = context.input("refiner")?;
        let file: RefinerFile = refiner.read_json(REFINER_FILE)?;
        let network = Refiner::read(&refiner.path(WEIGHTS_FILE), file.architecture).bad_input("input refiner")?;
        let strength = params.strength.unwrap_or(file.strength) as f32;
        let input = context.input("views")?;
        let mut views = Views::read(input)?;
        let background = views.background.shown();
        let progress = context.progress("refining", views.views.len() as u64);
        for view in &mut views.views {
            context.check_interrupt()?;
            refine(
                context,
                input,
                view,
                |picture| Ok(network.refine_by(&view_over(picture, background), strength)?),
                background,
            )?;
            progress.add(1);
        }
        context.write_json(VIEWS_FILE, &views)?;
        context.write_summary(&format!("{} views, with {strength:.2} of what the network adds", views.views.len()))
    }
}

/// Channels of a view, and their precision: those that `render-depth` writes.
const CHANNELS: [(&str, SampleType); 6] = [
    ("R", SampleType::Half),
    ("G", SampleType::Half),
    ("B", SampleType::Half),
    ("A", SampleType::Half),
    ("Z", SampleType::Float),
    ("distance", SampleType::Float),
];

/// Refines one view: its files are written, and named in it.
fn refine(
    context: &Context,
    input: &GivenInput,
    view: &mut View,
    network: impl Fn(&Picture) -> anyhow::Result<Picture>,
    background: f32,
) -> anyhow::Result<()> {
    let name = view.camera.name.clone();
    let place = || format!("view {name}");
    let file = view.image.as_ref().ok_or_else(|| Failure::BadInput(format!("input views: view {name} has no picture")))?;
    let image = read_exr(&input.path(file)).bad_input(place())?;
    let [Some(r), Some(g), Some(b), Some(a)] = ["R", "G", "B", "A"].map(|c| image.channel(c)) else {
        return Err(Failure::BadInput(format!("input views: view {name}: channels R, G, B and A are expected")).into());
    };
    let premultiplied = (0..r.len()).flat_map(|i| [r[i], g[i], b[i], a[i]]).collect();
    let refined = network(&Picture::new(image.width, image.height, 4, premultiplied))?;
    let path = format!("images/{name}.exr");
    write_view(&context.output_path(&path)?, &image, &refined, a, background)?;
    let preview = refined.data.chunks_exact(3).flat_map(|p| [to_u8(p[0]), to_u8(p[1]), to_u8(p[2]), 255]).collect();
    let preview = Rgba8::new(image.width, image.height, preview);
    write_png(&context.output_path(&format!("previews/{name}.png"))?, &preview)?;
    view.image = Some(path.clone());
    view.depth = view.depth.as_ref().map(|_| path);
    Ok(())
}

/// A view's file with other colours.
fn write_view(
    path: &std::path::Path,
    image: &ExrImage,
    refined: &Picture,
    opacity: &[f32],
    background: f32,
) -> anyhow::Result<()> {
    let kept: Vec<(Channel, Option<&[f32]>)> = CHANNELS
        .into_iter()
        .enumerate()
        .filter_map(|(i, (name, sample_type))| {
            let samples = image.channel(name);
            samples.map(|s| (Channel { name, sample_type }, (i >= 3).then_some(s)))
        })
        .collect();
    let channels: Vec<Channel> = kept.iter().map(|(c, _)| *c).collect();
    let note = "display-encoded sRGB, premultiplied; Z: camera-space z-depth in scene units";
    let written = write_exr(path, (image.width, image.height), &channels, note, |first, rows, samples| {
        let pixels = first * image.width..(first + rows) * image.width;
        for (i, sample) in pixels.zip(samples.chunks_exact_mut(kept.len())) {
            for (c, (value, (_, same))) in sample.iter_mut().zip(&kept).enumerate() {
                *value = same.map_or_else(|| refined.data[i * 3 + c] - (1.0 - opacity[i]) * background, |s| s[i]);
            }
        }
        Ok::<(), PixelError>(())
    });
    written.map_err(|error| match error {
        PixelError::NotFinite { .. } => Failure::Numerical(error.to_string()).into(),
        error => error.into(),
    })
}
