use std::collections::BTreeSet;
use std::path::Path;

use artifact::{Failure, FailureExt as _, GivenInput, relative_path};
use pixels::{Image, Mask, PixelError, read_png, read_premultiplied};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::bounds::Bounds;
use crate::camera::Camera;

/// Name of the list of views in every folder of views.
pub const VIEWS_FILE: &str = "views.json";

/// List of views, `views.json`: cameras and their files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Views {
    /// Conventions of the numbers, as text; constant.
    pub conventions: Conventions,
    /// Background behind the scene.
    pub background: Background,
    /// Bounds of the scene.
    pub bounds: Bounds,
    /// Views in the data set's order.
    pub views: Vec<View>,
}

/// Camera and its files, as paths in the folder of `views.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// Camera that took the view, with the image's size.
    pub camera: Camera,
    /// Image file: PNG (RGBA with straight alpha, or RGB) or EXR (premultiplied alpha).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<String>,
    /// Mask file: PNG of the image's size, white in pixels that count, black in others. All pixels
    /// count if missing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<String>,
    /// Depth file: EXR, channel `Z`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth: Option<String>,
    /// Low-resolution image file of the view, for display next to other images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub low_resolution: Option<String>,
}

impl View {
    /// Creates a view without files.
    pub fn camera_only(camera: Camera) -> Self {
        Self { camera, image: None, mask: None, depth: None, low_resolution: None }
    }

    /// Reads the image, premultiplied RGBA, and its mask; `None` if the view has no image.
    pub fn read_photograph(&self, input: &GivenInput) -> Result<Option<Photograph>, PixelError> {
        let Some(file) = &self.image else { return Ok(None) };
        let image = read_premultiplied(&input.path(file))?;
        let mask = self.read_mask(input, (image.width, image.height))?;
        Ok(Some(Photograph { image, mask }))
    }

    /// Reads the low-resolution image and its mask; `None` if the view has none. An LR pixel counts
    /// if all HR pixels under it count.
    pub fn read_lr_photograph(&self, input: &GivenInput) -> Result<Option<Photograph>, PixelError> {
        let Some(file) = &self.low_resolution else { return Ok(None) };
        let image = read_premultiplied(&input.path(file))?;
        let mask = self.mask.as_ref().map(|file| read_png(&input.path(file))).transpose()?;
        let mask = mask.map(|mask| Mask::of(&mask).resized((image.width, image.height), 0));
        Ok(Some(Photograph { image, mask }))
    }

    /// Reads the mask of an image of the given size; `None` if all pixels count.
    pub fn read_mask(
        &self,
        input: &GivenInput,
        size: (usize, usize),
    ) -> Result<Option<Mask>, PixelError> {
        self.mask.as_ref().map(|file| Mask::read(&input.path(file), size)).transpose()
    }
}

/// Image taken by a camera, with its mask.
#[derive(Clone, Debug, PartialEq)]
pub struct Photograph {
    /// Premultiplied RGBA, or RGB over a background.
    pub image: Image,
    /// Mask of the pixels that count; `None` for all.
    pub mask: Option<Mask>,
}

impl Photograph {
    /// Returns the photograph over a grey level: RGB.
    #[must_use]
    pub fn over(self, background: f32) -> Self {
        Self { image: self.image.over(background), ..self }
    }

    /// Returns the image with NaN in pixels that don't count.
    pub fn masked_image(self) -> Image {
        let mut image = self.image;
        if let Some(mask) = self.mask {
            let pixels = image.data.chunks_exact_mut(image.channels);
            for (pixel, counts) in pixels.zip(mask.counts) {
                if !counts {
                    pixel.fill(f32::NAN);
                }
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

/// Conventions as text, for readers of `views.json` without this crate.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Conventions {
    /// Camera axes and matrix.
    pub camera: String,
    /// Positions of pixels.
    pub pixels: String,
    /// Definition of depth.
    pub depth: String,
    /// Encoding of colours.
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

/// Background behind the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// White, as in the paper.
    White,
    /// Black.
    Black,
    /// Transparent: the field learns the images' alpha, too. Scores compare premultiplied colours.
    Alpha,
    /// No background: every ray ends on a surface, as in photographs. Training draws a new
    /// background colour for each ray, so that no density can imitate the background.
    Opaque,
}

impl Background {
    /// Returns the grey level behind displayed images: white for a transparent background, the mean
    /// of black and white for gaps in an opaque scene.
    pub fn grey_level(self) -> f32 {
        match self {
            Self::Black => 0.0,
            Self::White | Self::Alpha => 1.0,
            Self::Opaque => 0.5,
        }
    }
}

/// Error returned when `views.json` is invalid.
#[derive(Debug, thiserror::Error)]
#[error("{VIEWS_FILE}: {0}")]
pub struct ViewsError(String);

impl Views {
    /// Creates a list of views with the current conventions.
    pub fn new(background: Background, bounds: Bounds, views: Vec<View>) -> Self {
        Self { conventions: Conventions::default(), background, bounds, views }
    }

    /// Returns the view with a camera's name and pose. Names alone are ambiguous: Blender's
    /// training and test views have the same names.
    pub fn taken_by(&self, camera: &Camera) -> Option<&View> {
        self.views.iter().find(|v| {
            v.camera.name == camera.name && v.camera.camera_to_world == camera.camera_to_world
        })
    }

    /// Reads an image of a view over the displayed background: RGB.
    pub fn read_over(&self, path: &Path) -> Result<Image, PixelError> {
        Ok(read_premultiplied(path)?.over(self.background.grey_level()))
    }

    /// Reads and checks the `views.json` of an input.
    ///
    /// # Errors
    /// [`Failure::BadInput`] that names the file and, for an invalid name or camera, the view.
    pub fn read(input: &GivenInput) -> Result<Self, Failure> {
        let views: Self = input.read_json(VIEWS_FILE)?;
        views.check().bad_input(input.folder().display())?;
        Ok(views)
    }

    /// Reads and checks the `views.json` of a folder.
    ///
    /// # Errors
    /// [`Failure::BadInput`] that names the file and, for an invalid name or camera, the view.
    pub fn read_folder(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(VIEWS_FILE);
        let bytes = std::fs::read(&path).bad_input(path.display())?;
        let views: Self = serde_json::from_slice(&bytes).bad_input(path.display())?;
        views.check().bad_input(path.display())?;
        Ok(views)
    }

    /// Fails for an empty list, invalid cameras, names or paths that leave the folder, and empty
    /// bounds.
    pub fn check(&self) -> Result<(), ViewsError> {
        let refused = |problem| Err(ViewsError(problem));
        if self.views.is_empty() {
            return refused("no views found".to_owned());
        }
        if !self.bounds.is_valid() {
            return refused(format!("bounds {:?} are empty or not finite", self.bounds));
        }
        let mut names = BTreeSet::new();
        for view in &self.views {
            let name = &view.camera.name;
            let is_plain = relative_path(name).is_ok_and(|p| p.components().count() == 1)
                && !name.contains(char::is_control);
            if !is_plain || !names.insert(name) {
                return refused(format!("view name {name:?} is used twice or can't name a file"));
            }
            if let Err(error) = view.camera.check() {
                return refused(format!("view {name:?}: {error}"));
            }
            let View { image, mask, depth, low_resolution, .. } = view;
            for path in [image, mask, depth, low_resolution].into_iter().flatten() {
                if let Err(error) = relative_path(path) {
                    return refused(error.to_string());
                }
                // A terminal would interpret control characters.
                if path.contains(char::is_control) {
                    return refused(format!("{path:?} has control characters"));
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::intrinsics::Intrinsics;

    fn views() -> Views {
        let camera = Camera {
            name: "r_0".into(),
            intrinsics: Intrinsics::from_angle_x(8, 6, 0.7),
            camera_to_world: [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 4.]],
        };
        let bounds = Bounds::cube(1., 2., 6.);
        Views::new(Background::White, bounds, vec![View::camera_only(camera)])
    }

    #[test]
    fn views_are_restored_from_json() {
        let views = views();
        views.check().unwrap();
        let text = serde_json::to_string(&views).unwrap();
        assert_eq!(serde_json::from_str::<Views>(&text).unwrap(), views);
    }

    #[test]
    fn hostile_lists_are_refused() {
        let assert_refused = |views: &Views, reason: &str| {
            let message = views.check().unwrap_err().to_string();
            assert!(message.starts_with(VIEWS_FILE) && message.contains(reason), "{message}");
        };
        let mut v = views();
        v.views.push(v.views[0].clone());
        assert_refused(&v, "is used twice or can't name a file");
        let mut v = views();
        v.views[0].image = Some("../../etc/passwd".into());
        assert_refused(&v, "../../etc/passwd");
        let mut v = views();
        v.views[0].camera.name = "../x".into();
        assert_refused(&v, "is used twice or can't name a file");
        let mut v = views();
        v.views[0].camera.name = "\u{1b}]0;PWN\u{7}".into();
        assert!(!v.check().unwrap_err().to_string().contains(char::is_control));
        let mut v = views();
        v.views[0].image = Some("images/\u{9b}31m.png".into());
        assert!(!v.check().unwrap_err().to_string().contains(char::is_control));
        let mut v = views();
        v.bounds.max[1] = -1.0;
        assert_refused(&v, "are empty or not finite");
        let mut v = views();
        v.views.clear();
        assert_refused(&v, "no views found");
    }
}
