use crate::aligned::Aligned;
use crate::chunk::{CHUNK_RAYS, Chunk, FeatureGradients, Roulette};
use crate::field::Field;
use crate::grid::{LevelGradients, arrange_in_rows};
use crate::ray::{Ray, clip};
use crate::regularisers::Regularisers;
use crate::shading::{NetworkGradients, RayGradients};
use crate::spec::Strides;

/// Forward and backward pass of one worker without an optimiser, for benchmarks and for comparison
/// with torch-field's hash grid (docs/design/023).
#[derive(Debug)]
pub struct Passes {
    pub(crate) chunk: Chunk,
    transposed: Aligned,
    network_gradients: Vec<f32>,
    pub(crate) feature_gradients: FeatureGradients,
    grid_gradients: Vec<LevelGradients>,
}

impl Passes {
    /// Creates buffers for a field.
    pub fn new(field: &Field) -> Self {
        let mut transposed = Aligned::zeros(field.network.len());
        for layer in field.layers.all() {
            layer.transpose(&field.network, &mut transposed);
        }
        Self {
            chunk: Chunk::default(),
            transposed,
            network_gradients: vec![0.0; field.network.len()],
            feature_gradients: FeatureGradients::default(),
            grid_gradients: field.levels.iter().map(LevelGradients::zeros).collect(),
        }
    }

    /// Renders rays in this thread; if `backward`, also backpropagates a gradient of 1 for every
    /// colour channel to the grid's features and the networks' weights. Returns the numbers of
    /// samples marched and of samples with a colour.
    pub fn run(&mut self, field: &Field, rays: &[Ray], backward: bool) -> [usize; 2] {
        let mut samples = [0; 2];
        self.feature_gradients.clear();
        for rays in rays.chunks(CHUNK_RAYS) {
            let clipped: Vec<_> = rays.iter().map(|r| clip(&field.bounds, r)).collect();
            self.chunk.forward(field, &clipped, &[0.5; CHUNK_RAYS][..rays.len()], Strides::Single);
            samples[0] += self.chunk.samples.count;
            samples[1] += self.chunk.counted.sample.len();
            if backward {
                let ones = [[1.0; 3]; CHUNK_RAYS];
                let upstream = RayGradients {
                    colours: &ones,
                    backgrounds: &ones,
                    regularisers: Regularisers::default(),
                };
                self.backward(field, upstream, Roulette::default());
            }
        }
        samples
    }

    /// Backpropagates gradients from the chunk's rays.
    pub(crate) fn backward(
        &mut self,
        field: &Field,
        upstream: RayGradients<'_>,
        roulette: Roulette,
    ) {
        let (transposed, sums) = (&*self.transposed, &mut self.network_gradients[..]);
        let mut network = NetworkGradients { transposed, sums };
        self.chunk.backward(field, upstream, roulette, &mut network, &mut self.feature_gradients);
    }

    /// Adds the last backward pass's gradients of the grid's features to their sums.
    pub fn scatter(&mut self, field: &Field) {
        arrange_in_rows(&self.feature_gradients.positions, &mut self.feature_gradients.rows);
        let levels =
            field.levels.iter().zip(&self.feature_gradients.levels).zip(&mut self.grid_gradients);
        for ((level, gradients), sums) in levels {
            for half in &mut sums.halves {
                half.scatter(level, &self.feature_gradients.rows, gradients);
            }
        }
    }

    /// Returns the gradient with respect to the grid's features, summed by all calls of
    /// [`Passes::scatter`].
    pub fn grid_gradient(&self, field: &Field) -> Vec<f32> {
        let mut table = vec![0.0; field.grid_len()];
        for (level, gradients) in field.levels.iter().zip(&self.grid_gradients) {
            gradients.add_to(&mut table[level.range()]);
        }
        table
    }

    /// Returns the gradient with respect to the networks' weights, ordered by layer and input, and
    /// summed over all backward passes so far.
    pub fn network_gradient(&self) -> &[f32] {
        &self.network_gradients
    }
}
