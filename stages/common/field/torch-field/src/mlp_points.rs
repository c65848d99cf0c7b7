//! Density and colour of the paper's field at points of the unit cube, without rays: for baking.

use std::sync::{Mutex, PoisonError};

use glam::DVec3;
use radiance::{PointField, PointSamples, RenderError};
use scene::Space;
use tch::{Device, TchError, Tensor, no_grad};

use crate::composite::LAST_STEP;
use crate::mlp::Mlp;
use crate::network::encode;
use crate::ray_tensors::{matrix, to_host};

/// Number of points per pass, whose activations fit the cache; chosen by hand.
const POINTS_PER_PASS: usize = 1024;

/// Probes along each side of a box that [`PointField::may_have_density`] evaluates, corners
/// included: at every other voxel of a brick of the viewer. A surface between the probes is missed.
/// Chosen by hand.
const PROBES_PER_SIDE: usize = 5;

/// Thickness, in cube sides, of an unbounded space's outermost layer, whose density extends to
/// infinity; chosen by hand.
const END_LAYER: f64 = 1.0 / 128.0;

/// Magnitude to which raw colours are limited: beyond, eight bits differ by at most one level.
const MAX_RAW_COLOUR: f64 = 6.0;

/// The paper's field at points: its fine network on the CPU. View features are those of the
/// network's colour branch. All colour depends on the direction, so raw colours are 0.
pub struct MlpPoints {
    /// The field. A tensor may be used by one thread at a time, so each call takes handles of its
    /// own.
    field: Mutex<Mlp>,
}

impl MlpPoints {
    /// Creates the points of a field on the CPU.
    pub fn new(field: Mlp) -> Self {
        Self { field: Mutex::new(field) }
    }

    /// Calls a function with handles of the field for this thread, without gradients.
    fn with_field<T>(
        &self,
        call: impl FnOnce(&Mlp) -> Result<T, TchError>,
    ) -> Result<T, RenderError> {
        let field = self.field.lock().unwrap_or_else(PoisonError::into_inner).shallow_clone();
        no_grad(|| call(&field)).map_err(|error| RenderError::Backend(error.to_string()))
    }
}

impl PointField for MlpPoints {
    fn may_have_density(
        &self,
        low: [f32; 3],
        high: [f32; 3],
        min_density: f32,
    ) -> Result<bool, RenderError> {
        let side = PROBES_PER_SIDE;
        let mut probes = Vec::with_capacity(side * side * side);
        for i in 0..side * side * side {
            let index = [i % side, i / side % side, i / (side * side)];
            probes.push(std::array::from_fn(|axis| {
                let share = index[axis] as f32 / (side - 1) as f32;
                low[axis] + share * (high[axis] - low[axis])
            }));
        }
        Ok(self.densities(&probes)?.iter().any(|&density| density >= min_density))
    }

    fn densities(&self, points: &[[f32; 3]]) -> Result<Vec<f32>, RenderError> {
        self.with_field(|field| {
            let mut densities = Vec::with_capacity(points.len());
            for points in points.chunks(POINTS_PER_PASS) {
                densities.extend(field.densities_of(points, &field.trunk_at(points)?)?);
            }
            Ok(densities)
        })
    }

    fn samples(&self, points: &[[f32; 3]]) -> Result<PointSamples, RenderError> {
        self.with_field(|field| {
            let mut samples = PointSamples::default();
            for points in points.chunks(POINTS_PER_PASS) {
                let trunk = field.trunk_at(points)?;
                samples.densities.extend(field.densities_of(points, &trunk)?);
                samples.view_features.extend(to_host(&field.fine.feature(&trunk)?)?);
            }
            samples.raw_colours = vec![[0.0; 3]; points.len()];
            Ok(samples)
        })
    }

    fn view_colours(
        &self,
        features: &[f32],
        directions: &[Vec<[f32; 3]>],
    ) -> Result<Vec<Vec<[f32; 3]>>, RenderError> {
        self.with_field(|field| field.colours_of(features, directions))
    }
}

impl Mlp {
    /// Returns the outputs of the fine network's trunk at points of the unit cube.
    fn trunk_at(&self, points: &[[f32; 3]]) -> Result<Tensor, TchError> {
        let positions: Vec<f32> =
            points.iter().flat_map(|&point| self.network_position(point)).collect();
        let positions = matrix(&positions, [points.len() as i64, 3], Device::Cpu)?;
        self.fine.trunk(&encode(&positions, self.architecture.position_frequencies)?)
    }

    /// Converts a point of the unit cube to the networks' coordinates.
    fn network_position(&self, point: [f32; 3]) -> [f32; 3] {
        if self.bounds.space != Space::Box {
            return point.map(|c| 2.0 * c - 1.0);
        }
        let offset = self.bounds.longest_side() * DVec3::from(point.map(f64::from));
        self.frame().position_of(DVec3::from(self.bounds.min) + offset)
    }

    /// Returns densities per unit of a ray's t from the trunk's outputs. In a box this unit is the
    /// cube's side.
    fn densities_of(&self, points: &[[f32; 3]], trunk: &Tensor) -> Result<Vec<f32>, TchError> {
        let unit = match self.bounds.space {
            Space::Box => self.bounds.longest_side() / self.frame().unit,
            Space::Ndc(_) | Space::Contraction => 1.0,
        };
        let densities = self.fine.raw_density(trunk)?.f_relu()?.f_mul_scalar(unit)?;
        let mut densities = to_host(&densities)?;
        for (density, &point) in densities.iter_mut().zip(points) {
            if self.is_at_end(point) {
                *density *= LAST_STEP;
            }
        }
        Ok(densities)
    }

    /// Returns whether rays end at a point of an unbounded space, so that its density extends to
    /// infinity. In a box rays end outside of the cube.
    fn is_at_end(&self, point: [f32; 3]) -> bool {
        let point = DVec3::from(point.map(f64::from));
        match self.bounds.space {
            Space::Box => false,
            Space::Ndc(_) => point.z > 1.0 - END_LAYER,
            Space::Contraction => {
                let radius = 0.5 * self.bounds.longest_side();
                // Contracted distance of points at distance `far` (`Bounds::to_cube`).
                let end = 0.25 * (2.0 - radius / self.bounds.far.max(radius));
                point.distance(DVec3::splat(0.5)) > end - END_LAYER
            }
        }
    }

    /// Returns raw colours for rows of features, each in some directions.
    fn colours_of(
        &self,
        features: &[f32],
        directions: &[Vec<[f32; 3]>],
    ) -> Result<Vec<Vec<[f32; 3]>>, TchError> {
        let width = i64::from(self.architecture.hidden_dim);
        let features = matrix(features, [directions.len() as i64, width], Device::Cpu)?;
        let (mut rows, mut flat) = (Vec::new(), Vec::new());
        for (row, directions) in (0i64..).zip(directions) {
            rows.extend(directions.iter().map(|_| row));
            flat.extend(directions.iter().flatten());
        }
        let count = rows.len();
        let mut colours = Vec::with_capacity(count);
        let passes = rows.chunks(POINTS_PER_PASS).zip(flat.chunks(3 * POINTS_PER_PASS));
        for (rows, directions) in passes {
            let feature = features.f_index_select(0, &Tensor::f_from_slice(rows)?)?;
            let directions = matrix(directions, [rows.len() as i64, 3], Device::Cpu)?;
            let code = encode(&directions, self.architecture.direction_frequencies)?;
            let raw = self.fine.raw_colour(&feature, &code)?;
            let raw = to_host(&raw.f_clamp(-MAX_RAW_COLOUR, MAX_RAW_COLOUR)?)?;
            colours.extend_from_slice(raw.as_chunks::<3>().0);
        }
        let mut colours = colours.into_iter();
        Ok(directions.iter().map(|d| colours.by_ref().take(d.len()).collect()).collect())
    }
}

#[cfg(test)]
mod tests {
    use radiance::{Ray, clip};
    use scene::{Bounds, Frustum};
    use tch::Kind;

    use super::*;
    use crate::architecture::MlpArchitecture;
    use crate::mlp::Batch;

    fn bounds_of(space: Space) -> Bounds {
        Bounds { min: [1.0, 1.0, -2.0], max: [4.0, 3.0, 0.5], near: 0.5, far: 20.0, space }
    }

    /// Densities and colours at points along a ray equal those of the fine network in rays'
    /// coordinates, in every space.
    #[test]
    fn points_have_the_values_of_rays() {
        let pose = [[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 4.0]];
        let frustum =
            Frustum { camera_to_world: pose, min: [-0.5; 2], max: [0.5; 2], near: 2.0, far: 90.0 };
        let architecture = MlpArchitecture {
            layers: 5,
            hidden_dim: 16,
            scaled_positions: true,
            ..MlpArchitecture::default()
        };
        let direction = [0.28, 0.0, -0.96];
        let ray = Ray { origin: [2.0, 2.1, 4.0], direction, background: [1.0; 3] };
        for space in [Space::Box, Space::Ndc(frustum), Space::Contraction] {
            let bounds = bounds_of(space);
            let field = Mlp::new(architecture, bounds, 3, Device::Cpu).unwrap();
            let clipped = clip(&bounds, &ray);
            let t =
                (0..40).map(|k| clipped.enter + (clipped.leave - clipped.enter) * k as f32 / 39.0);
            let t: Vec<f32> = t.collect();
            let points: Vec<[f32; 3]> = t.iter().map(|&t| clipped.position(t)).collect();
            // Rays of the paper's field have their own unit in a box.
            let (unit, side) = (field.frame().unit, bounds.longest_side());
            let scale = if bounds.space == Space::Box { side / unit } else { 1.0 };
            let t = matrix(&t, [1, 40], Device::Cpu).unwrap() * scale;
            let batch = Batch::new(&[ray], &field).unwrap();
            let (colours, raw) = no_grad(|| {
                let positions = match &batch.maps {
                    None => {
                        t.unsqueeze(-1) * batch.direction.unsqueeze(1) + batch.origin.unsqueeze(1)
                    }
                    Some(maps) => maps.positions(&t).unwrap() * 2.0 - 1.0,
                };
                let code = encode(&positions.reshape([40, 3]), architecture.position_frequencies);
                let direction = encode(&batch.direction, architecture.direction_frequencies);
                let direction = direction.unwrap().expand([40, -1], false);
                field.fine.forward(&code.unwrap(), &direction).unwrap()
            });
            let mlp_points = MlpPoints::new(field);
            let samples = mlp_points.samples(&points).unwrap();
            let expected = to_host(&(raw.relu() * scale)).unwrap();
            assert_eq!(samples.densities, mlp_points.densities(&points).unwrap());
            assert!(expected.iter().any(|&density| density > 0.0), "{space:?}");
            // The density at a ray's end extends to infinity.
            let end = (samples.densities[39], expected[39]);
            assert!(bounds.space == Space::Box || (end.0 > 1e6) == (end.1 > 1e-4), "{end:?}");
            let inside = samples.densities.iter().zip(&expected).filter(|(found, _)| **found < 1e6);
            for (found, expected) in inside {
                assert!((found - expected).abs() < 1e-2 * expected.max(0.1), "{found} {expected}");
            }
            let directions = vec![vec![direction.map(|x| x as f32)]; 40];
            let found = mlp_points.view_colours(&samples.view_features, &directions).unwrap();
            let found: Vec<f32> = found.into_iter().flatten().flatten().collect();
            let found = Tensor::from_slice(&found).sigmoid().reshape([40, 3]);
            let error = (found - colours).abs().max().to_kind(Kind::Float).double_value(&[]);
            assert!(error < 1e-2, "{space:?}: {error}");
            let max_density = expected.iter().copied().fold(0.0, f32::max);
            assert!(!mlp_points.may_have_density([0.4; 3], [0.6; 3], 1e6).unwrap());
            assert!(mlp_points.may_have_density([0.0; 3], [1.0; 3], 0.01 * max_density).unwrap());
        }
    }
}
