use std::path::Path;

use artifact::Failure;
use pixels::{Channel, PixelError, SampleType, write_exr};

/// Path of a view's image in the output of a stage that renders or changes views: EXR.
pub fn image_file(name: &str) -> String {
    format!("images/{name}.exr")
}

/// Path of the same image for people: PNG, over the background. The runner's `--watch` shows it.
pub fn preview_file(name: &str) -> String {
    format!("previews/{name}.png")
}

/// Path of a view's [mask](crate::View::mask): PNG.
pub fn mask_file(name: &str) -> String {
    format!("masks/{name}.png")
}

/// The channels of a rendered view: colour and opacity, premultiplied; depth; where it was asked
/// for, the distance along the ray.
pub const VIEW_CHANNELS: [Channel; 6] = [
    Channel { name: "R", sample_type: SampleType::Half },
    Channel { name: "G", sample_type: SampleType::Half },
    Channel { name: "B", sample_type: SampleType::Half },
    Channel { name: "A", sample_type: SampleType::Half },
    Channel { name: "Z", sample_type: SampleType::Float },
    Channel { name: "distance", sample_type: SampleType::Float },
];

/// What the file says of them.
const VIEW_NOTE: &str =
    "display-encoded sRGB, premultiplied; Z: camera-space z-depth in scene units";

/// Writes the EXR file of a view. `channels` are some of [`VIEW_CHANNELS`]; `band(first_row, rows,
/// samples)` fills up to 16 rows at a time, as [`write_exr`] has it.
///
/// # Errors
/// [`Failure::Numerical`] with channel and pixel where a sample isn't finite; whatever `band`
/// says; why the file can't be written.
pub fn write_view_image<E: From<Failure> + From<PixelError>>(
    path: &Path,
    size: (usize, usize),
    channels: &[Channel],
    mut band: impl FnMut(usize, usize, &mut [f32]) -> Result<(), E>,
) -> Result<(), E> {
    let written = write_exr(path, size, channels, VIEW_NOTE, |first, rows, samples| {
        band(first, rows, samples).map_err(Stopped::Band)
    });
    written.map_err(|stopped| match stopped {
        Stopped::Pixels(error @ PixelError::NotFinite { .. }) => {
            Failure::Numerical(error.to_string()).into()
        }
        Stopped::Pixels(error) => error.into(),
        Stopped::Band(error) => error,
    })
}

/// Why writing a view ended early.
enum Stopped<E> {
    Pixels(PixelError),
    Band(E),
}

impl<E> From<PixelError> for Stopped<E> {
    fn from(error: PixelError) -> Self {
        Self::Pixels(error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(colour: f32) -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let path = folder.path().join("view.exr");
        write_view_image(&path, (2, 1), &VIEW_CHANNELS[..4], |_, _, samples| {
            samples.fill(colour);
            anyhow::ensure!(colour >= 0.0 || colour.is_nan(), "below black");
            Ok(())
        })
    }

    #[test]
    fn failures_keep_their_kind() {
        written(0.5).unwrap();
        let error = written(f32::NAN).unwrap_err();
        assert!(matches!(error.downcast_ref(), Some(Failure::Numerical(_))), "{error}");
        assert_eq!(written(-1.0).unwrap_err().to_string(), "below black");
    }
}
