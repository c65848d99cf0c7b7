//! What a field holds at places of its unit cube, without any ray: for whoever bakes it.

use crate::aligned::Aligned;
use crate::field::Field;
use crate::math::exp;
use crate::occupancy::cell_of;
use crate::samples::DensityRows;
use crate::shading::view_network;
use crate::simd::LANES;
use crate::spec::{
    DENSITY_OUTPUTS, MAX_RAW_DENSITY, OCCUPANCY_CELLS, RAW_COLOUR, VIEW_FEATURE, VIEW_FEATURES,
    VIEW_INPUTS,
};
use crate::spherical::spherical_harmonics;

/// What a field holds at a place.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PointSample {
    /// Optical depth for each unit of a ray's t ([`crate::NormalizedRay`]); 0 where the occupancy
    /// says that there is nothing.
    pub density: f32,
    /// Red, green and blue before the sigmoid, without the view network's part.
    pub raw_colour: [f32; 3],
    /// What [`Field::view_colours`] takes.
    pub view_features: [f32; VIEW_FEATURES],
}

/// Places in one pass: their activations stay in the cache.
const PLACES_PER_PASS: usize = 256;

impl Field {
    /// Whether some cell of the occupancy between two corners of the unit cube may hold something.
    pub fn may_hold(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        let (from, to) = (cell_of(low), cell_of(high));
        let cell = |x: usize, y: usize, z: usize| x + OCCUPANCY_CELLS * (y + OCCUPANCY_CELLS * z);
        (from[2]..=to[2]).any(|z| {
            (from[1]..=to[1])
                .any(|y| (from[0]..=to[0]).any(|x| self.occupancy.is_occupied(cell(x, y, z))))
        })
    }

    /// What the field holds at some places of the unit cube, as rays would find it. In this thread.
    pub fn sample_points(&self, places: &[[f32; 3]]) -> Vec<PointSample> {
        let mut samples = vec![PointSample::default(); places.len()];
        let occupied: Vec<usize> =
            (0..places.len()).filter(|&i| self.may_hold(places[i], places[i])).collect();
        let mut rows = DensityRows::default();
        for chosen in occupied.chunks(PLACES_PER_PASS) {
            let n = chosen.len().next_multiple_of(LANES);
            let mut positions = vec![0.0; 3 * n];
            for (k, &i) in chosen.iter().enumerate() {
                (0..3).for_each(|axis| positions[axis * n + k] = places[i][axis]);
            }
            let outputs = rows.outputs_at(self, &positions, n);
            for (k, &i) in chosen.iter().enumerate() {
                let output = |o: usize| outputs[o * n + k];
                samples[i] = PointSample {
                    density: exp(output(0).min(MAX_RAW_DENSITY)),
                    raw_colour: std::array::from_fn(|c| output(RAW_COLOUR + c)),
                    view_features: std::array::from_fn(|f| output(VIEW_FEATURE + f)),
                };
            }
        }
        samples
    }

    /// What is added to the raw colours of a ray's samples, for composited view features and each
    /// of some directions of unit length. In this thread.
    pub fn view_colours(
        &self,
        features: &[f32; VIEW_FEATURES],
        directions: &[[f32; 3]],
    ) -> Vec<[f32; 3]> {
        const { assert!(VIEW_FEATURE + VIEW_FEATURES == DENSITY_OUTPUTS) };
        let n = directions.len().next_multiple_of(LANES);
        let mut input = vec![0.0; VIEW_INPUTS * n];
        for (k, &direction) in directions.iter().enumerate() {
            let values = features.iter().copied().chain(spherical_harmonics(direction));
            values.enumerate().for_each(|(row, value)| input[row * n + k] = value);
        }
        let mut added = Aligned::default();
        let added = view_network(self, &input, &mut Default::default(), &mut added, n);
        (0..directions.len()).map(|k| [0, 1, 2].map(|c| added[c * n + k])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::architecture::Architecture;
    use crate::math::sigmoid;
    use crate::ray::{Ray, clip};
    use scene::Bounds;

    /// Composited by hand, the samples of a ray's places give the colour that the engine renders.
    #[test]
    fn places_hold_what_rays_see() {
        let architecture = Architecture {
            finest: 32,
            levels: 4,
            log2_entries: 10,
            steps: 64,
            ..Default::default()
        };
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.0, far: 9.0, ..Bounds::default() };
        let mut field = Field::new(architecture, bounds, 3);
        let (grid, network, _) = field.parts_mut();
        grid.iter_mut().for_each(|value| *value *= 4e3);
        network.iter_mut().for_each(|value| *value *= 1.3);
        field.occupancy.set(|cell| match cell % 3 {
            0 => crate::occupancy::Cell::Empty,
            _ => crate::occupancy::Cell::Dense,
        });
        let ray = Ray {
            origin: [0.3, 0.2, 4.0],
            direction: [-0.1, 0.05, -0.99373],
            background: [1.0; 3],
        };
        let clipped = clip(&bounds, &ray);
        let step = field.step();
        let t = (0..).map(|k| (k as f32 + 0.5).mul_add(step, clipped.enter));
        let places: Vec<[f32; 3]> =
            t.take_while(|&t| t < clipped.leave).map(|t| clipped.position(t)).collect();
        let samples = field.sample_points(&places);
        let (mut weights, mut through) = (Vec::new(), 1.0f32);
        for sample in &samples {
            let kept = (-sample.density * step).exp();
            weights.push(through * (1.0 - kept));
            through *= kept;
        }
        let mut features = [0.0; VIEW_FEATURES];
        for (sample, weight) in samples.iter().zip(&weights) {
            features.iter_mut().zip(&sample.view_features).for_each(|(sum, f)| *sum += weight * f);
        }
        let added = field.view_colours(&features, &[clipped.view, [0.0, 1.0, 0.0]]);
        let colour: [f32; 3] = std::array::from_fn(|c| {
            let lights = samples.iter().zip(&weights);
            lights.map(|(s, weight)| weight * sigmoid(s.raw_colour[c] + added[0][c])).sum::<f32>()
                + through
        });
        let pixel = field.render(&[ray])[0];
        assert!(through > 0.01 && through < 0.9 && added[0] != added[1], "{through} {added:?}");
        assert!(samples.iter().any(|s| s.density == 0.0));
        for c in 0..3 {
            assert!((colour[c] - pixel.colour[c]).abs() < 1e-3, "{colour:?} {pixel:?}");
        }
    }

    #[test]
    fn a_region_holds_something_where_one_of_its_cells_does() {
        let bounds =
            Bounds { min: [-1.0; 3], max: [1.0; 3], near: 0.0, far: 9.0, ..Bounds::default() };
        let mut field = Field::new(Architecture::default(), bounds, 3);
        let only = 100 + OCCUPANCY_CELLS * (20 + OCCUPANCY_CELLS * 30);
        field.occupancy.set(|cell| match cell == only {
            true => crate::occupancy::Cell::Thin,
            false => crate::occupancy::Cell::Empty,
        });
        let at = |x: f32, y: f32, z: f32| [x, y, z].map(|c| (c + 0.5) / OCCUPANCY_CELLS as f32);
        assert!(field.may_hold(at(98.0, 20.0, 28.0), at(101.0, 23.0, 30.0)));
        assert!(!field.may_hold(at(98.0, 20.0, 28.0), at(101.0, 23.0, 29.0)));
        assert!(!field.may_hold(at(101.0, 20.0, 28.0), [1.0; 3]));
    }
}
