//! Samples training views: their borders and strips, and the spectrum of their images.

use artifact::FailureExt as _;
use dataset::{Border, Frame};
use rayon::prelude::*;

use crate::borders::Borders;
use crate::detail::Spectrum;
use crate::frame_label;
use crate::strips::Strips;

/// Maximum number of views to sample, spread evenly: enough to decide whether nine in ten have the
/// same border (docs/design/035).
const MAX_VIEWS: usize = 20;

/// Findings in the sampled views.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Inspection {
    pub(crate) borders: Borders,
    /// Sum over the views' images.
    pub(crate) spectrum: Spectrum,
}

/// Border and strips of one view's image.
pub(crate) struct ViewBorder {
    pub(crate) border: Border,
    pub(crate) strips: Option<Strips>,
    /// True if there are strips, and the view's mask excludes them.
    pub(crate) has_masked_strips: bool,
}

impl Inspection {
    /// Samples training views, spread evenly; only the first view if that has alpha. At most one
    /// image per thread is in memory.
    pub(crate) fn of(frames: &[&Frame]) -> anyhow::Result<Self> {
        let count = frames.len().min(MAX_VIEWS);
        let mut views: Vec<(ViewBorder, Spectrum)> =
            frames.first().map(|first| inspect_view(first)).transpose()?.into_iter().collect();
        if views.first().is_some_and(|(view, _)| view.border != Border::Alpha) {
            let others =
                (1..count).into_par_iter().map(|i| inspect_view(frames[i * frames.len() / count]));
            views.extend(others.collect::<anyhow::Result<Vec<_>>>()?);
        }
        let (views, spectra): (Vec<ViewBorder>, Vec<Spectrum>) = views.into_iter().unzip();
        let borders: Vec<Border> = views.iter().map(|view| view.border).collect();
        let borders = Borders::new(&borders).with_strips(&views);
        Ok(Self { borders, spectrum: Spectrum::sum(&spectra) })
    }
}

fn inspect_view(frame: &Frame) -> anyhow::Result<(ViewBorder, Spectrum)> {
    let image = frame.photograph().bad_input(frame_label(frame))?;
    let border = Border::of_frame(frame, &image);
    let strips = if border == Border::Alpha { None } else { Strips::of(&image) };
    let mut has_masked_strips = false;
    if let Some(strips) = &strips {
        let mask = frame.mask().bad_input(frame_label(frame))?;
        has_masked_strips = mask.is_some_and(|mask| strips.are_masked(&mask));
    }
    Ok((ViewBorder { border, strips, has_masked_strips }, Spectrum::of(&image)))
}
