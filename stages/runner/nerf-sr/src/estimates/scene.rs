//! Images of a scene, from an artifact of `prep` or from the data set that `prep` will read.

use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use artifact::format_count;
use dataset::{Border, Dataset, Frame, Split};
use pixels::{DEGRADATION_FILE, Degradation, Filter, Kernel};
use scene::{Background, Camera, Intrinsics, Space, VIEWS_FILE, View, Views, common_direction};
use serde::Deserialize;
use serde_json::Value;
use store::SceneKind;
use workload::preparation_bytes;

use super::work::Images;

/// Width of the field's cube in NDC, in widths of an LR image, before the frustum is known: that of
/// `fern`.
const NDC_WIDTHS: f64 = 1.35;
/// Width of the field's cube in a contraction, in widths of an LR image, as in `train-ss`.
const CONTRACTION_WIDTHS: f64 = 2.0;
/// Bytes per pixel of reading an RGBA PNG, as in `dataset`: the decoder's pixels, the image's, and
/// the coefficients of a JPEG, which `dataset` adds for every format.
const READING_BYTES: u64 = 4 + 4 + 6;

/// Images of a scene, by the folders of the artifact that `prep` creates.
#[derive(Clone, Debug, Default)]
pub(crate) struct SceneImages {
    pub(crate) kind: SceneKind,
    /// Width of the field's cube, in widths of an LR image.
    pub(crate) widths_across: f64,
    /// True if the kernel of the LR images is a mean.
    pub(crate) has_box_kernel: bool,
    /// Photographs that `prep` will read.
    pub(crate) photographs: Images,
    /// Peak memory of preparing a photograph.
    pub(crate) preparation_bytes: u64,
    /// Images by folder, such as `train`.
    folders: Vec<(&'static str, Images)>,
}

/// Folders of a scene with `views.json`.
const FOLDERS: [&str; 6] =
    ["train", "downscaled", "train-cameras", "cameras", "truth", "references"];

/// Scene that `prep` will read.
struct PlannedScene {
    kind: SceneKind,
    /// Sizes of all photographs.
    sizes: Vec<(f64, f64)>,
    split: Split,
    is_benchmark: bool,
}

/// Data sets by folder, each read once.
#[derive(Default)]
pub(crate) struct Datasets(BTreeMap<PathBuf, Option<PlannedDataset>>);

impl Datasets {
    /// Returns a folder's data set; `None` if `prep` will refuse it.
    pub(super) fn get(&mut self, folder: &Path) -> Option<&PlannedDataset> {
        let read = || PlannedDataset::read(folder);
        self.0.entry(folder.to_path_buf()).or_insert_with(read).as_ref()
    }
}

/// Data set that `prep` will read.
pub(super) struct PlannedDataset {
    dataset: Dataset,
    /// Memory of reading each photograph, in bytes.
    reading_bytes: Vec<u64>,
    faces_one_direction: bool,
    /// Result of [`Self::is_opaque`], once computed.
    is_opaque: OnceCell<bool>,
}

/// Maximum number of photographs that are read for an estimate; chosen by hand. The first one
/// suffices for most opaque scenes, and for photographs with alpha.
const MAX_SAMPLES: usize = 3;

impl PlannedDataset {
    fn read(folder: &Path) -> Option<Self> {
        let dataset = Dataset::read(folder).ok()?;
        // A file that can't be read is reported by `prep`.
        let reading_bytes = dataset.frames.iter().map(|frame| frame.reading_bytes().unwrap_or(0));
        Some(Self {
            reading_bytes: reading_bytes.collect(),
            faces_one_direction: faces_one_direction(&dataset),
            is_opaque: OnceCell::new(),
            dataset,
        })
    }

    /// Predicts from the borders of a few photographs whether `prep` will take the scene as opaque.
    fn is_opaque(&self) -> bool {
        let frames = &self.dataset.frames;
        *self.is_opaque.get_or_init(|| {
            let count = frames.len().min(MAX_SAMPLES);
            let mut common = None;
            for sample in 0..count {
                let frame = &frames[sample * frames.len() / count];
                // A photograph that can't be read is reported by `prep`.
                let Ok(image) = frame.photograph() else { return true };
                let border = Border::of_frame(frame, &image);
                if border == Border::Alpha {
                    return false;
                }
                let Some(background) = border.background() else { return true };
                if *common.get_or_insert(background) != background {
                    return true;
                }
            }
            false
        })
    }
}

impl SceneImages {
    /// Reads the images of an existing artifact.
    pub(crate) fn of_artifact(artifact: &Path) -> Option<Self> {
        let mut scene = Self { widths_across: 1.0, ..Self::default() };
        let mut hr_width = None;
        if let Ok(bytes) = std::fs::read(artifact.join("train").join(DEGRADATION_FILE)) {
            let degradation: Degradation = serde_json::from_slice(&bytes).ok()?;
            scene.has_box_kernel = degradation.kernel.filter() == Filter::Box;
            hr_width = Some(f64::from(degradation.hr[0]));
        }
        for folder in FOLDERS {
            let Ok(bytes) = std::fs::read(artifact.join(folder).join(VIEWS_FILE)) else {
                continue;
            };
            let Views { background, bounds, views, .. } = serde_json::from_slice(&bytes).ok()?;
            let is_ndc = matches!(bounds.space, Space::Ndc(_));
            scene.kind = kind_of(background == Background::Opaque, is_ndc);
            if let Some(view) = views.first() {
                scene.widths_across = widths_across(&bounds.space, &view.camera.intrinsics);
            }
            // `train` is the first folder.
            let lr_width = scene.images("train").map(|images| images.largest_size.0 as f64);
            let lr_factor = lr_width.zip(hr_width).map_or(1.0, |(lr, hr)| lr / hr);
            let sizes: Vec<(f64, f64)> =
                views.iter().map(|view| image_size(view, lr_factor)).collect();
            scene.folders.push((folder, images_of(&sizes)));
        }
        Some(scene)
    }

    /// Predicts the images that `prep` makes of a data set.
    pub(super) fn of_dataset(set: &PlannedDataset, parameters: &Value) -> Option<Self> {
        let is_opaque = match parameters["background"].as_str() {
            Some(background) => background == "opaque",
            None => set.is_opaque(),
        };
        let PlannedDataset { dataset: set, reading_bytes, faces_one_direction, .. } = set;
        let all = set.frames.len();
        let split = match (parameters["split"].as_str(), &set.split) {
            // Approximate: `prep` removes the references from these test views.
            (Some("paper"), _) => Split::all(all),
            (Some("holdout"), _) | (_, None) => Split::hold_out(all),
            (_, Some(split)) => split.clone(),
        };
        let space = parameters["space"].as_str();
        let is_ndc = space.map_or(*faces_one_direction, |space| space == "ndc");
        let planned = PlannedScene {
            kind: kind_of(is_opaque, is_ndc),
            sizes: set.frames.iter().map(|frame| size_of(frame.intrinsics())).collect(),
            split,
            is_benchmark: set.format.is_benchmark(),
        };
        Some(Self::from_plan(&planned, parameters, |index| reading_bytes[index]))
    }

    /// Predicts the images that `prep` makes of the demo scene.
    pub(crate) fn of_demo(demo: &Value, parameters: &Value) -> Option<Self> {
        let number = |name: &str| demo[name].as_f64();
        let (width, train, test) = (number("size")?, number("train")?, number("test")?);
        let size = (width, (width / number("aspect")?).round());
        let train = train as usize;
        let all = train + test as usize;
        let has_backdrop = demo["backdrop"].as_bool()?;
        let background = parameters["background"].as_str();
        let space = parameters["space"].as_str();
        let is_opaque = background.map_or(has_backdrop, |background| background == "opaque");
        let is_ndc = space.map_or(demo["layout"] == "forward", |space| space == "ndc");
        let planned = PlannedScene {
            kind: kind_of(is_opaque, is_ndc),
            sizes: vec![size; all],
            split: Split { train: (0..train).collect(), test: (train..all).collect() },
            is_benchmark: true,
        };
        let reading = READING_BYTES * (size.0 * size.1) as u64;
        Some(Self::from_plan(&planned, parameters, |_| reading))
    }

    fn from_plan(
        planned: &PlannedScene,
        parameters: &Value,
        reading_bytes: impl Fn(usize) -> u64,
    ) -> Self {
        let PlannedScene { kind, sizes, split, is_benchmark } = planned;
        let number = |name: &str| parameters[name].as_f64();
        let lr_width = number("lr_width");
        let is_downscaled = match parameters["lr_source"].as_str() {
            Some(source) => source == "downscaled",
            None => *is_benchmark || lr_width.is_some(),
        };
        let width = sizes.first().map_or(1.0, |size| size.0);
        let scale = number("scale").unwrap_or(2.0);
        // Factors from the data set's images to the LR and to the HR images.
        let (lr, hr) = if is_downscaled {
            let hr = lr_width.map_or(1.0, |lr| lr * scale / width);
            (hr / scale, hr)
        } else {
            (1.0, scale)
        };
        let max_test = number("test_views").map_or(usize::MAX, |count| count as usize);
        let images = |indices: &[usize], factor: f64| {
            let scaled = indices.iter().map(|&i| (sizes[i].0 * factor, sizes[i].1 * factor));
            images_of(&scaled.collect::<Vec<_>>())
        };
        // `prep` spreads test views and references over all views; which views are taken matters
        // only if their sizes differ.
        let test: Vec<usize> = split.test.iter().copied().take(max_test).collect();
        let references = number("hr_references").filter(|_| is_downscaled).unwrap_or(0.0) as usize;
        let references = &split.train[..references.min(split.train.len())];
        let mut read = [&split.train[..], &test].concat();
        // With the paper's split, a view may be in both parts.
        read.sort_unstable();
        read.dedup();
        let preparation = read.iter().map(|&i| {
            let pixels = sizes[i].0 * sizes[i].1;
            let hr_pixels = if is_downscaled { pixels * hr.powi(2) } else { 0.0 };
            preparation_bytes(reading_bytes(i), pixels as u64, hr_pixels as u64)
        });
        Self {
            kind: *kind,
            widths_across: planned_widths_across(*kind, &parameters["space"]),
            has_box_kernel: is_mean_kernel(&parameters["kernel"], !is_downscaled),
            photographs: images(&read, 1.0),
            preparation_bytes: preparation.max().unwrap_or(0),
            folders: vec![
                ("train", images(&split.train, lr)),
                ("downscaled", images(&split.train, lr / scale)),
                ("train-cameras", images(&split.train, hr)),
                ("cameras", images(&test, hr)),
                // Without HR truth, views are scored at the size of the photographs.
                ("truth", images(&test, if is_downscaled { hr } else { lr })),
                ("references", images(references, hr)),
            ],
        }
    }

    /// Describes the scene in a line.
    pub(crate) fn summary(&self) -> String {
        let [train, test] = ["train", "cameras"].map(|folder| {
            let images = self.images(folder).unwrap_or_default();
            (images.count as usize, images.pixels as f64 / 1e6)
        });
        let kind = match self.kind {
            SceneKind::Object => "object in front of a plain background",
            SceneKind::Frustum => "opaque scene, photographed from one side",
            SceneKind::Unbounded => "opaque scene around the cameras",
        };
        format!(
            "{kind}: {} of {:.2} million LR pixels in all, {} of {:.2} million pixels in all to \
            render",
            format_count(train.0, "training view"),
            train.1,
            format_count(test.0, "view"),
            test.1
        )
    }

    /// Returns the images of a folder.
    pub(crate) fn images(&self, folder: &str) -> Option<Images> {
        self.folders.iter().find(|(name, _)| *name == folder).map(|(_, images)| *images)
    }
}

/// Returns whether `prep` may represent an opaque scene in NDC.
fn faces_one_direction(set: &Dataset) -> bool {
    let cameras: Vec<Camera> = set.frames.iter().map(Frame::camera).collect();
    common_direction(cameras.iter()).is_some()
        && !cameras.iter().any(|camera| camera.intrinsics.distortion.is_fisheye())
}

fn kind_of(is_opaque: bool, is_ndc: bool) -> SceneKind {
    match (is_opaque, is_ndc) {
        (false, _) => SceneKind::Object,
        (true, true) => SceneKind::Frustum,
        (true, false) => SceneKind::Unbounded,
    }
}

/// Returns the width of the field's cube, in widths of a view, as in `train-ss`.
fn widths_across(space: &Space, view: &Intrinsics) -> f64 {
    match space {
        Space::Box => 1.0,
        Space::Contraction => CONTRACTION_WIDTHS,
        Space::Ndc(frustum) => {
            let [width, height] = [0, 1].map(|axis| frustum.max[axis] - frustum.min[axis]);
            width.max(height) * (view.fx / f64::from(view.width))
        }
    }
}

fn planned_widths_across(kind: SceneKind, space: &Value) -> f64 {
    match kind {
        SceneKind::Frustum => NDC_WIDTHS,
        SceneKind::Unbounded if space != "box" => CONTRACTION_WIDTHS,
        SceneKind::Unbounded | SceneKind::Object => 1.0,
    }
}

/// Returns whether a kernel is a mean, or `by_default` if no kernel is given.
fn is_mean_kernel(kernel: &Value, by_default: bool) -> bool {
    let kernel = serde_json::from_value::<Kernel>(kernel.clone());
    kernel.map_or(by_default, |kernel| kernel.filter() == Filter::Box)
}

/// Returns the size of a view's image, or of its camera if the view has no image. Of a test view
/// without HR truth, this is the LR photograph, on which the view is scored.
fn image_size(view: &View, lr_factor: f64) -> (f64, f64) {
    let (width, height) = size_of(view.camera.intrinsics);
    match &view.low_resolution {
        Some(_) if view.image.is_none() => (width * lr_factor, height * lr_factor),
        _ => (width, height),
    }
}

fn size_of(image: Intrinsics) -> (f64, f64) {
    (f64::from(image.width), f64::from(image.height))
}

/// Returns number and size of images with the given widths and heights.
fn images_of(sizes: &[(f64, f64)]) -> Images {
    let sizes = sizes.iter().map(|(width, height)| (width.round() as u64, height.round() as u64));
    Images {
        count: sizes.len() as u64,
        pixels: sizes.clone().map(|(width, height)| width * height).sum(),
        largest_size: sizes.max_by_key(|(width, height)| width * height).unwrap_or_default(),
    }
}

/// Name of a recorded path's file.
const PATH_FILE: &str = "camera_path.json";

/// Part of a recorded path.
#[derive(Deserialize)]
struct PathFile {
    render_width: f64,
    render_height: f64,
    camera_path: Vec<Value>,
}

/// Returns the frames of a path that `camera-path` computes: as large as the scene's HR images,
/// unless parameter `size` gives the frames' width.
pub(super) fn computed_frames(parameters: &Value, scene: &SceneImages) -> Option<Images> {
    let count = parameters["frames"].as_u64()?;
    Some(frames(count, scene.images("train-cameras")?.largest_size, parameters))
}

/// Returns the frames of a recorded path; `None` if its file can't be read.
pub(super) fn recorded_frames(parameters: &Value, folder: &Path) -> Option<Images> {
    let bytes = std::fs::read(folder.join(PATH_FILE)).ok()?;
    let path: PathFile = serde_json::from_slice(&bytes).ok()?;
    let size = (path.render_width as u64, path.render_height as u64);
    Some(frames(path.camera_path.len() as u64, size, parameters))
}

fn frames(count: u64, largest_size: (u64, u64), parameters: &Value) -> Images {
    let pixels = largest_size.0.saturating_mul(largest_size.1).saturating_mul(count);
    Images { count, pixels, largest_size }.with_size(parameters)
}

#[cfg(test)]
mod tests {
    use scene::{Bounds, Frustum};
    use serde_json::json;

    use super::*;

    fn sizes(scene: &SceneImages) -> Vec<(u64, u64)> {
        let images = FOLDERS.iter().map(|folder| scene.images(folder).unwrap());
        images.map(|images| (images.count, images.pixels)).collect()
    }

    #[test]
    fn images_follow_from_the_parameters() {
        let demo = json!({"size": 200, "aspect": 1.0, "train": 80, "test": 10, "backdrop": true});
        let scene = SceneImages::of_demo(&demo, &json!({"scale": 2, "hr_references": 1})).unwrap();
        assert_eq!(scene.kind, SceneKind::Unbounded);
        let mut forward = demo.clone();
        forward["layout"] = json!("forward");
        for (parameters, kind) in [
            (json!({}), SceneKind::Frustum),
            (json!({"space": "contraction"}), SceneKind::Unbounded),
            (json!({"background": "white"}), SceneKind::Object),
        ] {
            assert_eq!(SceneImages::of_demo(&forward, &parameters).unwrap().kind, kind);
        }
        let (lr, hr) = (80 * 10_000, 10 * 40_000);
        let expected = [(80, lr), (80, lr / 4), (80, 4 * lr), (10, hr), (10, hr), (1, 40_000)];
        assert_eq!(sizes(&scene), expected);
        assert_eq!(
            scene.summary(),
            "opaque scene around the cameras: 80 training views of 0.80 million LR pixels in all, \
            10 views of 0.40 million pixels in all to render"
        );

        let smaller = json!({"scale": 4, "lr_width": 30, "test_views": 3, "hr_references": 0});
        let scene = SceneImages::of_demo(&demo, &smaller).unwrap();
        let images = |count, side| {
            Some(Images { count, pixels: count * side * side, largest_size: (side, side) })
        };
        assert_eq!(scene.images("train"), images(80, 30));
        assert_eq!(scene.images("cameras"), images(3, 120));
        assert_eq!(scene.photographs, images(83, 200).unwrap());
        assert_eq!(scene.preparation_bytes, 12 * 40_000 + 8 * 14_400);
        assert_eq!(scene.images("other"), None);
    }

    /// Photographs are trained on at their own size; views are larger.
    #[test]
    fn photographs_are_the_lr_images() {
        let planned = PlannedScene {
            kind: SceneKind::Unbounded,
            sizes: vec![(640.0, 480.0); 9],
            split: Split::hold_out(9),
            is_benchmark: false,
        };
        let scene = SceneImages::from_plan(&planned, &json!({"scale": 2}), |_| 7);
        let images = |count, factor: u64| {
            let largest_size = (factor * 640, factor * 480);
            Some(Images { count, pixels: count * largest_size.0 * largest_size.1, largest_size })
        };
        assert_eq!(scene.images("train"), images(7, 1));
        assert_eq!(scene.images("truth"), images(2, 1));
        assert_eq!(scene.preparation_bytes, preparation_bytes(7, 640 * 480, 0));
        assert!(scene.has_box_kernel);
        let lanczos = json!({"scale": 2, "kernel": "lanczos", "lr_width": 320});
        let scene = SceneImages::from_plan(&planned, &lanczos, |_| 7);
        assert_eq!(scene.preparation_bytes, preparation_bytes(7, 640 * 480, 640 * 480));
        assert!(!scene.has_box_kernel);
    }

    #[test]
    fn sizes_are_read_from_an_artifact() {
        let folder = tempfile::tempdir().unwrap();
        assert!(SceneImages::of_artifact(folder.path()).unwrap().images("train").is_none());
        let train = folder.path().join("train");
        std::fs::create_dir(&train).unwrap();
        let intrinsics = Intrinsics { fx: 45.0, ..Intrinsics::from_angle_x(30, 20, 0.7) };
        let camera_to_world = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]];
        let view = |name: &str| {
            let name = name.to_owned();
            View::camera_only(Camera { name, intrinsics, camera_to_world })
        };
        let scene_in = |space: Space| {
            let bounds = Bounds { space, ..Bounds::cube(1.0, 2.0, 6.0) };
            let views = Views::new(Background::Opaque, bounds, vec![view("a"), view("b")]);
            artifact::write_json(&train.join(VIEWS_FILE), &views).unwrap();
            SceneImages::of_artifact(folder.path()).unwrap()
        };
        let scene = scene_in(Space::Contraction);
        assert_eq!((scene.kind, scene.widths_across), (SceneKind::Unbounded, 2.0));
        let images = Images { count: 2, pixels: 1200, largest_size: (30, 20) };
        assert_eq!(scene.images("train"), Some(images));
        let frustum =
            Frustum { camera_to_world, min: [-0.5, -0.25], max: [0.5, 0.25], near: 1.0, far: 2.0 };
        let scene = scene_in(Space::Ndc(frustum));
        assert_eq!((scene.kind, scene.widths_across), (SceneKind::Frustum, 1.5));

        // A test view without HR truth has the size of its photograph.
        let truth = folder.path().join("truth");
        std::fs::create_dir(&truth).unwrap();
        let degradation = Degradation { kernel: Kernel::Box, hr: [60, 40] };
        artifact::write_json(&train.join(DEGRADATION_FILE), &degradation).unwrap();
        for (image, size) in [(None, (30, 20)), (Some("images/c.png".to_owned()), (60, 40))] {
            let camera = view("c").camera.resized(60, 40);
            let low_resolution = Some("low/c.png".to_owned());
            let test_view = View { image, low_resolution, ..View::camera_only(camera) };
            let bounds = Bounds::cube(1.0, 2.0, 6.0);
            let views = Views::new(Background::Opaque, bounds, vec![test_view]);
            artifact::write_json(&truth.join(VIEWS_FILE), &views).unwrap();
            let scene = SceneImages::of_artifact(folder.path()).unwrap();
            assert!(scene.has_box_kernel);
            assert_eq!(scene.images("truth").unwrap().largest_size, size);
        }
        std::fs::write(train.join(VIEWS_FILE), "{").unwrap();
        assert!(SceneImages::of_artifact(folder.path()).is_none());
    }

    #[test]
    fn frames_follow_from_parameters_or_a_recorded_path() {
        let demo = json!({"size": 200, "aspect": 2.0, "train": 8, "test": 2, "backdrop": false});
        let scene = SceneImages::of_demo(&demo, &json!({"scale": 2})).unwrap();
        let images = |count, largest_size: (u64, u64)| {
            Some(Images { count, pixels: count * largest_size.0 * largest_size.1, largest_size })
        };
        let parameters = json!({"frames": 120});
        assert_eq!(computed_frames(&parameters, &scene), images(120, (200, 100)));
        let parameters = json!({"frames": 3, "size": 50});
        assert_eq!(computed_frames(&parameters, &scene), images(3, (50, 25)));

        let folder = tempfile::tempdir().unwrap();
        assert_eq!(recorded_frames(&parameters, folder.path()), None);
        let file = json!({"render_width": 40, "render_height": 30.0, "camera_path": [{}, {}]});
        std::fs::write(folder.path().join(PATH_FILE), file.to_string()).unwrap();
        assert_eq!(recorded_frames(&json!({"size": null}), folder.path()), images(2, (40, 30)));
        assert_eq!(recorded_frames(&json!({"size": 80}), folder.path()), images(2, (80, 60)));
    }
}
