//! Dead leaves: random images of shapes that hide each other. Like photographs, they contain edges
//! and patterns of all sizes (Baradad et al. 2021, "Learning to See by Looking at Noise").

use std::f32::consts::TAU;
use std::ops::Range;

use numerics::{CounterRng, uniform};
use pixels::Rgba8;

/// Samples per pixel and axis.
const SAMPLES_PER_AXIS: usize = 2;
/// Fraction of images with a white background, as photographs of single objects have.
const WHITE_FRACTION: f32 = 0.3;
/// Ranges of the number of shapes, and of the smallest radius in pixels; chosen by hand.
const SHAPES: [f32; 2] = [25.0, 250.0];
const SMALLEST_RADII: [f32; 2] = [2.0, 10.0];
/// Range of the standard deviation in pixels of the filter that blurs an image, as a lens or a
/// renderer does. Without a blur, a network makes other images too sharp (design note 051).
const DEVIATIONS: [f32; 2] = [0.3, 0.8];
/// Number of samples on each side of a pixel's centre that the filter weights.
const REACH: usize = 4;
/// Largest radius relative to the image's side.
const LARGEST_RADIUS: f32 = 0.4;
/// Number of different patterns in an image.
const PATTERNS: u64 = 6;
/// Stream of random numbers.
const LEAVES_STREAM: u64 = 340;

/// Draws the `number`-th image, a square of `side` pixels.
pub(super) fn draw(seed: u64, number: u64, side: usize) -> Rgba8 {
    let mut rng = CounterRng::new(seed, LEAVES_STREAM, number);
    let side = side * SAMPLES_PER_AXIS;
    let palette = Palette::draw(&mut rng);
    let patterns: Vec<Pattern> = (0..PATTERNS).map(|_| Pattern::draw(&palette, &mut rng)).collect();
    let mut samples = vec![[1.0; 3]; side * side];
    if rng.uniform() >= WHITE_FRACTION {
        fill(&mut samples, side, [0..side, 0..side], |x, y| Some(patterns[0].colour(x, y)));
    }
    let smallest = log_uniform(SMALLEST_RADII, &mut rng) * SAMPLES_PER_AXIS as f32;
    for _ in 0..log_uniform(SHAPES, &mut rng) as usize {
        let shape = Shape::draw([smallest, LARGEST_RADIUS * side as f32], side, &mut rng);
        let pattern = &patterns[rng.below(PATTERNS) as usize];
        let light = between([0.7, 1.1], &mut rng);
        fill(&mut samples, side, shape.bounds(side), |x, y| {
            shape.contains(x, y).then(|| pattern.colour(x, y).map(|v| light * v))
        });
    }
    filter(&samples, side, between(DEVIATIONS, &mut rng))
}

/// Colours the samples of some columns and rows for which `colour` returns a colour.
fn fill(
    samples: &mut [[f32; 3]],
    side: usize,
    [columns, rows]: [Range<usize>; 2],
    colour: impl Fn(f32, f32) -> Option<[f32; 3]>,
) {
    for (y, x) in rows.flat_map(|y| columns.clone().map(move |x| (y, x))) {
        if let Some(colour) = colour(x as f32, y as f32) {
            samples[y * side + x] = colour.map(|v| v.clamp(0.0, 1.0));
        }
    }
}

/// Computes pixels by a Gaussian filter whose deviation is given in pixels.
fn filter(samples: &[[f32; 3]], side: usize, deviation: f32) -> Rgba8 {
    let pixels = side / SAMPLES_PER_AXIS;
    let weights: [f32; 2 * REACH] = std::array::from_fn(|i| {
        let distance = (i as f32 + 0.5 - REACH as f32) / SAMPLES_PER_AXIS as f32;
        (-0.5 * (distance / deviation).powi(2)).exp()
    });
    let total: f32 = weights.iter().sum();
    let taps = |pixel: usize| {
        weights.iter().enumerate().map(move |(i, weight)| {
            let sample = (pixel * SAMPLES_PER_AXIS + SAMPLES_PER_AXIS / 2 + i).max(REACH) - REACH;
            (sample.min(side - 1), weight / total)
        })
    };
    let mut rows = vec![[0.0; 3]; side * pixels];
    for (i, pixel) in rows.iter_mut().enumerate() {
        for (column, weight) in taps(i % pixels) {
            *pixel = add(*pixel, weight, samples[i / pixels * side + column]);
        }
    }
    let mut data = Vec::with_capacity(4 * pixels * pixels);
    for (y, x) in (0..pixels).flat_map(|y| (0..pixels).map(move |x| (y, x))) {
        let columns =
            taps(y).fold([0.0; 3], |sum, (row, weight)| add(sum, weight, rows[row * pixels + x]));
        data.extend(columns.map(pixels::to_u8));
        data.push(255);
    }
    Rgba8::new(pixels, pixels, data)
}

/// Adds a weighted colour to a sum.
fn add(sum: [f32; 3], weight: f32, colour: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|c| sum[c] + weight * colour[c])
}

/// Draws a number of a range.
fn between([low, high]: [f32; 2], rng: &mut CounterRng) -> f32 {
    low + (high - low) * rng.uniform()
}

/// Draws a number of a range, with equal probability for equal ratios.
fn log_uniform([low, high]: [f32; 2], rng: &mut CounterRng) -> f32 {
    low * (high / low).powf(rng.uniform())
}

/// Colours that all patterns of an image share.
struct Palette(Vec<[f32; 3]>);

impl Palette {
    fn draw(rng: &mut CounterRng) -> Self {
        let count = 2 + rng.below(6);
        let saturation = if rng.below(2) == 0 { 1.0 } else { 0.4 };
        let (scale, offset) = (between([0.4, 1.0], rng), between([0.0, 0.2], rng));
        let colours = (0..count).map(|_| {
            let colour: [f32; 3] = std::array::from_fn(|_| rng.uniform());
            let grey = colour.iter().sum::<f32>() / 3.0;
            colour.map(|v| scale * (grey + saturation * (v - grey)) + offset)
        });
        Self(colours.collect())
    }

    /// Draws one of the colours, slightly changed.
    fn colour(&self, rng: &mut CounterRng) -> [f32; 3] {
        let colour = self.0[rng.below(self.0.len() as u64) as usize];
        colour.map(|v| v + 0.08 * rng.normal() as f32)
    }
}

/// Rotation of axes.
#[derive(Clone, Copy)]
struct Rotation {
    cosine: f32,
    sine: f32,
}

impl Rotation {
    fn draw(rng: &mut CounterRng) -> Self {
        let (sine, cosine) = between([0.0, TAU], rng).sin_cos();
        Self { cosine, sine }
    }

    fn apply(self, x: f32, y: f32) -> (f32, f32) {
        (x * self.cosine + y * self.sine, y * self.cosine - x * self.sine)
    }
}

/// Pattern of two colours, with shading across the image.
struct Pattern {
    kind: PatternKind,
    colours: [[f32; 3]; 2],
    rotation: Rotation,
    /// Period in samples.
    period: f32,
    /// Width of stripes, diameter of dots, width of joints or threshold of patches, from 0 to 1.
    duty: f32,
    /// Strength of the second colour.
    strength: f32,
    /// Decrease of brightness per sample along the image's axes.
    shading: [f32; 2],
    seed: u64,
}

#[derive(Clone, Copy)]
enum PatternKind {
    Plain,
    Stripes,
    Checks,
    Dots,
    Bricks,
    Clouds,
    Patches,
}

/// Kinds of pattern; a kind that is listed twice is drawn twice as often.
const PATTERN_KINDS: [PatternKind; 12] = [
    PatternKind::Plain,
    PatternKind::Plain,
    PatternKind::Plain,
    PatternKind::Plain,
    PatternKind::Stripes,
    PatternKind::Stripes,
    PatternKind::Checks,
    PatternKind::Dots,
    PatternKind::Bricks,
    PatternKind::Clouds,
    PatternKind::Clouds,
    PatternKind::Patches,
];

impl Pattern {
    fn draw(palette: &Palette, rng: &mut CounterRng) -> Self {
        let shading = if rng.below(5) < 3 { 0.001 } else { 0.0 };
        Self {
            kind: PATTERN_KINDS[rng.below(PATTERN_KINDS.len() as u64) as usize],
            colours: [palette.colour(rng), palette.colour(rng)],
            rotation: Rotation::draw(rng),
            period: log_uniform([6.0, 64.0], rng),
            duty: between([0.2, 0.8], rng),
            strength: between([0.3, 1.0], rng),
            shading: [shading * rng.uniform(), shading * rng.uniform()],
            seed: rng.below(1 << 32),
        }
    }

    fn colour(&self, x: f32, y: f32) -> [f32; 3] {
        let (u, v) = self.rotation.apply(x, y);
        let weight = self.strength * self.weight(u / self.period, v / self.period);
        let light = 1.0 - self.shading[0] * x - self.shading[1] * y;
        let [a, b] = self.colours;
        std::array::from_fn(|c| light * (a[c] + weight * (b[c] - a[c])))
    }

    /// Returns the second colour's weight at a position in periods.
    fn weight(&self, u: f32, v: f32) -> f32 {
        let is_second = match self.kind {
            PatternKind::Plain => false,
            PatternKind::Stripes => u.rem_euclid(1.0) < self.duty,
            PatternKind::Checks => (u.rem_euclid(1.0) < 0.5) != (v.rem_euclid(1.0) < 0.5),
            PatternKind::Dots => {
                (u.rem_euclid(1.0) - 0.5).hypot(v.rem_euclid(1.0) - 0.5) < 0.5 * self.duty + 0.05
            }
            PatternKind::Bricks => {
                let row = 2.0 * v;
                let column = u + 0.5 * row.floor().rem_euclid(2.0);
                let joint = 0.25 * self.duty;
                row.rem_euclid(1.0) > joint && column.rem_euclid(1.0) > 0.5 * joint
            }
            PatternKind::Clouds => return self.noise(u, v).clamp(0.0, 1.0),
            PatternKind::Patches => self.noise(u, v) > self.duty,
        };
        if is_second { 1.0 } else { 0.0 }
    }

    /// Returns smooth noise of five octaves around 0.5.
    fn noise(&self, u: f32, v: f32) -> f32 {
        let octaves = (0..5).map(|octave| {
            let frequency = 0.25 * (1u32 << octave) as f32;
            (self.smooth_noise(frequency * u, frequency * v, octave) - 0.5)
                * 1.2
                * 0.6f32.powi(octave as i32)
        });
        0.5 + octaves.sum::<f32>()
    }

    /// Returns values at integer positions, interpolated in between.
    fn smooth_noise(&self, u: f32, v: f32, octave: u64) -> f32 {
        let (column, row) = (u.floor(), v.floor());
        let value = |i: f32, j: f32| {
            let number = (column + i) as i64 as u64 ^ ((row + j) as i64 as u64).rotate_left(32);
            uniform(self.seed, octave, number)
        };
        let [s, t] = [u - column, v - row].map(|x| x * x * (3.0 - 2.0 * x));
        let row_at = |j| value(0.0, j) + s * (value(1.0, j) - value(0.0, j));
        row_at(0.0) + t * (row_at(1.0) - row_at(0.0))
    }
}

/// Shape in the image.
struct Shape {
    kind: ShapeKind,
    centre: [f32; 2],
    rotation: Rotation,
    radius: f32,
    /// Ratio of the axes, or of a ring's radii.
    ratio: f32,
    /// Period of a fence or grid in samples, and the fraction that its rails fill.
    period: f32,
    duty: f32,
    /// Angles and distances of a polygon's sides.
    sides: Vec<(Rotation, f32)>,
}

#[derive(Clone, Copy)]
enum ShapeKind {
    Ellipse,
    Box,
    Polygon,
    Ring,
    Fence,
    Grid,
    Bar,
}

/// Kinds of shape; a kind that is listed twice is drawn twice as often.
const SHAPE_KINDS: [ShapeKind; 12] = [
    ShapeKind::Ellipse,
    ShapeKind::Ellipse,
    ShapeKind::Ellipse,
    ShapeKind::Box,
    ShapeKind::Box,
    ShapeKind::Box,
    ShapeKind::Polygon,
    ShapeKind::Polygon,
    ShapeKind::Ring,
    ShapeKind::Fence,
    ShapeKind::Grid,
    ShapeKind::Bar,
];

impl Shape {
    /// Draws a shape. The density of radii r is proportional to r⁻³, as in images that look the
    /// same at any size.
    fn draw([smallest, largest]: [f32; 2], side: usize, rng: &mut CounterRng) -> Self {
        let [a, b] = [smallest.powi(-2), largest.powi(-2)];
        let kind = SHAPE_KINDS[rng.below(SHAPE_KINDS.len() as u64) as usize];
        let corners = if matches!(kind, ShapeKind::Polygon) { 3 + rng.below(4) } else { 0 };
        let sides = (0..corners).map(|i| {
            let turn = (i as f32 + 0.6 * rng.uniform()) / corners as f32;
            let (sine, cosine) = (TAU * turn).sin_cos();
            (Rotation { cosine, sine }, between([0.4, 1.0], rng))
        });
        let sides = sides.collect();
        let radius = (a + rng.uniform() * (b - a)).powf(-0.5);
        Self {
            kind,
            centre: [rng.uniform(), rng.uniform()].map(|v| v * side as f32),
            rotation: Rotation::draw(rng),
            radius: if matches!(kind, ShapeKind::Bar) { 3.0 * radius } else { radius },
            ratio: match kind {
                ShapeKind::Ring => between([0.6, 0.95], rng),
                ShapeKind::Bar => log_uniform([1.5, 16.0], rng) / (6.0 * radius),
                _ => between([0.2, 1.0], rng),
            },
            period: log_uniform([8.0, 40.0], rng),
            duty: between([0.1, 0.4], rng),
            sides,
        }
    }

    /// Returns the columns and rows that contain the shape.
    fn bounds(&self, side: usize) -> [Range<usize>; 2] {
        self.centre.map(|centre| {
            let reach = 1.5 * self.radius;
            (centre - reach).max(0.0) as usize..((centre + reach) as usize + 1).min(side)
        })
    }

    fn contains(&self, x: f32, y: f32) -> bool {
        let [dx, dy] = [x - self.centre[0], y - self.centre[1]];
        // A square's corners are the farthest points.
        if dx * dx + dy * dy > 2.0 * self.radius * self.radius {
            return false;
        }
        let (p, q) = self.rotation.apply(dx, dy);
        let (u, v) = (p / self.radius, q / self.radius);
        let is_on_rail = |s: f32| (s / self.period).rem_euclid(1.0) < self.duty;
        let is_within = |ratio: f32| u.abs() <= 1.0 && v.abs() <= ratio;
        match self.kind {
            ShapeKind::Ellipse => u.hypot(v / self.ratio) <= 1.0,
            ShapeKind::Box | ShapeKind::Bar => is_within(self.ratio),
            ShapeKind::Polygon => {
                self.sides.iter().all(|(side, distance)| side.apply(u, v).0 <= *distance)
                    && u.hypot(v) <= 1.2
            }
            ShapeKind::Ring => (self.ratio..=1.0).contains(&u.hypot(v)),
            ShapeKind::Fence => is_within(1.0) && is_on_rail(p),
            ShapeKind::Grid => is_within(1.0) && (is_on_rail(p) || is_on_rail(q)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_repeat_and_differ() {
        let images: Vec<Rgba8> = (0..8).map(|number| draw(1, number, 64)).collect();
        for (number, image) in images.iter().enumerate() {
            assert_eq!((image.width, image.height), (64, 64));
            assert_eq!(image.data, draw(1, number as u64, 64).data);
            let others = images.iter().filter(|other| other.data == image.data);
            assert_eq!(others.count(), 1, "image {number} is drawn twice");
            let levels = || image.data.chunks_exact(4).map(|pixel| pixel[1]);
            let (low, high) = (levels().min().unwrap(), levels().max().unwrap());
            assert!(high - low > 50, "image {number} is flat: {low} to {high}");
        }
        assert_ne!(draw(2, 0, 64).data, images[0].data);
    }
}
