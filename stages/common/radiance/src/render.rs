use std::cell::RefCell;

use rayon::prelude::*;

use crate::chunk::{CHUNK_RAYS, Chunk};
use crate::field::Field;
use crate::ray::{NormalizedRay, Ray, clip};
use crate::samples::RaySum;
use crate::spec::UNSEEN;
use crate::strides::Strides;

/// What a ray sees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel {
    /// Colour over the ray's background.
    pub colour: [f32; 3],
    /// Colour of the scene alone, weighted by opacity (premultiplied).
    pub premultiplied: [f32; 3],
    /// Share of the ray that is stopped.
    pub opacity: f32,
    /// Expected distance where it is stopped, in scene units; the far end where nothing stops it.
    pub depth: f32,
    /// Distance at which half of the ray is stopped; the far end where it never is.
    pub median_depth: f32,
}

impl Pixel {
    /// Whether all of it is finite.
    pub fn is_finite(&self) -> bool {
        let depths = [self.opacity, self.depth, self.median_depth];
        self.colour.iter().chain(&self.premultiplied).chain(&depths).all(|v| v.is_finite())
    }
}

/// Rays that couldn't be cast.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// What the field is computed by refused: a library, or its device.
    #[error("the field can't be rendered: {0}")]
    Backend(String),
    /// A pixel isn't finite.
    #[error("the field renders numbers that aren't finite; train it again, with a lower rate")]
    NotFinite,
}

/// Whatever rays can be cast through: what renders views needn't know which field it has.
pub trait RayField {
    /// Colour, opacity and depth of each ray.
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError>;
}

impl<F: RayField + ?Sized> RayField for &F {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        (**self).render(rays)
    }
}

impl RayField for Field {
    fn render(&self, rays: &[Ray]) -> Result<Vec<Pixel>, RenderError> {
        Ok(Self::render(self, rays))
    }
}

thread_local! {
    /// Kept from one call to the next: views are rendered in bands, and buffers grow slowly. Some
    /// ten MB a thread.
    static CHUNK: RefCell<Chunk> = RefCell::default();
}

impl Field {
    /// Colour, opacity and depth of each ray, in parallel; the result doesn't depend on the number
    /// of threads.
    pub fn render(&self, rays: &[Ray]) -> Vec<Pixel> {
        let chunks = rays.par_chunks(CHUNK_RAYS);
        chunks.flat_map_iter(|rays| self.render_chunk(rays)).collect()
    }

    /// Colour, opacity and depth of at most [`CHUNK_RAYS`] rays.
    fn render_chunk(&self, rays: &[Ray]) -> Vec<Pixel> {
        let mut chunk = CHUNK.take();
        let clipped: Vec<_> = rays.iter().map(|r| clip(&self.bounds, r)).collect();
        chunk.forward(self, &clipped, &[0.5; CHUNK_RAYS][..rays.len()], Strides::Even);
        let far = self.bounds.far as f32;
        let seen = rays.iter().zip(&clipped).zip(&chunk.sums);
        let pixels = seen.map(|((ray, clipped), sum)| pixel(ray, clipped, sum, far)).collect();
        CHUNK.set(chunk);
        pixels
    }
}

/// What a ray sees; the far end where it misses the cube.
fn pixel(ray: &Ray, clipped: &NormalizedRay, sum: &RaySum, far: f32) -> Pixel {
    let far = if clipped.leave > clipped.enter { clipped.distance(clipped.leave) } else { far };
    let opacity = 1.0 - sum.transmittance;
    Pixel {
        colour: std::array::from_fn(|c| {
            sum.transmittance.mul_add(ray.background[c], sum.colour[c])
        }),
        premultiplied: sum.colour,
        opacity,
        depth: if sum.weight > UNSEEN { sum.distance / sum.weight } else { far },
        median_depth: sum.median.map_or(far, |t| clipped.distance(t)),
    }
}
