//! `prep`: posed images → scene. Makes HR ground truth and, from it, the LR images that training may see.
//!
//! * `blender`: reads `transforms_{train,test}.json` and what they name.
//! * `sizes`: LR and HR size from `lr`, `hr`, `scale`.
//! * `degrade`: HR and LR pictures of one photograph, through Pillow's exact kernels.
//! * `bounds`: where the scene is, from what the cameras see; `hull`: tighter, from alpha, where that is allowed.
//!
//! The scene has four subtrees, so that a stage sees what it may and no more: `train/` (LR images, cameras, bounds), `cameras/`
//! (the test cameras at HR size, no pictures), `truth/` (HR test images, depth), `references/` (HR training images).

mod blender;
mod bounds;
mod degrade;
mod hull;
mod sizes;

use std::path::Path;

use anyhow::Context as _;
use artifact::{Context, Failure, FailureExt as _, Input, Output, Stage};
use pixels::{Channel, DEGRADATION_FILE, Degradation, Kernel, Rgba8, SampleType, read_exr, read_png, write_exr, write_png};
use rayon::prelude::*;
use scene::{Background, Bounds, Camera, Intrinsics, VIEWS_FILE, View, Views};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use blender::{Dataset, DatasetError, Frame};
pub use bounds::bounds_of;
pub use degrade::{LowResolution, degrade};
pub use hull::{GRID, carve};
pub use sizes::{SizeError, Sizes, sizes};

/// Parameters of `prep`.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Params {
    /// Width of the LR images, in pixels; the height follows the aspect. Without it: the HR width divided by `scale`.
    #[schemars(range(min = 1))]
    pub lr: Option<u32>,
    /// Width of the HR images; without it: `lr` times `scale`, or the data's own width.
    #[schemars(range(min = 1))]
    pub hr: Option<u32>,
    /// HR width over LR width; not needed where `lr` and `hr` are given. Without any of them: 2.
    #[schemars(range(min = 1.0, max = 16.0))]
    pub scale: Option<f64>,
    /// How LR images are made from HR ones.
    pub kernel: Kernel,
    /// What lies behind the scene; `alpha` keeps it open.
    pub background: Background,
    /// Distance along rays before which there is nothing; without it: from the cameras.
    #[schemars(range(min = 0.0))]
    pub near: Option<f64>,
    /// Distance along rays behind which there is nothing; without it: from the cameras.
    #[schemars(range(min = 0.0))]
    pub far: Option<f64>,
    /// `alpha` carves a visual hull from the LR images' alpha: faster training, but information the paper's method doesn't see.
    pub hull: HullSource,
    /// At most so many test views, spread evenly; without it: all.
    #[schemars(range(min = 1))]
    pub test_views: Option<u32>,
    /// The first so many training views are kept at HR, as references for refinement.
    pub references: u32,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            lr: None,
            hr: None,
            scale: None,
            kernel: Kernel::Lanczos,
            background: Background::White,
            near: None,
            far: None,
            hull: HullSource::None,
            test_views: None,
            references: 1,
        }
    }
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
    /// How LR images were made.
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
}

/// The stage.
pub struct Prep;

impl Stage for Prep {
    type Params = Params;
    const NAME: &'static str = "prep";
    const SUMMARY: &'static str = "Makes a scene of posed images: LR images to train on, HR ground truth, cameras and bounds.";

    fn inputs() -> Vec<(&'static str, Input)> {
        vec![(
            "dataset",
            Input::required(&["dataset"], "folder with transforms_train.json and transforms_test.json (Blender format)"),
        )]
    }

    fn output() -> Output {
        Output::kind("scene")
            .with_subtree("train", "scene/train")
            .with_subtree("cameras", "scene/cameras")
            .with_subtree("truth", "scene/truth")
            .with_subtree("references", "scene/references")
    }

    fn run(context: &Context, params: &Params) -> anyhow::Result<()> {
        let folder = context.input("dataset")?.folder();
        let train = Dataset::read(folder, "train").bad_input("dataset")?;
        let mut test = Dataset::read(folder, "test").bad_input("dataset")?;
        if let Some(most) = params.test_views {
            let (most, all) = (most as usize, test.frames.len());
            if most < all {
                test.frames = (0..most).map(|i| test.frames[i * all / most].clone()).collect();
            }
        }
        let first = read_png(&train.frames[0].image).bad_input(frame_place("train", 0, &train.frames[0]))?;
        let native = (first.width as u32, first.height as u32);
        let sizes = sizes(native, params.lr, params.hr, params.scale).usage("parameters")?;
        if params.kernel == Kernel::Avg && !sizes.is_integer() {
            let message = format!("parameter kernel: avg needs a whole scale, not {:?} → {:?}; choose box", sizes.hr, sizes.lr);
            return Err(Failure::Usage(message).into());
        }
        Job { context, params, sizes, native }.run(&train, &test)
    }
}

fn frame_place(split: &str, index: usize, frame: &Frame) -> String {
    format!("transforms_{split}.json: frame {index} ({})", frame.name)
}

/// Everything the steps of one run share.
struct Job<'a> {
    context: &'a Context,
    params: &'a Params,
    sizes: Sizes,
    native: (u32, u32),
}

impl Job<'_> {
    fn run(&self, train: &Dataset, test: &Dataset) -> anyhow::Result<()> {
        let progress = self.context.progress("preparing", (train.frames.len() + test.frames.len()) as u64);
        let train_cameras = self.cameras(train, self.native);
        let mut bounds = bounds_of(&train_cameras);
        for (name, given, bound) in [("near", self.params.near, &mut bounds.near), ("far", self.params.far, &mut bounds.far)] {
            if let Some(value) = given {
                if !value.is_finite() {
                    return Err(Failure::Usage(format!("parameter {name}: {value} is not a distance")).into());
                }
                *bound = value;
            }
        }
        if bounds.near >= bounds.far {
            let message = format!("parameter near: {} is not before far = {}", bounds.near, bounds.far);
            return Err(Failure::Usage(message).into());
        }

        let references = (self.params.references as usize).min(train.frames.len());
        let train_pictures = (0..train.frames.len())
            .into_par_iter()
            .map(|i| -> anyhow::Result<LowResolution> {
                self.context.check_interrupt()?;
                let (hr, lr) = self.pictures("train", i, &train.frames[i])?;
                self.write_low("train/images", &train.frames[i].name, &lr)?;
                if i < references {
                    self.write_high("references", &train.frames[i].name, &hr)?;
                }
                progress.add(1);
                Ok(lr)
            })
            .collect::<anyhow::Result<Vec<_>>>()?;
        let low_name = |name: &str| format!("images/{name}.{}", degrade::extension(self.params.kernel));
        let mut views = Views::new(self.params.background, bounds, Vec::new());
        views.views = train_cameras
            .iter()
            .map(|c| {
                let camera = c.resized(self.sizes.lr.0, self.sizes.lr.1);
                View { image: Some(low_name(&c.name)), ..View::camera_only(camera) }
            })
            .collect();
        if self.params.hull == HullSource::Alpha {
            let cameras: Vec<Camera> = views.views.iter().map(|v| v.camera.clone()).collect();
            let alphas: Vec<Vec<f32>> = train_pictures.iter().map(LowResolution::alpha).collect();
            let footprint = degrade::footprint(self.params.kernel);
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
        drop(train_pictures);
        self.context.write_json(&format!("train/{VIEWS_FILE}"), &views)?;
        let degradation = Degradation { kernel: self.params.kernel, hr: self.sizes.hr.into() };
        self.context.write_json(&format!("train/{DEGRADATION_FILE}"), &degradation)?;

        let high = |c: &Camera| c.resized(self.sizes.hr.0, self.sizes.hr.1);
        let reference_views = train_cameras[..references]
            .iter()
            .map(|c| View { image: Some(format!("images/{}.png", c.name)), ..View::camera_only(high(c)) })
            .collect();
        if references > 0 {
            let views = Views::new(self.params.background, bounds, reference_views);
            self.context.write_json(&format!("references/{VIEWS_FILE}"), &views)?;
        }

        (0..test.frames.len())
            .into_par_iter()
            .map(|i| {
                self.context.check_interrupt()?;
                let frame = &test.frames[i];
                let (hr, lr) = self.pictures("test", i, frame)?;
                self.write_high("truth", &frame.name, &hr)?;
                self.write_low("truth/low", &frame.name, &lr)?;
                if let Some(depth) = &frame.depth {
                    self.write_depth(depth, &frame.name).bad_input(frame_place("test", i, frame))?;
                }
                progress.add(1);
                Ok(())
            })
            .collect::<anyhow::Result<Vec<()>>>()?;
        let truth: Vec<View> = self
            .cameras(test, self.native)
            .iter()
            .zip(&test.frames)
            .map(|(c, frame)| View {
                camera: high(c),
                image: Some(format!("images/{}.png", c.name)),
                depth: frame.depth.as_ref().map(|_| format!("depth/{}.exr", c.name)),
                low_resolution: Some(format!("low/{}.{}", c.name, degrade::extension(self.params.kernel))),
            })
            .collect();
        let cameras = truth.iter().map(|v| View::camera_only(v.camera.clone())).collect();
        self.context.write_json(&format!("truth/{VIEWS_FILE}"), &Views::new(self.params.background, bounds, truth))?;
        self.context.write_json(&format!("cameras/{VIEWS_FILE}"), &Views::new(self.params.background, bounds, cameras))?;
        self.summarise(train, test, bounds)
    }

    fn cameras(&self, dataset: &Dataset, (width, height): (u32, u32)) -> Vec<Camera> {
        let intrinsics = Intrinsics::from_angle_x(width, height, dataset.camera_angle_x);
        let camera = |f: &Frame| Camera { name: f.name.clone(), intrinsics, camera_to_world: f.camera_to_world };
        dataset.frames.iter().map(camera).collect()
    }

    fn pictures(&self, split: &str, index: usize, frame: &Frame) -> anyhow::Result<(Rgba8, LowResolution)> {
        let image = read_png(&frame.image).bad_input(frame_place(split, index, frame))?;
        let size = (image.width as u32, image.height as u32);
        if size != self.native {
            let message = format!(
                "{}: {size:?} pixels where the first has {:?}; all images must be of one size",
                frame_place(split, index, frame),
                self.native
            );
            return Err(Failure::BadInput(message).into());
        }
        Ok(degrade(&image, &self.sizes, self.params.kernel))
    }

    fn write_high(&self, subtree: &str, name: &str, image: &Rgba8) -> anyhow::Result<()> {
        write_png(&self.context.output_path(&format!("{subtree}/images/{name}.png"))?, image).map_err(Into::into)
    }

    fn write_low(&self, folder: &str, name: &str, image: &LowResolution) -> anyhow::Result<()> {
        let path = self.context.output_path(&format!("{folder}/{name}.{}", degrade::extension(self.params.kernel)))?;
        match image {
            LowResolution::Bytes(image) => write_png(&path, image)?,
            LowResolution::Floats(picture) => {
                let channels = ["R", "G", "B", "A"].map(|name| Channel { name, sample_type: SampleType::Float });
                write_exr(
                    &path,
                    (picture.width, picture.height),
                    &channels,
                    "display-encoded sRGB, premultiplied",
                    |first, rows, samples| {
                        samples.copy_from_slice(&picture.data[first * picture.width * 4..(first + rows) * picture.width * 4]);
                        Ok::<(), pixels::PixelError>(())
                    },
                )?;
            }
        }
        Ok(())
    }

    /// True depth at HR size: that of the nearest native pixel centre, since averaging depths across an edge invents surfaces.
    fn write_depth(&self, source: &Path, name: &str) -> anyhow::Result<()> {
        let native = read_exr(source)?;
        let channel = |name: &str| native.channel(name).with_context(|| format!("{}: no channel {name}", source.display()));
        let (depth, opacity) = (channel("Z")?, channel("A")?);
        let (width, height) = (self.sizes.hr.0 as usize, self.sizes.hr.1 as usize);
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

    fn summarise(&self, train: &Dataset, test: &Dataset, bounds: Bounds) -> anyhow::Result<()> {
        let Sizes { lr, hr } = self.sizes;
        let scale = [f64::from(hr.0) / f64::from(lr.0), f64::from(hr.1) / f64::from(lr.1)];
        self.context.write_json(
            "scene.json",
            &SceneSummary {
                format: "blender".to_owned(),
                native: self.native.into(),
                hr: hr.into(),
                lr: lr.into(),
                scale,
                kernel: self.params.kernel,
                background: self.params.background,
                bounds,
                train: train.frames.len(),
                test: test.frames.len(),
                has_depth: test.frames.iter().any(|f| f.depth.is_some()),
            },
        )?;
        self.context.write_summary(&format!(
            "{} training views at {}×{} from {}×{} ({:?}), {} test views; rays from {:.2} to {:.2}",
            train.frames.len(),
            lr.0,
            lr.1,
            hr.0,
            hr.1,
            self.params.kernel,
            test.frames.len(),
            bounds.near,
            bounds.far
        ))
    }
}
