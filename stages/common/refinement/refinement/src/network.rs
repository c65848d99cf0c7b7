//! Forward and backward passes of the network.

use crate::convolution::{
    After, Convolution, LayerGradients, Maps, Scratch, convolve, convolve_back,
};

/// Layers of a [`Refiner`](crate::Refiner), in order.
pub(crate) struct Layers(pub(crate) Vec<Convolution>);

/// Memory of one thread's passes.
#[derive(Debug, Default)]
pub(crate) struct Pass {
    /// Input of each layer, and the output of the last.
    maps: Vec<Maps>,
    /// Gradients of a layer's outputs, of its inputs, and of a residual block's outputs.
    slopes: [Maps; 3],
    /// Sums of the gradients of all backward passes since [`Pass::reset`].
    pub(crate) gradients: Vec<LayerGradients>,
    scratch: Scratch,
}

impl Pass {
    /// Runs the layers on the samples of a window, and returns the output.
    pub(crate) fn forward(
        &mut self,
        layers: &Layers,
        (width, height): (usize, usize),
        samples: &[f32],
    ) -> &Maps {
        self.maps.resize_with(layers.0.len() + 1, Maps::default);
        self.maps[0].fill(width, height, samples);
        let last = layers.0.len() - 1;
        for (i, layer) in layers.0.iter().enumerate() {
            let (before, after) = self.maps.split_at_mut(i + 1);
            // Odd layers begin a residual block, even ones but the first end it.
            let step = match i {
                _ if i == 0 || i == last => After::Linear,
                _ if i % 2 == 1 => After::Relu,
                _ => After::Add(&before[i - 1]),
            };
            convolve(layer, &before[i], step, &mut after[0], &mut self.scratch);
        }
        &self.maps[last + 1]
    }

    /// Sets all gradients to 0.
    pub(crate) fn reset(&mut self, layers: &Layers) {
        self.gradients.resize_with(layers.0.len(), LayerGradients::default);
        for (gradients, layer) in self.gradients.iter_mut().zip(&layers.0) {
            gradients.reset(layer);
        }
    }

    /// Adds the gradients of the last forward pass, from those of its output's samples.
    pub(crate) fn backward(&mut self, layers: &Layers, output_gradients: &[f32]) {
        let Self { maps, slopes: [slope, below, block], gradients, scratch } = self;
        let last = layers.0.len() - 1;
        let output = &maps[last + 1];
        slope.fill(output.width, output.height, output_gradients);
        for i in (0..=last).rev() {
            let (layer, x, gradients) = (&layers.0[i], &maps[i], &mut gradients[i]);
            below.reset_like(x);
            if i == 0 {
                convolve_back(layer, x, slope, None, gradients, None, scratch);
            } else if i == last {
                convolve_back(layer, x, slope, None, gradients, Some(below), scratch);
            } else if i % 2 == 0 {
                convolve_back(layer, x, slope, None, gradients, Some(below), scratch);
                std::mem::swap(block, slope);
            } else {
                let gate = Some(&maps[i + 1]);
                convolve_back(layer, x, slope, gate, gradients, Some(below), scratch);
                below.add_to_middle(block);
            }
            std::mem::swap(slope, below);
        }
    }
}
