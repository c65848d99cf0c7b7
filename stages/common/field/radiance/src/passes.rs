use crate::aligned::Aligned;
use crate::chunk::{CHUNK_RAYS, Chunk, FeatureGradients, Roulette};
use crate::field::Field;
use crate::ray::{Ray, clip};
use crate::regularisers::Regularisers;
use crate::shading::{NetworkGradients, RayGradients};
use crate::spec::Strides;

/// Forward and backward pass of one worker without an optimiser, for benchmarks and for comparison
/// with the libtorch twin.
#[derive(Debug)]
pub struct Passes {
    chunk: Chunk,
    transposed: Aligned,
    network: Vec<f32>,
    features: FeatureGradients,
    touched: Vec<u8>,
}

impl Passes {
    /// Creates buffers for a field.
    pub fn new(field: &Field) -> Self {
        let mut transposed = Aligned::zeros(field.network.len());
        for layer in field.layers.all() {
            layer.transpose(&field.network, &mut transposed);
        }
        let blocks = field.levels.iter().map(crate::grid::Level::blocks).max().unwrap_or(0);
        Self {
            chunk: Chunk::default(),
            transposed,
            network: vec![0.0; field.network.len()],
            features: FeatureGradients::default(),
            touched: vec![0; blocks],
        }
    }

    /// Renders rays in this thread; if `backward`, also backpropagates a gradient of 1 for every
    /// colour channel to the grid's features. Returns the numbers of samples marched and of samples
    /// with a colour.
    pub fn run(&mut self, field: &Field, rays: &[Ray], backward: bool) -> [usize; 2] {
        let mut samples = [0; 2];
        self.features.clear();
        for rays in rays.chunks(CHUNK_RAYS) {
            let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
            self.chunk.forward(field, &clipped, &[0.5; CHUNK_RAYS][..rays.len()], Strides::Single);
            samples[0] += self.chunk.samples();
            samples[1] += self.chunk.coloured_samples();
            if backward {
                let ones = [[1.0; 3]; CHUNK_RAYS];
                let upstream = RayGradients {
                    colours: &ones,
                    backgrounds: &ones,
                    regularisers: Regularisers::default(),
                };
                let mut network =
                    NetworkGradients { transposed: &self.transposed, sums: &mut self.network };
                self.chunk.backward(
                    field,
                    upstream,
                    Roulette::default(),
                    &mut network,
                    &mut self.features,
                );
            }
        }
        samples
    }

    /// Adds the last backward pass's gradients to a table of the grid's size.
    ///
    /// # Panics
    /// If the table has another size.
    pub fn scatter(&mut self, field: &Field, table: &mut [f32]) {
        for (level, gradients) in field.levels.iter().zip(&self.features.levels) {
            let touched = &mut self.touched[..level.blocks()];
            crate::grid::scatter(
                level,
                &mut table[level.range()],
                touched,
                &self.features.positions,
                gradients,
            );
        }
    }

    /// Returns the gradient by the networks' weights, by layer and input, summed over all backward
    /// passes so far.
    pub fn network_gradient(&self) -> &[f32] {
        &self.network
    }
}
