//! `upsample`: enlarges views to the size of HR cameras with a 2-D method: the baselines of the
//! paper's tables, and the photographs at HR that `refine` averages with refined views.
//!
//! * `bicubic`: Pillow's filter on 8 bits, bit-exact.
//! * `imdn`, `swinir`: networks with a fixed scale, which is read from their weights.
//! * `liif`: a network for any scale.
//!
//! Weights are safetensors files with the tensors' published names, converted from released
//! checkpoints by `scripts/convert-weights.py`; every tensor's shape is checked. Images are
//! composited on their background and enlarged as display-encoded sRGB. The enlarged views are
//! opaque and have no depth. A photograph's mask is enlarged with it.
//!
//! Each view runs through libtorch in one thread, so bytes don't depend on the number of threads.

#[cfg(test)]
mod goldens;
mod imdn;
mod liif;
mod network;
mod swinir;

use anyhow::Context as _;
use artifact::{Failure, FailureExt as _, GivenInput, bail_bad_input, bail_usage};
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
use stage::{Context, Input, Output, Rule, Stage};
use tch::no_grad;

use network::Network;

/// Parameters of `upsample`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Method that enlarges views.
    pub method: Method,
    /// Name of the network's file in input `weights`. Default: `imdn_xS.safetensors` or
    /// `swinir_xS.safetensors` for scale S, or `liif.safetensors`.
    #[schemars(extend("x-default" = "by method"))]
    pub file: Option<String>,
}

/// Method that enlarges an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Pillow's bicubic filter, on 8 bits.
    #[default]
    Bicubic,
    /// IMDN, a light convolutional network (Hui et al. 2019).
    Imdn,
    /// LIIF, a local implicit image function with EDSR's baseline encoder, for any scale (Chen et
    /// al. 2021).
    Liif,
    /// SwinIR, a transformer (Liang et al. 2021).
    Swinir,
}

/// Remedy for missing weights, as a sentence fragment.
const REMEDY: &str = "convert the published checkpoint with scripts/convert-weights.py";

/// The stage.
pub struct Upsample;

impl Stage for Upsample {
    type Params = Params;
    const NAME: &'static str = "upsample";
    const SUMMARY: &'static str = "Enlarges views by a 2-D method, as a baseline.";
    const LIBTORCH: bool = true;

    fn inputs() -> Vec<(&'static str, Input)> {
        let cameras = ["scene/cameras", "scene/truth", "cameras"];
        vec![
            (
                "views",
                Input::required(&["views", "scene/train"], "rendered views or photographs at LR"),
            ),
            (
                "cameras",
                Input::required(
                    &cameras,
                    "the views' cameras at HR, which set the size of the output",
                ),
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
            network's safetensors file; {REMEDY}"
        );
        let needs_weights = Rule::new(&message)
            .when("method", json!({"enum": ["imdn", "liif", "swinir"]}))
            .needs("weights");
        let named = missing_file_rule("{file}").when("file", json!({"type": "string"}));
        let liif = missing_file_rule("liif.safetensors")
            .when("method", json!({"const": "liif"}))
            .when("file", json!({"type": "null"}));
        let mut rules = vec![needs_weights, named, liif];
        rules.extend(scale_rules("imdn", &[2, 3, 4]));
        rules.extend(scale_rules("swinir", &[2, 3, 4, 8]));
        rules
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        nets::deterministic();
        let input = context.input("views")?;
        let views = Views::read(input)?;
        let cameras = Views::read(context.input("cameras")?)?;
        let pairs = views
            .views
            .iter()
            .map(|view| Ok((view, hr_camera(view, &cameras)?)))
            .collect::<Result<Vec<_>, Failure>>()?;
        let networks = read_networks(context, params, &pairs)?;
        let progress = context.progress("enlarging", pairs.len() as u64);
        let threads = networks.len();
        let work =
            networks.into_par_iter().enumerate().map(|(thread, network)| -> anyhow::Result<()> {
                for (view, camera) in pairs.iter().skip(thread).step_by(threads) {
                    context.check_interrupt()?;
                    let name = format!("view {}", camera.name);
                    let photograph = view
                        .read_photograph(input)
                        .bad_input(name.clone())?
                        .with_context(|| format!("{name} has no image"));
                    let Photograph { image: lr, mask } =
                        photograph.bad_input("input views")?.over(views.background.grey_level());
                    let hr = enlarge(network.as_deref(), &lr, camera).context(name)?;
                    let mask = mask.map(|mask| mask.resized((hr.width, hr.height), 0));
                    write_view(context, &camera.name, &hr, mask)?;
                    progress.add(1);
                }
                Ok(())
            });
        work.collect::<anyhow::Result<Vec<_>>>()?;
        let hr = pairs.iter().map(|(view, camera)| View {
            image: Some(image_file(&camera.name)),
            mask: view.mask.as_ref().map(|_| mask_file(&camera.name)),
            ..View::camera_only((*camera).clone())
        });
        let hr = Views::new(views.background, views.bounds, hr.collect());
        context.write_json(VIEWS_FILE, &hr)?;
        let name = format!("{:?}", params.method).to_lowercase();
        context.write_summary(&format!(
            "{}, by {name}",
            artifact::format_count(hr.views.len(), "view")
        ))
    }
}

/// Returns the rule that the folder of weights must contain a file.
fn missing_file_rule(file: &str) -> Rule {
    Rule::new(&format!("no file {file}; {REMEDY}")).or_files("weights", &[file])
}

/// Returns rules for a method whose networks have one scale each: `scales` are those of the
/// published networks.
fn scale_rules(method: &str, scales: &[u32]) -> Vec<Rule> {
    let words: Vec<String> = scales.iter().map(u32::to_string).collect();
    let message = format!(
        "parameter method: {method} has networks for scales {} only; choose one of these scales, \
        or method bicubic or liif",
        words.join(", ")
    );
    let of_method = |rule: Rule| {
        rule.when("method", json!({"const": method})).when("file", json!({"type": "null"}))
    };
    let mut rules = vec![
        of_method(Rule::new(&message))
            .must("cameras.scale", json!({"anyOf": [{"type": "null"}, {"enum": scales}]})),
    ];
    for scale in scales {
        let rule = missing_file_rule(&format!("{method}_x{scale}.safetensors"));
        rules.push(of_method(rule).when("cameras.scale", json!({"const": scale})));
    }
    rules
}

/// Constructor of a network from its weights.
type NetworkReader = fn(&Weights) -> Result<Box<dyn Network>, nets::WeightsError>;

/// Finds a view's HR camera.
fn hr_camera<'a>(view: &View, cameras: &'a Views) -> Result<&'a Camera, Failure> {
    cameras.taken_by(&view.camera).map(|hr| &hr.camera).ok_or_else(|| {
        let name = &view.camera.name;
        Failure::BadInput(format!("input cameras: no camera {name} with the view's pose"))
    })
}

/// Reads the method's network once for each thread; one `None` for each thread with `bicubic`.
fn read_networks(
    context: &Context,
    params: &Params,
    pairs: &[(&View, &Camera)],
) -> anyhow::Result<Vec<Option<Box<dyn Network>>>> {
    let scale = pairs.first().map_or(1.0, |(view, camera)| {
        f64::from(camera.intrinsics.width) / f64::from(view.camera.intrinsics.width)
    });
    let nearest = scale.round();
    let (default, read): (String, NetworkReader) = match params.method {
        Method::Bicubic => return Ok((0..context.threads).map(|_| None).collect()),
        Method::Imdn => (format!("imdn_x{nearest}.safetensors"), |weights| {
            Ok(Box::new(imdn::Imdn::read(weights)?))
        }),
        Method::Swinir => (format!("swinir_x{nearest}.safetensors"), |weights| {
            Ok(Box::new(swinir::SwinIr::read(weights)?))
        }),
        Method::Liif => {
            ("liif.safetensors".to_owned(), |weights| Ok(Box::new(liif::Liif::read(weights)?)))
        }
    };
    let file = params.file.as_ref().unwrap_or(&default);
    let weights = read_weights(context.input("weights")?, file)?;
    let networks =
        (0..context.threads).map(|_| read(&weights).map(Some)).collect::<Result<Vec<_>, _>>();
    let networks = networks.bad_input("input weights")?;
    let network_scale = networks.first().and_then(|n| n.as_ref()?.scale());
    for (view, camera) in pairs {
        let [lr, hr] = [&view.camera, *camera]
            .map(|c| [i64::from(c.intrinsics.width), i64::from(c.intrinsics.height)]);
        check_scale(network_scale, lr, hr)
            .map_err(|e| Failure::BadInput(format!("view {}: {file} {e}", camera.name)))?;
    }
    Ok(networks)
}

/// Fails if a network's scale, if it has one, doesn't map the LR size to the HR size.
fn check_scale(scale: Option<i64>, lr: [i64; 2], hr: [i64; 2]) -> anyhow::Result<()> {
    let Some(scale) = scale.filter(|scale| lr.map(|size| size * scale) != hr) else {
        return Ok(());
    };
    anyhow::bail!(
        "enlarges {scale} times, but the camera has {}×{} pixels and the view {}×{}; use views of \
        another size, or method bicubic or liif",
        hr[0],
        hr[1],
        lr[0],
        lr[1]
    )
}

/// Reads the network's tensors from a file of this name in the input.
fn read_weights(input: &GivenInput, file: &str) -> Result<Weights, Failure> {
    if std::path::Path::new(file).file_name().is_none_or(|name| name != file) {
        bail_usage!("parameter file: {file:?} is not the name of a file in input weights");
    }
    let path = input.path(file);
    if !path.is_file() {
        bail_bad_input!("input weights: no file {file}; {REMEDY}");
    }
    Weights::read(&path).bad_input("input weights")
}

/// Enlarges an image to the size of a camera, with a network or else Pillow's bicubic filter.
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

/// Writes a view's files: opaque colours, preview and mask.
fn write_view(context: &Context, name: &str, hr: &Image, mask: Option<Mask>) -> anyhow::Result<()> {
    if let Some(mask) = mask {
        write_png(&context.output_path(&mask_file(name))?, &mask.to_rgba8())?;
    }
    let channels = &VIEW_CHANNELS[..4];
    let path = context.output_path(&image_file(name))?;
    write_view_image(&path, (hr.width, hr.height), channels, |first, rows, samples| {
        let pixels = &hr.data[first * hr.width * 3..(first + rows) * hr.width * 3];
        for (i, sample) in samples.chunks_exact_mut(4).enumerate() {
            sample[..3].copy_from_slice(&pixels[3 * i..3 * i + 3]);
            sample[3] = 1.0;
        }
        anyhow::Ok(())
    })?;
    Ok(write_png(&context.output_path(&preview_file(name))?, &hr.to_rgba8())?)
}
