use std::cell::RefCell;

use rayon::prelude::*;

use crate::chunk::{CHUNK_RAYS, Chunk};
use crate::field::Field;
use crate::ray::{NormalizedRay, Ray, clip};
use crate::samples::RaySum;
use crate::spec::MIN_TOTAL_WEIGHT;
use crate::spec::Strides;
use crate::trainer::{PhaseClock, PhaseTimes};

/// Render of one ray.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel {
    /// Colour over the ray's background.
    pub colour: [f32; 3],
    /// Premultiplied colour of the scene without background.
    pub premultiplied: [f32; 3],
    /// Fraction of the light that is stopped.
    pub opacity: f32,
    /// Expected distance along the ray at which light is stopped, in scene units; distance of the
    /// far end if no light is stopped.
    pub depth: f32,
    /// Distance along the ray at which half of the light is stopped, in scene units; distance of
    /// the far end if less is stopped.
    pub median_depth: f32,
}

impl Pixel {
    /// Returns whether all numbers are finite.
    pub fn is_finite(&self) -> bool {
        let depths = [self.opacity, self.depth, self.median_depth];
        self.colour.iter().chain(&self.premultiplied).chain(&depths).all(|v| v.is_finite())
    }
}

/// Error returned when rays can't be rendered.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// A library or its device failed.
    #[error("cannot render the field: {0}")]
    Backend(String),
    /// A pixel isn't finite.
    #[error("rendered pixels are not finite; train the field again with a lower learning rate")]
    NotFinite,
}

/// Field that renders rays, of any kind and on any device.
pub trait RayField {
    /// Renders colour, opacity and depth of each ray.
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
    /// Buffers reused across calls, some ten MB per thread: views are rendered in bands, and
    /// growing buffers for each band is slow.
    static CHUNK: RefCell<Chunk> = RefCell::default();
}

impl Field {
    /// Renders colour, opacity and depth of each ray, in parallel; the result doesn't depend on the
    /// number of threads.
    pub fn render(&self, rays: &[Ray]) -> Vec<Pixel> {
        self.render_timed(rays).0
    }

    /// Renders like [`Field::render`]; also returns the tasks' times.
    pub fn render_timed(&self, rays: &[Ray]) -> (Vec<Pixel>, PhaseTimes) {
        let clock = PhaseClock::start();
        let chunks = rays.par_chunks(CHUNK_RAYS);
        let pixels = chunks.flat_map_iter(|rays| clock.task(|| self.render_chunk(rays))).collect();
        let mut times = PhaseTimes::default();
        times.add(&clock);
        (pixels, times)
    }

    /// Renders at most [`CHUNK_RAYS`] rays.
    fn render_chunk(&self, rays: &[Ray]) -> Vec<Pixel> {
        let mut chunk = CHUNK.take();
        let clipped: Vec<_> = rays.iter().map(|r| clip(&self.bounds, r)).collect();
        chunk.forward(self, &clipped, &[0.5; CHUNK_RAYS][..rays.len()], Strides::Single);
        let far = self.bounds.far as f32;
        let pixels =
            (0..rays.len()).map(|i| pixel(&rays[i], &clipped[i], &chunk.sums[i], far)).collect();
        CHUNK.set(chunk);
        pixels
    }
}

/// Converts a ray's sums to a pixel; depth is `far` if the ray misses the cube.
fn pixel(ray: &Ray, clipped: &NormalizedRay, sum: &RaySum, far: f32) -> Pixel {
    let far = if clipped.leave > clipped.enter { clipped.distance(clipped.leave) } else { far };
    let opacity = 1.0 - sum.transmittance;
    Pixel {
        colour: std::array::from_fn(|c| {
            sum.transmittance.mul_add(ray.background[c], sum.colour[c])
        }),
        premultiplied: sum.colour,
        opacity,
        depth: if sum.weight > MIN_TOTAL_WEIGHT { sum.distance / sum.weight } else { far },
        median_depth: sum.median.map_or(far, |t| clipped.distance(t)),
    }
}
