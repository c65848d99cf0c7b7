use std::path::Path;

use artifact::{Failure, GivenInput};
use pixels::{Channel, ExrImage, Image, write_png};
use refinement::{KnownView, LrObservations, Rendered, Use};
use scene::{Photograph, VIEW_CHANNELS, View, write_view_image};
use serde::{Deserialize, Serialize};
use stage::Context;

use crate::enlarged::Enlarged;
use crate::network::{AnyRefiner, Application};

/// A rendered view, and its file's channels.
pub(crate) fn read_view(
    input: &GivenInput,
    view: &View,
    background: f32,
) -> Result<(Rendered, ExrImage), Failure> {
    Rendered::read(input, view, background)?.ok_or_else(|| {
        Failure::BadInput(format!(
            "input {}: view {}: it has no image",
            input.name(),
            view.camera.name
        ))
    })
}

/// How a view was refined.
#[derive(Serialize, Deserialize)]
pub(crate) struct RefinedView {
    /// Whether it was made consistent with its own LR observation.
    #[serde(rename = "agreed")]
    pub(crate) is_consistent: bool,
    /// What each reference was of use for.
    pub(crate) uses: Vec<Use>,
}

/// What all views share.
pub(crate) struct RefineJob<'a> {
    pub(crate) context: &'a Context,
    pub(crate) input: &'a GivenInput,
    pub(crate) background: f32,
    pub(crate) network: AnyRefiner,
    pub(crate) application: Application,
    pub(crate) photographs: Option<LrObservations<'a>>,
    pub(crate) enlarged: Option<Enlarged<'a>>,
    /// Whether the network was trained on views that are consistent with their own LR observations.
    pub(crate) takes_consistent: bool,
}

impl RefineJob<'_> {
    /// Refines one view and writes its files.
    pub(crate) fn refine(
        &self,
        view: &View,
        references: &[KnownView],
        [image, preview]: [&str; 2],
    ) -> anyhow::Result<RefinedView> {
        let (rendered, file, own) = self.shown(view)?;
        let mut uses = vec![Use::default(); references.len()];
        let redrawn = self.network.redraw(&rendered, references, &self.application, &mut uses)?;
        let mean = match &self.enlarged {
            Some(enlarged) => enlarged.mean(redrawn, &view.camera)?,
            None => redrawn,
        };
        let refined = self.make_consistent(mean, own.as_ref());
        let path = self.context.output_path(image)?;
        write_recoloured(&path, &file, &refined, &rendered.opacity, self.background)?;
        write_png(&self.context.output_path(preview)?, &refined.to_rgba8())?;
        Ok(RefinedView { is_consistent: own.is_some(), uses })
    }

    /// A view as the network takes it, its file's channels, and its own photograph.
    pub(crate) fn shown(
        &self,
        view: &View,
    ) -> Result<(Rendered, ExrImage, Option<Photograph>), Failure> {
        let (rendered, image) = read_view(self.input, view, self.background)?;
        let own = match &self.photographs {
            Some(photographs) => photographs.photograph(&view.camera)?,
            None => None,
        };
        if !self.takes_consistent {
            return Ok((rendered, image, own));
        }
        let colours = self.make_consistent(rendered.colours(), own.as_ref());
        Ok((rendered.with_colours(&colours), image, own))
    }

    /// An image of a view that is consistent with its own LR observation, where there is one.
    fn make_consistent(&self, image: Image, own: Option<&Photograph>) -> Image {
        match self.photographs.as_ref().zip(own) {
            Some((photographs, own)) => photographs.project(&image, own),
            None => image,
        }
    }
}

/// Writes a view's file with other colours, composited on the background; its other channels stay.
fn write_recoloured(
    path: &Path,
    image: &ExrImage,
    refined: &Image,
    opacity: &[f32],
    background: f32,
) -> anyhow::Result<()> {
    // None where a channel is a colour.
    let kept: Vec<(Channel, Option<&[f32]>)> = VIEW_CHANNELS
        .into_iter()
        .enumerate()
        .filter_map(|(i, channel)| {
            Some((channel, image.channel(channel.name).map(|s| (i >= 3).then_some(s))?))
        })
        .collect();
    let channels: Vec<Channel> = kept.iter().map(|(c, _)| *c).collect();
    let size = (image.width, image.height);
    write_view_image(path, size, &channels, |first, rows, samples| {
        let pixels = first * image.width..(first + rows) * image.width;
        for (i, sample) in pixels.zip(samples.chunks_exact_mut(kept.len())) {
            for (c, (value, (_, same))) in sample.iter_mut().zip(&kept).enumerate() {
                *value = same.map_or_else(
                    || refined.data[i * 3 + c] - (1.0 - opacity[i]) * background,
                    |s| s[i],
                );
            }
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use pixels::read_exr;

    use super::*;

    /// Two pixels, the second half transparent.
    fn rendered(folder: &Path) -> ExrImage {
        let path = folder.join("rendered.exr");
        let pixels = [[0.5, 0.25, 0.125, 1.0, 2.0, 2.5], [0.25, 0.25, 0.25, 0.5, 3.0, 3.5]];
        write_view_image(&path, (2, 1), &VIEW_CHANNELS, |_, _, samples| {
            samples.copy_from_slice(pixels.as_flattened());
            anyhow::Ok(())
        })
        .unwrap();
        read_exr(&path).unwrap()
    }

    #[test]
    fn colours_change_and_other_channels_stay() {
        let folder = tempfile::tempdir().unwrap();
        let before = rendered(folder.path());
        let path = folder.path().join("refined.exr");
        let refined = Image::new(2, 1, 3, vec![0.75, 0.5, 0.25, 0.75, 1.0, 0.5]);
        write_recoloured(&path, &before, &refined, &[1.0, 0.5], 1.0).unwrap();
        let after = read_exr(&path).unwrap();
        for channel in VIEW_CHANNELS.iter().skip(3) {
            assert_eq!(after.channel(channel.name), before.channel(channel.name), "{channel:?}");
        }
        // On white, half of the second pixel is background.
        assert_eq!(after.channel("R").unwrap(), [0.75, 0.25]);
        assert_eq!(after.channel("G").unwrap(), [0.5, 0.5]);
        assert_eq!(after.premultiplied().unwrap().over(1.0).data, refined.data);
    }

    #[test]
    fn colours_that_are_not_finite_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let before = rendered(folder.path());
        let refined = Image::new(2, 1, 3, vec![0.5, f32::NAN, 0.5, 0.5, 0.5, 0.5]);
        let path = folder.path().join("refined.exr");
        let error = write_recoloured(&path, &before, &refined, &[1.0, 0.5], 1.0).unwrap_err();
        assert!(matches!(error.downcast_ref(), Some(Failure::Numerical(_))), "{error}");
    }
}
