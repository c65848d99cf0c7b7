use crate::view::KnownView;

/// Colours of one reference at the surface point of a view's pixel, as differences.
#[derive(Clone, Copy, Default)]
pub(crate) struct WarpedPixel {
    /// The reference's colour minus the view's rendered colour.
    pub(crate) difference: [f32; 3],
    /// The reference's colour minus its own rendered colour: the detail that rendering lacks.
    pub(crate) detail: [f32; 3],
    /// Position in the reference in pixels.
    pub(crate) position: [f32; 2],
    /// Weight by viewing angle and resolution, 0 to 1; 0 if the point isn't visible.
    pub(crate) visibility: f32,
    /// `visibility`, later reduced where the reference disagrees with the rendered view.
    pub(crate) confidence: f32,
}

impl WarpedPixel {
    /// Samples a reference at a position for a pixel of the rendered view.
    pub(crate) fn new(
        reference: &KnownView,
        position: [f32; 2],
        visibility: f32,
        pixel: &[f32],
    ) -> Self {
        let colour = reference.truth.colour_at(position);
        let rendered = reference.rendered.view.colour_at(position);
        let difference = std::array::from_fn(|c| colour[c] - pixel[c]);
        let detail = std::array::from_fn(|c| colour[c] - rendered[c]);
        // An image with non-finite pixels shows nothing there.
        let is_known = difference.iter().chain(&detail).all(|d: &f32| d.is_finite());
        if is_known {
            Self { difference, detail, position, visibility, confidence: visibility }
        } else {
            Self::default()
        }
    }
}
