use std::f64::consts::TAU;

use glam::{DMat3, DVec3};

use crate::material::Material;

/// A shape in its own space.
#[derive(Clone, Copy, Debug)]
enum Shape {
    /// Ball of a radius.
    Ball(f64),
    /// Box of half sides.
    Block(DVec3),
    /// Upright cylinder: radius, half height.
    Drum(f64, f64),
    /// Rod between two points, of a radius, with round ends.
    Rod(DVec3, DVec3, f64),
}

/// A shape with a place and a look.
#[derive(Clone, Copy, Debug)]
struct Thing {
    shape: Shape,
    centre: DVec3,
    /// World to the thing's own axes.
    to_local: DMat3,
    material: Material,
}

impl Thing {
    /// One whose axes are the world's.
    fn new(shape: Shape, centre: DVec3, material: Material) -> Self {
        Self { shape, centre, to_local: DMat3::IDENTITY, material }
    }

    /// Distance and normal of the first surface that a ray meets; the normal in the thing's own
    /// space.
    fn intersect(&self, origin: DVec3, direction: DVec3) -> Option<(f64, DVec3)> {
        let local_origin = self.to_local * (origin - self.centre);
        self.shape.intersect(local_origin, self.to_local * direction)
    }

    fn bounding_ball(&self) -> BoundingBall {
        let (centre, radius) = self.shape.bounding_ball();
        BoundingBall { centre: self.centre + self.to_local.transpose() * centre, radius }
    }
}

/// A ball around things, so that most rays pass them at the cost of one test.
#[derive(Clone, Copy, Debug)]
struct BoundingBall {
    centre: DVec3,
    radius: f64,
}

/// Things inside one bounding ball, each inside its own.
#[derive(Clone, Debug)]
struct Cluster {
    ball: BoundingBall,
    things: Vec<Thing>,
    balls: Vec<BoundingBall>,
}

/// Where a ray meets a surface.
pub(crate) struct Hit {
    /// Distance along the ray.
    pub(crate) t: f64,
    /// Unit normal in world space.
    pub(crate) normal: DVec3,
    /// Point in the thing's own space, about 1 in size: what textures use.
    pub(crate) local: DVec3,
    /// Normal in the thing's own space.
    pub(crate) local_normal: DVec3,
    pub(crate) material: Material,
}

/// The scene: things on a round base, inside a ball of radius 1.35 around the origin.
#[derive(Clone, Debug)]
pub struct World {
    groups: Vec<Cluster>,
    pub(crate) seed: u32,
    /// Whether there is a sky, which every ray meets that meets nothing else.
    pub(crate) sky: bool,
}

/// Top of the base.
const FLOOR: f64 = -0.5;

impl World {
    /// The scene of a seed: the seed turns the arrangement, moves things between places and changes
    /// textures.
    pub fn new(seed: u32) -> Self {
        let turn = f64::from(seed % 360) * 2.4;
        let angle = |slot: u32| turn + f64::from((slot * (1 + seed % 4) + seed) % 5) * TAU / 5.0;
        let place = |slot, distance: f64| distance * towards(angle(slot)) + DVec3::Z * FLOOR;
        let mut groups = vec![
            base(),
            crate_at(place(0, 0.62), 0.5 + turn),
            group(vec![Thing::new(
                Shape::Ball(0.3),
                place(1, 0.62) + DVec3::Z * 0.3,
                Material::Ball,
            )]),
            cage(place(2, 0.64)),
        ];
        groups.extend(spring(place(3, 0.60)));
        groups.push(sign(place(4, 0.66)));
        Self { groups, seed, sky: false }
    }

    /// The same things with a world around them that doesn't end: ground, towers far away, sky.
    #[must_use]
    pub fn with_backdrop(mut self) -> Self {
        let ground = FLOOR - 0.2;
        self.groups.push(group(vec![Thing::new(
            Shape::Drum(60.0, 0.05),
            DVec3::Z * (ground - 0.05),
            Material::Tiles,
        )]));
        for k in 0..9u32 {
            // Scattered by the golden angle, between 7 and 20 units away.
            let (angle, distance) = (f64::from(k + self.seed % 9) * 2.4, 7.0 + 1.6 * f64::from(k));
            let half = DVec3::new(0.7, 0.9, 1.2 + 0.35 * f64::from(k % 4));
            let foot = distance * towards(angle) + DVec3::Z * ground;
            self.groups.push(group(vec![Thing::new(
                Shape::Block(half),
                foot + DVec3::Z * half.z,
                Material::Crate,
            )]));
        }
        self.sky = true;
        self
    }

    /// Distance from a point to the nearest surface, below 0 inside of things. Geometry made of the
    /// scene's images is measured by it.
    pub fn distance(&self, point: DVec3) -> f64 {
        let things = self.groups.iter().flat_map(|group| &group.things);
        let to = |thing: &Thing| thing.shape.distance(thing.to_local * (point - thing.centre));
        things.map(to).fold(f64::INFINITY, f64::min)
    }

    /// The first surface that a ray meets: where, and its unit normal, outwards. The direction has
    /// unit length.
    pub fn surface(&self, origin: DVec3, direction: DVec3) -> Option<(DVec3, DVec3)> {
        self.first_hit(origin, direction).map(|hit| (origin + hit.t * direction, hit.normal))
    }

    /// The first surface along a ray, beyond a tiny distance.
    pub(crate) fn first_hit(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let mut best: Option<(f64, &Thing, DVec3)> = None;
        for thing in self.candidates(origin, direction) {
            if let Some((t, normal)) = thing.intersect(origin, direction)
                && best.as_ref().is_none_or(|(nearest, ..)| t < *nearest)
            {
                best = Some((t, thing, normal));
            }
        }
        best.map(|(t, thing, local_normal)| {
            let size = thing.shape.half_size();
            Hit {
                t,
                normal: thing.to_local.transpose() * local_normal,
                local: thing.to_local * (origin + t * direction - thing.centre) / size,
                local_normal,
                material: thing.material,
            }
        })
    }

    /// Whether a ray meets any surface, beyond a tiny distance.
    pub(crate) fn is_met(&self, origin: DVec3, direction: DVec3) -> bool {
        self.candidates(origin, direction).any(|thing| thing.intersect(origin, direction).is_some())
    }

    /// The things that a ray may meet, by their bounding balls.
    fn candidates(&self, origin: DVec3, direction: DVec3) -> impl Iterator<Item = &Thing> {
        let groups = self.groups.iter().filter(move |group| group.ball.may_meet(origin, direction));
        groups
            .flat_map(|group| group.things.iter().zip(&group.balls))
            .filter(move |(_, ball)| ball.may_meet(origin, direction))
            .map(|(thing, _)| thing)
    }
}

/// The horizontal direction at an angle, of unit length.
fn towards(angle: f64) -> DVec3 {
    DVec3::new(libm::cos(angle), libm::sin(angle), 0.0)
}

/// World to the axes of a thing that is turned around the vertical.
fn turned(angle: f64) -> DMat3 {
    DMat3::from_cols(
        DVec3::new(libm::cos(angle), -libm::sin(angle), 0.0),
        DVec3::new(libm::sin(angle), libm::cos(angle), 0.0),
        DVec3::Z,
    )
}

/// The round base that all stands on.
fn base() -> Cluster {
    let centre = DVec3::new(0.0, 0.0, FLOOR - 0.06);
    group(vec![Thing::new(Shape::Drum(1.1, 0.06), centre, Material::Tiles)])
}

/// A printed crate.
fn crate_at(foot: DVec3, angle: f64) -> Cluster {
    let half = 0.26;
    let block =
        Thing::new(Shape::Block(DVec3::splat(half)), foot + DVec3::Z * half, Material::Crate);
    group(vec![Thing { to_local: turned(angle), ..block }])
}

/// A cage of rods around a striped ball.
fn cage(foot: DVec3) -> Cluster {
    let mut things = vec![Thing::new(Shape::Ball(0.17), foot + DVec3::Z * 0.36, Material::Stripes)];
    let on_circle = |k: usize, n: usize| 0.27 * towards(k as f64 / n as f64 * TAU);
    for k in 0..12 {
        let p = on_circle(k, 12);
        things.push(Thing::new(Shape::Rod(p, p + DVec3::Z * 0.7, 0.011), foot, Material::Rod));
    }
    for height in [0.02, 0.36, 0.7] {
        for k in 0..20 {
            let [a, b] = [k, k + 1].map(|k| on_circle(k, 20) + DVec3::Z * height);
            things.push(Thing::new(Shape::Rod(a, b, 0.013), foot, Material::Rod));
        }
    }
    group(things)
}

/// A copper spring, in pieces short enough for tight bounding balls.
fn spring(foot: DVec3) -> Vec<Cluster> {
    const PIECES: usize = 80;
    let point = |k: usize| along_spring(k as f64 / PIECES as f64);
    let rods: Vec<Thing> = (0..PIECES)
        .map(|k| Thing::new(Shape::Rod(point(k), point(k + 1), 0.018), foot, Material::Copper))
        .collect();
    rods.chunks(16).map(|piece| group(piece.to_vec())).collect()
}

/// The point of a spring's wire at a share of its length.
fn along_spring(share: f64) -> DVec3 {
    const TURNS: f64 = 5.0;
    let radius = 0.20 - 0.08 * share;
    radius * towards(share * TURNS * TAU) + DVec3::Z * (0.02 + 0.95 * share)
}

/// A sign on a thin post.
fn sign(foot: DVec3) -> Cluster {
    let facing = libm::atan2(foot.y, foot.x) + std::f64::consts::FRAC_PI_2;
    let post = Shape::Rod(DVec3::ZERO, DVec3::Z * 0.5, 0.014);
    let board = Shape::Block(DVec3::new(0.27, 0.010, 0.19));
    let board = Thing::new(board, foot + DVec3::Z * 0.62, Material::Sign);
    group(vec![Thing::new(post, foot, Material::Rod), Thing { to_local: turned(facing), ..board }])
}

fn group(things: Vec<Thing>) -> Cluster {
    let mut balls: Vec<BoundingBall> = things.iter().map(Thing::bounding_ball).collect();
    let centre = balls.iter().map(|ball| ball.centre).sum::<DVec3>() / balls.len() as f64;
    let reach = |ball: &BoundingBall| (ball.centre - centre).length() + ball.radius;
    let radius = balls.iter().map(reach).fold(0.0, f64::max);
    // A thing's ball is a little larger, so that rounding loses no hit. The cluster's ball isn't: a
    // larger one would change images.
    balls.iter_mut().for_each(|ball| ball.radius += ROUNDING);
    Cluster { ball: BoundingBall { centre, radius }, things, balls }
}

impl BoundingBall {
    fn may_meet(&self, origin: DVec3, direction: DVec3) -> bool {
        let to = self.centre - origin;
        let along = to.dot(direction);
        let beside = to.length_squared() - along * along;
        let r2 = self.radius * self.radius;
        beside < r2 && (along > 0.0 || to.length_squared() < r2)
    }
}

/// Above the rounding errors of distances in the scene.
const ROUNDING: f64 = 1e-6;
/// Surfaces nearer than this are the one the ray starts on.
const EPSILON: f64 = 1e-6;

fn quadratic(a: f64, b: f64, c: f64) -> Option<(f64, f64)> {
    // a t² + 2 b t + c = 0
    let under = b * b - a * c;
    (under >= 0.0 && a > 0.0).then(|| ((-b - under.sqrt()) / a, (-b + under.sqrt()) / a))
}

impl Shape {
    fn half_size(self) -> DVec3 {
        match self {
            Self::Ball(r) => DVec3::splat(r),
            Self::Block(half) => half,
            Self::Drum(r, _) => DVec3::splat(r),
            Self::Rod(..) => DVec3::ONE,
        }
    }

    fn bounding_ball(self) -> (DVec3, f64) {
        match self {
            Self::Ball(r) => (DVec3::ZERO, r),
            Self::Block(half) => (DVec3::ZERO, half.length()),
            Self::Drum(r, h) => (DVec3::ZERO, (r * r + h * h).sqrt()),
            Self::Rod(a, b, r) => (0.5 * (a + b), 0.5 * (b - a).length() + r),
        }
    }

    /// Distance from the surface, below 0 inside, in the shape's own space.
    fn distance(self, p: DVec3) -> f64 {
        match self {
            Self::Ball(r) => p.length() - r,
            Self::Block(half) => outside(p.abs() - half),
            Self::Drum(r, h) => {
                let beside = libm::sqrt(p.x * p.x + p.y * p.y) - r;
                // The same along the two directions that a drum has.
                outside(DVec3::new(beside, p.z.abs() - h, f64::NEG_INFINITY))
            }
            Self::Rod(a, b, r) => {
                let (axis, from) = (b - a, p - a);
                let share = (from.dot(axis) / axis.length_squared()).clamp(0.0, 1.0);
                (from - share * axis).length() - r
            }
        }
    }

    /// Distance and normal of the first surface, in the shape's own space.
    fn intersect(self, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
        match self {
            Self::Ball(r) => intersect_ball(r, o, d),
            Self::Block(half) => intersect_block(half, o, d),
            Self::Drum(r, h) => intersect_drum(r, h, o, d),
            Self::Rod(a, b, r) => intersect_rod([a, b], r, o, d),
        }
    }
}

/// Distance from what ends at 0 along each axis, by how far a point lies beyond that.
fn outside(beyond: DVec3) -> f64 {
    beyond.max(DVec3::ZERO).length() + beyond.max_element().min(0.0)
}

fn intersect_ball(r: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let (near, far) = quadratic(d.length_squared(), o.dot(d), o.length_squared() - r * r)?;
    let t = if near > EPSILON { near } else { far };
    (t > EPSILON).then(|| (t, (o + t * d) / r))
}

fn intersect_block(half: DVec3, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let inverse = d.recip();
    let (a, b) = ((-half - o) * inverse, (half - o) * inverse);
    let (low, high) = (a.min(b), a.max(b));
    let (near, far) = (low.max_element(), high.min_element());
    let t = if near > EPSILON { near } else { far };
    if near > far || t <= EPSILON {
        return None;
    }
    let p = (o + t * d) / half;
    let axis = if p.x.abs() >= p.y.abs().max(p.z.abs()) {
        DVec3::X
    } else if p.y.abs() >= p.z.abs() {
        DVec3::Y
    } else {
        DVec3::Z
    };
    Some((t, axis * p.dot(axis).signum()))
}

fn intersect_drum(r: f64, h: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let mut nearest = Nearest::default();
    let roots =
        quadratic(d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - r * r);
    for t in roots.into_iter().flat_map(|(near, far)| [near, far]) {
        let p = o + t * d;
        if p.z.abs() <= h {
            nearest.offer(t, DVec3::new(p.x / r, p.y / r, 0.0));
        }
    }
    for side in [-1.0, 1.0] {
        let t = (side * h - o.z) / d.z;
        let p = o + t * d;
        if t.is_finite() && p.x * p.x + p.y * p.y <= r * r {
            nearest.offer(t, DVec3::Z * side);
        }
    }
    nearest.0
}

fn intersect_rod([a, b]: [DVec3; 2], r: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let axis = b - a;
    let (length2, od) = (axis.length_squared(), o - a);
    let (along_d, along_o) = (axis.dot(d), axis.dot(od));
    let mut nearest = Nearest::default();
    let roots = quadratic(
        length2 * d.length_squared() - along_d * along_d,
        length2 * od.dot(d) - along_o * along_d,
        length2 * (od.length_squared() - r * r) - along_o * along_o,
    );
    for t in roots.into_iter().flat_map(|(near, far)| [near, far]) {
        let share = (along_o + t * along_d) / length2;
        if (0.0..=1.0).contains(&share) {
            nearest.offer(t, (od + t * d - share * axis) / r);
        }
    }
    for end in [a, b] {
        if let Some((t, normal)) = intersect_ball(r, o - end, d) {
            nearest.offer(t, normal);
        }
    }
    nearest.0
}

/// The nearest surface of those offered: distance and normal.
#[derive(Default)]
struct Nearest(Option<(f64, DVec3)>);

impl Nearest {
    fn offer(&mut self, t: f64, normal: DVec3) {
        if t > EPSILON && self.0.is_none_or(|(nearest, _)| t < nearest) {
            self.0 = Some((t, normal));
        }
    }
}
