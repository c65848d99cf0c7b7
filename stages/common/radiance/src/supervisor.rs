use crate::ray::Ray;

/// Where a trainer's rays come from and how their colours are judged. Rays come in bundles that are
/// judged together: the s×s sub-pixel rays of an LR pixel are a pixel bundle.
pub trait Supervisor: Sync {
    /// Is told before every step which share of the training's rays is done, from which alone its
    /// bundles may change.
    fn set_progress(&mut self, _done: f64) {}
    /// Rays in a bundle of this step.
    fn rays_per_bundle(&self) -> usize;
    /// Casts the rays of a bundle. `bundle` counts from 0 over the whole training: draw from it
    /// alone.
    fn sample_rays(&self, bundle: u64, rays: &mut [Ray]);
    /// The bundle's loss, given its rays' colours; writes the loss's gradient by each colour.
    fn loss_and_gradient(
        &self,
        bundle: u64,
        colours: &[[f32; 3]],
        gradients: &mut [[f32; 3]],
    ) -> f64;
    /// Is given each bundle's colours again after a step that went well, in the order of the
    /// bundles: for a supervision that keeps what was rendered.
    fn remember(&mut self, _bundle: u64, _colours: &[[f32; 3]]) {}
}
