//! `upsample`: enlarges views to the size of HR cameras by a method that looks at each image alone:
//! the baselines of the paper's tables, and the training photographs at HR size, which `refine`
//! takes the mean with.
//!
//! * `bicubic`: Pillow's, on 8 bits, to the last bit.
//! * `imdn`, `swinir`: networks for one scale, which their weights say; the views must be that much
//!   smaller.
//! * `liif`: a network for any scale.
//!
//! Weights are safetensors files with the tensors' published names (`scripts/convert-weights.py`
//! makes them from released checkpoints); every tensor's shape is checked. Images are composited on
//! their background, enlarged as display-encoded sRGB, and are opaque afterwards: there is no depth
//! to them. What doesn't count of a photograph, by its mask, doesn't when it is enlarged.
//!
//! Convolutions and attention go through libtorch, a view in one thread, so bytes don't depend on
//! how many there are.

#[cfg(test)]
mod goldens;
mod imdn;
mod layers;
mod liif;
mod network;
mod swinir;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput};
use contract::{Input, Output, Rule};
use nets::Weights;
use pixels::{Filter, Image, Mask, resize_pillow, write_png};
use rayon::prelude::*;
use scene::{
    Camera, Photograph, VIEW_CHANNELS, VIEWS_FILE, View, Views, image_file, mask_file,
    preview_file, write_view_image,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;
use stage::{Context, Stage};
use tch::no_grad;

use network::Network;

/// Parameters of `upsample`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Method that enlarges views.
    pub method: Method,
    /// The network's file in input `weights`. Default: `imdn_xS.safetensors` or
    /// `swinir_xS.safetensors` for scale S, or `liif.safetensors`.
    #[schemars(extend("x-default" = "by method"))]
    pub file: Option<String>,
}

/// Ways to enlarge an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Pillow's bicubic filter, on 8 bits.
    #[default]
    Bicubic,
    /// IMDN, a light convolutional network (Hui et al. 2019).
    Imdn,
    /// LIIF, a local implicit image function behind EDSR's baseline encoder, for any scale (Chen et
    /// al. 2021).
    Liif,
    /// SwinIR, a transformer (Liang et al. 2021).
    Swinir,
}

/// Where a network's file comes from.
const MAKE_WEIGHTS: &str = "scripts/convert-weights.py makes it from the published checkpoint";

/// The stage.
pub struct Upsample;

impl Stage for Upsample {
    type Params = Params;
    const NAME: &'static str = "upsample";
    const SUMMARY: &'static str = "Enlarges views by a 2-D method, as a baseline.";

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras = ["scene/cameras", "scene/truth", "cameras"];
        vec![
            (
                "views",
                Input::required(&["views", "scene/train"], "rendered views, or photographs, at LR"),
            ),
            (
                "cameras",
                Input::required(&cameras, "their cameras, at HR: how large the views become"),
            ),
            (
                "weights",
                Input::optional(&["weights"], "folder with the network's safetensors file"),
            ),
        ]
    }

    fn output() -> Output {
        Output::kind("views")
    }

    fn rules() -> Vec<Rule> {
        let message = format!(
            "input weights is missing: methods imdn, liif and swinir need a folder with their \
            network's safetensors file; {MAKE_WEIGHTS}"
        );
        vec![
            Rule::new(&message)
                .when("method", json!({"enum": ["imdn", "liif", "swinir"]}))
                .needs("weights"),
        ]
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        let input = context.input("views")?;
        let (views, cameras) = (Views::read(input)?, Views::read(context.input("cameras")?)?);
        let pairs = views
            .views
            .iter()
            .map(|view| pair(view, &cameras))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let networks = networks(context, params, &pairs)?;
        let progress = context.progress("enlarging", pairs.len() as u64);
        let lanes = networks.len();
        let work =
            networks.into_par_iter().enumerate().map(|(lane, network)| -> anyhow::Result<()> {
                for (view, camera) in pairs.iter().skip(lane).step_by(lanes) {
                    context.check_interrupt()?;
                    let place = || format!("view {}", camera.name);
                    let photograph = view
                        .read_photograph(input)
                        .bad_input(place())?
                        .with_context(|| format!("{}: it has no image", place()));
                    let Photograph { image: lr, mask } =
                        photograph.bad_input("input views")?.over(views.background.shown());
                    let hr = enlarge(network.as_deref(), &lr, camera).with_context(place)?;
                    write(
                        context,
                        &camera.name,
                        &hr,
                        mask.map(|mask| mask.resized((hr.width, hr.height), 0)),
                    )?;
                    progress.add(1);
                }
                Ok(())
            });
        work.collect::<anyhow::Result<Vec<_>>>()?;
        let hr = pairs.iter().map(|(view, camera)| {
            let image = Some(image_file(&camera.name));
            View {
                image,
                mask: view.mask.as_ref().map(|_| mask_file(&camera.name)),
                ..View::camera_only((*camera).clone())
            }
        });
        let hr = Views::new(views.background, views.bounds, hr.collect());
        context.write_json(VIEWS_FILE, &hr)?;
        let name = format!("{:?}", params.method).to_lowercase();
        context.write_summary(&format!("{}, by {name}", artifact::counted(hr.views.len(), "view")))
    }
}

/// How a network is made of its weights.
type Read = fn(&Weights) -> Result<Box<dyn Network>, nets::WeightsError>;

/// A view and its HR camera.
fn pair<'a>(view: &'a View, cameras: &'a Views) -> anyhow::Result<(&'a View, &'a Camera)> {
    let Some(hr) = cameras.taken_by(&view.camera) else {
        let name = &view.camera.name;
        let missing = format!("input cameras: no camera {name} with that view's pose");
        return Err(Failure::BadInput(missing).into());
    };
    Ok((view, &hr.camera))
}

/// A network for each thread, none for what needs none.
fn networks(
    context: &Context,
    params: &Params,
    pairs: &[(&View, &Camera)],
) -> anyhow::Result<Vec<Option<Box<dyn Network>>>> {
    let widths =
        pairs.first().map(|(view, camera)| (view.camera.intrinsics.width, camera.intrinsics.width));
    let (lr, hr) = widths.unwrap_or((1, 1));
    let scale = (f64::from(hr) / f64::from(lr)).round();
    let (default, read): (String, Read) = match params.method {
        Method::Bicubic => return Ok((0..context.threads).map(|_| None).collect()),
        Method::Imdn => (format!("imdn_x{scale}.safetensors"), |weights| {
            Ok(Box::new(imdn::Imdn::read(weights)?))
        }),
        Method::Swinir => (format!("swinir_x{scale}.safetensors"), |weights| {
            Ok(Box::new(swinir::SwinIr::read(weights)?))
        }),
        Method::Liif => {
            ("liif.safetensors".to_owned(), |weights| Ok(Box::new(liif::Liif::read(weights)?)))
        }
    };
    let file = params.file.as_ref().unwrap_or(&default);
    let weights = open(context.input("weights")?, file)?;
    let networks =
        (0..context.threads).map(|_| read(&weights).map(Some)).collect::<Result<Vec<_>, _>>();
    let networks = networks.bad_input("input weights")?;
    let scale = networks.first().and_then(|n| n.as_ref()?.scale());
    for (view, camera) in pairs {
        let [lr, hr] = [&view.camera, *camera]
            .map(|c| [i64::from(c.intrinsics.width), i64::from(c.intrinsics.height)]);
        fit(scale, lr, hr)
            .map_err(|e| Failure::BadInput(format!("view {}: {file} {e}", camera.name)))?;
    }
    Ok(networks)
}

/// Sizes that a network can't make of each other.
#[derive(Debug, thiserror::Error)]
#[error(
    "enlarges {by} times, which doesn't make {}×{} of {}×{}; take views of another size, or \
    bicubic or liif",
    hr[0], hr[1], lr[0], lr[1]
)]
struct WrongScale {
    /// The network's scale.
    by: i64,
    lr: [i64; 2],
    hr: [i64; 2],
}

/// Whether a network of that scale makes the HR size of the LR one; what is wrong otherwise.
fn fit(scale: Option<i64>, lr: [i64; 2], hr: [i64; 2]) -> Result<(), WrongScale> {
    match scale.filter(|by| lr.map(|size| size * by) != hr) {
        None => Ok(()),
        Some(by) => Err(WrongScale { by, lr, hr }),
    }
}

/// The network's tensors, from a file of that name in the input.
fn open(input: &GivenInput, file: &str) -> Result<Weights, Failure> {
    if std::path::Path::new(file).file_name().is_none_or(|name| name != file) {
        return Err(Failure::Usage(format!(
            "file: {file:?} is no name of a file in input weights"
        )));
    }
    let path = input.path(file);
    if !path.is_file() {
        return Err(Failure::BadInput(format!(
            "input weights: no file {file} in it; {MAKE_WEIGHTS}"
        )));
    }
    Weights::read(&path).bad_input("input weights")
}

/// An image at the size of a camera.
fn enlarge(network: Option<&dyn Network>, lr: &Image, camera: &Camera) -> anyhow::Result<Image> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let Some(network) = network else {
        let hr = resize_pillow(&lr.to_rgba8(), width as usize, height as usize, Filter::Bicubic);
        return Ok(Image::premultiplied(&hr).over(0.0));
    };
    let size = [i64::from(height), i64::from(width)];
    let hr = no_grad(|| network.enlarge(&nets::tensor_of(lr)?, size))?.f_clamp(0.0, 1.0)?;
    Ok(nets::image_of(&hr)?)
}

/// A view's files: opaque colours, a preview, and what counts of them.
fn write(context: &Context, name: &str, hr: &Image, mask: Option<Mask>) -> anyhow::Result<()> {
    if let Some(mask) = mask {
        write_png(&context.output_path(&mask_file(name))?, &mask.to_rgba8())?;
    }
    let channels = &VIEW_CHANNELS[..4];
    let path = context.output_path(&image_file(name))?;
    write_view_image(&path, (hr.width, hr.height), channels, |first, rows, samples| {
        let pixels = hr.data[first * hr.width * 3..(first + rows) * hr.width * 3].chunks_exact(3);
        for (sample, pixel) in samples.chunks_exact_mut(4).zip(pixels) {
            sample[..3].copy_from_slice(pixel);
            sample[3] = 1.0;
        }
        anyhow::Ok(())
    })?;
    Ok(write_png(&context.output_path(&preview_file(name))?, &hr.to_rgba8())?)
}
