//! `prep`: posed images → scene. Makes HR ground truth and, from it, the LR images that training may see.
//!
//! * `sizes`: LR and HR size from `lr_width`, `hr_width`, `scale`.
//! * `degrade`: HR and LR images of one photograph, through Pillow's exact kernels.
//! * `bounds`: where the scene is, from what the cameras see; `hull`: tighter, from alpha, where that is allowed.
//! * `pose_warnings`: poses that can't be right, or hardly.
//!
//! The photographs are read by the crate `dataset`, whatever form their folder has.
//!
//! The scene has six subtrees, so that a stage sees what it may and no more: `train/` (LR images, cameras, bounds), `downscaled/` (the
//! same, shrunk once more: what refinement learns from, since `train/` is its HR truth), `train-cameras/` and `cameras/` (the training
//! and the test cameras at HR size, no images), `truth/` (HR test images, depth), `references/` (HR training images).

mod borders;
mod bounds;
mod degrade;
mod hull;
mod pose_warnings;
mod references;
mod sizes;

use std::path::Path;

use anyhow::Context as _;
use artifact::{Context, Failure, FailureExt as _, Input, Output, Rule, Stage, WARNING, counted, printable, with_warnings};
use dataset::{Dataset, Format, Frame, Split};
use pixels::{Channel, DEGRADATION_FILE, Degradation, Kernel, Mask, Rgba8, SampleType, read_exr, write_exr, write_png};
use rayon::prelude::*;
use scene::{Background, Bounds, Camera, Space, VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;

use borders::{Behind, Border, Borders};
pub use bounds::{SeenDepths, SpaceError, SpaceKind, place};
pub use degrade::{LrImage, degrade};
pub use hull::{GRID, carve};
pub use sizes::{SizeError, Sizes, enlarged, sizes};

/// Parameters of `prep`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the LR images in pixels; the height follows the aspect. Default: the HR width divided by `scale`.
    #[schemars(range(min = 1), extend("x-group" = "output", "x-default" = "by data set"))]
    pub lr_width: Option<u32>,
    /// Width of the HR images in pixels. Default: `lr_width` times `scale`, or the width of the images given.
    #[schemars(range(min = 1), extend("x-group" = "output", "x-default" = "by data set"))]
    pub hr_width: Option<u32>,
    /// HR width over LR width. It needn't be given beside both widths.
    #[schemars(range(min = 1.0, max = 16.0), extend("x-group" = "output", "x-default" = "2"))]
    pub scale: Option<f64>,
    /// Where LR images come from: `photographs` as given, without HR ground truth, or `downscaled` from HR images by `kernel`. Default:
    /// `photographs` for COLMAP and transforms.json without `lr_width`, else `downscaled`.
    #[schemars(extend("x-group" = "data", "x-default" = "by data set"))]
    pub lr_source: Option<LrSource>,
    /// Kernel that makes LR images from HR ones. With `lr_source: photographs`, the kernel that is assumed to have made them. Default: `lanczos`
    /// for downscaled images, `box` for photographs.
    #[schemars(extend("x-group" = "data", "x-default" = "by `lr_source`"))]
    pub kernel: Option<Kernel>,
    /// Treatment of lens distortion, where the data set states it.
    #[schemars(extend("x-group" = "data"))]
    pub lens: LensHandling,
    /// What lies behind the scene. Default: `white` where images have alpha. Without alpha `white` or `black` where the borders of nine in ten
    /// views are that colour, else `opaque`.
    #[schemars(extend("x-group" = "field", "x-default" = "by data set"))]
    pub background: Option<Background>,
    /// Distance along rays before which nothing lies. Default: from the cameras.
    #[schemars(range(min = 0.0), extend("x-group" = "field", "x-default" = "by data set"))]
    pub near: Option<f64>,
    /// Distance along rays behind which nothing lies. Default: from the cameras.
    #[schemars(range(min = 0.0), extend("x-group" = "field", "x-default" = "by data set"))]
    pub far: Option<f64>,
    /// Space that the field keeps in its unit cube. Default: `ndc` where all cameras look one way and the nearest depth is known or the background
    /// is `opaque`, `contraction` where else it is `opaque` or points are known far outside the space that the cameras look at, else `box`.
    #[schemars(extend("x-group" = "field", "x-default" = "by data set"))]
    pub space: Option<SpaceKind>,
    /// `alpha` carves a visual hull from the LR images' alpha. Training is faster, with information that the paper's method doesn't use.
    #[schemars(extend("x-group" = "field"))]
    pub hull: HullSource,
    /// Which views are for training and which for testing. Default: the data set's own split, else `holdout`.
    #[schemars(extend("x-group" = "data", "x-default" = "by data set"))]
    pub split: Option<SplitKind>,
    /// Maximum number of test views, spread evenly.
    #[schemars(range(min = 1), extend("x-group" = "data", "x-default" = "all"))]
    pub test_views: Option<u32>,
    /// Number of training views that are kept at HR, as references. The first view is one; each further one has the camera farthest from those
    /// before.
    #[schemars(extend("x-group" = "data"))]
    pub hr_references: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            lr_width: None,
            hr_width: None,
            scale: None,
            lr_source: None,
            kernel: None,
            lens: LensHandling::Follow,
            background: None,
            near: None,
            far: None,
            space: None,
            hull: HullSource::None,
            split: None,
            test_views: None,
            hr_references: 1,
        }
    }
}

/// What is done about lens distortion, where the data say what it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LensHandling {
    /// Rays follow it: photographs stay as they were taken, to the last pixel, and so do rendered views.
    Follow,
    /// Photographs are resampled to what pinhole cameras would have taken, and lose a border.
    Undo,
    /// Photographs are taken for a pinhole's: the habit with LLFF's scenes, whose files don't speak of lenses. To compare with.
    Ignore,
}

/// Where LR images come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LrSource {
    /// The photographs as they are given; there is no HR truth.
    Photographs,
    /// HR images, made smaller by `kernel`.
    Downscaled,
}

/// Where a visual hull comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum HullSource {
    /// There is none: the box is what the cameras see.
    None,
    /// The LR images' alpha.
    Alpha,
}

/// Ways to part views for training from views for testing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SplitKind {
    /// As the data set itself says.
    Given,
    /// Every eighth view, the first among them, is for testing alone: what a figure needs to be honest.
    Holdout,
    /// All views are for both, references excepted, which aren't tested: the paper's way with photographs.
    Paper,
}

/// One view in so many is held out.
const HOLD_OUT_EVERY: usize = 8;

/// `scene.json`: what `prep` found and chose, for people.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SceneSummary {
    /// Form of the data set.
    pub format: String,
    /// Size of the data's own images.
    pub native: [u32; 2],
    /// Size of the HR images.
    pub hr: [u32; 2],
    /// Size of the LR images.
    pub lr: [u32; 2],
    /// HR over LR, per axis.
    pub scale: [f64; 2],
    /// Whether LR images were made from HR ones.
    pub has_truth: bool,
    /// How LR images were made, or are taken to have been made.
    pub kernel: Kernel,
    /// What lies behind the scene.
    pub background: Background,
    /// Where the scene is.
    pub bounds: Bounds,
    /// Number of training views.
    pub train: usize,
    /// Number of test views.
    pub test: usize,
    /// Whether test views have true depth.
    pub has_depth: bool,
    /// What was found and chosen, a line each.
    pub notes: Vec<String>,
}

/// The stage.
pub struct Prep;

impl Stage for Prep {
    type Params = Params;
    const NAME: &'static str = "prep";
    const SUMMARY: &'static str = "Makes a scene of posed images: LR images to train on, HR ground truth, cameras and bounds.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![("dataset", Input::required(&["dataset"], "posed photographs: Blender's form, transforms.json, LLFF or COLMAP"))]
    }

    fn output() -> Output {
        Output::kind("scene")
            .with_subtree("train", "scene/train")
            .with_subtree("downscaled", "scene/train")
            .with_subtree("train-cameras", "scene/cameras")
            .with_subtree("cameras", "scene/cameras")
            .with_subtree("truth", "scene/truth")
            .with_subtree("references", "scene/references")
    }

    fn rules() -> Vec<Rule> {
        let whole = Rule::new("parameter kernel: average needs a whole scale; choose box, or another scale");
        let boxed = Rule::new("parameter hull: alpha carves a box; choose space: box, too");
        vec![
            whole.when("kernel", json!({"const": "average"})).must("scale", json!({"multipleOf": 1})),
            boxed.when("hull", json!({"const": "alpha"})).must("space", json!({"enum": [null, "box"]})),
        ]
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let mut set = Dataset::read(context.input("dataset")?.folder()).bad_input("dataset")?;
        set = match params.lens {
            LensHandling::Follow => {
                for frame in &set.frames {
                    let ask = "parameter lens: undo keeps what has its ray";
                    frame
                        .camera()
                        .check()
                        .map_err(|e| Failure::BadInput(format!("dataset: {}: {e} ({ask})", frame_name(frame))))?;
                }
                set
            }
            LensHandling::Undo => set.undistorted().bad_input("dataset")?,
            LensHandling::Ignore => set.without_distortion(),
        };
        if matches!(params.split, Some(SplitKind::Holdout | SplitKind::Paper)) {
            set = set.merged();
        }
        let mut split = split(&set, params).map_err(Failure::Usage)?;
        if let Some(most) = params.test_views {
            let (most, all) = (most as usize, split.test.len());
            if most < all {
                split.test = (0..most).map(|i| split.test[i * all / most]).collect();
            }
        }
        let warnings = pose_warnings(&set, &split)?;
        let first = set.frames[split.train[0]].intrinsics();
        let native = (first.width, first.height);
        let making = Making::new(&set, params).map_err(Failure::Usage)?;
        let sizes = if making.has_truth {
            sizes(native, params.lr_width, params.hr_width, params.scale)
        } else {
            enlarged(native, params.hr_width, params.scale)
        };
        let job = Job { context, params, making, sizes: sizes.usage("parameters")?, native };
        let notes: Vec<String> = set.notes.iter().cloned().chain([job.choice(&split)]).chain(warnings).collect();
        notes.iter().for_each(|note| context.say(note));
        if making.kernel == Kernel::Average {
            let mut all = split.train.iter().chain(&split.test).map(|&i| job.sizes_of(&set.frames[i].intrinsics()));
            if let Some(odd) = all.find(|s| !s.is_integer()) {
                let message =
                    format!("parameter kernel: average needs a whole scale, not {:?} → {:?}; choose box", odd.hr, odd.lr);
                return Err(Failure::Usage(message).into());
            }
        }
        let chosen = |numbers: &[usize]| numbers.iter().map(|&i| &set.frames[i]).collect::<Vec<_>>();
        job.run(&set, notes, &chosen(&split.train), &chosen(&split.test))
    }
}

/// Warnings of what looks wrong about poses; such as can't be right are refused.
fn pose_warnings(set: &Dataset, split: &Split) -> anyhow::Result<Vec<String>> {
    let camera = |&i: &usize| set.frames[i].camera();
    let training: Vec<Camera> = split.train.iter().map(camera).collect();
    let test: Vec<Camera> = split.test.iter().filter(|i| !split.train.contains(i)).map(camera).collect();
    pose_warnings::check(&training).map_err(|reason| Failure::BadInput(format!("dataset: {reason}")))?;
    Ok(pose_warnings::warnings(&training, &test).into_iter().map(|text| format!("{WARNING}{text}")).collect())
}

/// Looks at the borders of training views, spread evenly; where the first has alpha, at no other. No more images than threads are
/// held at once.
fn borders(frames: &[&Frame]) -> anyhow::Result<Borders> {
    let look = |frame: &Frame| -> anyhow::Result<Border> { Ok(Border::of(&frame.photograph().bad_input(frame_name(frame))?)) };
    let count = frames.len().min(borders::LOOKED_AT);
    if count > 0 && look(frames[0])? == Border::Transparent {
        return Ok(Borders::new(&[Border::Transparent]));
    }
    let chosen = (0..count).into_par_iter().map(|i| look(frames[i * frames.len() / count]));
    Ok(Borders::new(&chosen.collect::<anyhow::Result<Vec<Border>>>()?))
}

/// Which frames are for what.
fn split(set: &Dataset, params: &Params) -> Result<Split, String> {
    let count = set.frames.len();
    match (params.split, &set.split) {
        (Some(SplitKind::Given) | None, Some(given)) => Ok(given.clone()),
        (Some(SplitKind::Given), None) => {
            Err("parameter split: the data set doesn't say which views are for testing; choose holdout or paper".to_owned())
        }
        (Some(SplitKind::Holdout) | None, _) => Ok(Split::hold_out(count, HOLD_OUT_EVERY)),
        (Some(SplitKind::Paper), _) => {
            let mut split = Split::all(count);
            let most = (params.hr_references as usize).min(count.saturating_sub(1));
            let chosen = references::choose(set.frames.iter().map(|f| f.camera().centre()), most);
            split.test.retain(|i| !chosen.contains(i));
            Ok(split)
        }
    }
}

/// Whether LR images are made, and by which kernel they are, or are taken to have been.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Making {
    has_truth: bool,
    kernel: Kernel,
}

impl Making {
    fn new(set: &Dataset, params: &Params) -> Result<Self, String> {
        let is_benchmark = matches!(set.format, Format::Blender | Format::Llff);
        let has_truth = match params.lr_source {
            Some(source) => source == LrSource::Downscaled,
            None => is_benchmark || params.lr_width.is_some(),
        };
        if !has_truth && params.lr_width.is_some() {
            return Err(
                "parameter lr_width: with lr_source photographs their own width is the LR width; leave lr_width out".to_owned()
            );
        }
        if !has_truth && params.kernel == Some(Kernel::Average) {
            return Err("parameter kernel: average makes LR images and can't be assumed; choose box".to_owned());
        }
        let default = if has_truth { Kernel::Lanczos } else { Kernel::Box };
        Ok(Self { has_truth, kernel: params.kernel.unwrap_or(default) })
    }
}

/// Where in the data set a complaint belongs.
fn frame_name(frame: &Frame) -> String {
    format!("frame {}", frame.name)
}

/// Space and background, in words.
fn space_note(bounds: &Bounds, background: Background) -> String {
    let behind = match background {
        Background::White => "on white",
        Background::Black => "on black",
        Background::Alpha => "the background kept open",
        Background::Opaque => "nothing behind",
    };
    let space = match bounds.space {
        Space::Box => {
            format!("space: a box of {:.3} units, seen from {:.3} to {:.3}", bounds.longest_side(), bounds.near, bounds.far)
        }
        Space::Ndc(f) => format!("space: all cameras look one way, so NDC, from depth {:.3} to {:.3}", f.near, f.far),
        Space::Contraction => {
            format!("space: a ball of {:.3} units, and all around it up to {:.0}, contracted", bounds.longest_side(), bounds.far)
        }
    };
    format!("{space}; {behind}")
}

/// A mask's file, where a frame has one.
fn mask_name(frame: &Frame) -> Option<String> {
    frame.mask.as_ref().map(|_| format!("masks/{}.png", frame.name))
}

/// Everything the steps of one run share.
struct Job<'a> {
    context: &'a Context,
    params: &'a Params,
    making: Making,
    /// Those of the first training view, and its own size.
    sizes: Sizes,
    native: (u32, u32),
}

impl Job<'_> {
    /// What lies behind the scene, and by which sign that is known where it wasn't given.
    fn background(&self, train: &[&Frame]) -> anyhow::Result<(Background, Option<String>)> {
        if let Some(given) = self.params.background {
            return Ok((given, None));
        }
        let borders = borders(train)?;
        let sign = (borders.behind != Behind::Transparent).then(|| borders.to_string());
        Ok((borders.background(), sign))
    }

    fn run(&self, set: &Dataset, mut notes: Vec<String>, train: &[&Frame], test: &[&Frame]) -> anyhow::Result<()> {
        let progress = self.context.progress("preparing", (train.len() + test.len()) as u64);
        let cameras = |frames: &[&Frame]| -> Vec<Camera> { frames.iter().map(|f| f.camera()).collect() };
        let (train_cameras, test_cameras) = (cameras(train), cameras(test));
        // What the user says of all views stands in for what isn't known of each.
        let given =
            self.params.near.zip(self.params.far).map(|(near, far)| [near, far]).filter(|[near, far]| 0.0 < *near && near < far);
        let sights = |cameras: &[Camera], frames: &[&Frame]| -> Vec<_> {
            cameras.iter().cloned().zip(frames.iter().map(|f| f.depths.or(given))).collect()
        };
        let (training, others) = (sights(&train_cameras, train), sights(&test_cameras, test));
        let (background, sign) = self.background(train)?;
        let goes_on = background == Background::Opaque;
        let placed = place(&training, &others, goes_on, self.params.space);
        let mut bounds = placed.map_err(|e| Failure::Usage(e.to_string()))?;
        if self.params.hull == HullSource::Alpha && bounds.space != Space::Box {
            return Err(Failure::Usage("parameter hull: alpha carves a box; choose space: box, too".to_owned()).into());
        }
        for (name, given, bound) in [("near", self.params.near, &mut bounds.near), ("far", self.params.far, &mut bounds.far)] {
            if let Some(value) = given {
                if !value.is_finite() {
                    return Err(Failure::Usage(format!("parameter {name}: {value} is not a distance")).into());
                }
                *bound = value;
            }
        }
        if let (Some(far), Space::Ndc(frustum)) = (self.params.far, &mut bounds.space) {
            frustum.far = frustum.far.min(far);
        }
        if bounds.near >= bounds.far || !bounds.is_valid() {
            let message = format!("parameter near: {} is not before far = {}", bounds.near, bounds.far);
            return Err(Failure::Usage(message).into());
        }
        for note in sign.into_iter().chain([space_note(&bounds, background)]) {
            self.context.say(&note);
            notes.push(note);
        }

        let count = if self.making.has_truth { self.params.hr_references as usize } else { 0 };
        let references = references::choose(train_cameras.iter().map(Camera::centre), count);
        let alphas = train
            .par_iter()
            .enumerate()
            .map(|(i, frame)| {
                self.context.check_interrupt()?;
                let alpha = self.write_training_images(frame, references.contains(&i))?;
                progress.add(1);
                Ok(alpha)
            })
            .collect::<anyhow::Result<Vec<_>>>()?;
        let lr_name = |name: &str| format!("images/{name}.{}", degrade::extension(self.making.kernel));
        let mut views = Views::new(background, bounds, Vec::new());
        views.views = train_cameras
            .iter()
            .zip(train)
            .map(|(c, frame)| View {
                image: Some(lr_name(&c.name)),
                mask: mask_name(frame),
                ..View::camera_only(self.resized(c, |s| s.lr))
            })
            .collect();
        if self.params.hull == HullSource::Alpha {
            let cameras: Vec<Camera> = views.views.iter().map(|v| v.camera.clone()).collect();
            let alphas: Vec<Vec<f32>> = alphas.into_iter().flatten().collect();
            let footprint = degrade::footprint(self.making.kernel);
            bounds = hull::tightened(&bounds, &cameras, &alphas, footprint).bad_input("hull: alpha")?;
            if self.params.near.is_none() && self.params.far.is_none() {
                bounds = bounds::with_range(bounds, &train_cameras);
            }
            views.bounds = bounds;
            let grid = carve(&bounds, &cameras, &alphas, footprint);
            let tensor = safetensors::tensor::TensorView::new(safetensors::Dtype::U8, vec![GRID, GRID, GRID], &grid)?;
            let bytes = safetensors::serialize([("hull", tensor)], None)?;
            let path = self.context.output_path("train/hull.safetensors")?;
            std::fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
            views.hull = Some("hull.safetensors".to_owned());
        }
        self.context.write_json(&format!("train/{VIEWS_FILE}"), &views)?;
        self.write_downscaled_views(&views)?;
        let degradation = Degradation { kernel: self.making.kernel, hr: self.sizes.hr.into() };
        for subtree in ["train", "truth"] {
            self.context.write_json(&format!("{subtree}/{DEGRADATION_FILE}"), &degradation)?;
        }

        let at_hr = |c: &Camera| self.resized(c, |s| s.hr);
        let enlarged = train_cameras.iter().map(|c| View::camera_only(at_hr(c))).collect();
        self.context.write_json(&format!("train-cameras/{VIEWS_FILE}"), &Views::new(background, bounds, enlarged))?;
        let reference_views = references
            .iter()
            .map(|&i| View {
                image: Some(format!("images/{}.png", train[i].name)),
                mask: mask_name(train[i]),
                ..View::camera_only(at_hr(&train_cameras[i]))
            })
            .collect();
        if !references.is_empty() {
            let views = Views::new(background, bounds, reference_views);
            self.context.write_json(&format!("references/{VIEWS_FILE}"), &views)?;
        }

        test.par_iter()
            .map(|frame| {
                self.context.check_interrupt()?;
                let (hr, lr) = self.images(frame)?;
                if let Some(hr) = &hr {
                    self.write_hr("truth", &frame.name, hr)?;
                }
                self.write_lr("truth/low", &frame.name, &lr)?;
                if let Some(mask) = frame.mask().bad_input(frame_name(frame))? {
                    let mask = match &hr {
                        Some(hr) => mask.resized((hr.width, hr.height), 0),
                        None => self.lr_mask(&mask, &lr),
                    };
                    self.write_mask("truth", &frame.name, &mask)?;
                }
                if let (Some(depth), Some(hr)) = (&frame.depth, hr) {
                    self.write_depth(depth, &frame.name, (hr.width, hr.height)).bad_input(frame_name(frame))?;
                }
                progress.add(1);
                Ok(())
            })
            .collect::<anyhow::Result<Vec<()>>>()?;
        let truth: Vec<View> = test_cameras
            .iter()
            .zip(test)
            .map(|(c, frame)| View {
                camera: at_hr(c),
                image: self.making.has_truth.then(|| format!("images/{}.png", c.name)),
                mask: mask_name(frame),
                depth: frame.depth.as_ref().filter(|_| self.making.has_truth).map(|_| format!("depth/{}.exr", c.name)),
                low_resolution: Some(format!("low/{}.{}", c.name, degrade::extension(self.making.kernel))),
            })
            .collect();
        let cameras = truth.iter().map(|v| View::camera_only(v.camera.clone())).collect();
        self.context.write_json(&format!("truth/{VIEWS_FILE}"), &Views::new(background, bounds, truth))?;
        self.context.write_json(&format!("cameras/{VIEWS_FILE}"), &Views::new(background, bounds, cameras))?;
        self.summarise(set, notes, train, test, bounds, background)
    }

    /// Writes all that is made of a frame to train on: LR image, the same one size down, HR reference, and their masks. Returns the LR
    /// image's alpha, where a hull is carved of it: no more images than threads are held at once.
    fn write_training_images(&self, frame: &Frame, is_reference: bool) -> anyhow::Result<Option<Vec<f32>>> {
        let (hr, lr) = self.images(frame)?;
        let name = &frame.name;
        self.write_lr("train/images", name, &lr)?;
        let mask = frame.mask().bad_input(frame_name(frame))?;
        let lr_mask = mask.as_ref().map(|mask| self.lr_mask(mask, &lr));
        lr_mask.iter().try_for_each(|mask| self.write_mask("train", name, mask))?;
        if let Some(hr) = hr.filter(|_| is_reference) {
            self.write_hr("references", name, &hr)?;
            mask.iter().try_for_each(|m| self.write_mask("references", name, &m.resized((hr.width, hr.height), 0)))?;
        }
        let lr_size = self.sizes_of(&frame.intrinsics()).lr;
        let (width, height) = self.one_size_down(lr_size);
        let downscaled = lr.shrunk((width as usize, height as usize), self.making.kernel);
        self.write_lr("downscaled/images", name, &downscaled)?;
        let downscaled_mask = lr_mask.map(|mask| self.lr_mask(&mask, &downscaled));
        downscaled_mask.iter().try_for_each(|mask| self.write_mask("downscaled", name, mask))?;
        Ok((self.params.hull == HullSource::Alpha).then(|| lr.alpha()))
    }

    /// Size of an LR image shrunk as HR images were to make LR ones.
    fn one_size_down(&self, (width, height): (u32, u32)) -> (u32, u32) {
        let Sizes { lr, hr } = self.sizes;
        let shrunk = |length: u32, lr: u32, hr: u32| ((f64::from(length) * f64::from(lr) / f64::from(hr)).round() as u32).max(1);
        (shrunk(width, lr.0, hr.0), shrunk(height, lr.1, hr.1))
    }

    /// Writes the views of the same task one size down, where its solution is known.
    fn write_downscaled_views(&self, train: &Views) -> anyhow::Result<()> {
        let make = |view: &View| {
            let k = &view.camera.intrinsics;
            let (width, height) = self.one_size_down((k.width, k.height));
            View { camera: view.camera.resized(width, height), ..view.clone() }
        };
        let views = train.views.iter().map(make).collect();
        self.context.write_json(&format!("downscaled/{VIEWS_FILE}"), &Views::new(train.background, train.bounds, views))?;
        // LR images that weren't rounded are shrunk by the box: the same, and for any size.
        let kernel = if self.making.kernel == Kernel::Average { Kernel::Box } else { self.making.kernel };
        self.context.write_json(&format!("downscaled/{DEGRADATION_FILE}"), &Degradation { kernel, hr: self.sizes.lr.into() })
    }

    /// LR and HR size of a view: other shapes are shrunk as much as the first view is.
    fn sizes_of(&self, native: &scene::Intrinsics) -> Sizes {
        let of = |length: u32, first: u32, target: u32| {
            ((f64::from(length) * f64::from(target) / f64::from(first)).round() as u32).max(1)
        };
        let size = |target: (u32, u32)| (of(native.width, self.native.0, target.0), of(native.height, self.native.1, target.1));
        Sizes { lr: size(self.sizes.lr), hr: size(self.sizes.hr) }
    }

    fn resized(&self, camera: &Camera, which: impl Fn(Sizes) -> (u32, u32)) -> Camera {
        let (width, height) = which(self.sizes_of(&camera.intrinsics));
        camera.resized(width, height)
    }

    /// The HR image, where there is one, and the LR image.
    fn images(&self, frame: &Frame) -> anyhow::Result<(Option<Rgba8>, LrImage)> {
        let image = frame.photograph().bad_input(frame_name(frame))?;
        if !self.making.has_truth {
            return Ok((None, LrImage::Bytes(image)));
        }
        let (hr, lr) = degrade(&image, &self.sizes_of(&frame.intrinsics()), self.making.kernel);
        Ok((Some(hr), lr))
    }

    /// What was chosen, in a line.
    fn choice(&self, split: &Split) -> String {
        let Sizes { lr, hr } = self.sizes;
        let kernel = format!("{:?}", self.making.kernel).to_lowercase();
        let both = split.train.iter().filter(|i| split.test.contains(i)).count();
        let (train, test) = (counted(split.train.len(), "view"), split.test.len());
        let parts = match both {
            0 => format!("{train} to train on, {} for testing", counted(test, "other")),
            _ => format!("{train} to train on, {test} for testing, {both} of them for both"),
        };
        if self.making.has_truth {
            format!("{parts}; LR images of {}×{} are made from HR ones of {}×{} by {kernel}", lr.0, lr.1, hr.0, hr.1)
        } else {
            format!(
                "{parts}; the photographs are the LR images ({}×{}), as if made by {kernel}; HR is {}×{}",
                lr.0, lr.1, hr.0, hr.1
            )
        }
    }

    fn write_hr(&self, subtree: &str, name: &str, image: &Rgba8) -> anyhow::Result<()> {
        write_png(&self.context.output_path(&format!("{subtree}/images/{name}.png"))?, image).map_err(Into::into)
    }

    fn write_mask(&self, subtree: &str, name: &str, mask: &Mask) -> anyhow::Result<()> {
        write_png(&self.context.output_path(&format!("{subtree}/masks/{name}.png"))?, &mask.to_rgba8()).map_err(Into::into)
    }

    /// The mask of an LR image: what its pixels were made from must count. Photographs that are LR themselves keep theirs.
    fn lr_mask(&self, mask: &Mask, image: &LrImage) -> Mask {
        let size = image.size();
        let around = if size == (mask.width, mask.height) { 0 } else { degrade::mask_reach(self.making.kernel) };
        mask.resized(size, around)
    }

    fn write_lr(&self, folder: &str, name: &str, image: &LrImage) -> anyhow::Result<()> {
        let path = self.context.output_path(&format!("{folder}/{name}.{}", degrade::extension(self.making.kernel)))?;
        match image {
            LrImage::Bytes(image) => write_png(&path, image)?,
            LrImage::Floats(image) => {
                let channels = ["R", "G", "B", "A"].map(|name| Channel { name, sample_type: SampleType::Float });
                write_exr(
                    &path,
                    (image.width, image.height),
                    &channels,
                    "display-encoded sRGB, premultiplied",
                    |first, rows, samples| {
                        samples.copy_from_slice(&image.data[first * image.width * 4..(first + rows) * image.width * 4]);
                        Ok::<(), pixels::PixelError>(())
                    },
                )?;
            }
        }
        Ok(())
    }

    /// True depth at HR size: that of the nearest native pixel centre, since averaging depths across an edge invents surfaces.
    fn write_depth(&self, source: &Path, name: &str, (width, height): (usize, usize)) -> anyhow::Result<()> {
        let native = read_exr(source)?;
        let shown = source.display().to_string();
        let channel = |name: &str| native.channel(name).with_context(|| format!("{}: no channel {name}", printable(&shown)));
        let (depth, opacity) = (channel("Z")?, channel("A")?);
        let nearest = |i: usize, from: usize, to: usize| (2 * i + 1) * from / (2 * to);
        let path = self.context.output_path(&format!("truth/depth/{name}.exr"))?;
        let channels =
            [Channel { name: "A", sample_type: SampleType::Half }, Channel { name: "Z", sample_type: SampleType::Float }];
        write_exr(
            &path,
            (width, height),
            &channels,
            "Z: z-depth of the nearest native pixel centre; A: 0 where nothing is seen",
            |first, _, samples| {
                for (i, sample) in samples.chunks_exact_mut(2).enumerate() {
                    let (x, y) = (nearest(i % width, native.width, width), nearest(first + i / width, native.height, height));
                    let at = y * native.width + x;
                    sample.copy_from_slice(&[opacity[at], depth[at]]);
                }
                Ok(())
            },
        )
    }

    fn summarise(
        &self,
        set: &Dataset,
        notes: Vec<String>,
        train: &[&Frame],
        test: &[&Frame],
        bounds: Bounds,
        background: Background,
    ) -> anyhow::Result<()> {
        let Sizes { lr, hr } = self.sizes;
        let scale = [f64::from(hr.0) / f64::from(lr.0), f64::from(hr.1) / f64::from(lr.1)];
        let warnings: Vec<String> = notes.iter().filter_map(|n| n.strip_prefix(WARNING)).map(str::to_owned).collect();
        self.context.write_json(
            "scene.json",
            &SceneSummary {
                format: set.format.to_string(),
                native: self.native.into(),
                hr: hr.into(),
                lr: lr.into(),
                scale,
                has_truth: self.making.has_truth,
                kernel: self.making.kernel,
                background,
                bounds,
                train: train.len(),
                test: test.len(),
                has_depth: self.making.has_truth && test.iter().any(|f| f.depth.is_some()),
                notes,
            },
        )?;
        let summary = format!(
            "{} at {}×{} from {}×{} ({:?}), {}; rays from {:.2} to {:.2}",
            counted(train.len(), "training view"),
            lr.0,
            lr.1,
            hr.0,
            hr.1,
            self.making.kernel,
            counted(test.len(), "test view"),
            bounds.near,
            bounds.far
        );
        self.context.write_summary(&with_warnings(&summary, &warnings))
    }
}
