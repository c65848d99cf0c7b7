use std::path::Path;

use dataset::{Dataset, Format, Frame, Split};
use serde_json::Value;

use super::costs::{Images, SceneKind};

/// Test views of a data set without a split: every eighth (`prep`'s `split: holdout`).
const HOLDOUT: usize = 8;

/// Images of a scene, by the folders of the artifact that `prep` creates.
#[derive(Clone, Debug)]
pub(crate) struct SceneImages {
    pub(crate) kind: SceneKind,
    /// Images by folder, such as `train`.
    folders: Vec<(&'static str, Images)>,
}

/// Folders of a scene with `views.json`.
const FOLDERS: [&str; 6] =
    ["train", "downscaled", "train-cameras", "cameras", "truth", "references"];

impl SceneImages {
    /// Reads the images of an existing artifact.
    pub(crate) fn of_artifact(artifact: &Path) -> Option<Self> {
        let mut kind = SceneKind::Object;
        let mut folders = Vec::new();
        for folder in FOLDERS {
            let Ok(bytes) = std::fs::read(artifact.join(folder).join("views.json")) else {
                continue;
            };
            let views: Value = serde_json::from_slice(&bytes).ok()?;
            let is_ndc = views["bounds"]["space"].get("ndc").is_some();
            kind = kind_of(views["background"] == "opaque", is_ndc);
            let sizes = views["views"].as_array()?.iter().map(|view| {
                let size = &view["camera"]["intrinsics"];
                Some((size["width"].as_f64()?, size["height"].as_f64()?))
            });
            folders.push((folder, count(&sizes.collect::<Option<Vec<_>>>()?)));
        }
        Some(Self { kind, folders })
    }

    /// Predicts the images that `prep` makes of a data set.
    pub(crate) fn of_dataset(folder: &Path, parameters: &Value) -> Option<Self> {
        let set = Dataset::read(folder).ok()?;
        let sizes: Vec<(f64, f64)> = set.frames.iter().map(size_of).collect();
        let all = sizes.len();
        let split = match (parameters["split"].as_str(), set.split) {
            (Some("paper"), _) => Split::all(all),
            (Some("holdout"), _) | (_, None) => Split::hold_out(all, HOLDOUT),
            (_, Some(split)) => split,
        };
        let is_benchmark = set.format.is_benchmark();
        let background = parameters["background"].as_str();
        // LLFF's photographs have no background of one colour.
        let is_object = set.format == Format::Blender;
        let is_opaque = background.map_or(!is_object, |background| background == "opaque");
        let space = parameters["space"].as_str();
        let is_ndc = space.map_or(set.format == Format::Llff, |space| space == "ndc");
        Some(Self::planned(kind_of(is_opaque, is_ndc), &sizes, &split, is_benchmark, parameters))
    }

    /// Predicts the images that `prep` makes of the demo scene.
    pub(crate) fn of_demo(demo: &Value, parameters: &Value) -> Option<Self> {
        let number = |name: &str| demo[name].as_f64();
        let (width, train, test) = (number("size")?, number("train")?, number("test")?);
        let size = (width, (width / number("aspect")?).round());
        let train = train as usize;
        let all = train + test as usize;
        let is_opaque = demo["backdrop"].as_bool()?;
        let kind = kind_of(is_opaque, false);
        let split = Split { train: (0..train).collect(), test: (train..all).collect() };
        Some(Self::planned(kind, &vec![size; all], &split, true, parameters))
    }

    fn planned(
        kind: SceneKind,
        sizes: &[(f64, f64)],
        split: &Split,
        is_benchmark: bool,
        parameters: &Value,
    ) -> Self {
        let number = |name: &str| parameters[name].as_f64();
        let (lr_width, hr_width) = (number("lr_width"), number("hr_width"));
        let is_downscaled = match parameters["lr_source"].as_str() {
            Some(source) => source == "downscaled",
            None => is_benchmark || lr_width.is_some(),
        };
        let width = sizes.first().map_or(1.0, |size| size.0);
        let given = lr_width.zip(hr_width).map(|(lr, hr)| hr / lr);
        let scale = number("scale").or(given).unwrap_or(2.0);
        // Factors from the data set's images to the LR and to the HR images.
        let (lr, hr) = if is_downscaled {
            let hr = hr_width.or(lr_width.map(|lr| lr * scale)).map_or(1.0, |hr| hr / width);
            (hr / scale, hr)
        } else {
            (1.0, scale)
        };
        let max_test = number("test_views").map_or(usize::MAX, |count| count as usize);
        let images = |indices: &[usize], factor: f64| {
            let scaled = indices.iter().map(|&i| (sizes[i].0 * factor, sizes[i].1 * factor));
            count(&scaled.collect::<Vec<_>>())
        };
        let test: Vec<usize> = split.test.iter().copied().take(max_test).collect();
        let references = number("hr_references").unwrap_or(0.0) as usize;
        let references = &split.train[..references.min(split.train.len())];
        let folders = vec![
            ("train", images(&split.train, lr)),
            ("downscaled", images(&split.train, lr / scale)),
            ("train-cameras", images(&split.train, hr)),
            ("cameras", images(&test, hr)),
            ("truth", images(&test, hr)),
            ("references", images(references, hr)),
        ];
        Self { kind, folders }
    }

    /// Describes the scene in a line.
    pub(crate) fn summary(&self) -> String {
        let [train, test] = ["train", "cameras"].map(|folder| {
            let images = self.images(folder).unwrap_or_default();
            (images.count, images.pixels as f64 / 1e6)
        });
        let kind = match self.kind {
            SceneKind::Object => "object before a plain background",
            SceneKind::Frustum => "opaque scene that faces the cameras",
            SceneKind::Unbounded => "opaque scene around the cameras",
        };
        format!(
            "{kind}: {} training views of {:.2} million LR pixels in all, {} views of {:.2} \
            million pixels to render",
            train.0, train.1, test.0, test.1
        )
    }

    /// Returns the images of a folder.
    pub(crate) fn images(&self, folder: &str) -> Option<Images> {
        self.folders.iter().find(|(name, _)| *name == folder).map(|(_, images)| *images)
    }
}

fn kind_of(is_opaque: bool, is_ndc: bool) -> SceneKind {
    match (is_opaque, is_ndc) {
        (false, _) => SceneKind::Object,
        (true, true) => SceneKind::Frustum,
        (true, false) => SceneKind::Unbounded,
    }
}

fn size_of(frame: &Frame) -> (f64, f64) {
    let size = frame.intrinsics();
    (f64::from(size.width), f64::from(size.height))
}

fn count(sizes: &[(f64, f64)]) -> Images {
    let pixels = sizes.iter().map(|(width, height)| width.round() * height.round());
    Images { count: sizes.len() as u64, pixels: pixels.sum::<f64>() as u64 }
}

#[cfg(test)]
mod tests {
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
        let (lr, hr) = (80 * 10_000, 10 * 40_000);
        let expected = [(80, lr), (80, lr / 4), (80, 4 * lr), (10, hr), (10, hr), (1, 40_000)];
        assert_eq!(sizes(&scene), expected);
        assert_eq!(
            scene.summary(),
            "opaque scene around the cameras: 80 training views of 0.80 million LR pixels in all, 10 views of 0.40 \
            million pixels to render"
        );

        let smaller = json!({"scale": 4, "lr_width": 30, "test_views": 3, "hr_references": 0});
        let scene = SceneImages::of_demo(&demo, &smaller).unwrap();
        assert_eq!(scene.images("train"), Some(Images { count: 80, pixels: 80 * 900 }));
        assert_eq!(scene.images("cameras"), Some(Images { count: 3, pixels: 3 * 14_400 }));
        assert_eq!(scene.images("other"), None);
    }

    /// Photographs keep their size for training, and views are larger.
    #[test]
    fn photographs_are_the_lr_images() {
        let split = Split::hold_out(9, HOLDOUT);
        let sizes = vec![(640.0, 480.0); 9];
        let scene =
            SceneImages::planned(SceneKind::Unbounded, &sizes, &split, false, &json!({"scale": 2}));
        let pixels = 640 * 480;
        assert_eq!(scene.images("train"), Some(Images { count: 7, pixels: 7 * pixels }));
        assert_eq!(scene.images("truth"), Some(Images { count: 2, pixels: 2 * 4 * pixels }));
    }

    #[test]
    fn an_artifact_has_its_own_sizes() {
        let folder = tempfile::tempdir().unwrap();
        assert!(SceneImages::of_artifact(folder.path()).unwrap().images("train").is_none());
        let train = folder.path().join("train");
        std::fs::create_dir(&train).unwrap();
        let size = json!({"camera": {"intrinsics": {"width": 30, "height": 20}}});
        let views = json!({"background": "opaque", "views": [size, size]});
        std::fs::write(train.join("views.json"), views.to_string()).unwrap();
        let scene = SceneImages::of_artifact(folder.path()).unwrap();
        assert_eq!(scene.kind, SceneKind::Unbounded);
        assert_eq!(scene.images("train"), Some(Images { count: 2, pixels: 1200 }));
        std::fs::write(train.join("views.json"), "{").unwrap();
        assert!(SceneImages::of_artifact(folder.path()).is_none());
    }
}
