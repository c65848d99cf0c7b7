use artifact::{WARNING, counted};
use scene::Intrinsics;

use crate::error::DatasetError;
use crate::file_reason::FileReason;
use crate::format::Format;
use crate::frame::Frame;
use crate::split::Split;
use crate::turn::Turn;

/// Posed photographs.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// How the folder has them.
    pub format: Format,
    /// All of them: in the file's order, or by name where a file has none.
    pub frames: Vec<Frame>,
    /// What the folder itself says of which are for training and which for testing.
    pub split: Option<Split>,
    /// What was found and chosen, a line each, for people.
    pub notes: Vec<String>,
}

impl Dataset {
    /// All frames together, whatever the folder itself says of their use. Blender's training and
    /// test views have the same names: then the one for testing is called `test_NAME`.
    #[must_use]
    pub fn merged(mut self) -> Self {
        let split = self.split.take().unwrap_or_default();
        let mut taken: std::collections::BTreeSet<String> =
            split.train.iter().map(|&i| self.frames[i].name.clone()).collect();
        for &i in &split.test {
            let name = &mut self.frames[i].name;
            while !taken.insert(name.clone()) {
                *name = format!("test_{name}");
            }
        }
        self
    }

    /// Has rays follow the lenses. The pixels for which a lens has no ray are masked, and counted.
    #[must_use]
    pub fn followed(mut self) -> Self {
        let mut known: Vec<(Intrinsics, usize)> = Vec::new();
        let (mut pixels, mut photographs) = (0, 0);
        for frame in &self.frames {
            let lens = frame.intrinsics();
            let cut = match known.iter().find(|(other, _)| *other == lens) {
                Some((_, cut)) => *cut,
                None => {
                    let counts = lens.lens_mask().map(|mask| mask.counts).unwrap_or_default();
                    let cut = counts.iter().filter(|counts| !**counts).count();
                    known.push((lens, cut));
                    cut
                }
            };
            pixels += cut;
            photographs += usize::from(cut > 0);
        }
        if pixels > 0 {
            self.notes.push(format!(
                "{} of {} are more than 89° from the axis of a fisheye lens and are masked",
                counted(pixels, "pixel"),
                counted(photographs, "photograph")
            ));
        }
        self
    }

    /// Has images read with their lens's distortion undone: resampled to what pinhole cameras would
    /// have taken, of the same size, with a border cut off where the lens saw no more. Of a fisheye
    /// lens's view at most 100° across remain.
    pub fn undistorted(mut self) -> Result<Self, DatasetError> {
        let (mut undone, mut angles) = (0, Vec::new());
        for frame in self.frames.iter_mut().filter(|f| !f.taken_with.distortion.is_none()) {
            let pinhole = frame.taken_with.pinhole().ok_or_else(|| {
                let reason = FileReason::Distortion(frame.taken_with.distortion);
                DatasetError::format(&frame.image, reason)
            })?;
            frame.pinhole = Some(pinhole);
            if frame.taken_with.distortion.is_fisheye() {
                angles.push(pinhole.pinhole_angles());
            } else {
                undone += 1;
            }
        }
        self.notes.extend(angles_note(&angles));
        if undone > 0 {
            self.notes
                .push(format!("lens distortion of {} is undone", counted(undone, "photograph")));
        }
        Ok(self)
    }

    /// Takes all lenses for free of distortion.
    #[must_use]
    pub fn without_distortion(mut self) -> Self {
        let mut ignored = 0;
        for frame in self.frames.iter_mut().filter(|f| !f.taken_with.distortion.is_none()) {
            frame.taken_with.distortion = scene::Distortion::default();
            ignored += 1;
        }
        if ignored > 0 {
            self.notes
                .push(format!("lens distortion of {} is ignored", counted(ignored, "photograph")));
        }
        self
    }

    /// Removes a uniform scale from the rotations of poses, and warns of it. Centres stay: they are
    /// where the program that wrote the poses meant cameras to be.
    pub(crate) fn remove_scales(&mut self) {
        let (mut count, mut least, mut largest) = (0, f64::INFINITY, 0.0f64);
        for frame in &mut self.frames {
            if let Some((rigid, scale)) = scene::without_scale(&frame.camera_to_world) {
                frame.camera_to_world = rigid;
                count += 1;
                (least, largest) = (least.min(scale), largest.max(scale));
            }
        }
        if count > 0 {
            let [least, largest] = [least, largest].map(four_digits);
            let range = if least == largest { least } else { format!("{least} to {largest}") };
            self.notes.push(format!(
                "{WARNING}rotations of {count} of {} have a scale of {range}, which is removed; \
                centres stay",
                counted(self.frames.len(), "view")
            ));
        }
    }

    /// Says what is done to images that aren't all alike, upright and from a pinhole.
    pub(crate) fn note_what_is_special(&mut self) {
        let count = |is: &dyn Fn(&Frame) -> bool| self.frames.iter().filter(|f| is(f)).count();
        let fisheye = count(&|f| f.taken_with.distortion.is_fisheye());
        let (distorted, turned) = (
            count(&|f| !f.taken_with.distortion.is_none()) - fisheye,
            count(&|f| f.turn == Turn::Upright),
        );
        let assumed = count(&|f| f.turn == Turn::Assumed);
        let size = |f: &Frame| (f.taken_with.width, f.taken_with.height);
        let sizes: std::collections::BTreeSet<_> = self.frames.iter().map(size).collect();
        if distorted > 0 {
            let have = if distorted == 1 { "has" } else { "have" };
            self.notes.push(format!("{} {have} lens distortion", counted(distorted, "photograph")));
        }
        if fisheye > 0 {
            let were = if fisheye == 1 { "was" } else { "were" };
            self.notes.push(format!(
                "{} {were} taken with a fisheye lens",
                counted(fisheye, "photograph")
            ));
        }
        if turned > 0 {
            let are = if turned == 1 { "is" } else { "are" };
            self.notes.push(format!(
                "{} {are} turned upright, as EXIF data ask",
                counted(turned, "photograph")
            ));
        }
        if assumed > 0 {
            let have = if assumed == 1 { "has" } else { "have" };
            self.notes.push(format!(
                "{} {have} an EXIF orientation that the camera's width and height neither confirm \
                nor contradict; assumed: poses are those of the image as stored",
                counted(assumed, "photograph")
            ));
        }
        if let (Some(first), Some(last), true) = (sizes.first(), sizes.last(), sizes.len() > 1) {
            let text = |(w, h): &(u32, u32)| format!("{w}×{h}");
            self.notes.push(format!(
                "photographs of {} sizes, from {} to {}",
                sizes.len(),
                text(first),
                text(last)
            ));
        }
    }
}

/// Formats a number with at most four significant digits.
fn four_digits(value: f64) -> String {
    let rounded = format!("{value:.3e}").parse().unwrap_or(value);
    format!("{rounded:?}")
}

/// Describes the pinhole cameras in place of fisheye cameras, by their angles of view.
fn angles_note(angles: &[[f64; 2]]) -> Option<String> {
    let first = angles.first()?;
    let [mut narrowest, mut widest] = [first, first];
    for angles in angles {
        narrowest = if angles[0] < narrowest[0] { angles } else { narrowest };
        widest = if angles[0] > widest[0] { angles } else { widest };
    }
    let text = |[across, down]: &[f64; 2]| format!("{across:.1}°×{down:.1}°");
    let range = if text(narrowest) == text(widest) {
        text(widest)
    } else {
        format!("{} to {}", text(narrowest), text(widest))
    };
    let photographs = counted(angles.len(), "fisheye photograph");
    let (are, cameras) = if angles.len() == 1 {
        ("is", "a pinhole camera that sees")
    } else {
        ("are", "pinhole cameras that see")
    };
    Some(format!(
        "{photographs} {are} resampled for {cameras} {range}; what lies beyond is cut off"
    ))
}

#[cfg(test)]
mod tests {
    use pixels::Rgba8;

    use super::*;

    const POSE: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";

    /// Three views of 40×30 pixels with fisheye lenses that see 200°, 200° and 100° across; the
    /// second has a mask that leaves the left half out.
    fn fisheye_set(folder: &std::path::Path) -> Dataset {
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
        let half = |i: usize| if i % 40 < 20 { [0, 0, 0, 255] } else { [255; 4] };
        let mask = Rgba8::new(40, 30, (0..40 * 30).flat_map(half).collect());
        pixels::write_png(&folder.join("mask.png"), &mask).unwrap();
        let text = format!(r#"{{"frames": [{}]}}"#, frames.join(","));
        std::fs::write(folder.join("transforms.json"), text).unwrap();
        Dataset::read(folder).unwrap()
    }

    /// What a lens has no ray for is left out, in addition to what a mask leaves out.
    #[test]
    fn masks_of_lenses_join_those_of_the_data() {
        let dir = tempfile::tempdir().unwrap();
        let set = fisheye_set(dir.path()).followed();
        let is_cut = |i: usize| {
            let (x, y) = ((i % 40) as f64 - 19.5, (i / 40) as f64 - 14.5);
            x.hypot(y) / 40.0 * 200.0 >= 89.0
        };
        let [a, b, c] = &set.frames[..] else { panic!("three frames") };
        let whole = a.mask().unwrap().unwrap();
        let half = b.mask().unwrap().unwrap();
        assert!(c.mask().unwrap().is_none());
        assert_eq!([a, b, c].map(Frame::is_masked), [true, true, false]);
        for i in 0..40 * 30 {
            assert_eq!(whole.counts[i], !is_cut(i), "{i}");
            assert_eq!(half.counts[i], !is_cut(i) && i % 40 >= 20, "{i}");
        }
        let cut = (0..40 * 30).filter(|i| is_cut(*i)).count();
        assert!(set.notes.contains(&"3 photographs were taken with a fisheye lens".to_owned()));
        let said = format!(
            "{} pixels of 2 photographs are more than 89° from the axis of a fisheye lens and are \
            masked",
            2 * cut
        );
        assert!(set.notes.contains(&said), "{said}: {:?}", set.notes);
    }

    #[test]
    fn undone_fisheye_lenses_have_a_known_angle() {
        let dir = tempfile::tempdir().unwrap();
        let set = fisheye_set(dir.path()).undistorted().unwrap();
        let said = "3 fisheye photographs are resampled for pinhole cameras that see 91.3°×75.0° to \
            100.0°×83.6°; what lies beyond is cut off";
        assert_eq!(set.notes.last().unwrap(), said);
        assert!(set.frames[0].mask().unwrap().is_none() && set.frames[1].is_masked());
    }
}
