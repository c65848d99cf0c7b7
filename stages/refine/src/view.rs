use std::path::Path;

use artifact::{Failure, GivenInput};
use pixels::{Channel, ExrImage, Image, write_png};
use refinement::{KnownView, LrObservations, ReferenceStatistics, Rendered};
use scene::{Photograph, VIEW_CHANNELS, View, write_view_image};
use serde::{Deserialize, Serialize};
use stage::Context;

use crate::enlarged::EnlargedPhotographs;
use crate::network::{AnyRefiner, RefinementOptions};

/// Reads a rendered view, and all channels of its file. Fails if the view has no depth and
/// `needs_depth` is true.
pub(crate) fn read_view(
    input: &GivenInput,
    view: &View,
    background: f32,
    needs_depth: bool,
) -> Result<(Rendered, ExrImage), Failure> {
    Rendered::read(input, view, background, needs_depth)?.ok_or_else(|| {
        Failure::BadInput(format!("input {}: view {} has no image", input.name(), view.camera.name))
    })
}

/// Result of refining a view, which is stored for a resumed run.
#[derive(Serialize, Deserialize)]
pub(crate) struct RefinedView {
    /// True if the view was made consistent with its own LR photograph.
    pub(crate) is_consistent: bool,
    /// Statistics of each reference.
    pub(crate) statistics: Vec<ReferenceStatistics>,
}

/// Settings and inputs of all views.
pub(crate) struct RefineJob<'a> {
    pub(crate) context: &'a Context,
    pub(crate) views_input: &'a GivenInput,
    pub(crate) background: f32,
    pub(crate) network: AnyRefiner,
    pub(crate) options: RefinementOptions,
    pub(crate) photographs: Option<LrObservations<'a>>,
    pub(crate) enlarged: Option<EnlargedPhotographs<'a>>,
    /// True if the network was trained on views consistent with their own LR photographs.
    pub(crate) expects_consistent: bool,
}

/// View to refine.
pub(crate) struct ViewToRefine {
    /// Render in the form that the network takes.
    pub(crate) rendered: Rendered,
    /// All channels of the view's file.
    file: ExrImage,
    /// LR photograph of the same camera.
    photograph: Option<Photograph>,
}

impl RefineJob<'_> {
    /// Refines one view and writes its files at the paths of image and preview in the output.
    pub(crate) fn refine(
        &self,
        view: &View,
        references: &[KnownView],
        [image, preview]: [&str; 2],
    ) -> anyhow::Result<RefinedView> {
        let ViewToRefine { rendered, file, photograph } = self.read(view)?;
        let mut statistics = vec![ReferenceStatistics::default(); references.len()];
        let mut refined =
            self.network.refine(&rendered, references, &self.options, &mut statistics)?;
        if let Some(enlarged) = &self.enlarged {
            refined = enlarged.average_with(refined, &view.camera)?;
        }
        let refined = self.make_consistent(refined, photograph.as_ref());
        let path = self.context.output_path(image)?;
        write_recoloured(&path, &file, &refined, &rendered.opacity, self.background)?;
        write_png(&self.context.output_path(preview)?, &refined.to_rgba8())?;
        Ok(RefinedView { is_consistent: photograph.is_some(), statistics })
    }

    /// Reads a view.
    pub(crate) fn read(&self, view: &View) -> Result<ViewToRefine, Failure> {
        let needs_depth = self.network.takes_references();
        let (mut rendered, file) = read_view(self.views_input, view, self.background, needs_depth)?;
        let photographs = self.photographs.as_ref();
        let photograph = photographs.map(|p| p.photograph(&view.camera)).transpose()?.flatten();
        if self.expects_consistent {
            let colours = self.make_consistent(rendered.colours(), photograph.as_ref());
            rendered = rendered.with_colours(&colours);
        }
        Ok(ViewToRefine { rendered, file, photograph })
    }

    /// Makes an image of a view consistent with the view's LR photograph, if any.
    fn make_consistent(&self, image: Image, photograph: Option<&Photograph>) -> Image {
        match (&self.photographs, photograph) {
            (Some(photographs), Some(photograph)) => photographs.project(&image, photograph),
            _ => image,
        }
    }
}

/// Writes a view's file with new colours. `refined` is composited on the background, which is
/// subtracted, so that the file stays premultiplied. The other channels stay unchanged.
fn write_recoloured(
    path: &Path,
    image: &ExrImage,
    refined: &Image,
    opacity: &[f32],
    background: f32,
) -> anyhow::Result<()> {
    let channels = VIEW_CHANNELS.into_iter();
    let (channels, samples_of): (Vec<Channel>, Vec<&[f32]>) =
        channels.filter_map(|channel| Some((channel, image.channel(channel.name)?))).unzip();
    let size = (image.width, image.height);
    write_view_image(path, size, &channels, |first, _, samples| {
        for (i, pixel) in samples.chunks_exact_mut(channels.len()).enumerate() {
            let i = first * image.width + i;
            for (c, value) in pixel.iter_mut().enumerate() {
                // The first three channels are R, G and B.
                *value = if c < 3 {
                    refined.data[i * 3 + c] - (1.0 - opacity[i]) * background
                } else {
                    samples_of[c][i]
                };
            }
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use pixels::read_exr;

    use super::*;

    /// Writes and reads an image of two pixels, of which the second is half transparent.
    fn rendered(folder: &Path) -> ExrImage {
        let path = folder.join("rendered.exr");
        let pixels = [[0.5, 0.25, 0.125, 1.0, 2.0], [0.25, 0.25, 0.25, 0.5, 3.0]];
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
