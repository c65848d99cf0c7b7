//! Forward and backward passes of the network.

use crate::convolution::{
    After, Convolution, LayerGradients, Maps, Scratch, convolve, convolve_back,
};

/// Memory of one thread's passes.
#[derive(Debug, Default)]
pub(crate) struct Pass {
    /// Input of each layer, and the output of the last.
    maps: Vec<Maps>,
    /// Gradients with respect to a layer's output, its input, and a residual block's output.
    gradient_maps: [Maps; 3],
    /// Sums of the gradients of all backward passes since [`Pass::reset`].
    pub(crate) gradients: Vec<LayerGradients>,
    scratch: Scratch,
}

impl Pass {
    /// Runs the layers of a [`Refiner`](crate::Refiner) on the samples of a window, and returns the
    /// output.
    pub(crate) fn forward(
        &mut self,
        layers: &[Convolution],
        (width, height): (usize, usize),
        samples: &[f32],
    ) -> &Maps {
        self.maps.resize_with(layers.len() + 1, Maps::default);
        self.maps[0].fill(width, height, samples);
        let last = layers.len() - 1;
        for (i, layer) in layers.iter().enumerate() {
            let (before, after) = self.maps.split_at_mut(i + 1);
            // Between the first and the last layer, odd ones begin a residual block and even ones
            // end it.
            let step = if i == 0 || i == last {
                After::Linear
            } else if i % 2 == 1 {
                After::Relu
            } else {
                After::Add(&before[i - 1])
            };
            convolve(layer, &before[i], step, &mut after[0], &mut self.scratch);
        }
        &self.maps[last + 1]
    }

    /// Sets all gradients to 0.
    pub(crate) fn reset(&mut self, layers: &[Convolution]) {
        self.gradients.resize_with(layers.len(), LayerGradients::default);
        for (gradients, layer) in self.gradients.iter_mut().zip(layers) {
            gradients.reset(layer);
        }
    }

    /// Adds the gradients of the last forward pass, from those of its output's samples.
    pub(crate) fn backward(&mut self, layers: &[Convolution], output_gradients: &[f32]) {
        let Self { maps, gradient_maps: [output, input, block], gradients, scratch } = self;
        let last = layers.len() - 1;
        let result = &maps[last + 1];
        output.fill(result.width, result.height, output_gradients);
        for i in (0..=last).rev() {
            let (layer, x, gradients) = (&layers[i], &maps[i], &mut gradients[i]);
            if i == 0 {
                convolve_back(layer, x, output, None, gradients, None, scratch);
                return;
            }
            input.reset_like(x);
            let begins_block = i < last && i % 2 == 1;
            let gate = begins_block.then_some(&maps[i + 1]);
            convolve_back(layer, x, output, gate, gradients, Some(input), scratch);
            if begins_block {
                input.add_to_middle(block);
            } else if i < last {
                std::mem::swap(block, output);
            }
            std::mem::swap(output, input);
        }
    }
}

#[cfg(test)]
mod tests {
    use numerics::CounterRng;
    use tch::{Kind, Tensor};

    use super::*;

    /// Input channels, hidden channels and outputs.
    const SHAPE: [usize; 3] = [5, 18, 3];
    const BLOCKS: usize = 2;
    const SIZE: (usize, usize) = (21, 17);

    fn numbers(count: usize, stream: u64) -> Vec<f32> {
        let mut rng = CounterRng::new(3, 1, stream);
        (0..count).map(|_| 0.4 * (rng.uniform() - 0.5)).collect()
    }

    /// Returns libtorch's output for the kernels and biases of all layers.
    fn torch_output(input: &Tensor, parameters: &[(Tensor, Tensor)]) -> Tensor {
        let layer = |x: &Tensor, i: usize| {
            let (kernels, bias) = &parameters[i];
            x.conv2d(&kernels.permute([0, 3, 1, 2]), Some(bias), 1, 0, 1, 1)
        };
        let mut x = layer(input, 0);
        for block in 0..BLOCKS {
            let inner = layer(&x, 1 + 2 * block).relu();
            let [_, _, height, width] = x.size()[..] else { unreachable!("four dimensions") };
            let middle = x.narrow(2, 2, height - 4).narrow(3, 2, width - 4);
            x = middle + layer(&inner, 2 + 2 * block);
        }
        layer(&x, 1 + 2 * BLOCKS)
    }

    /// Outputs and gradients equal those of libtorch's convolutions and autograd.
    #[test]
    fn passes_equal_those_of_libtorch() {
        let [inputs, hidden, outputs] = SHAPE;
        let (width, height) = SIZE;
        let shapes: Vec<(usize, usize)> = (0..2 * BLOCKS + 2)
            .map(|i| match i {
                0 => (inputs, hidden),
                _ if i == 2 * BLOCKS + 1 => (hidden, outputs),
                _ => (hidden, hidden),
            })
            .collect();
        let parameters: Vec<(Vec<f32>, Vec<f32>)> = (0..)
            .zip(&shapes)
            .map(|(i, (inputs, outputs))| {
                (numbers(9 * inputs * outputs, 10 + i), numbers(*outputs, 30 + i))
            })
            .collect();
        let samples = numbers(width * height * inputs, 1);
        let weights_of = |count| numbers(count, 2);

        let layers = parameters.iter().map(|(kernels, bias)| Convolution::new(kernels, bias));
        let layers: Vec<Convolution> = layers.collect();
        let (mut pass, mut output) = (Pass::default(), Vec::new());
        pass.reset(&layers);
        pass.forward(&layers, SIZE, &samples).copy_samples(outputs, &mut output);
        let weights = weights_of(output.len());
        pass.backward(&layers, &weights);

        let tensors: Vec<(Tensor, Tensor)> = parameters
            .iter()
            .zip(&shapes)
            .map(|((kernels, bias), (inputs, outputs))| {
                let shape = [*outputs, 3, 3, *inputs].map(|d| d as i64);
                let kernels = Tensor::from_slice(kernels).reshape(shape).set_requires_grad(true);
                (kernels, Tensor::from_slice(bias).set_requires_grad(true))
            })
            .collect();
        let size = [1, height, width, inputs].map(|d| d as i64);
        let input = Tensor::from_slice(&samples).reshape(size).permute([0, 3, 1, 2]);
        let expected = torch_output(&input, &tensors).permute([0, 2, 3, 1]).reshape([-1]);
        assert_near("outputs", &output, &expected);
        (expected * Tensor::from_slice(&weights)).sum(Kind::Float).backward();
        for (i, (kernels, bias)) in tensors.iter().enumerate() {
            let (inputs, outputs) = shapes[i];
            let gradients = &pass.gradients[i];
            assert_near("kernels", &gradients.kernels(inputs, outputs), &kernels.grad());
            assert_near("biases", &gradients.bias(outputs), &bias.grad());
        }
    }

    fn assert_near(name: &str, found: &[f32], expected: &Tensor) {
        let expected = Vec::<f32>::try_from(expected.reshape([-1])).unwrap();
        assert_eq!(found.len(), expected.len(), "{name}");
        let scale = expected.iter().fold(0.0f32, |most, value| most.max(value.abs()));
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found - expected).abs() < 1e-5 * scale, "{name}: {found}, not {expected}");
        }
    }
}
