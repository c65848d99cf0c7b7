use artifact::counted;

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

    /// Has images read with their lens's distortion undone: resampled to what pinhole cameras would
    /// have taken, of the same size, with a border cut off where the lens saw no more.
    pub fn undistorted(mut self) -> Result<Self, DatasetError> {
        let mut undone = 0;
        for frame in self.frames.iter_mut().filter(|f| !f.taken_with.distortion.is_none()) {
            undone += 1;
            let pinhole = frame.taken_with.pinhole().ok_or_else(|| {
                let reason = FileReason::Distortion(frame.taken_with.distortion);
                DatasetError::format(&frame.image, reason)
            })?;
            frame.pinhole = Some(pinhole);
        }
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

    /// Says what is done to images that aren't all alike, upright and from a pinhole.
    pub(crate) fn note_what_is_special(&mut self) {
        let count = |is: &dyn Fn(&Frame) -> bool| self.frames.iter().filter(|f| is(f)).count();
        let (distorted, turned) =
            (count(&|f| !f.taken_with.distortion.is_none()), count(&|f| f.turn == Turn::Upright));
        let assumed = count(&|f| f.turn == Turn::Assumed);
        let size = |f: &Frame| (f.taken_with.width, f.taken_with.height);
        let sizes: std::collections::BTreeSet<_> = self.frames.iter().map(size).collect();
        if distorted > 0 {
            let have = if distorted == 1 { "has" } else { "have" };
            self.notes.push(format!("{} {have} lens distortion", counted(distorted, "photograph")));
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
