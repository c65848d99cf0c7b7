use crate::view::KnownView;

/// What one reference shows of a pixel.
#[derive(Clone, Copy, Default)]
pub(crate) struct WarpedPixel {
    /// Difference to what is rendered.
    pub(crate) difference: [f32; 3],
    /// Difference to what is rendered for the reference.
    pub(crate) lacking: [f32; 3],
    /// Where in the reference, in pixels.
    pub(crate) place: [f32; 2],
    /// By angle and size; 0 where it shows nothing.
    pub(crate) visibility: f32,
    /// The same, less where it looks otherwise than what is rendered.
    pub(crate) confidence: f32,
}

impl WarpedPixel {
    /// What a reference shows at a place of it, for a pixel as rendered.
    pub(crate) fn new(
        reference: &KnownView,
        place: [f32; 2],
        visibility: f32,
        pixel: &[f32],
    ) -> Self {
        let (colour, theirs) =
            (reference.truth.colour_at(place), reference.rendered.view.colour_at(place));
        let difference = std::array::from_fn(|c| colour[c] - pixel[c]);
        let lacking = std::array::from_fn(|c| colour[c] - theirs[c]);
        // An image with a hole in it shows nothing there.
        let is_shown = difference.iter().chain(&lacking).all(|d: &f32| d.is_finite());
        if is_shown {
            Self { difference, lacking, place, visibility, confidence: visibility }
        } else {
            Self::default()
        }
    }
}
