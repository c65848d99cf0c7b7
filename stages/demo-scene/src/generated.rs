//! Random scenes that teach networks: shapes, textures and colours of many kinds and sizes.

use std::f64::consts::TAU;

use glam::{DMat3, DQuat, DVec3};
use numerics::CounterRng;

use crate::material::Material;
use crate::pattern::{Pattern, PatternedMaterial};
use crate::world::{Object, Shape};

/// Radius of the ball that holds all objects, in scene units.
const SCENE_RADIUS: f64 = 1.2;
/// Smallest and largest radius of an object.
const RADII: [f64; 2] = [0.06, 0.65];

/// Largest number of shapes in a row of a lattice.
const MAX_ROW: usize = 6;
/// Stream of random numbers of generated scenes.
const SCENES: u64 = 501;

/// Random choices of a scene.
pub(crate) struct SceneDraws(CounterRng);

impl SceneDraws {
    /// Starts the choices of a seed.
    pub(crate) fn new(seed: u32) -> Self {
        Self(CounterRng::new(u64::from(seed), SCENES, 0))
    }

    /// Draws a number from 0 to 1.
    fn uniform(&mut self) -> f64 {
        f64::from(self.0.uniform())
    }

    /// Draws a number in a range.
    fn between(&mut self, [low, high]: [f64; 2]) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Draws a number in a range whose logarithm is uniform.
    fn scale(&mut self, [low, high]: [f64; 2]) -> f64 {
        low * libm::pow(high / low, self.uniform())
    }

    /// Draws an index below `count`.
    fn below(&mut self, count: usize) -> usize {
        self.0.below(count as u64) as usize
    }

    /// Draws one of some values.
    fn choose<T: Copy>(&mut self, values: &[T]) -> T {
        values[self.below(values.len())]
    }

    /// Draws whether an event of a probability happens.
    fn happens(&mut self, probability: f64) -> bool {
        self.uniform() < probability
    }

    /// Draws a direction.
    fn direction(&mut self) -> DVec3 {
        let (z, angle) = (self.between([-1.0, 1.0]), TAU * self.uniform());
        let level = (1.0 - z * z).sqrt();
        DVec3::new(level * libm::cos(angle), level * libm::sin(angle), z)
    }

    /// Draws a rotation, around the vertical or around any axis.
    fn rotation(&mut self) -> DMat3 {
        let angle = TAU * self.uniform();
        let axis = if self.happens(0.5) { DVec3::Z } else { self.direction() };
        let (sin, cos) = (libm::sin(0.5 * angle), libm::cos(0.5 * angle));
        DMat3::from_quat(DQuat::from_xyzw(sin * axis.x, sin * axis.y, sin * axis.z, cos))
    }

    /// Draws an albedo in linear light.
    fn colour(&mut self) -> DVec3 {
        let light = self.uniform() * self.uniform().sqrt();
        let grey = DVec3::splat(0.02 + 0.85 * light);
        let hue = DVec3::new(self.uniform(), self.uniform(), self.uniform());
        let bright = 0.02 + 0.85 * hue * (0.3 + 0.7 * self.uniform());
        grey.lerp(bright, if self.happens(0.3) { 0.0 } else { self.uniform().sqrt() })
    }

    /// Draws a material in colours of a palette.
    fn material(&mut self, palette: &[DVec3]) -> Material {
        let patterns = [
            Pattern::Plain,
            Pattern::Plain,
            Pattern::Stripes,
            Pattern::Checks,
            Pattern::Cells,
            Pattern::Marks,
            Pattern::Leaves,
            Pattern::Leaves,
            Pattern::Clouds,
        ];
        let pattern = self.choose(&patterns);
        let colours = [0; 3].map(|_| self.choose(palette));
        let is_glossy = self.happens(0.4);
        Material::Patterned(PatternedMaterial {
            pattern,
            colours,
            direction: self.direction(),
            frequency: self.scale([1.0, 30.0]),
            seed: (self.uniform() * 1e6) as u32,
            specular: if is_glossy { self.uniform() } else { 0.03 },
            exponent: if is_glossy { self.scale([10.0, 200.0]) as i32 } else { 12 },
            mirror: if is_glossy && self.happens(0.3) { 0.25 * self.uniform() } else { 0.0 },
        })
    }

    /// Draws a shape of about a radius.
    fn shape(&mut self, radius: f64) -> Shape {
        match self.below(8) {
            0 | 1 => Shape::Ball(radius),
            2..=4 => {
                let half = [0; 3].map(|_| radius * self.scale([0.15, 1.0]));
                Shape::Block(DVec3::from_array(half) * 0.8)
            }
            5 => Shape::Drum(radius * self.scale([0.2, 0.9]), radius * self.scale([0.05, 0.9])),
            6 => Shape::Block(DVec3::new(0.8, 0.6, self.between([0.01, 0.05])) * radius),
            _ => {
                let half = radius * self.direction();
                Shape::Rod(-half, half, radius * self.scale([0.02, 0.2]))
            }
        }
    }

    /// Draws a single object, bars, or a lattice, inside a ball.
    fn group(&mut self, centre: DVec3, radius: f64, palette: &[DVec3]) -> Vec<Object> {
        let to_local = self.rotation();
        let material = self.material(palette);
        if radius < 0.12 || self.happens(0.45) {
            let shape = self.shape(radius);
            return vec![Object { shape, centre, to_local, material }];
        }
        if self.happens(0.35) {
            return self.bars(centre, radius, to_local, material);
        }
        self.lattice(centre, radius, to_local, palette)
    }

    /// Draws equal small shapes in rows, on a plate or free.
    fn lattice(
        &mut self,
        centre: DVec3,
        radius: f64,
        to_local: DMat3,
        palette: &[DVec3],
    ) -> Vec<Object> {
        let pitch = radius / 5.5;
        let size = pitch * self.between([0.3, 0.8]);
        let (small, common) = (self.shape(size), self.material(palette));
        let counts = [MAX_ROW, MAX_ROW, MAX_ROW / 2].map(|most| 1 + self.below(most));
        let is_mixed = self.happens(0.5);
        let mut objects = Vec::new();
        for i in 0..counts.iter().product() {
            let cell = [i % counts[0], i / counts[0] % counts[1], i / (counts[0] * counts[1])];
            let from_middle = [0, 1, 2].map(|k| cell[k] as f64 - 0.5 * (counts[k] as f64 - 1.0));
            let offset = pitch * (to_local.transpose() * DVec3::from_array(from_middle));
            let material = if is_mixed { self.material(palette) } else { common };
            objects.push(Object { shape: small, centre: centre + offset, to_local, material });
        }
        if self.happens(0.5) {
            let shape = Shape::Block(DVec3::new(0.75 * radius, 0.6 * radius, 0.3 * pitch));
            objects.push(Object { shape, centre, to_local, material: self.material(palette) });
        }
        objects
    }

    /// Draws a fence or grid of thin rods.
    fn bars(
        &mut self,
        centre: DVec3,
        radius: f64,
        to_local: DMat3,
        material: Material,
    ) -> Vec<Object> {
        let side = 0.7 * radius;
        let count = 2 + self.below(9);
        let thickness = side / count as f64 * self.scale([0.04, 0.5]);
        let is_crossed = self.happens(0.5);
        let mut objects = Vec::new();
        for k in 0..count {
            let at = side * (2.0 * (k as f64 + 0.5) / count as f64 - 1.0);
            let [a, b] = [-side, side].map(|end| DVec3::new(at, end, 0.0));
            let mut ends = vec![[a, b]];
            if is_crossed {
                ends.push([a, b].map(|p| DVec3::new(p.y, p.x, thickness)));
            }
            for [a, b] in ends {
                let shape = Shape::Rod(a, b, thickness);
                objects.push(Object { shape, centre, to_local, material });
            }
        }
        objects
    }

    /// Draws the groups of objects of a scene.
    pub(crate) fn groups(&mut self) -> Vec<Vec<Object>> {
        let palette: Vec<DVec3> = (0..3 + self.below(8)).map(|_| self.colour()).collect();
        let count = 14 + self.below(26);
        (0..count)
            .map(|_| {
                let radius = self.scale(RADII);
                let centre =
                    self.direction() * ((SCENE_RADIUS - radius) * libm::cbrt(self.uniform()));
                self.group(centre, radius, &palette)
            })
            .collect()
    }
}
