//! Density and colour of a field at points of its unit cube, without rays: for baking.

use crate::RenderError;
use crate::aligned::Aligned;
use crate::field::Field;
use crate::math::exp;
use crate::math::spherical_harmonics;
use crate::occupancy::cell_at;
use crate::samples::DensityRows;
use crate::shading::view_network;
use crate::spec::{
    DENSITY_OUTPUTS, FIRST_RAW_COLOUR, FIRST_VIEW_FEATURE, MAX_RAW_DENSITY, OCCUPANCY_CELLS,
    VIEW_FEATURES, VIEW_INPUTS,
};
use numerics::simd::LANES;

/// Values of a field at some points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointSamples {
    /// Optical depth per unit of a ray's t ([`crate::NormalizedRay`]) at each point; 0 in an empty
    /// cell.
    pub densities: Vec<f32>,
    /// Red, green and blue of each point before the sigmoid, without the view-dependent part.
    pub raw_colours: Vec<[f32; 3]>,
    /// View features, a row of equal length for each point; [`PointField::view_colours`] takes
    /// them with directions.
    pub view_features: Vec<f32>,
}

/// Field of any kind that is evaluated at points of its unit cube, in the calling thread.
///
/// # Errors
/// All methods return [`RenderError::Backend`] if a library fails.
pub trait PointField: Sync {
    /// Returns whether a density of at least `min_density` is possible between two corners. A field
    /// that can only be probed may miss a thin surface.
    fn may_have_density(
        &self,
        low: [f32; 3],
        high: [f32; 3],
        min_density: f32,
    ) -> Result<bool, RenderError>;

    /// Evaluates the densities of [`PointSamples`] alone.
    fn densities(&self, points: &[[f32; 3]]) -> Result<Vec<f32>, RenderError>;

    /// Evaluates density, raw colour and view features.
    fn samples(&self, points: &[[f32; 3]]) -> Result<PointSamples, RenderError>;

    /// Computes the view-dependent part of raw colours. Each row of `features` is evaluated in the
    /// directions at the row's index in `directions`, which are unit vectors in world space.
    fn view_colours(
        &self,
        features: &[f32],
        directions: &[Vec<[f32; 3]>],
    ) -> Result<Vec<Vec<[f32; 3]>>, RenderError>;
}

/// Number of points per pass, whose activations fit the cache; chosen by hand.
const POINTS_PER_PASS: usize = 256;

impl PointField for Field {
    /// Returns whether the box between the corners intersects an occupied cell.
    fn may_have_density(
        &self,
        low: [f32; 3],
        high: [f32; 3],
        _min_density: f32,
    ) -> Result<bool, RenderError> {
        Ok(self.has_occupied_cell(low, high))
    }

    fn densities(&self, points: &[[f32; 3]]) -> Result<Vec<f32>, RenderError> {
        Ok(self.samples(points)?.densities)
    }

    fn samples(&self, points: &[[f32; 3]]) -> Result<PointSamples, RenderError> {
        let mut samples = PointSamples {
            densities: vec![0.0; points.len()],
            raw_colours: vec![[0.0; 3]; points.len()],
            view_features: vec![0.0; VIEW_FEATURES * points.len()],
        };
        let occupied: Vec<usize> =
            (0..points.len()).filter(|&i| self.has_occupied_cell(points[i], points[i])).collect();
        let mut rows = DensityRows::default();
        for indices in occupied.chunks(POINTS_PER_PASS) {
            let n = indices.len().next_multiple_of(LANES);
            let mut positions = vec![0.0; 3 * n];
            for (k, &i) in indices.iter().enumerate() {
                for axis in 0..3 {
                    positions[axis * n + k] = points[i][axis];
                }
            }
            let outputs = rows.outputs_at(self, &positions, n);
            for (k, &i) in indices.iter().enumerate() {
                samples.densities[i] = exp(outputs[k].min(MAX_RAW_DENSITY));
                samples.raw_colours[i] = [0, 1, 2].map(|c| outputs[(FIRST_RAW_COLOUR + c) * n + k]);
                for f in 0..VIEW_FEATURES {
                    samples.view_features[VIEW_FEATURES * i + f] =
                        outputs[(FIRST_VIEW_FEATURE + f) * n + k];
                }
            }
        }
        Ok(samples)
    }

    fn view_colours(
        &self,
        features: &[f32],
        directions: &[Vec<[f32; 3]>],
    ) -> Result<Vec<Vec<[f32; 3]>>, RenderError> {
        let rows = features.as_chunks().0.iter().zip(directions);
        Ok(rows.map(|(row, directions)| self.view_colours_of(row, directions)).collect())
    }
}

impl Field {
    fn has_occupied_cell(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        let [xs, ys, zs] = [0, 1, 2].map(|axis| cell_at(low)[axis]..=cell_at(high)[axis]);
        zs.into_iter().any(|z| {
            ys.clone().any(|y| {
                let row = OCCUPANCY_CELLS * (y + OCCUPANCY_CELLS * z);
                xs.clone().any(|x| self.occupancy.is_occupied(row + x))
            })
        })
    }

    /// Computes the view-dependent part of raw colours for composited view features and each of
    /// `directions`.
    fn view_colours_of(
        &self,
        features: &[f32; VIEW_FEATURES],
        directions: &[[f32; 3]],
    ) -> Vec<[f32; 3]> {
        const { assert!(FIRST_VIEW_FEATURE + VIEW_FEATURES == DENSITY_OUTPUTS) };
        let n = directions.len().next_multiple_of(LANES);
        let mut input = vec![0.0; VIEW_INPUTS * n];
        for (k, &direction) in directions.iter().enumerate() {
            let values = features.iter().copied().chain(spherical_harmonics(direction));
            for (row, value) in values.enumerate() {
                input[row * n + k] = value;
            }
        }
        let mut view_colour = Aligned::default();
        let view_colour = view_network(self, &input, &mut Default::default(), &mut view_colour, n);
        (0..directions.len()).map(|k| [0, 1, 2].map(|c| view_colour[c * n + k])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::architecture::Architecture;
    use crate::math::sigmoid;
    use crate::ray::{Ray, clip};
    use scene::Bounds;

    #[test]
    fn composited_point_samples_equal_a_rendered_ray() {
        let architecture = Architecture {
            max_resolution: 32,
            n_levels: 4,
            log2_hashmap_size: 10,
            march_steps: 64,
            ..Default::default()
        };
        let bounds = Bounds::cube(1.0, 0.0, 9.0);
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
        let step = field.march_step();
        let t = (0..).map(|k| (k as f32 + 0.5).mul_add(step, clipped.enter));
        let positions: Vec<[f32; 3]> =
            t.take_while(|&t| t < clipped.leave).map(|t| clipped.position(t)).collect();
        let samples = field.samples(&positions).unwrap();
        let (mut weights, mut transmittance) = (Vec::new(), 1.0f32);
        for density in &samples.densities {
            let transmitted = (-density * step).exp();
            weights.push(transmittance * (1.0 - transmitted));
            transmittance *= transmitted;
        }
        let mut features = [0.0; VIEW_FEATURES];
        for (row, weight) in samples.view_features.chunks(VIEW_FEATURES).zip(&weights) {
            features.iter_mut().zip(row).for_each(|(sum, f)| *sum += weight * f);
        }
        let view_colour = field.view_colours_of(&features, &[clipped.view, [0.0, 1.0, 0.0]]);
        let colour: [f32; 3] = std::array::from_fn(|c| {
            let weighted = samples.raw_colours.iter().zip(&weights);
            weighted.map(|(raw, weight)| weight * sigmoid(raw[c] + view_colour[0][c])).sum::<f32>()
                + transmittance
        });
        let pixel = field.render(&[ray])[0];
        assert!(
            transmittance > 0.01 && transmittance < 0.9 && view_colour[0] != view_colour[1],
            "{transmittance} {view_colour:?}"
        );
        assert!(samples.densities.contains(&0.0));
        for c in 0..3 {
            assert!((colour[c] - pixel.colour[c]).abs() < 1e-3, "{colour:?} {pixel:?}");
        }
    }

    #[test]
    fn a_box_with_an_occupied_cell_is_occupied() {
        let bounds = Bounds::cube(1.0, 0.0, 9.0);
        let mut field = Field::new(Architecture::default(), bounds, 3);
        let occupied_cell = 100 + OCCUPANCY_CELLS * (20 + OCCUPANCY_CELLS * 30);
        field.occupancy.set(|cell| match cell == occupied_cell {
            true => crate::occupancy::Cell::Thin,
            false => crate::occupancy::Cell::Empty,
        });
        let centre = |x: f32, y: f32, z: f32| [x, y, z].map(|c| (c + 0.5) / OCCUPANCY_CELLS as f32);
        assert!(field.has_occupied_cell(centre(98.0, 20.0, 28.0), centre(101.0, 23.0, 30.0)));
        assert!(!field.has_occupied_cell(centre(98.0, 20.0, 28.0), centre(101.0, 23.0, 29.0)));
        assert!(!field.has_occupied_cell(centre(101.0, 20.0, 28.0), [1.0; 3]));
    }
}
