use scene::{Background, Intrinsics, Space, Views};

/// Properties of a scene that defaults depend on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneFacts {
    /// Space that the field's unit cube contains.
    pub space: Space,
    /// Background of the scene.
    pub background: Background,
    /// Number of LR pixels across the field's cube, maximum over the views.
    pub pixels_across: f64,
    /// Number of LR pixels of all views.
    pub lr_pixels: u64,
    /// True if the scene states the kernel of its LR images.
    pub has_kernel: bool,
    /// True if the training is initialised from a trained field.
    pub is_fine_tuning: bool,
}

impl SceneFacts {
    /// Returns the properties of a scene for training from scratch.
    pub fn of(views: &Views, has_kernel: bool) -> Self {
        let mut facts = Self {
            space: views.bounds.space,
            background: views.background,
            pixels_across: 0.0,
            lr_pixels: 0,
            has_kernel,
            is_fine_tuning: false,
        };
        for view in &views.views {
            let k = view.camera.intrinsics;
            facts.pixels_across = facts.pixels_across.max(pixels_across(k, facts.space));
            facts.lr_pixels += u64::from(k.width) * u64::from(k.height);
        }
        facts
    }

    pub(super) fn is_ndc(&self) -> bool {
        matches!(self.space, Space::Ndc(_))
    }
}

/// Returns the number of a view's LR pixels across the field's cube.
fn pixels_across(k: Intrinsics, space: Space) -> f64 {
    match space {
        // The view covers about the whole cube.
        Space::Box => f64::from(k.width),
        Space::Ndc(frustum) => {
            let [width, height] = [0, 1].map(|axis| frustum.max[axis] - frustum.min[axis]);
            width.max(height) * k.fx
        }
        // The view covers about half of the cube; the contracted shell fills the rest.
        Space::Contraction => 2.0 * f64::from(k.width),
    }
}
