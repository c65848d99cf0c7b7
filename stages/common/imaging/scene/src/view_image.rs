use std::path::Path;

use artifact::Failure;
use pixels::{Channel, PixelError, SampleType, check_finite, write_exr};

/// Returns the path of a view's EXR image in the output of a stage that renders or changes views.
pub fn image_file(name: &str) -> String {
    format!("images/{name}.exr")
}

/// Returns the path of a view's PNG preview over the background, which `--watch` displays.
pub fn preview_file(name: &str) -> String {
    format!("previews/{name}.png")
}

/// Returns the path of a view's PNG [mask](crate::View::mask).
pub fn mask_file(name: &str) -> String {
    format!("masks/{name}.png")
}

/// Channels of a rendered view: premultiplied colour, opacity and depth.
pub const VIEW_CHANNELS: [Channel; 5] = [
    Channel { name: "R", sample_type: SampleType::Half },
    Channel { name: "G", sample_type: SampleType::Half },
    Channel { name: "B", sample_type: SampleType::Half },
    Channel { name: "A", sample_type: SampleType::Half },
    Channel { name: "Z", sample_type: SampleType::Float },
];

/// Description of [`VIEW_CHANNELS`] in the file.
const VIEW_NOTE: &str =
    "display-encoded sRGB, premultiplied; Z: camera-space z-depth in scene units";

/// Writes the EXR file of a view. `channels` is a subset of [`VIEW_CHANNELS`]; `band(first_row,
/// rows, samples)` fills up to 16 rows at a time, as for [`write_exr`].
///
/// # Errors
/// [`Failure::Numerical`] with channel and pixel if a sample isn't finite; errors of `band`; errors
/// of writing the file.
pub fn write_view_image<E: From<Failure> + From<PixelError>>(
    path: &Path,
    size: (usize, usize),
    channels: &[Channel],
    mut band: impl FnMut(usize, usize, &mut [f32]) -> Result<(), E>,
) -> Result<(), E> {
    write_exr(path, size, channels, VIEW_NOTE, |first, rows, samples| {
        band(first, rows, samples)?;
        check_finite(path, channels, size.0, first, samples)
            .map_err(|error| Failure::Numerical(error.to_string()).into())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Writes an image of one colour; fails for a negative colour.
    fn write_image(colour: f32) -> anyhow::Result<()> {
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
        write_image(0.5).unwrap();
        let error = write_image(f32::NAN).unwrap_err();
        assert!(matches!(error.downcast_ref(), Some(Failure::Numerical(_))), "{error}");
        assert_eq!(write_image(-1.0).unwrap_err().to_string(), "below black");
    }
}
