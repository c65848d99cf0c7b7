use std::collections::BTreeSet;

use artifact::{WARNING, format_count};
use scene::{Camera, Intrinsics};

use crate::error::DatasetError;
use crate::file_status::path_text;
use crate::format::Format;
use crate::frame::{Frame, Turn};
use crate::split::Split;
use crate::text::counted_with_verb;

/// Posed photographs of a folder.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// Format of the folder.
    pub format: Format,
    /// All frames, in the order of the file that lists them, or by name if none does.
    pub frames: Vec<Frame>,
    /// The folder's own split into training and test views.
    pub split: Option<Split>,
    /// Human-readable findings and choices, one per line.
    pub notes: Vec<String>,
}

impl Dataset {
    /// Removes the folder's own split. A test view with the name of a training view, as in Blender
    /// scenes, is renamed `test_NAME`.
    #[must_use]
    pub fn without_split(mut self) -> Self {
        let split = self.split.take().unwrap_or_default();
        let mut taken: BTreeSet<String> =
            split.train.iter().map(|&i| self.frames[i].name.clone()).collect();
        for &i in &split.test {
            let name = &mut self.frames[i].name;
            while !taken.insert(name.clone()) {
                *name = format!("test_{name}");
            }
        }
        self
    }

    /// Adds a note on the pixels that are masked because their lens has no ray for them. For data
    /// sets that keep their lens distortion.
    #[must_use]
    pub fn with_lens_mask_note(mut self) -> Self {
        let mut known: Vec<(Intrinsics, usize)> = Vec::new();
        let (mut pixels, mut photographs) = (0, 0);
        for frame in &self.frames {
            let lens = frame.intrinsics();
            let masked_pixels = match known.iter().find(|(other, _)| *other == lens) {
                Some((_, masked_pixels)) => *masked_pixels,
                None => {
                    let has_ray = lens.lens_mask().map(|mask| mask.counts).unwrap_or_default();
                    let masked_pixels = has_ray.iter().filter(|has_ray| !**has_ray).count();
                    known.push((lens, masked_pixels));
                    masked_pixels
                }
            };
            pixels += masked_pixels;
            photographs += usize::from(masked_pixels > 0);
        }
        if pixels > 0 {
            self.notes.push(format!(
                "{} of {} are more than 89° from the axis of a fisheye lens and are masked",
                format_count(pixels, "pixel"),
                format_count(photographs, "photograph")
            ));
        }
        self
    }

    /// Makes images be read without lens distortion: resampled to pinhole cameras of the same size,
    /// which crops their border. The pinhole camera that replaces a fisheye lens has a field of
    /// view of at most 100°.
    pub fn undistorted(mut self) -> Result<Self, DatasetError> {
        let (mut undistorted, mut angles) = (0, Vec::new());
        for frame in self.frames.iter_mut().filter(|f| f.has_distortion()) {
            let distortion = frame.lens_intrinsics.distortion;
            let pinhole = frame.lens_intrinsics.pinhole().ok_or_else(|| {
                DatasetError::Invalid(format!(
                    "{}: lens distortion {distortion} leaves no pinhole image; are its \
                    coefficients right?",
                    path_text(&frame.image)
                ))
            })?;
            frame.pinhole = Some(pinhole);
            if distortion.is_fisheye() {
                frame.depth_range =
                    frame.depth_range.map(|range| depths_of(range, &frame.camera()));
                angles.push(pinhole.pinhole_angles());
            } else {
                undistorted += 1;
            }
        }
        self.notes.extend(angles_note(&angles));
        if undistorted > 0 {
            let count = format_count(undistorted, "photograph");
            self.notes.push(format!("lens distortion of {count} is removed"));
        }
        Ok(self)
    }

    /// Removes a uniform scale from the rotations of poses, with a warning. Centres are unchanged:
    /// the program that wrote the poses placed the cameras there.
    pub(crate) fn remove_scales(&mut self) {
        let (mut count, mut smallest, mut largest) = (0, f64::INFINITY, 0.0f64);
        for frame in &mut self.frames {
            if let Some((rigid, scale)) = scene::without_scale(&frame.camera_to_world) {
                frame.camera_to_world = rigid;
                count += 1;
                smallest = smallest.min(scale);
                largest = largest.max(scale);
            }
        }
        if count > 0 {
            let range = range_text([smallest, largest].map(with_four_digits));
            self.notes.push(format!(
                "{WARNING}rotations of {count} of {} have a scale of {range}, which is removed; \
                centres are unchanged",
                format_count(self.frames.len(), "view")
            ));
        }
    }

    /// Adds notes on lens distortion, EXIF orientations and differing sizes.
    pub(crate) fn add_image_notes(&mut self) {
        let frames = &self.frames;
        let fisheye = frames.iter().filter(|f| f.lens_intrinsics.distortion.is_fisheye()).count();
        let distorted = frames.iter().filter(|f| f.has_distortion()).count() - fisheye;
        let upright = frames.iter().filter(|f| f.turn == Turn::Upright).count();
        let assumed = frames.iter().filter(|f| f.turn == Turn::AssumedStored).count();
        for (count, verbs, text) in [
            (distorted, ["has", "have"], "lens distortion"),
            (fisheye, ["was", "were"], "taken with a fisheye lens"),
            (upright, ["is", "are"], "turned upright, as EXIF data require"),
            (
                assumed,
                ["has", "have"],
                "an EXIF orientation that the camera's width and height neither confirm nor \
                contradict; assuming that poses refer to the stored image",
            ),
        ] {
            if count > 0 {
                let subject = counted_with_verb(count, "photograph", verbs);
                self.notes.push(format!("{subject} {text}"));
            }
        }
        let lenses = self.frames.iter().map(|frame| frame.lens_intrinsics);
        let sizes: BTreeSet<(u32, u32)> = lenses.map(|k| (k.width, k.height)).collect();
        if let (Some((w, h)), Some((width, height))) = (sizes.first(), sizes.last())
            && sizes.len() > 1
        {
            let count = sizes.len();
            self.notes
                .push(format!("photographs have {count} sizes, from {w}×{h} to {width}×{height}"));
        }
    }
}

/// Converts the range of points' distances from a pinhole camera to a range that contains their
/// depths. Of points at one distance, a point in a corner of the view has the least depth.
fn depths_of([nearest, farthest]: [f64; 2], camera: &Camera) -> [f64; 2] {
    let slopes =
        camera.intrinsics.border().map(|[x, y]| camera.depth_per_distance(&camera.ray(x, y)));
    [nearest * slopes.fold(1.0, f64::min), farthest]
}

/// Formats the range between two numbers, which may be equal.
fn range_text([from, to]: [String; 2]) -> String {
    if from == to { to } else { format!("{from} to {to}") }
}

/// Formats a number with at most four significant digits.
fn with_four_digits(value: f64) -> String {
    let rounded = format!("{value:.3e}").parse().unwrap_or(value);
    format!("{rounded:?}")
}

/// Describes the pinhole cameras in place of fisheye cameras, by their fields of view in degrees.
fn angles_note(angles: &[[f64; 2]]) -> Option<String> {
    let narrowest = angles.iter().min_by(|a, b| a[0].total_cmp(&b[0]))?;
    let widest = angles.iter().max_by(|a, b| a[0].total_cmp(&b[0]))?;
    let range =
        range_text([narrowest, widest].map(|[across, down]| format!("{across:.1}°×{down:.1}°")));
    let subject = counted_with_verb(angles.len(), "fisheye photograph", ["is", "are"]);
    let cameras = if angles.len() == 1 { "a pinhole camera" } else { "pinhole cameras" };
    Some(format!(
        "{subject} resampled to {cameras} with a field of view of {range}; the rest is cropped"
    ))
}

#[cfg(test)]
mod tests {
    use pixels::Rgba8;

    use super::*;

    const POSE: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";

    /// Writes and reads three views of 40×30 pixels through fisheye lenses with fields of view of
    /// 200°, 200° and 100°. The second view's mask excludes the left half.
    fn write_fisheye_dataset(folder: &std::path::Path) -> Dataset {
        let focal = |degrees: f64| 40.0 / degrees.to_radians();
        let mut frames = Vec::new();
        for (name, degrees) in [("a", 200.0), ("b", 200.0), ("c", 100.0)] {
            let mask = if name == "b" { r#""mask_path": "mask.png","# } else { "" };
            frames.push(format!(
                r#"{{"file_path": "{name}.png", {mask} "fl_x": {}, "is_fisheye": true,
                    "transform_matrix": {POSE}}}"#,
                focal(degrees)
            ));
            let image = Rgba8::new(40, 30, vec![255; 4 * 40 * 30]);
            pixels::write_png(&folder.join(format!("{name}.png")), &image).unwrap();
        }
        let right_half = |i: usize| if i % 40 < 20 { [0, 0, 0, 255] } else { [255; 4] };
        let mask = Rgba8::new(40, 30, (0..40 * 30).flat_map(right_half).collect());
        pixels::write_png(&folder.join("mask.png"), &mask).unwrap();
        let text = format!(r#"{{"frames": [{}]}}"#, frames.join(","));
        std::fs::write(folder.join("transforms.json"), text).unwrap();
        Dataset::read(folder).unwrap()
    }

    /// Pixels without a ray are masked, in addition to those that a view's mask excludes.
    #[test]
    fn lens_masks_combine_with_given_masks() {
        let dir = tempfile::tempdir().unwrap();
        let set = write_fisheye_dataset(dir.path()).with_lens_mask_note();
        let is_outside_lens = |i: usize| {
            let (x, y) = ((i % 40) as f64 - 19.5, (i / 40) as f64 - 14.5);
            x.hypot(y) / 40.0 * 200.0 >= 89.0
        };
        let [a, b, c] = &set.frames[..] else { panic!("three frames") };
        let lens_mask = a.mask().unwrap().unwrap();
        let combined_mask = b.mask().unwrap().unwrap();
        assert!(c.mask().unwrap().is_none());
        assert_eq!([a, b, c].map(Frame::is_masked), [true, true, false]);
        for i in 0..40 * 30 {
            assert_eq!(lens_mask.counts[i], !is_outside_lens(i), "{i}");
            assert_eq!(combined_mask.counts[i], !is_outside_lens(i) && i % 40 >= 20, "{i}");
        }
        let count = (0..40 * 30).filter(|i| is_outside_lens(*i)).count();
        assert!(set.notes.contains(&"3 photographs were taken with a fisheye lens".to_owned()));
        let note = format!(
            "{} pixels of 2 photographs are more than 89° from the axis of a fisheye lens and are \
            masked",
            2 * count
        );
        assert!(set.notes.contains(&note), "{note}: {:?}", set.notes);
    }

    #[test]
    fn undistorted_fisheye_lenses_report_their_field_of_view() {
        let dir = tempfile::tempdir().unwrap();
        let mut set = write_fisheye_dataset(dir.path());
        set.frames[1].depth_range = Some([2.0, 10.0]);
        let set = set.undistorted().unwrap();
        // A point at distance 2 in a corner of the pinhole's view has the least depth.
        let [nearest, farthest] = set.frames[1].depth_range.unwrap();
        let pinhole = set.frames[1].intrinsics();
        let corner = [20.0 / pinhole.fx, 15.0 / pinhole.fy, 1.0];
        let length = corner.iter().map(|x| x * x).sum::<f64>().sqrt();
        assert!((nearest - 2.0 / length).abs() < 1e-9 && farthest == 10.0, "{nearest} {farthest}");
        let note = "3 fisheye photographs are resampled to pinhole cameras with a field of view of \
            91.3°×75.0° to 100.0°×83.6°; the rest is cropped";
        assert_eq!(set.notes.last().unwrap(), note);
        assert!(set.frames[0].mask().unwrap().is_none() && set.frames[1].is_masked());
    }
}
