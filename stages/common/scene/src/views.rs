use std::collections::BTreeSet;
use std::path::Path;

use artifact::{Failure, FailureExt as _, GivenInput, relative_path};
use pixels::{Image, Mask, PixelError, read_png, read_premultiplied};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::bounds::Bounds;
use crate::camera::{Camera, CameraError};

/// Name of the file in every folder of views.
pub const VIEWS_FILE: &str = "views.json";

/// `views.json`: cameras, and the files that belong to them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Views {
    /// How to read the numbers; constant.
    pub conventions: Conventions,
    /// What lies behind the scene.
    pub background: Background,
    /// Where the scene is.
    pub bounds: Bounds,
    /// The views, in the data set's order.
    pub views: Vec<View>,
}

/// A camera and its files, as paths inside the folder of `views.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// Where it was taken from; its intrinsics have the image's size.
    pub camera: Camera,
    /// The image: PNG (RGBA with straight alpha, or RGB) or EXR (premultiplied alpha).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<String>,
    /// Which of the image's pixels count: PNG of its size, white where they do, black where they
    /// don't. Without it: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<String>,
    /// Depth: EXR, channel `Z`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth: Option<String>,
    /// The same view at low resolution, to look at beside the others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub low_resolution: Option<String>,
}

impl View {
    /// A camera without files.
    pub fn camera_only(camera: Camera) -> Self {
        Self { camera, image: None, mask: None, depth: None, low_resolution: None }
    }

    /// Its image, premultiplied RGBA, and which of its pixels count; none where it has no image.
    pub fn read_photograph(&self, input: &GivenInput) -> Result<Option<Photograph>, PixelError> {
        let Some(file) = &self.image else { return Ok(None) };
        let image = read_premultiplied(&input.path(file))?;
        let mask = self.read_mask(input, (image.width, image.height))?;
        Ok(Some(Photograph { image, mask }))
    }

    /// The same at low resolution; a pixel of it counts where all that lies under it does.
    pub fn read_lr(&self, input: &GivenInput) -> Result<Option<Photograph>, PixelError> {
        let Some(file) = &self.low_resolution else { return Ok(None) };
        let image = read_premultiplied(&input.path(file))?;
        let mask = self.mask.as_ref().map(|file| read_png(&input.path(file))).transpose()?;
        let mask = mask.map(|mask| Mask::of(&mask).resized((image.width, image.height), 0));
        Ok(Some(Photograph { image, mask }))
    }

    /// Which pixels of its image, of that size, count; none where all do.
    pub fn read_mask(
        &self,
        input: &GivenInput,
        size: (usize, usize),
    ) -> Result<Option<Mask>, PixelError> {
        self.mask.as_ref().map(|file| Mask::read(&input.path(file), size)).transpose()
    }
}

/// What a camera took: an image, and what of it shows the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Photograph {
    /// Premultiplied RGBA, or RGB over a background.
    pub image: Image,
    /// Which pixels count; without it all do. The others say nothing of the scene.
    pub mask: Option<Mask>,
}

impl Photograph {
    /// RGB over a grey level.
    #[must_use]
    pub fn over(self, background: f32) -> Self {
        Self { image: self.image.over(background), ..self }
    }

    /// The image, NaN where it doesn't count.
    pub fn known(self) -> Image {
        let mut image = self.image;
        let counts = self.mask.iter().flat_map(|mask| &mask.counts);
        for (pixel, counts) in image.data.chunks_exact_mut(image.channels).zip(counts) {
            if !counts {
                pixel.fill(f32::NAN);
            }
        }
        image
    }
}

impl From<Image> for Photograph {
    fn from(image: Image) -> Self {
        Self { image, mask: None }
    }
}

/// The conventions in words, for whoever reads `views.json` without this crate.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Conventions {
    /// Camera axes and matrix.
    pub camera: String,
    /// Where pixels lie.
    pub pixels: String,
    /// What depth means.
    pub depth: String,
    /// What colours mean.
    pub colour: String,
}

impl Default for Conventions {
    fn default() -> Self {
        Self {
            camera: "OpenGL: x right, y up, looking along -z; camera_to_world = [R | t] row by \
                row"
            .into(),
            pixels: "pixel (i, j), row 0 on top, has its centre at (i + 0.5, j + 0.5)".into(),
            depth: "camera-space z-depth in scene units".into(),
            colour:
                "display-encoded sRGB; PNG has straight alpha, EXR premultiplied; composite on \
                the background in floating point"
                    .into(),
        }
    }
}

/// What lies behind the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// White, as in the paper.
    White,
    /// Black.
    Black,
    /// Kept open: alpha is data, colours are premultiplied.
    Alpha,
    /// Nothing: every ray ends on something, as in photographs. Training puts another colour there
    /// each time, so that nothing can pretend to be it.
    Opaque,
}

impl Background {
    /// The colour behind the scene when it has to be shown: open backgrounds are shown on white,
    /// what is left open of an opaque scene on the mean of all colours.
    pub fn shown(self) -> f32 {
        match self {
            Self::Black => 0.0,
            Self::White | Self::Alpha => 1.0,
            Self::Opaque => 0.5,
        }
    }
}

/// A `views.json` that can't be used.
#[derive(Debug, thiserror::Error)]
pub enum ViewsError {
    /// No view at all.
    #[error("{VIEWS_FILE}: it lists no views")]
    Empty,
    /// A camera that can't be.
    #[error("{VIEWS_FILE}: view {name:?}: {source}")]
    Camera {
        /// The view.
        name: String,
        /// What is wrong.
        source: CameraError,
    },
    /// Two views of one name, or a name that is no file name.
    #[error("{VIEWS_FILE}: view name {0:?} is used twice or can't name a file")]
    Name(String),
    /// A path out of the folder.
    #[error("{VIEWS_FILE}: {0}")]
    Path(String),
    /// A box without inside.
    #[error("{VIEWS_FILE}: bounds {0:?} have no inside")]
    Bounds(Box<Bounds>),
}

impl Views {
    /// Views without files.
    pub fn new(background: Background, bounds: Bounds, views: Vec<View>) -> Self {
        Self { conventions: Conventions::default(), background, bounds, views }
    }

    /// The view that has a camera's name and pose. Names alone say little: Blender's training and
    /// test views have the same.
    pub fn taken_by(&self, camera: &Camera) -> Option<&View> {
        self.views.iter().find(|v| {
            v.camera.name == camera.name && v.camera.camera_to_world == camera.camera_to_world
        })
    }

    /// Reads one of these views' images over the background on which they are shown: RGB.
    pub fn read_over(&self, path: &Path) -> Result<Image, PixelError> {
        Ok(read_premultiplied(path)?.over(self.background.shown()))
    }

    /// Reads and checks the `views.json` of an input.
    ///
    /// # Errors
    /// [`Failure::BadInput`] with input, file and view.
    pub fn read(input: &GivenInput) -> Result<Self, Failure> {
        let views: Self = input.read_json(VIEWS_FILE)?;
        views.check().bad_input(input.folder().display())?;
        Ok(views)
    }

    /// Reads and checks the `views.json` of a folder that a run's record names.
    ///
    /// # Errors
    /// [`Failure::BadInput`] with file and view.
    pub fn of_folder(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(VIEWS_FILE);
        let bytes = std::fs::read(&path).bad_input(path.display())?;
        let views: Self = serde_json::from_slice(&bytes).bad_input(path.display())?;
        views.check().bad_input(path.display())?;
        Ok(views)
    }

    /// Refuses what can't be: no views, impossible cameras, names or paths that leave the folder,
    /// an empty box.
    pub fn check(&self) -> Result<(), ViewsError> {
        if self.views.is_empty() {
            return Err(ViewsError::Empty);
        }
        if !self.bounds.is_valid() {
            return Err(ViewsError::Bounds(Box::new(self.bounds)));
        }
        let mut names = BTreeSet::new();
        for view in &self.views {
            let name = &view.camera.name;
            let plain = relative_path(name).is_ok_and(|p| p.components().count() == 1)
                && !name.contains(char::is_control);
            if !plain || !names.insert(name) {
                return Err(ViewsError::Name(name.clone()));
            }
            view.camera
                .check()
                .map_err(|source| ViewsError::Camera { name: name.clone(), source })?;
            for path in
                [&view.image, &view.mask, &view.depth, &view.low_resolution].into_iter().flatten()
            {
                check_path(path)?;
            }
        }
        Ok(())
    }
}

/// Refuses paths that leave the folder, or that would do something to a terminal where they are
/// printed.
fn check_path(path: &str) -> Result<(), ViewsError> {
    relative_path(path).map_err(|e| ViewsError::Path(e.to_string()))?;
    if path.contains(char::is_control) {
        Err(ViewsError::Path(format!("{path:?} has control characters")))
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::intrinsics::Intrinsics;
    use crate::space::Space;

    fn views() -> Views {
        let camera = Camera {
            name: "r_0".into(),
            intrinsics: Intrinsics::from_angle_x(8, 6, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        };
        let bounds = Bounds { min: [-1.; 3], max: [1.; 3], near: 2., far: 6., space: Space::Box };
        Views::new(Background::White, bounds, vec![View::camera_only(camera)])
    }

    #[test]
    fn json_round_trip() {
        let views = views();
        views.check().unwrap();
        let text = serde_json::to_string(&views).unwrap();
        assert_eq!(serde_json::from_str::<Views>(&text).unwrap(), views);
    }

    #[test]
    fn hostile_lists_are_refused() {
        let mut v = views();
        v.views.push(v.views[0].clone());
        assert!(matches!(v.check(), Err(ViewsError::Name(_))));
        let mut v = views();
        v.views[0].image = Some("../../etc/passwd".into());
        assert!(matches!(v.check(), Err(ViewsError::Path(_))));
        let mut v = views();
        v.views[0].camera.name = "../x".into();
        assert!(matches!(v.check(), Err(ViewsError::Name(_))));
        let mut v = views();
        v.views[0].camera.name = "\u{1b}]0;PWN\u{7}".into();
        assert!(!v.check().unwrap_err().to_string().contains(char::is_control));
        let mut v = views();
        v.views[0].image = Some("images/\u{9b}31m.png".into());
        assert!(!v.check().unwrap_err().to_string().contains(char::is_control));
        let mut v = views();
        v.bounds.max[1] = -1.0;
        assert!(matches!(v.check(), Err(ViewsError::Bounds(_))));
        let mut v = views();
        v.views.clear();
        assert!(matches!(v.check(), Err(ViewsError::Empty)));
    }
}
