use artifact::{FailureExt as _, GivenInput, bail_bad_input};
use pixels::Image;
use scene::{Camera, Photograph, Views};

/// Photographs enlarged by single-image super-resolution.
pub(crate) struct EnlargedPhotographs<'a> {
    input: &'a GivenInput,
    views: Views,
}

impl<'a> EnlargedPhotographs<'a> {
    pub(crate) fn read(input: &'a GivenInput) -> anyhow::Result<Self> {
        Ok(Self { input, views: Views::read(input)? })
    }

    /// True if a camera has an enlarged photograph.
    pub(crate) fn has(&self, camera: &Camera) -> bool {
        self.views.taken_by(camera).is_some_and(|view| view.image.is_some())
    }

    /// Averages an image with the same camera's enlarged photograph, if any. Pixels that the mask
    /// excludes stay unchanged.
    pub(crate) fn average_with(&self, mut image: Image, camera: &Camera) -> anyhow::Result<Image> {
        let Some(view) = self.views.taken_by(camera) else { return Ok(image) };
        let name = format!("input enlarged: view {}", camera.name);
        let Some(photograph) = view.read_photograph(self.input).bad_input(&name)? else {
            return Ok(image);
        };
        let Photograph { image: mut other, mask } =
            photograph.over(self.views.background.grey_level());
        if (other.width, other.height) != (image.width, image.height) {
            bail_bad_input!(
                "{name}: {}×{} pixels, but the view to refine has {}×{}",
                other.width,
                other.height,
                image.width,
                image.height
            );
        }
        if let Some(mask) = mask {
            mask.fill(&mut other, &image);
        }
        for (i, sample) in image.data.iter_mut().enumerate() {
            *sample = 0.5 * (*sample + other.data[i]);
        }
        Ok(image)
    }
}

#[cfg(test)]
mod tests {
    use artifact::{Failure, write_json};
    use pixels::{Mask, Rgba8, write_png};
    use scene::{Background, Bounds, Intrinsics, VIEWS_FILE, View};

    use super::*;

    fn camera(name: &str, x: f64) -> Camera {
        Camera {
            name: name.to_owned(),
            intrinsics: Intrinsics::from_angle_x(2, 1, 0.7),
            camera_to_world: [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]],
        }
    }

    /// Writes three views. `whole` has a pixel of level 0.2 and a transparent pixel on white.
    /// `masked` has the same image, but its second pixel doesn't count. `empty` has no image.
    fn views_folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let image = Rgba8::new(2, 1, vec![51, 51, 51, 255, 0, 0, 0, 0]);
        write_png(&folder.path().join("image.png"), &image).unwrap();
        let mask = Mask { width: 2, height: 1, counts: vec![true, false] };
        write_png(&folder.path().join("mask.png"), &mask.to_rgba8()).unwrap();
        let camera_only = |name: &str| View::camera_only(camera(name, 0.0));
        let whole = View { image: Some("image.png".to_owned()), ..camera_only("whole") };
        let masked = View {
            image: Some("image.png".to_owned()),
            mask: Some("mask.png".to_owned()),
            ..camera_only("masked")
        };
        let bounds = Bounds::cube(1.0, 2.0, 6.0);
        let views =
            Views::new(Background::White, bounds, vec![whole, masked, camera_only("empty")]);
        write_json(&folder.path().join(VIEWS_FILE), &views).unwrap();
        folder
    }

    #[test]
    fn pixels_that_count_are_averaged() {
        let folder = views_folder();
        let input = GivenInput::open("enlarged", folder.path()).unwrap();
        let enlarged = EnlargedPhotographs::read(&input).unwrap();
        let image = Image::new(2, 1, 3, vec![0.4, 0.4, 0.4, 0.5, 0.5, 0.5]);
        // The last two cases have another pose and another name.
        let cases: [(&str, f64, [f32; 2]); 5] = [
            ("whole", 0.0, [0.3, 0.75]),
            ("masked", 0.0, [0.3, 0.5]),
            ("empty", 0.0, [0.4, 0.5]),
            ("whole", 1.0, [0.4, 0.5]),
            ("other", 0.0, [0.4, 0.5]),
        ];
        for (name, x, [first, second]) in cases {
            let mean = enlarged.average_with(image.clone(), &camera(name, x)).unwrap();
            let expected = [first, first, first, second, second, second];
            let is_near = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-6;
            assert!(mean.data.iter().zip(&expected).all(is_near), "{name}: {:?}", mean.data);
        }
        assert!(enlarged.has(&camera("whole", 0.0)));
        assert!(!enlarged.has(&camera("whole", 1.0)) && !enlarged.has(&camera("other", 0.0)));
    }

    #[test]
    fn another_size_is_refused() {
        let folder = views_folder();
        let input = GivenInput::open("enlarged", folder.path()).unwrap();
        let enlarged = EnlargedPhotographs::read(&input).unwrap();
        let image = Image::new(3, 1, 3, vec![0.5; 9]);
        let error = enlarged.average_with(image, &camera("whole", 0.0)).unwrap_err();
        assert!(matches!(error.downcast_ref(), Some(Failure::BadInput(_))), "{error}");
        assert_eq!(
            error.to_string(),
            "input enlarged: view whole: 2×1 pixels, but the view to refine has 3×1"
        );
    }
}
